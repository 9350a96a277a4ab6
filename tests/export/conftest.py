from __future__ import annotations

import pytest

from bask_data.dataset import Dataset
from tests.export.encoded import Demo, exported_dataset


@pytest.fixture(scope="session")
def encoded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Dataset, dict[str, Demo]]:
    """Three encoded demonstrations; tests must not change them."""
    return exported_dataset(tmp_path_factory.mktemp("encoded") / "kitchen")
