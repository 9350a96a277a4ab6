"""HDF5 files of strangers, behind a guard: nothing outside the file is opened, and sizes are bounded before reading.

HDF5 can refer to other files by links, virtual data sets and external storage, runs filters from plug-ins, and declares
sizes that have nothing to do with what is stored. Every object is reached through `Hdf5File`, which allows none of this
and reads one frame at a time.
"""

from __future__ import annotations

import math
import zlib
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray

from bask_data.errors import BadData, UsageError, imported
from bask_data.formats.files import Folder, listed, natural, source_file
from bask_data.formats.hdf5.storage import check_chunks, check_storage, large_chunks

SUFFIXES = (".hdf5", ".h5")

MAX_BLOCK_BYTES = 256 * 2**20
"""Largest frame, chunk or whole array that is decoded, bytes, by its declared size: an image of 80 megapixels, or poses
of two million frames. Keeps wrong files from filling memory."""

MAX_KEPT_BYTES = 64 * 2**20
"""Decoded blocks of frames of one data set that are kept, bytes, but always one. Sensitivity not measured."""

MAX_FRAMES = 2_000_000
"""Most rows of a data set: 18 hours at 30 frames per second. A file may declare any number without storing one."""

MAX_MEMBERS = 200_000
"""Most members of a group that are listed; the largest robot data sets have some thousand episodes in a file."""

MAX_HOPS = 16
"""Most soft links on the way to an object: more are a cycle."""

MAX_ATTRIBUTE_CHARACTERS = 64 * 2**20
"""Longest text attribute that is parsed, characters."""

KINDS = {"b": "booleans", "i": "integers", "u": "unsigned integers", "f": "floating-point numbers"}


def hdf5_source(source: Path, follow_links: bool) -> Path:
    """SOURCE as an HDF5 file: itself, or the only one in the folder.

    Raises:
        UsageError: it is something else, or a folder with none or several.
    """
    if not source.is_dir():
        return source_file(source, SUFFIXES, follow_links)
    files = sorted(path.name for path in source.iterdir() if path.suffix.lower() in SUFFIXES and path.name[0] != ".")
    if len(files) != 1:
        expected, got = f"a file {' or '.join(SUFFIXES)}, or a folder with one", listed(files) or "a folder without any"
        raise UsageError(source, "SOURCE", expected=expected, got=got, fix="pass the file." if files else "")
    return Folder(source, follow_links).member(files[0], "SOURCE")


