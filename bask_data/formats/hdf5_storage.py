"""Where an HDF5 data set's values lie and how they are packed: refused unless in the file itself and within its chunks."""

from __future__ import annotations

import math
import zlib
from contextlib import suppress
from importlib import import_module
from itertools import product
from pathlib import Path
from typing import Any

from bask_data.errors import BadData

DEFLATE = 1
"""HDF5's number of the filter gzip."""

MAX_STORED_BYTES = 2**20
"""Stored size above which a deflated chunk is unpacked against a limit first, bytes: 1 MB can become 1 GB, and HDF5
allocates as much as comes out, not as much as the chunk declares."""

FILTERS = {DEFLATE: "gzip", 2: "shuffle", 3: "fletcher32", 4: "szip", 5: "nbit", 6: "scaleoffset", 32000: "lzf"}
"""Filters that HDF5 and h5py bring with them, by number."""


def check_storage(h5py: Any, path: Path, place: str, dataset: Any) -> None:
    """Refuse values that are not in this file, or that no installed filter decodes."""
    made = dataset.id.get_create_plist()
    if made.get_layout() == h5py.h5d.VIRTUAL or made.get_external_count():
        got = "external storage" if made.get_external_count() else "a virtual data set"
        fix = "copy the content into one file with h5py: new[place] = old[place][...]."
        raise BadData(path, place, expected="values stored in this file", got=got, fix=fix)
    filters = filters_of(dataset)
    repeated = [number for number in filters if filters.count(number) > 1]
    if repeated:
        raise BadData(path, place, expected="each filter once", got=f"filters {filters}")
    for number in filters:
        if number not in FILTERS and not h5py.h5z.filter_avail(number):
            # Most plug-ins come with this package, which registers them when it is imported.
            with suppress(ImportError):
                import_module("hdf5plugin")
        if not h5py.h5z.filter_avail(number):
            got = f"filter {number} {FILTERS.get(number, '')}".strip()
            fix = "pip install hdf5plugin, or rewrite the file: h5repack -f GZIP=4 OLD NEW."
            raise BadData(path, place, expected="an HDF5 filter that is installed", got=got, fix=fix)


def filters_of(dataset: Any) -> list[int]:
    """Numbers of the filters that a data set's chunks go through when they are written."""
    made = dataset.id.get_create_plist()
    return [made.get_filter(i)[0] for i in range(made.get_nfilters())]


def check_chunks(path: Path, place: str, dataset: Any, rows: slice | tuple[()]) -> None:
    """Refuse deflated chunks that unpack to more than they declare."""
    n_declared = math.prod(dataset.chunks) * dataset.dtype.itemsize
    n_rows = dataset.shape[0]
    first, end, _ = rows.indices(n_rows) if isinstance(rows, slice) else (0, n_rows, 1)
    axes = (range(first, end), *(range(n) for n in dataset.shape[1:]))
    for corner in product(*(axis[::step] for axis, step in zip(axes, dataset.chunks, strict=True))):
        begin = tuple(at - at % step for at, step in zip(corner, dataset.chunks, strict=True))
        if dataset.id.get_chunk_info_by_coord(begin).size <= MAX_STORED_BYTES:
            continue
        skipped, stored = dataset.id.read_direct_chunk(begin)
        if skipped:
            continue
        # A checksum of four bytes may follow the values.
        if len(zlib.decompressobj().decompress(stored, n_declared + 5)) > n_declared + 4:
            expected = f"{n_declared} bytes, the chunk's size"
            raise BadData(path, f"{place} at {begin}", expected=expected, got="more when unpacked")
