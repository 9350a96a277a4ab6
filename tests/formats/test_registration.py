from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from bask_data.formats.recording import CameraRecording
from bask_data.formats.registration import registration, save_picture
from tests.scenes import intrinsics, orbit, tabletop

HEIGHT, WIDTH = 180, 240
K = intrinsics(HEIGHT, WIDTH)
POSES = orbit(4, elevation_deg=(20, 45))


VIEWS = [tabletop(5).render(K, pose, HEIGHT, WIDTH) for pose in POSES]


def camera(shift: tuple[int, int] = (0, 0), colors: str = "texture") -> CameraRecording:
    """An analytic camera, whose colour is moved by (u, v) pixels against its depth.

    Args:
        colors: `texture`; `objects`: one colour for each, so that their outlines are the edges; or `plain`.
    """

    def read(i: int) -> tuple[np.ndarray, np.ndarray]:
        rgb = {
            "texture": VIEWS[i].rgb,
            "objects": np.take(np.arange(6)[:, None] * 40 + np.uint8([30, 10, 0]), VIEWS[i].instance, axis=0),
            "plain": np.full((HEIGHT, WIDTH, 3), 90, np.uint8),
        }[colors]
        return np.roll(rgb, shift[::-1], axis=(0, 1)).astype(np.uint8), np.rint(1e4 * VIEWS[i].depth).astype(np.uint16)

    return CameraRecording("c", K, HEIGHT, WIDTH, 1e-4, POSES, np.arange(4.0), read, lambda i: read(i)[1])


@pytest.mark.parametrize(
    ("colors", "poses_fit", "by"),
    [("texture", True, "edges"), ("objects", False, "edges")],
)
def test_depth_on_colour_fits(colors: str, poses_fit: bool, by: str) -> None:
    found = registration(camera(colors=colors), poses_fit)
    assert (found.verdict, found.findings("table")) == ("fits", []) and by in found.by


@pytest.mark.parametrize("shift", [(9, -4), (-7, 10)])
@pytest.mark.parametrize(("colors", "poses_fit"), [("texture", True), ("objects", False)])
def test_depth_beside_colour_is_found_with_its_shift(shift: tuple[int, int], colors: str, poses_fit: bool) -> None:
    found = registration(camera(shift, colors), poses_fit)
    assert found.verdict == "shifted" and np.abs(np.subtract(found.shift, shift)).max() <= 1
    (finding,) = found.findings("table")
    assert finding.code == "depth-shifted" and f"u {found.shift[0]:+d}, v {found.shift[1]:+d}" in finding.evidence


def test_colours_that_fit_acquit_no_depth_of_a_camera_beside() -> None:
    """Colours of a plane fit each other wherever on it depth lies."""
    seen = camera()

    def read(i: int) -> tuple[np.ndarray, np.ndarray]:
        rgb, raw = seen.read(i)
        # 4 cm to the left: pixels move by K[0, 0] * 0.04 / z.
        beside = np.zeros_like(raw)
        v, u = np.nonzero(raw)
        far_first = np.argsort(-raw[v, u].astype(int), kind="stable")
        v, u = v[far_first], u[far_first]
        moved = np.rint(u + K[0, 0] * 0.04 / (raw[v, u] * 1e-4)).astype(int)
        inside = moved < WIDTH
        beside[v[inside], moved[inside]] = raw[v, u][inside]
        return rgb, beside

    found = registration(replace(seen, read=read, read_depth=lambda i: read(i)[1]))
    assert found.verdict == "cannot tell" and "before a plane they always are" in found.text


def test_colour_without_edges_tells_nothing() -> None:
    assert registration(camera(colors="plain")).verdict == "cannot tell"


def test_the_picture_shows_depths_edges_over_colour(tmp_path: Path) -> None:
    seen = camera()

    def read(i: int) -> tuple[np.ndarray, np.ndarray]:
        rgb, raw = seen.read(i)
        return rgb, raw * np.float32(1e-4)

    save_picture(tmp_path / "sub" / "edges.png", [(4, read), (4, read)])
    picture = cv2.imread(str(tmp_path / "sub" / "edges.png"))
    assert picture.shape == (2 * HEIGHT, 2 * WIDTH, 3)
    assert (picture == (0, 0, 255)).all(axis=2).mean() > 0.005
