"""One recording in the conventions of many tools: `ingest auto` finds the command, and the numbers are the same.

Nothing is converted here: what no file states is given by documented options.
"""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from bask_data.cli.app import app
from bask_data.dataset import Dataset
from bask_data.formats import FORMATS
from bask_data.formats.files import natural
from bask_data.kinds import Demonstration, Scan
from tests.formats.views import Views, rendered
from tests.formats.written_sources import SOURCES, Written

LOSSES = 10.0
"""Mean difference of colour that JPEG and video cost, of 255; views of other frames differ by 30 and more."""


@pytest.fixture(scope="module")
def views() -> Views:
    return rendered()


def found_command(written: Written, root: Path) -> list[str]:
    """The command that `ingest auto` finds, with the source's own options in place of placeholders."""
    answer = CliRunner().invoke(app, ["ingest", "auto", str(written.path), str(root), "--scene", "a", "--json"])
    assert answer.exit_code == 0, answer.output
    found = json.loads(answer.stdout)
    words = shlex.split(found["command"])
    for name in found["missing"]:
        i = words.index(f"--{name}")
        del words[i : i + 2]
    return [*words[1:], *written.options]


@pytest.mark.parametrize("convention", SOURCES)
def test_one_command_gives_the_recording_back(convention: str, views: Views, tmp_path: Path) -> None:
    source, root = tmp_path / "source", tmp_path / "d"
    source.mkdir()
    written = SOURCES[convention](source, views)
    words = found_command(written, root)
    assert words[1] == (convention if convention in {format.name for format in FORMATS} else "frames")
    answer = CliRunner().invoke(app, words)
    assert answer.exit_code == 0, answer.output
    dataset = Dataset(root)
    [scope] = [scope for scope in ("scene", "demonstration") if dataset.items(scope)]
    makes = Scan if scope == "scene" else Demonstration
    [camera] = makes(dataset.path(makes, "a")).cameras
    assert camera.n_frames == views.n
    np.testing.assert_allclose(camera.world_from_cameras, views.poses, atol=written.tolerance)
    np.testing.assert_allclose(camera.Ks, np.tile(views.K, (views.n, 1, 1)), rtol=1e-6)
    for i in range(views.n):
        np.testing.assert_allclose(camera.depth(i), views.depth_mm[i] / 1000, atol=written.depth_tolerance)
        difference = np.abs(camera.rgb(i).astype(int) - views.color[i])
        assert difference.mean() < (LOSSES if written.is_lossy else 1e-9), f"frame {i}"


@pytest.mark.parametrize(
    "convention", ["tum", "scannet", "arkitscenes", "bop", "nerfstudio", "polycam", "colmap", "rlbench"]
)
def test_a_broken_first_image_can_be_left_out_as_any_other(convention: str, views: Views, tmp_path: Path) -> None:
    written = SOURCES[convention](tmp_path, views)
    images = [path for path in written.path.rglob("*") if path.suffix in (".png", ".jpg", ".jpeg")]
    images.sort(key=lambda path: natural(str(path)))
    color = [
        path for path in images if re.search("rgb|color|images|lowres_wide", path.relative_to(written.path).as_posix())
    ]
    color[0].write_bytes(color[0].read_bytes()[:60])
    words = ["ingest", convention, str(written.path), str(tmp_path / "d"), "--scene", "a", *written.options]
    refused = CliRunner().invoke(app, words)
    assert refused.exit_code == 4 and color[0].name in refused.stderr, refused.stderr
    answer = CliRunner().invoke(app, [*words, "--skip-bad", "--trust"])
    assert answer.exit_code == 0, answer.stderr
    [camera] = Scan(tmp_path / "d/scan/a").cameras
    assert camera.n_frames == views.n - 1
    np.testing.assert_allclose(camera.world_from_cameras, views.poses[1:], atol=written.tolerance)
