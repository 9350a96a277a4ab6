from __future__ import annotations

from pathlib import Path

import pytest

from bask_data.cli.working import executor_of
from bask_data.dataset import Dataset
from bask_data.engine import plan, run
from tests.cli.test_commands import cli
from tests.datasets import add_scan
from tests.toy_stages import fuse


def test_a_dask_cluster_makes_the_items(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    dataset = Dataset.create(tmp_path / "d")
    for level, name in enumerate("abc"):
        add_scan(dataset, name, level=level)
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
        distributed.Client(cluster) as client,
    ):
        outcomes = list(run(plan(dataset, fuse), executor=client.get_executor()))
        assert {(outcome.item, outcome.status) for outcome in outcomes} == {(name, "made") for name in "abc"}
        with executor_of(1, cluster.scheduler_address) as (_, n_workers):
            assert n_workers == 2, "the time left is that of all workers"
        ended = cli("reconstruct", dataset.root, "--cluster", cluster.scheduler_address, "--only", "a")
        # The toy recording has no surface; what counts is that the worker's error arrives whole.
        assert ended.exit_code == 4, ended.stderr
        assert "fix:" in ended.stderr


def test_missing_dask_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    dataset = Dataset.create(tmp_path / "d")
    add_scan(dataset, "a")
    monkeypatch.setitem(sys.modules, "distributed", None)
    ended = cli("reconstruct", dataset.root, "--cluster", "tcp://127.0.0.1:1")
    assert ended.exit_code == 5
    assert "pip install 'bask-data[cluster]'" in ended.stderr
