"""What every test runs under: shapes checked, few threads, the same examples every time."""

from __future__ import annotations

import ast
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

# Before NumPy or torch is loaded. One thread per worker: two workers share two cores, and results that depend on how a
# sum is split over threads come out the same on every machine.
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")
os.environ.setdefault("MPLBACKEND", "Agg")
os.environ["DVC_NO_ANALYTICS"] = "1"
os.environ.pop("PYTHONWARNINGS", None)

import hypothesis
import jaxtyping
import jaxtyping._import_hook as import_hook
import pytest

if TYPE_CHECKING:
    from bask_data.dataset import Dataset

CHECKED = ("bask_data.core", "bask_data.formats", "bask_data.nn", "bask_data.sim")


def _is_compiled(decorator: ast.expr) -> bool:
    name = decorator.func if isinstance(decorator, ast.Call) else decorator
    last = name.attr if isinstance(name, ast.Attribute) else name.id if isinstance(name, ast.Name) else ""
    return last in {"compiled", "njit", "jit", "vectorize", "guvectorize", "stencil"}


# The hook wraps a function below its other decorators, so numba would be handed the wrapper, which it cannot compile.
# Functions numba compiles are left alone, as the hook leaves those marked `no_type_check`.
_is_exempt = import_hook._is_no_type_check
import_hook._is_no_type_check = lambda decorator: _is_exempt(decorator) or _is_compiled(decorator)

# Holds every array that goes in or out of these modules against its annotation, `Float[ndarray, "h w"]`, and binds the
# sizes across arguments. The rest of the package speaks pydantic and typer, which look at annotations themselves.
jaxtyping.install_import_hook(CHECKED, "beartype.beartype")

hypothesis.settings.register_profile("default", deadline=None, max_examples=50)
# The same examples on every run, so that a red run is red for the change that made it so.
hypothesis.settings.register_profile("ci", deadline=None, max_examples=50, derandomize=True, print_blob=True)
hypothesis.settings.register_profile("thorough", deadline=None, max_examples=1000)
hypothesis.settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE") or ("ci" if os.environ.get("CI") else "default"))


# Datasets that many tests read, built once per worker. A test that writes takes a copy: `tests.datasets.copied`.


@contextmanager
def _untouched(dataset: Dataset) -> Iterator[Dataset]:
    """The dataset, checked to be unchanged in the end."""
    before = {file: file.stat().st_mtime_ns for file in dataset.root.rglob("*")}
    yield dataset
    after = {file: file.stat().st_mtime_ns for file in dataset.root.rglob("*")}
    assert after == before, f"a test changed what all tests read: {sorted(before.items() ^ after.items())[:3]}"


@pytest.fixture(scope="session")
def two_scans(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Dataset]:
    """Scans `a` of two frames and `b` of three, of a few grey pixels each, and nothing made from them."""
    from bask_data.dataset import Dataset
    from tests.datasets import add_scan

    dataset = Dataset.create(tmp_path_factory.mktemp("two_scans") / "table")
    add_scan(dataset, "a")
    add_scan(dataset, "b", n_frames=3)
    with _untouched(dataset):
        yield dataset


@pytest.fixture
def dataset(two_scans: Dataset, tmp_path: Path) -> Dataset:
    """The test's own copy of `two_scans`."""
    from tests.datasets import copied

    return copied(two_scans, tmp_path / "table")


@pytest.fixture(scope="session")
def filled(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Dataset]:
    """A scan `scan-a`, a demonstration `demo-a`, and everything made from them but a network."""
    from tests.report.filled import filled_dataset

    with _untouched(filled_dataset(tmp_path_factory.mktemp("filled") / "dataset")) as dataset:
        yield dataset


@pytest.fixture(scope="session")
def filled_with_network(filled: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Dataset]:
    """`filled`, and an untrained network."""
    from tests.datasets import copied
    from tests.report.filled import publish_network

    dataset = copied(filled, tmp_path_factory.mktemp("filled_with_network") / "dataset")
    publish_network(dataset)
    with _untouched(dataset):
        yield dataset


@pytest.fixture(scope="session")
def learnable(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Dataset]:
    """Scans `a` and `b` with exact masks and matches: all that training needs."""
    from tests.stages.learning import learning_dataset

    with _untouched(learning_dataset(tmp_path_factory.mktemp("learnable") / "dataset", ("a", "b"))) as dataset:
        yield dataset


@pytest.fixture(scope="session")
def pickable(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Dataset]:
    """Scans `a` and `b` with masks, a demonstration `lift` and an untrained network: all that picking needs."""
    from tests.picker.pickable import pickable_dataset

    with _untouched(pickable_dataset(tmp_path_factory.mktemp("pickable") / "dataset")) as dataset:
        yield dataset
