from __future__ import annotations

import sys

import pytest

from bask_data.cli.console import say, shown_progress
from bask_data.progress import note, progress


def test_escape_sequences_in_data_never_reach_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    say("a\x1b[31mb\x1b]0;title\x07c\x9b31m\nd")
    assert capsys.readouterr().err == "ab]0;titlec31m\nd\n"


@pytest.mark.parametrize("is_terminal", [False, True])
def test_notes_during_a_loop_are_shown_at_once(
    is_terminal: bool, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: is_terminal)
    with shown_progress():
        for i in progress(range(3), "training"):
            note(f"step {i}: [loss] \x1b[31m0.5")
            assert f"  ...         step {i}: [loss] 0.5\n" in capsys.readouterr().err
    note("nobody listens")
    assert "nobody" not in capsys.readouterr().err


def test_a_log_shows_the_time_left_without_the_slow_first_step(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 0.0
    monkeypatch.setattr("time.monotonic", lambda: now)
    with shown_progress():
        for i in progress(range(40), "training"):
            now += 15 if i == 0 else 1
    lines = capsys.readouterr().err.splitlines()
    assert lines[:2] == ["  ...         training 1/40", "  ...         training 11/40, about 29.0 s left"]
