"""A format is added in the places listed in the docstring of `bask_data/export/__init__.py`, and no others."""

from __future__ import annotations

import json

import pytest

from tests.extended import ExtendedPackage

TOY = '''"""Toy: the number of frames of each demonstration, one a line."""

from pathlib import Path

from bask_data.export.description import write_description
from bask_data.export.episodes import Episodes


def write(out: Path, episodes: Episodes) -> list[str]:
    """Write the folder."""
    lines = [f"{episode.entry.name} {len(episode.values['action'])}\\n" for episode in episodes]
    (out / "lengths.txt").write_text("".join(lines))
    write_description(out, episodes.described("toy"))
    return ["it is a toy."]
'''

LINE = """ExportFormat("toy", "lengths, one a line", "cat {path}/lengths.txt", columns=("action",)),"""


@pytest.fixture(scope="module")
def extended(tmp_path_factory: pytest.TempPathFactory) -> ExtendedPackage:
    package = ExtendedPackage(tmp_path_factory.mktemp("extended"), {"export/toy.py": TOY})
    package.add_to_table("export/table.py", LINE)
    return package


def test_a_format_that_was_added_is_listed(extended: ExtendedPackage) -> None:
    shown = extended.command("export", "--help")
    assert shown.returncode == 0, shown.stderr
    assert "diffusion-policy, toy" in shown.stdout
    assert "toy: lengths, one a line." in " ".join(shown.stdout.split())


def test_a_format_that_was_added_is_written_reported_and_replaced(extended: ExtendedPackage, encoded, tmp_path) -> None:
    out = tmp_path / "out"
    made = extended.command("export", "toy", encoded[0].root, out, "--json")
    assert made.returncode == 0, made.stderr
    assert (out / "lengths.txt").read_text() == "a 12\nb 7\nc 9\n"
    assert json.loads(made.stdout)["format"] == "toy"
    assert "note: it is a toy." in made.stderr
    assert f"next: cat {out}/lengths.txt" in made.stderr
    assert extended.command("export", "toy", encoded[0].root, out).returncode == 3
    again = extended.command("export", "toy", encoded[0].root, out, "--force", "--only", "b")
    assert again.returncode == 0, again.stderr
    assert (out / "lengths.txt").read_text() == "b 7\n"
