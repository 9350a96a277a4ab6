"""Consistency of depth and poses: depth of one frame, moved into another, must match the depth measured there.

Inverted poses and poses in other camera axes pass every check of single files. They are detected here by comparing
with the other interpretations of the poses. The result is reported to the user; nothing is changed.
"""

from __future__ import annotations

import re

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.geometry import in_image, invert_rigid, pixel_grid, project, transform, unproject
from bask_data.formats.recording import CameraRecording

N_PAIRS = 4
"""Pairs of frames that are compared, spread over the recording; a wrong convention shows in every pair. Sensitivity
not measured."""

MIN_POINTS = 200
"""Least number of points projected onto measured depth, over all pairs, for a meaningful share. Chosen; sensitivity not
measured."""

AGREES_WITHIN = (0.005, 0.02)
"""Metres, and share of the depth: depths count as equal within 5 mm plus 2 %, the noise and calibration error of RGB-D
cameras. Sensitivity not measured."""


_BETTER = re.compile(r"; with (--.+) it would be \d+%")


def agreement(camera: CameraRecording, otherwise: dict[str, Float[ndarray, "t 4 4"]]) -> str:
    """Summary of the depth agreement between some pairs of frames.

    The text is stored in the recording: rewording it changes the digests of artifacts.

    Args:
        otherwise: `world_from_cameras` under other interpretations of the same files, by the options for them.
    """
    pairs = _pairs(camera.n_frames)
    if not pairs:
        return "a single frame: nothing to hold the poses against"
    depths = {i: camera.read(i)[1] * camera.depth_scale for pair in pairs for i in pair}
    share = _share(camera, depths, pairs, camera.world_from_cameras)
    others = {name: _share(camera, depths, pairs, poses) for name, poses in otherwise.items()}
    text = (
        f"{share:.0%} of the depth of a frame, moved into another, meets what was measured there ({len(pairs)} pairs)"
    )
    better = [name for name, other in others.items() if other > max(2 * share, 0.3)]
    if better:
        best = max(better, key=others.__getitem__)
        text += f"; with {best} it would be {others[best]:.0%}: look at the options"
    elif share < 0.3:
        text += "; that is little: look at the poses, the intrinsics and the depth scale"
    return text


def is_doubtful(text: str) -> bool:
    """Whether a summary by `agreement` says that poses, intrinsics or depth are probably wrong."""
    return "; " in text


def better_options(text: str) -> str:
    """The options under which the depths agree better, from a summary by `agreement`; empty if there are none."""
    better = _BETTER.search(text)
    return better[1] if better else ""


def _pairs(n_frames: int) -> list[tuple[int, int]]:
    """Pairs of frames an eighth of the recording apart: far enough to differ, close enough to overlap."""
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
    """Share of points projected onto measured depth that agree with it; 0 if frames hardly overlap."""
    n_close = n_measured = 0
    for a, b in pairs:
        seen = depths[a] > 0
        points_a = unproject(pixel_grid(camera.height, camera.width)[seen], depths[a][seen], camera.Ks[a])
        b_from_a = invert_rigid(world_from_cameras[b]) @ world_from_cameras[a]
        uv, z = project(transform(b_from_a, points_a), camera.Ks[b])
        inside = in_image(uv, camera.height, camera.width)
        u, v = np.rint(uv[inside]).astype(int).T
        measured = depths[b][v, u]
        is_close = np.abs(z[inside] - measured) < AGREES_WITHIN[0] + AGREES_WITHIN[1] * measured
        n_measured += int((measured > 0).sum())
        n_close += int(is_close[measured > 0].sum())
    return n_close / n_measured if n_measured > MIN_POINTS else 0.0