class StoredFrames:
    """A data set whose first axis is frames, read one at a time, cheapest in ascending order.

    Chunks that hold several frames are decoded once, as a block of frames. The last blocks are kept, so that a look at
    some frames of a short recording does not decode it twice.
    """

    def __init__(self, file: Hdf5File, place: str, dataset: Any, large: set[tuple[int, ...]]) -> None:
        """See `Hdf5File.frames`, which makes them.

        Args:
            large: where chunks begin that are to be checked before they are read.
        """
        self.place = place
        self.shape: tuple[int, ...] = dataset.shape
        self.dtype: np.dtype = dataset.dtype
        self._file, self._dataset = file, dataset
        self._large = large
        chunks = dataset.chunks or (1,)
        frame = math.prod(self.shape[1:]) * self.dtype.itemsize
        self._n_block = chunks[0] if chunks[0] * frame <= MAX_BLOCK_BYTES else 1
        self._n_kept = max(1, MAX_KEPT_BYTES // max(1, self._n_block * frame))
        self._blocks: OrderedDict[int, ndarray] = OrderedDict()

    def __len__(self) -> int:
        return self.shape[0]

    def __call__(self, i: int) -> ndarray:
        """A frame's values; `BadData` if they cannot be decoded."""
        begin = i - i % self._n_block
        if begin not in self._blocks:
            if len(self._blocks) >= self._n_kept:
                self._blocks.popitem(last=False)
            rows = range(begin, begin + self._n_block)
            self._blocks[begin] = self._file.read(self.place, self._dataset, self._large, rows)
        self._blocks.move_to_end(begin)
        return self._blocks[begin][i - begin]


class Hdf5File:
    """An HDF5 file, opened read-only; objects are named by their path in it, their place: `data/demo_0/actions`."""

    def __init__(self, path: Path) -> None:
        """Open the file.

        Raises:
            BadData: it is no HDF5 file, or damaged.
            MissingDependency: h5py is not installed.
        """
        self.path = path
        self._h5py = imported("h5py", "h5py", user=str(path), extra="formats")
        with self._readable(""):
            if not self._h5py.is_hdf5(path):
                fix = "fetch its content (`git lfs pull`), or check SOURCE."
                raise BadData(path, "", expected="an HDF5 file", got=f"{path.stat().st_size} bytes of another", fix=fix)
            self._file = self._h5py.File(path, "r", locking="best-effort")

    def has(self, place: str) -> bool:
        """Whether there is an object at a place; `BadData` for one that leads out of the file."""
        return self._find(place) is not None

    def members(self, place: str = "/") -> list[str]:
        """Names of a group's members, in natural order; hidden ones, which begin with a dot, are ignored.

        Raises:
            BadData: there is no group, or it has too many members.
        """
        group = self._group(place)
        with self._readable(place):
            if len(group) > MAX_MEMBERS:
                raise BadData(self.path, place, expected=f"at most {MAX_MEMBERS} members", got=len(group))
            return sorted((name for name in group if not name.startswith(".")), key=natural)

    def is_group(self, place: str) -> bool:
        """Whether there is a group at a place."""
        return isinstance(self._find(place), self._h5py.Group)

    def attribute(self, place: str, name: str) -> str | int | float | None:
        """A text or number in an object's attribute; None if it has none of this name, or one of another type."""
        found = self._found(place)
        with self._readable(f"{place} attribute {name}"):
            if name not in found.attrs:
                return None
            stored = found.attrs.get_id(name)
            is_text = isinstance(stored.get_type(), self._h5py.h5t.TypeStringID)
            if stored.shape != () or not (is_text or stored.dtype.kind in "biuf"):
                return None
            value = found.attrs[name]
        if not is_text:
            number: int | float = value.item()
            return number
        text = value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)
        if len(text) > MAX_ATTRIBUTE_CHARACTERS:
            expected = f"at most {MAX_ATTRIBUTE_CHARACTERS} characters"
            raise BadData(self.path, f"{place} attribute {name}", expected=expected, got=len(text))
        return text

    def array(self, place: str, shape: tuple[int | None, ...], kinds: str = "f") -> ndarray:
        """A whole data set; see `frames` for the arguments and errors."""
        dataset = self._dataset(place, shape, kinds)
        with self._readable(place):
            n_bytes = dataset.size * dataset.dtype.itemsize
        if n_bytes > MAX_BLOCK_BYTES:
            raise self._too_large(place, n_bytes)
        return self.read(place, dataset, self._large(place, dataset))

    def frames(self, place: str, shape: tuple[int | None, ...], kinds: str = "f") -> StoredFrames:
        """A data set over frames.

        Args:
            shape: the expected shape; None is any size.
            kinds: letters of NumPy's kinds of numbers that are allowed: `u` unsigned, `i` integers, `f` floating point,
                `b` booleans.

        Raises:
            BadData: there is no data set, or one of another shape or type, too large, stored elsewhere, or with filters
                that are not installed.
        """
        dataset = self._dataset(place, shape, kinds)
        return StoredFrames(self, place, dataset, self._large(place, dataset))

    def color(self, place: str) -> StoredFrames:
        """Colour images over frames, (t, h, w, 3); see `frames` for the errors."""
        images = self.frames(place, (None, None, None, 3), "u")
        if images.dtype != np.uint8:
            raise BadData(self.path, place, expected="8 bits per channel", got=images.dtype, fix="rewrite it as uint8.")
        return images

    def shape(self, place: str) -> tuple[int, ...]:
        """Shape of a data set; `BadData` if there is none."""
        return self._dataset(place, None, "biuf").shape

    def read(self, place: str, dataset: Any, large: set[tuple[int, ...]], rows: range | None = None) -> ndarray:
        """Values of a data set, all or of some rows; `BadData` if they cannot be decoded."""
        with self._readable(place):
            if large:
                check_chunks(self.path, place, dataset, large, rows or range(dataset.shape[0]))
            values: ndarray = np.asarray(dataset[rows.start : rows.stop] if rows else dataset[()])
        return values

    def _large(self, place: str, dataset: Any) -> set[tuple[int, ...]]:
        with self._readable(place):
            return large_chunks(dataset)

    def _found(self, place: str) -> Any:
        found = self._find(place)
        if found is None:
            parent, _, name = place.strip("/").rpartition("/")
            there = listed(self.members(parent)) if self.is_group(parent) else "nothing"
            fix = "check SOURCE and its version."
            raise BadData(self.path, parent or "/", expected=f"a member {name}", got=there or "nothing", fix=fix)
        return found

    def _group(self, place: str) -> Any:
        found = self._found(place)
        if not isinstance(found, self._h5py.Group):
            raise BadData(self.path, place, expected="a group", got="a data set")
        return found

    def _find(self, place: str) -> Any:
        """The object at a place, reached by links inside the file only; None if there is none."""
        rest, found, n_hops = _parts(place), self._file, 0
        link_types = self._h5py.h5l
        while rest:
            name, rest = rest[0].encode("utf-8", "surrogateescape"), rest[1:]
            if not isinstance(found, self._h5py.Group):
                return None
            with self._readable(place):
                # Group.get and `in` of h5py follow links, also out of the file; these do not.
                links = found.id.links
                if not links.exists(name):
                    return None
                kind = links.get_info(name).type
                if kind == link_types.TYPE_HARD:
                    found = found[name]
                    continue
                target = links.get_val(name) if kind == link_types.TYPE_SOFT else b""
            n_hops += 1
            if not target or n_hops > MAX_HOPS:
                got = "links in a circle" if target else "a link to another file"
                fix = "copy the content into one file: h5py's Group.copy(..., expand_external=True)."
                raise BadData(self.path, place, expected="an object inside this file", got=got, fix=fix)
            # The target of a soft link is relative to the group of the link, or begins at the root.
            found = self._file if target.startswith(b"/") else found
            rest = [*_parts(target.decode("utf-8", "surrogateescape")), *rest]
        return found

    def _dataset(self, place: str, shape: tuple[int | None, ...] | None, kinds: str) -> Any:
        """The data set at a place, checked without reading it."""
        dataset = self._found(place)
        if not isinstance(dataset, self._h5py.Dataset):
            raise BadData(self.path, place, expected="a data set", got="a group")
        with self._readable(place):
            check_storage(self._h5py, self.path, place, dataset)
            actual, dtype = dataset.shape, dataset.dtype
        if dtype.kind not in kinds or dtype.itemsize > 8:
            wanted = " or ".join(KINDS[kind] for kind in kinds)
            raise BadData(self.path, place, expected=wanted, got=f"{'objects' if dtype.kind == 'O' else dtype}")
        if actual is None or (shape is not None and not _fits(actual, shape)):
            raise BadData(self.path, place, expected=f"shape {_spelled(shape)}", got=_spelled(actual))
        if actual and actual[0] > MAX_FRAMES:
            raise BadData(self.path, place, expected=f"at most {MAX_FRAMES} rows", got=actual[0])
        for size in (actual[1:], dataset.chunks or ()):
            if (n_bytes := math.prod(size) * dtype.itemsize) > MAX_BLOCK_BYTES:
                raise self._too_large(place, n_bytes)
        return dataset

    def _too_large(self, place: str, n_bytes: int) -> BadData:
        expected = f"at most {MAX_BLOCK_BYTES // 2**20} MiB at once"
        fix = "rewrite it in smaller chunks, such as one frame."
        return BadData(self.path, place, expected=expected, got=f"{n_bytes / 2**20:.0f} MiB declared", fix=fix)

    @contextmanager
    def _readable(self, place: str) -> Iterator[None]:
        """Whatever HDF5 raises about a damaged file becomes `BadData`."""
        try:
            yield
        except (OSError, RuntimeError, ValueError, KeyError, TypeError, zlib.error) as error:
            fix = "copy it again from its source."
            got = str(error).strip("'\"")[:200]
            raise BadData(self.path, place, expected="readable HDF5", got=got, fix=fix) from error


def _parts(place: str) -> list[str]:
    return [part for part in place.split("/") if part not in ("", ".")]


def _fits(actual: tuple[int, ...], shape: tuple[int | None, ...]) -> bool:
    return len(actual) == len(shape) and all(b is None or a == b for a, b in zip(actual, shape, strict=True))


def _spelled(shape: tuple[int | None, ...] | None) -> str:
    return "none" if shape is None else "(" + ", ".join("any" if n is None else str(n) for n in shape) + ")"
