from __future__ import annotations

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


def camera(shift: tuple[int, int] = (0, 0), plain: bool = False) -> CameraRecording:
    """An analytic camera, whose colour is moved by (u, v) pixels against its depth."""
    views = [tabletop(5).render(K, pose, HEIGHT, WIDTH) for pose in POSES]

    def read(i: int) -> tuple[np.ndarray, np.ndarray]:
        flat = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
        # Objects of one colour each, so that their outlines are the edges of colour.
        rgb = flat if plain else np.take(np.arange(6)[:, None] * 40 + np.uint8([30, 10, 0]), views[i].instance, axis=0)
        return np.roll(rgb, shift[::-1], axis=(0, 1)).astype(np.uint8), np.rint(1e4 * views[i].depth).astype(np.uint16)

    return CameraRecording("c", K, HEIGHT, WIDTH, 1e-4, POSES, np.arange(4.0), read, lambda i: read(i)[1])


def test_depth_on_colour_fits() -> None:
    found = registration(camera())
    assert (found.verdict, found.n_frames) == ("fits", 4)


@pytest.mark.parametrize("shift", [(9, -4), (-7, 10)])
def test_depth_beside_colour_is_found_with_its_shift(shift: tuple[int, int]) -> None:
    found = registration(camera(shift))
    assert found.verdict == "shifted" and np.abs(np.subtract(found.shift, shift)).max() <= 1
    assert f"{np.hypot(*shift):.0f} pixels away" in found.text


def test_colour_without_edges_tells_nothing() -> None:
    assert registration(camera(plain=True)).verdict == "cannot tell"


def test_the_picture_shows_depths_edges_over_colour(tmp_path: Path) -> None:
    seen = camera()

    def read(i: int) -> tuple[np.ndarray, np.ndarray]:
        rgb, raw = seen.read(i)
        return rgb, raw * np.float32(1e-4)

    save_picture(tmp_path / "sub" / "edges.png", [(4, read), (4, read)])
    picture = cv2.imread(str(tmp_path / "sub" / "edges.png"))
    assert picture.shape == (2 * HEIGHT, 2 * WIDTH, 3)
    assert (picture == (0, 0, 255)).all(axis=2).mean() > 0.005
