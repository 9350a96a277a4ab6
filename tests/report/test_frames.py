from __future__ import annotations

from pathlib import Path

import numpy as np

from bask_data.dataset import Dataset
from bask_data.kinds import Demonstration, Scan
from bask_data.report import write_report
from tests.datasets import publish_recording
from tests.scenes import intrinsics

HEIGHT, WIDTH, N = 24, 32, 6


def page(root: Path, kind: type[Scan] | type[Demonstration], world_from_cameras: np.ndarray) -> str:
    """A table at 0.5 m in most of the image, before a wall at 5 m."""
    depth = np.full((HEIGHT, WIDTH), 0.5, np.float32)
    depth[:8] = 5.0
    dataset = Dataset.create(root)
    publish_recording(
        dataset,
        "table",
        rgb=[np.full((HEIGHT, WIDTH, 3), 90, np.uint8)] * N,
        depth=[depth] * N,
        K=intrinsics(HEIGHT, WIDTH),
        world_from_cameras=world_from_cameras,
        kind=kind,
    )
    return write_report(dataset, root / "report.html").read_text(encoding="utf-8")


AT_REST = np.tile(np.eye(4), (N, 1, 1))


def test_a_camera_at_rest_has_one_tile_in_a_scan_and_several_in_a_demonstration(tmp_path):
    scan, demonstration = page(tmp_path / "a", Scan, AT_REST), page(tmp_path / "b", Demonstration, AT_REST)
    assert scan.count('alt="colour of frame') == 1
    assert "The camera does not move" in scan
    assert demonstration.count('alt="colour of frame') == N
    assert "The camera does not move" not in demonstration


def test_colours_of_depth_spread_over_the_scene_and_not_to_the_wall_behind_it(tmp_path):
    moving = AT_REST.copy()
    moving[:, 0, 3] = np.linspace(0, 0.1, N)
    html = page(tmp_path / "a", Scan, moving)
    assert html.count('alt="colour of frame') == N
    assert "<span>1.00 m</span>" in html
    assert "<span>5.00 m</span>" not in html
