"""The examples and the notebook, run on two small datasets."""

from __future__ import annotations

import ast
import json
import runpy
import sys
from pathlib import Path
from typing import Any

import cv2
import matplotlib.pyplot as plt
import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from bask_data.cli.app import app
from tests.tiny import HEIGHT, PARAMS, WIDTH, write_recording

REPOSITORY = Path(__file__).parents[2]
EXAMPLES = REPOSITORY / "examples"
SCRIPTS = sorted(file.name for file in EXAMPLES.glob("*.py"))
MOST_BYTES = 60_000


def finished_dataset(root: Path, seed: int) -> Path:
    """A scan and a demonstration with everything that the pipeline makes of them."""
    options = write_recording(root.with_name(f"{root.name}_files"), seed=seed)
    root.mkdir()
    (root / "params.yaml").write_text(yaml.safe_dump(PARAMS))
    files = str(root.with_name(f"{root.name}_files"))
    for words in (
        ["ingest", "frames", files, str(root), "--scene", "table1", *options],
        ["ingest", "frames", files, str(root), "--scene", "demo1", "--as", "demonstration", *options],
        ["run", str(root)],
    ):
        answer = CliRunner().invoke(app, words)
        assert answer.exit_code == 0, answer.output
    return root


@pytest.fixture(scope="module")
def roots(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("examples")
    return [finished_dataset(folder / f"dataset{seed}", seed) for seed in (0, 1)]


@pytest.fixture(autouse=True)
def closed_figures():
    yield
    plt.close("all")


def run_script(name: str, root: Path, out: Path, monkeypatch: pytest.MonkeyPatch) -> np.ndarray:
    """Run an example as from a shell, and read its picture."""
    monkeypatch.setattr(sys, "argv", [name, str(root), "--out", str(out)])
    runpy.run_path(str(EXAMPLES / name), run_name="__main__")
    picture = cv2.imread(str(out))
    assert picture is not None, out
    return picture


def test_there_are_five_scripts_and_each_is_explained_with_its_picture() -> None:
    assert SCRIPTS == ["frame.py", "keypoints.py", "loader.py", "matches.py", "track.py"]
    text = (EXAMPLES / "README.md").read_text()
    for name in SCRIPTS:
        lines = (EXAMPLES / name).read_text().splitlines()
        assert len(lines) <= 60, name
        picture = name.replace(".py", ".jpg")
        assert f"]({name})" in text and f"]({picture})" in text
        assert (EXAMPLES / picture).stat().st_size < MOST_BYTES
        assert cv2.imread(str(EXAMPLES / picture)).std() > 20


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_script_draws_what_the_dataset_has(
    name: str, roots: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here, again, there = (
        run_script(name, root, tmp_path / f"{i}.png", monkeypatch)
        for i, root in enumerate((roots[0], roots[0], roots[1]))
    )
    assert min(here.shape[:2]) > 100 and here.std() > 20
    np.testing.assert_array_equal(here, again)
    assert here.shape != there.shape or np.abs(here.astype(int) - there).mean() > 0.5


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_script_ends_with_one_line_if_there_is_no_dataset(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", [name, str(tmp_path / "nowhere")])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")
    [line] = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {tmp_path / 'nowhere'}") and ended.value.code in (2, 4)


def test_the_notebook_runs_and_every_result_can_be_shown(
    roots: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("build/demo").mkdir(parents=True)
    Path("build/demo/dataset").symlink_to(roots[0])
    names: dict[str, Any] = {}
    shown = []
    for cell in json.loads((EXAMPLES / "tour.ipynb").read_text())["cells"]:
        if cell["cell_type"] != "code":
            continue
        tree = ast.parse("".join(cell["source"]))
        last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
        exec(compile(tree, "tour.ipynb", "exec"), names)
        if last is not None:
            value = eval(compile(ast.Expression(last.value), "tour.ipynb", "eval"), names)  # noqa: S307
            shown.append(value._repr_html_() if hasattr(value, "_repr_html_") else repr(value))
    assert [text.count("<img") for text in shown[:2]] == [6, 2] and all(shown)
    assert "up to date" in shown[-1] and "stale" not in shown[-1]
    assert names["batch"]["rgb_a"].shape == (2, 3, HEIGHT, WIDTH)


def test_the_notebook_is_valid_and_carries_no_outputs() -> None:
    notebook = json.loads((EXAMPLES / "tour.ipynb").read_text())
    pytest.importorskip("nbformat").validate(notebook)
    assert notebook["nbformat"] == 4
    assert all(
        not cell["outputs"] and cell["execution_count"] is None for cell in notebook["cells"] if "outputs" in cell
    )
