from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path

import pytest

from bask_data.engine import Outcome
from bask_data.engine.forecast import Forecast


def predicted(root: Path, kind: str, item: str, status: str = "would make") -> Outcome:
    return Outcome(f"make {item}", kind, item, "main", str(root / kind / item), status)  # type: ignore[arg-type]


def record(root: Path, kind: str, item: str, content: object) -> None:
    file = root / "provenance" / kind / f"{item}.json"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(content))


def test_time_left_follows_from_the_tasks_made_so_far(tmp_path: Path) -> None:
    tasks = [predicted(tmp_path, "mesh", name) for name in "abc"]
    forecast = Forecast(tmp_path, tasks)
    assert forecast.left() == (0.0, "more than")
    forecast.count(replace(tasks[0], status="made", seconds=10.0))
    assert forecast.left() == (20.0, "about")
    forecast.count(replace(tasks[1], status="made", seconds=20.0))
    assert forecast.left() == (15.0, "about")
    forecast.count(replace(tasks[2], status="failed", seconds=1.0))
    assert forecast.left() == (0.0, "about")


def test_time_left_follows_from_provenance_before_anything_is_made(tmp_path: Path) -> None:
    tasks = [predicted(tmp_path, "mesh", name) for name in "ab"]
    tasks.append(predicted(tmp_path, "mesh", "c", "up to date"))
    record(tmp_path, "mesh", "b", {"seconds": 4.0})
    record(tmp_path, "mesh", "c", {"seconds": 8.0})
    assert Forecast(tmp_path, tasks).left() == (12.0, "about")


@pytest.mark.parametrize("content", [{}, {"seconds": "long"}, [], None])
def test_damaged_provenance_counts_as_none(tmp_path: Path, content: object) -> None:
    record(tmp_path, "mesh", "a", content)
    assert Forecast(tmp_path, [predicted(tmp_path, "mesh", "a")]).left() == (0.0, "more than")


def test_unknown_duration_of_a_stage_makes_the_estimate_a_lower_bound(tmp_path: Path) -> None:
    record(tmp_path, "mesh", "a", {"seconds": 4.0})
    tasks = [predicted(tmp_path, "mesh", "a"), predicted(tmp_path, "net", "")]
    assert Forecast(tmp_path, tasks).left() == (4.0, "more than")


def test_workers_share_the_items_of_a_stage(tmp_path: Path) -> None:
    record(tmp_path, "mesh", "a", {"seconds": 4.0})
    tasks = [predicted(tmp_path, "mesh", name) for name in "abcdef"]
    assert Forecast(tmp_path, tasks, workers=3).left() == (8.0, "about")
    assert Forecast(tmp_path, tasks[:1], workers=3).left() == (4.0, "about")


def test_only_what_would_be_made_is_pending(tmp_path: Path) -> None:
    forecast = Forecast(tmp_path, [predicted(tmp_path, "mesh", "a"), predicted(tmp_path, "mesh", "b", "up to date")])
    assert forecast.is_pending("mesh") and forecast.is_pending("mesh", "a")
    assert not forecast.is_pending("mesh", "b") and not forecast.is_pending("net")


def test_asking_at_each_of_thousands_of_items_takes_no_time(tmp_path: Path) -> None:
    tasks = [predicted(tmp_path, "mesh", f"a{i}") for i in range(4000)]
    forecast = Forecast(tmp_path, tasks)
    begun = time.process_time()
    for task in tasks:
        assert forecast.is_pending("mesh", task.item)
        forecast.left()
        forecast.count(replace(task, status="made", seconds=1.0))
    assert time.process_time() - begun < 2


def test_work_that_may_turn_out_unnecessary_makes_the_estimate_an_upper_bound(tmp_path: Path) -> None:
    record(tmp_path, "mesh", "a", {"seconds": 4.0})
    tasks = [predicted(tmp_path, "mesh", "a"), predicted(tmp_path, "objects", "a", "may make")]
    record(tmp_path, "objects", "a", {"seconds": 6.0})
    forecast = Forecast(tmp_path, tasks)
    assert forecast.left() == (10.0, "at most")
    assert forecast.is_pending("objects", "a")
    forecast.count(replace(tasks[1], status="up to date"))
    assert forecast.left() == (4.0, "about")
    unknown = [*tasks, predicted(tmp_path, "keypoints", "a")]
    assert Forecast(tmp_path, unknown).left() == (10.0, "about"), "neither bound holds"
