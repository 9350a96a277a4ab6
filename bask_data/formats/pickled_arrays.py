"""What stands for NumPy's functions in pickles of strangers: arrays of numbers, checked and as large as the file says.

`pickles` reads the pickles; nothing of NumPy's own unpickling is used, which trusts what a file claims.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy import ndarray

NUMPY = ("numpy.core", "numpy._core")
"""Where NumPy keeps what its pickles name, before and since version 2."""


class Refused(Exception):
    """The pickle asks for something that is not plain data."""


@dataclass
class DataType:
    """A NumPy type of numbers: a kind and a size, and the byte order, which follows as its state."""

    code: str
    order: str = "="

    @property
    def dtype(self) -> np.dtype:
        return np.dtype(self.order.replace("|", "=") + self.code)


@dataclass
class PendingArray:
    """A NumPy array whose content follows as its state; `places` are those in the memo."""

    places: list[int] = field(default_factory=list)


def _data_type(code: Any, *_: Any) -> DataType:
    if not isinstance(code, str) or not re.fullmatch(r"[<>|=]?([biuf][1248]|\?)", code):
        raise Refused("an array of objects" if code in ("O", "O8", "|O") else "an array of something else than numbers")
    return DataType(code.lstrip("<>|="), code[0] if code[0] in "<>|=" else "=")


def _reconstructed(*_: Any) -> PendingArray:
    return PendingArray()


def _scalar(data_type: Any, content: Any) -> Any:
    return array_of(content, data_type, (), "C").item()


def _from_buffer(content: Any, data_type: Any, shape: Any, order: Any) -> ndarray:
    return array_of(content, data_type, shape, order)


def _no_bytes() -> bytes:
    """How protocols before 3 write no bytes."""
    return b""


def _bytes(text: Any, encoding: Any) -> bytes:
    """How protocols before 3 write bytes."""
    if not isinstance(text, str) or encoding != "latin1":
        raise Refused("bytes in an unusual encoding")
    return text.encode("latin1")


def array_of(content: Any, data_type: Any, shape: Any, order: Any) -> ndarray:
    """An array of numbers from its bytes; `Refused` if any of the arguments, which a file states, is something else."""
    if isinstance(content, list) or not isinstance(data_type, DataType):
        raise Refused("an array of objects")
    if not isinstance(content, bytes | bytearray) or not isinstance(shape, tuple) or order not in ("C", "F"):
        raise Refused("an array without content")
    if not all(type(n) is int and n >= 0 for n in shape):
        raise Refused("an array of impossible shape")
    if math.prod(shape) * data_type.dtype.itemsize != len(content):
        raise Refused("an array whose content is of another size")
    return np.frombuffer(content, data_type.dtype).reshape(shape, order=order)


CALLS: dict[str, Callable[..., Any]] = {
    "numpy.dtype": _data_type,
    "_codecs.encode": _bytes,
    "__builtin__.bytes": _no_bytes,
    **{f"{numpy}.multiarray._reconstruct": _reconstructed for numpy in NUMPY},
    **{f"{numpy}.multiarray.scalar": _scalar for numpy in NUMPY},
    **{f"{numpy}.numeric._frombuffer": _from_buffer for numpy in NUMPY},
}
"""What stands for the functions that pickles of arrays name."""
