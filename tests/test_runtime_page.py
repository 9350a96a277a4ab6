"""The loop that docs/runtime.md shows, run as it stands there."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from bask_data.kinds import Demonstration, DescriptorNet, KeypointTrack, ReferenceKeypoints
from bask_data.stages.encode import EncodeParams, encode
from tests.tracked import N_FRAMES, ColourNetwork, dataset_of, poses, side_poses

PAGE = Path(__file__).parent.parent / "docs" / "runtime.md"


class Robot:
    """A demonstration, lived through once."""

    def __init__(self, demonstration: Demonstration) -> None:
        self._cameras = {camera.name: camera for camera in demonstration.cameras}
        self._now = -1
        self.acted: list[tuple[np.ndarray, np.ndarray]] = []

    def is_running(self) -> bool:
        self._now += 1
        return self._now < N_FRAMES

    def frames(self) -> dict[str, SimpleNamespace]:
        return {
            name: SimpleNamespace(
                rgb=camera.rgb(self._now), depth_mm=camera.depth(self._now) * 1000, K=camera.Ks[self._now]
            )
            for name, camera in self._cameras.items()
        }

    def world_from_camera(self, name: str) -> np.ndarray:
        return self._cameras[name].world_from_cameras[self._now]

    def world_from_gripper(self) -> None:
        return None

    def act(self, action: tuple[np.ndarray, np.ndarray]) -> None:
        self.acted.append(action)


def test_the_loop_on_the_page_does_what_encode_does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(DescriptorNet, "network", lambda self: ColourNetwork())
    monkeypatch.chdir(tmp_path)
    dataset = dataset_of(tmp_path / "data", {"side": side_poses(), "wrist": poses()})
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert len([line for line in code.splitlines() if line.strip()]) <= 20
    demonstration = Demonstration(dataset.path(Demonstration, "reach"))
    robot = Robot(demonstration)
    exec(code, {"robot": robot, "policy": lambda mean, spread: (mean, spread)})
    (tmp_path / "out").mkdir()
    reference = ReferenceKeypoints(dataset.path(ReferenceKeypoints))
    encode(demonstration, DescriptorNet(tmp_path), reference, truths=[], params=EncodeParams(), out=tmp_path / "out")
    track = KeypointTrack(tmp_path / "out")
    # Millimetres and back round depth, so the last digits differ, and by and by which particles are kept.
    np.testing.assert_allclose([mean for mean, _ in robot.acted], track.mean, atol=5e-3)
    assert all((spread > 0).all() for _, spread in robot.acted)
