from __future__ import annotations

import itertools
import json
from pathlib import Path

import pytest

from tests.scripts import script

run = script("benchmarks/run.py", "benchmarks_run")


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> dict[str, float]:
    """A clock that only the work itself moves on."""
    state = {"now": 0.0}
    monkeypatch.setattr(run.time, "perf_counter", lambda: state["now"])
    return state


def work(clock: dict[str, float], *durations: float) -> object:
    turns = itertools.chain(durations, itertools.repeat(durations[-1]))

    def call() -> None:
        clock["now"] += next(turns)

    return call


def test_the_ratio_is_of_neighbouring_calls_and_the_first_does_not_count(clock: dict[str, float]) -> None:
    ours = work(clock, 100.0, 1.0, 2.0, 4.0)
    plain = work(clock, 1.0, 10.0, 20.0, 44.0)  # a machine that slows down slows both
    row = run.compare("b", "c", ours, plain, budget=0.0, max_rounds=20)
    assert (row.ratio, row.lowest, row.highest, row.rounds) == (10.0, 10.0, 11.0, 3)
    assert (row.ours_s, row.plain_s) == (2.0, 20.0)


def test_the_time_and_the_number_of_rounds_are_bounded(clock: dict[str, float]) -> None:
    assert run.compare("b", "c", work(clock, 1.0), work(clock, 1.0), budget=10.0, max_rounds=20).rounds == 5
    assert run.compare("b", "c", work(clock, 0.1), work(clock, 0.1), budget=10.0, max_rounds=20).rounds == 20


def test_a_failing_benchmark_is_named_and_the_others_still_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bench_a.py").write_text("def cases():\n    raise ValueError('no data')\n    yield\n")
    (tmp_path / "bench_b.py").write_text("def cases():\n    yield 'nothing', lambda: 0, lambda: sum(range(10000))\n")
    files = run.benchmark_files([], tmp_path)
    monkeypatch.setattr(run, "benchmark_files", lambda _: files)
    assert run.main(["--rounds", "3", "--seconds", "0", "--json", str(tmp_path / "out.json")]) == 1
    printed = capsys.readouterr().out
    assert "FAILED bench_a.py: ValueError: no data" in printed
    assert "b: nothing:" in printed
    figures = json.loads((tmp_path / "out.json").read_text())
    assert [row["case"] for row in figures["rows"]] == ["nothing"]
    assert figures["rows"][0]["rounds"] == 3


def test_an_unknown_name_lists_the_known_ones(tmp_path: Path) -> None:
    (tmp_path / "bench_a.py").touch()
    with pytest.raises(SystemExit, match=r"no benchmark x\.  fix: one of a"):
        run.benchmark_files(["x"], tmp_path)


def test_every_benchmark_offers_cases() -> None:
    files = run.benchmark_files([])
    assert files
    assert [file.name for file in files if "\ndef cases() -> " not in file.read_text()] == []
