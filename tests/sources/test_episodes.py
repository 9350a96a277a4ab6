from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from typer.testing import CliRunner, Result

import bask_data.dataset
from bask_data.cli.app import app
from bask_data.dataset import Dataset, Source
from bask_data.errors import UsageError
from bask_data.formats import FORMATS
from bask_data.formats.options.maniskill import ManiskillOptions
from bask_data.kinds import Demonstration
from bask_data.progress import listened_by
from bask_data.sources.episodes import chosen_episodes, ingest_episodes, items_of
from tests.formats.test_maniskill import written

MANISKILL = next(format for format in FORMATS if format.name == "maniskill")


def ingest(source: Path, root: Path, *options: object) -> Result:
    words = ["ingest", "maniskill", source, root, "--scene", "pick", "--as", "demonstration", "--trust", *options]
    return CliRunner().invoke(app, list(map(str, words)))


def spoilt(source: Path, name: str) -> Path:
    with h5py.File(source, "r+") as file:
        del file[f"{name}/obs/sensor_param/hand_camera/intrinsic_cv"]
        file[f"{name}/obs/sensor_param/hand_camera/intrinsic_cv"] = np.zeros((4, 3, 3), np.float32)
    return source


def test_all_episodes_become_recordings_of_their_own(tmp_path: Path) -> None:
    source = written(tmp_path / "a.h5", n_trajectories=3)
    made = ingest(source, tmp_path / "d", "--episode", "all")
    assert made.exit_code == 0, made.output
    dataset = Dataset(tmp_path / "d")
    assert list(dataset.file.demonstrations) == ["pick_traj_0", "pick_traj_1", "pick_traj_2"]
    # Actions differ by the number of the trajectory: each recording has its own.
    actions = [Demonstration(dataset.path(Demonstration, f"pick_traj_{i}")).robot.action for i in range(3)]
    np.testing.assert_allclose(actions[2] - actions[0], 2, atol=1e-5)
    assert dataset.file.demonstrations["pick_traj_1"].options["episode"] == "traj_1"
    again = ingest(source, tmp_path / "d", "--episode", "all", "--json")
    assert [row["status"] for row in json.loads(again.stdout)["outcomes"]] == ["up to date"] * 3


def test_a_range_counts_over_all_episodes() -> None:
    names = [f"demo_{i}" for i in range(10)]
    assert chosen_episodes(Path("s"), names, "0:2") == ["demo_0", "demo_1"]
    assert chosen_episodes(Path("s"), names, "-1:") == ["demo_9"]
    assert chosen_episodes(Path("s"), names, "::4") == ["demo_0", "demo_4", "demo_8"]
    with pytest.raises(UsageError, match="choose among 0:10"):
        chosen_episodes(Path("s"), names, "10:")
    with pytest.raises(UsageError, match="leave out --episode"):
        chosen_episodes(Path("s"), [], "all")


def test_names_of_episodes_become_names_of_recordings() -> None:
    assert items_of("pour", ["variation0/episode3", "1"]) == {
        "variation0/episode3": "pour_variation0_episode3",
        "1": "pour_1",
    }
    with pytest.raises(UsageError, match="two pour_a_b"):
        items_of("pour", ["a/b", "a b"])
    with pytest.raises(UsageError, match="at most 64 characters"):
        items_of("pour", ["x" * 64])


def test_a_bad_episode_is_refused_or_left_out_and_counted(tmp_path: Path) -> None:
    source = spoilt(written(tmp_path / "a.h5", n_trajectories=3), "traj_1")
    refused = ingest(source, tmp_path / "d", "--episode", "all")
    assert refused.exit_code == 4 and "in episode traj_1; --skip-bad reads the others" in refused.stderr
    assert list(Dataset(tmp_path / "d").file.demonstrations) == ["pick_traj_0"]
    ended = ingest(source, tmp_path / "e", "--episode", "all", "--skip-bad")
    assert ended.exit_code == 4 and "1 failed, 0 blocked, 2 succeeded" in ended.stderr
    assert "FAILED" in ended.stderr and "ingest demonstration pick_traj_1" in ended.stderr
    assert list(Dataset(tmp_path / "e").file.demonstrations) == ["pick_traj_0", "pick_traj_2"]


def test_an_interruption_loses_no_finished_episode(tmp_path: Path) -> None:
    source = written(tmp_path / "a.h5", n_trajectories=3)
    options = ManiskillOptions(episode="all", trust=True)

    def interrupt(label: str, done: int, total: int | None) -> None:
        if (label, done) == ("reading episodes", 2):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), listened_by(interrupt):
        list(ingest_episodes(tmp_path / "d", "pick", format=MANISKILL, source=source, options=options))
    assert list(Dataset(tmp_path / "d").file.scenes) == ["pick_traj_0", "pick_traj_1"]


def test_listing_many_recordings_costs_no_square_of_their_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    n_written = []
    write = bask_data.dataset.write_text_atomically
    monkeypatch.setattr(
        bask_data.dataset,
        "write_text_atomically",
        lambda path, text: (n_written.append(len(text)), write(path, text))[1],
    )
    total = {}
    for n in (200, 800):
        dataset = Dataset.create(tmp_path / str(n))
        n_written.clear()
        with dataset.adding_many():
            for i in range(n):
                dataset.add("scene", f"s{i:04d}", Source(format="frames", path="."))
        total[n] = sum(n_written)
        assert len(Dataset(tmp_path / str(n)).file.scenes) == n
    assert total[800] < 5.5 * total[200]  # Four times as many recordings; the square would be sixteen times.
