"""Datasets: directories with a list of their items, `dataset.json`."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from filelock import FileLock
from pydantic import BaseModel, ConfigDict, ValidationError

from bask_data.artifact import (
    RESTORE,
    SCRATCH,
    Artifact,
    read_json,
    recover,
    write_group,
    write_json_atomically,
    write_text_atomically,
)
from bask_data.errors import BadData, UsageError, WouldOverwrite
from bask_data.params import first_fault
from bask_data.spelling import choices, suggestion

DATASET = "dataset.json"
DATASET_VERSION = 1
"""Version of the format of `dataset.json` that is read and written."""
SHARE_UNLISTED = 1 / 16
"""Items added together that may wait to be listed, as a share of those listed. A process that is killed leaves these
published but not listed; the same command lists them. Chosen: each item is then written about 16 times."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")


class Splits(BaseModel):
    """Which scenes are for what. Splits are by scene, never by frame: frames of one scene resemble each other."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    train: tuple[str, ...] = ()
    validation: tuple[str, ...] = ()
    test: tuple[str, ...] = ()


class Source(BaseModel):
    """How an item came in: enough to ingest it again.

    Args:
        path: of the source, relative to the dataset's directory where that was possible.
        truth: whether it comes with labels or other truth.
    """

    model_config = ConfigDict(extra="forbid")

    format: str
    path: str
    options: dict[str, Any] = {}
    truth: bool = False


class Variant(BaseModel):
    """A further result of a stage with other parameters, beside `main`.

    Args:
        inputs: variant of each input kind that has variants.
    """

    model_config = ConfigDict(extra="forbid")

    inputs: dict[str, str] = {}


class DatasetFile(BaseModel):
    """The content of `dataset.json`."""

    model_config = ConfigDict(extra="forbid")

    bask_dataset: int = DATASET_VERSION
    name: str
    licence: str = ""
    scenes: dict[str, Source] = {}
    demonstrations: dict[str, Source] = {}
    splits: Splits = Splits()
    variants: dict[str, dict[str, Variant]] = {}


class Dataset:
    """A dataset on disk. `dataset.json` is the list of items; directories are not."""

    def __init__(self, root: Path | str) -> None:
        """Open an existing dataset; `BadData` if there is none."""
        self.root = Path(root)
        file = self.root / DATASET
        if not file.exists():
            raise _no_dataset(self.root)
        try:
            self._text = file.read_bytes()
            document = read_json(file)
            self.file = DatasetFile.model_validate(_of_known_version(document, file))
        except ValidationError as error:
            field, expected, came = first_fault(error)
            raise BadData(file, field, expected=expected, got=came, fix=RESTORE) from error
        self._added: list[tuple[str, str, Source]] | None = None
        for name in [*self.file.scenes, *self.file.demonstrations]:
            check_name(name, file)
        splits = self.file.splits
        for name in (*splits.train, *splits.validation, *splits.test):
            if name not in self.file.scenes:
                known = choices(self.file.scenes) or "no scenes"
                raise BadData(file, "splits", expected=f"one of {known}", got=name, fix=f"bask-data split {root}")
        for kind, variants in self.file.variants.items():
            for name, variant in variants.items():
                check_name(name, file)
                for of_input in variant.inputs.values():
                    check_name(of_input, file)
            check_name(kind, file)

    @staticmethod
    def create(root: Path | str, name: str = "", licence: str = "") -> Dataset:
        """Create an empty dataset; `WouldOverwrite` if there is one."""
        root = Path(root)
        if (root / DATASET).exists():
            raise WouldOverwrite(root / DATASET, "", expected="no dataset", got="one", fix="use the existing dataset.")
        if root.exists() and not root.is_dir():
            raise UsageError(root, "", expected="a directory", got="a file", fix="choose another path.")
        write_group(root, {"bask": {"dataset": 1}})
        content = DatasetFile(name=name or root.resolve().name, licence=licence)
        write_json_atomically(root / DATASET, content.model_dump(mode="json"))
        return Dataset(root)

    @staticmethod
    def open_if_any(root: Path | str) -> Dataset | None:
        """Open the dataset; None if there is none."""
        return Dataset(root) if (Path(root) / DATASET).exists() else None

    @staticmethod
    def open_or_create(root: Path | str) -> Dataset:
        """Open the dataset, or create it if there is none."""
        return Dataset(root) if (Path(root) / DATASET).exists() else Dataset.create(root)

    def items(self, scope: str) -> list[str]:
        """Names of the scenes, the demonstrations or both, in the order they were added."""
        if scope == "scene":
            return list(self.file.scenes)
        if scope == "demonstration":
            return list(self.file.demonstrations)
        return [*self.file.scenes, *self.file.demonstrations]

    def select(self, names: Sequence[str], scope: str = "recording", *, option: str = "--only") -> list[str]:
        """Items of a scope by name, each once, in the order given; all of them if none is named.

        Args:
            option: the option that gave the names, for the error.

        Raises:
            UsageError: no item has one of these names, or there is no item at all.
        """
        known = self.items(scope)
        unknown = [name for name in names if name not in set(known)]
        if unknown:
            expected = f"one of {choices(known) or 'no items yet'}"
            fix = suggestion(unknown[0], known) or f"`bask-data info {self.root}` lists them."
            raise UsageError(self.root, option, expected=expected, got=", ".join(unknown), fix=fix)
        if not known:
            fix = "bask-data ingest --help"
            raise UsageError(self.root, "", expected=f"a {scope}", got="none in the dataset", fix=fix)
        return list(dict.fromkeys(names)) or known

    def path(self, artifact: type[Artifact], item: str = "", variant: str = "main") -> Path:
        """Path of an artifact, whether it exists or not."""
        return self.root / artifact_place(artifact, item, variant)

    def prepare(self, artifact: type[Artifact], variant: str = "main") -> None:
        """Create the groups above an artifact, so that any Zarr reader can find it."""
        write_groups_above(self.root, artifact, variant)

    def add(self, scope: str, item: str, source: Source) -> None:
        """Add an item, or replace its source."""
        check_name(item, self.root / DATASET)
        added = [(scope, item, source)] if self._added is None else [*self._added, (scope, item, source)]
        n_listed = len(self.file.scenes) + len(self.file.demonstrations)
        if self._added is not None and len(added) <= SHARE_UNLISTED * n_listed:
            self._added = added
            return
        self._update(lambda file: self._with(file, added))
        self._added = None if self._added is None else []

    @contextmanager
    def adding_many(self) -> Iterator[None]:
        """Within the block, `add` writes the list less and less often, and the rest at its end, also after an error.

        The list is written as a whole: once per item, a dataset would cost the square of its number of items.
        """
        self._added = []
        try:
            yield
        finally:
            added, self._added = self._added, None
            if added:
                self._update(lambda file: self._with(file, added))

    def _with(self, file: DatasetFile, added: list[tuple[str, str, Source]]) -> DatasetFile:
        items = {"scene": dict(file.scenes), "demonstration": dict(file.demonstrations)}
        for scope, item, source in added:
            other = "demonstration" if scope == "scene" else "scene"
            if item in items[other]:
                got, fix = f"the name of a {other}", "choose another name."
                raise UsageError(self.root / DATASET, item, expected=f"a {scope}", got=got, fix=fix)
            items[scope][item] = source
        return file.model_copy(update={"scenes": items["scene"], "demonstrations": items["demonstration"]})

    def add_variant(self, artifact: type[Artifact], name: str, variant: Variant) -> None:
        """Add a variant of a kind to the list, so that `status` and `run` include it."""
        check_name(name, self.root / DATASET)

        def enter(file: DatasetFile) -> DatasetFile:
            of_kind = {**file.variants.get(artifact.kind, {}), name: variant}
            return file.model_copy(update={"variants": {**file.variants, artifact.kind: of_kind}})

        if self.variants(artifact).get(name) != variant:
            self._update(enter)

    def set_splits(self, splits: Splits) -> None:
        """Replace the splits; `UsageError` unless every name is a scene, and in one split only."""
        names = [*splits.train, *splits.validation, *splits.test]

        def replaced(file: DatasetFile) -> DatasetFile:
            for name in names:
                if name not in file.scenes:
                    expected = f"one of {choices(file.scenes) or 'no scenes'}"
                    fix = suggestion(name, file.scenes) or f"`bask-data info {self.root}` lists the scenes."
                    raise UsageError(self.root / DATASET, "splits", expected=expected, got=name, fix=fix)
            return file.model_copy(update={"splits": splits})

        doubled = sorted({name for name in names if names.count(name) > 1})
        if doubled:
            raise UsageError(
                self.root / DATASET,
                "splits",
                expected="each scene in one split",
                got=", ".join(doubled),
                fix="name it in one of --train, --validation and --test.",
            )
        self._update(replaced)

    def variants(self, artifact: type[Artifact]) -> dict[str, Variant]:
        """The variants of a kind, always including `main`, which is the only one of kinds without variants."""
        main = {"main": Variant()}
        return {**main, **self.file.variants.get(artifact.kind, {})} if artifact.has_variants else main

    def recover(self) -> None:
        """Remove what killed processes left behind."""
        recover(self.root)

    def _update(self, change: Callable[[DatasetFile], DatasetFile]) -> None:
        """Change the file as it is on disk, under a lock; what depends on its content must be checked in `change`."""
        (self.root / SCRATCH).mkdir(exist_ok=True)
        with FileLock(self.root / SCRATCH / "dataset.lock"):
            # Another process may have changed the file since it was read; otherwise it need not be validated again.
            is_known = (self.root / DATASET).read_bytes() == self._text
            current = self.file if is_known else Dataset(self.root).file
            changed = change(current)
            if changed != current:
                # The same text as from `json.dumps`, eight times faster; it is rewritten for every added scene.
                write_text_atomically(self.root / DATASET, changed.model_dump_json(indent=2) + "\n")
            self.file, self._text = changed, (self.root / DATASET).read_bytes()


def _no_dataset(root: Path) -> BadData:
    """The error for a path without a dataset. A mistyped path is more likely than a dataset that is yet to be made."""
    if root.is_file():
        got, fix = "a file", f"give its directory: {root.parent}" if root.name == DATASET else "check the path."
    else:
        got, fix = "none", f"check the path, or create one: bask-data init {root}"
    return BadData(root, "", expected=f"a dataset (a directory with {DATASET})", got=got, fix=fix)


def _of_known_version(document: Any, file: Path) -> Any:
    """The document; `BadData` if a newer version of this package wrote it, whose fields may mean something else."""
    version = document.get("bask_dataset", DATASET_VERSION) if isinstance(document, dict) else DATASET_VERSION
    if isinstance(version, int) and version != DATASET_VERSION:
        newer = version > DATASET_VERSION
        fix = "it was made by a newer version: upgrade bask-data." if newer else RESTORE
        raise BadData(file, "bask_dataset", expected=str(DATASET_VERSION), got=version, fix=fix)
    return document


def artifact_place(artifact: type[Artifact], item: str = "", variant: str = "main") -> str:
    """Path of an artifact relative to its dataset, with forward slashes. Nothing is read."""
    parts = [artifact.kind]
    if artifact.has_variants:
        parts.append(variant)
    if artifact.scope != "dataset":
        parts.append(item)
    return "/".join(parts)


def write_groups_above(root: Path, artifact: type[Artifact], variant: str = "main") -> None:
    """Create missing groups above an artifact, so that any Zarr reader can find it."""
    parents = [root, root / artifact.kind]
    if artifact.has_variants and artifact.scope != "dataset":
        parents.append(root / artifact.kind / variant)
    for parent in parents:
        if not (parent / "zarr.json").exists():
            write_group(parent, {"bask": {"dataset": 1}} if parent == root else {})


def check_name(name: str, where: Path | str, field: str = "name") -> None:
    """`UsageError` for a name that is not a single plain directory.

    Args:
        where, field: what states the name, for the error: a file and its field, or a command and its option.
    """
    if not _NAME.fullmatch(name):
        raise UsageError(
            where,
            field,
            expected="letters, digits, '_' and '-', at most 64, beginning with a letter or digit",
            got=repr(name[:80]),
            fix=f"for instance {plain_name(name)}",
        )


def plain_name(name: str) -> str:
    """The allowed name that is most like the given one."""
    return re.sub(r"[^A-Za-z0-9_-]+", "_", name).strip("_-")[:64] or "table"
