"""Where values of an HDF5 file lie and how they are packed: refused unless in the file itself and within its chunks."""

from __future__ import annotations

import math
import zlib
from contextlib import suppress
from importlib import import_module
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


def large_chunks(dataset: Any) -> set[tuple[int, ...]]:
    """Where chunks begin that may unpack to much more than they declare; to be checked before they are read."""
    large: set[tuple[int, ...]] = set()
    if dataset.chunks is None or DEFLATE not in filters_of(dataset):
        return large
    if dataset.id.get_storage_size() > MAX_STORED_BYTES:
        # The function goes on as long as it returns None.
        dataset.id.chunk_iter(
            lambda chunk: large.add(tuple(chunk.chunk_offset)) if chunk.size > MAX_STORED_BYTES else None
        )
    return large


def check_chunks(path: Path, place: str, dataset: Any, large: set[tuple[int, ...]], rows: range) -> None:
    """Refuse chunks with any of the rows that unpack to more than they declare; those that do not leave `large`."""
    n_declared = math.prod(dataset.chunks) * dataset.dtype.itemsize
    for begin in [at for at in large if at[0] < rows.stop and rows.start < at[0] + dataset.chunks[0]]:
        skipped, stored = dataset.id.read_direct_chunk(begin)
        # A checksum of four bytes may follow the values.
        if not skipped and len(zlib.decompressobj().decompress(stored, n_declared + 5)) > n_declared + 4:
            expected = f"{n_declared} bytes, the chunk's size"
            raise BadData(path, f"{place} at {begin}", expected=expected, got="more when unpacked")
        large.discard(begin)
