from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from bask_data.cli.app import app
from bask_data.kinds import Reconstruction
from bask_data.sim.options import SimOptions
from bask_data.sources.simulate import simulate


def test_a_static_camera_does_not_extend_the_workspace_to_the_floor(tmp_path: Path) -> None:
    options = SimOptions(task="phone", height=60, width=80, frames=24, depth_noise=0.0)
    simulate(tmp_path / "d", options, n_scans=1, n_demonstrations=0)
    answer = CliRunner().invoke(app, ["reconstruct", str(tmp_path / "d"), "--voxel-size", "0.008"])
    assert answer.exit_code == 0, answer.output
    lowest_z = Reconstruction(tmp_path / "d" / "reconstruction" / "phone_scan0").metadata.bounds[2]
    assert lowest_z == pytest.approx(-0.02, abs=0.1)  # the floor is at -0.75
