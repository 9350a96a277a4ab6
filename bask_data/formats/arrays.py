"""NumPy's files, bounded before their content is read, and never run."""

from __future__ import annotations

from pathlib import Path
from tokenize import TokenError

import numpy as np
from numpy import ndarray

from bask_data.errors import BadData
from bask_data.formats.files import read_head

MAX_HEADER_CHARACTERS = 10_000
"""Longest header of a .npy file that is parsed; NumPy's own bound."""

NPY_SIGNATURE = b"\x93NUMPY"


def read_npy(path: Path, most: int) -> ndarray:
    """The array of numbers in a `.npy` file, mapped into memory: what is not looked at is not read.

    Args:
        most: numbers in the array that are accepted.

    Raises:
        BadData: it is no such file, holds anything but numbers, is cut short, or is larger.
    """
    try:
        if read_head(path, len(NPY_SIGNATURE)) != NPY_SIGNATURE:
            raise ValueError("another kind of file")
        array = np.load(path, mmap_mode="r", allow_pickle=False, max_header_size=MAX_HEADER_CHARACTERS)
        if array.dtype.kind not in "fiu":
            raise ValueError(f"values of {array.dtype}")
        if array.size > most:
            raise ValueError(f"{array.shape}, more than {most} numbers")
    except (
        ValueError,
        TypeError,
        SyntaxError,
        TokenError,
        EOFError,
        RecursionError,
        MemoryError,
        OverflowError,
    ) as error:
        raise BadData(
            path,
            "array",
            expected="numbers saved by numpy.save",
            got=(str(error) or repr(error)).splitlines()[0][:200],
            fix="save the array with numpy.save(FILE, array); Python objects are not read.",
        ) from error
    return array
