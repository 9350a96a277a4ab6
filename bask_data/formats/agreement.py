"""Whether a recording agrees with itself: depth of one frame, moved into another, must meet what was measured there.

Poses the wrong way round or in the wrong axes pass every check of single files. They are found here, by reading the
poses in the other ways as well. Nothing is changed by it: the user is told.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.geometry import in_image, invert_rigid, pixel_grid, project, transform, unproject
from bask_data.formats.recording import CameraRecording

N_PAIRS = 4
"""Pairs of frames that are compared, spread over the recording: a wrong convention shows in each of them. Sensitivity
not measured."""

MIN_POINTS = 200
"""Points of a pair that must meet a measurement before a share of them means anything. Chosen; sensitivity not
measured."""

AGREES_WITHIN = (0.005, 0.02)
"""Metres, and share of the depth: depths count as equal within 5 mm plus 2 %. That is noise and calibration of an RGB-D
camera, not geometry. Sensitivity not measured."""


def agreement(camera: CameraRecording, otherwise: dict[str, Float[ndarray, "t 4 4"]]) -> str:
    """What a comparison of some pairs of frames says, in words.

    Args:
        otherwise: `world_from_cameras` under other readings of the same files, by the options that would give them.
    """
    pairs = _pairs(camera.n_frames)
    if not pairs:
        return "a single frame: nothing to hold the poses against"
    depths = {i: camera.read(i)[1] * camera.depth_scale for pair in pairs for i in pair}
    share = _share(camera, depths, pairs, camera.world_from_cameras)
    others = {name: _share(camera, depths, pairs, poses) for name, poses in otherwise.items()}
    said = (
        f"{share:.0%} of the depth of a frame, moved into another, meets what was measured there ({len(pairs)} pairs)"
    )
    better = [name for name, other in others.items() if other > max(2 * share, 0.3)]
    if better:
        best = max(better, key=others.__getitem__)
        said += f"; with {best} it would be {others[best]:.0%}: look at the options"
    elif share < 0.3:
        said += "; that is little: look at the poses, the intrinsics and the depth scale"
    return said


def _pairs(n_frames: int) -> list[tuple[int, int]]:
    """Some pairs an eighth of the recording apart: far enough to differ, near enough to overlap."""
    if n_frames < 2:
        return []
    step = max(1, n_frames // 8)
    starts = np.unique(np.linspace(0, n_frames - 1 - step, N_PAIRS).astype(int))
    return [(int(start), int(start) + step) for start in starts]


def _share(
    camera: CameraRecording,
    depths: dict[int, ndarray],
    pairs: list[tuple[int, int]],
    world_from_cameras: Float[ndarray, "t 4 4"],
) -> float:
    """Share of points that meet a measurement at their depth, of those that meet any; 0 where frames hardly overlap."""
    n_near = n_met = 0
    for a, b in pairs:
        seen = depths[a] > 0
        points_a = unproject(pixel_grid(camera.height, camera.width)[seen], depths[a][seen], camera.K)
        b_from_a = invert_rigid(world_from_cameras[b]) @ world_from_cameras[a]
        uv, z = project(transform(b_from_a, points_a), camera.K)
        inside = in_image(uv, camera.height, camera.width)
        u, v = np.rint(uv[inside]).astype(int).T
        measured = depths[b][v, u]
        met = measured > 0
        n_met += int(met.sum())
        n_near += int((np.abs(z[inside] - measured)[met] < AGREES_WITHIN[0] + AGREES_WITHIN[1] * measured[met]).sum())
    return n_near / n_met if n_met > MIN_POINTS else 0.0
