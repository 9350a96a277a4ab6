"""Whether depth lies on colour. Depth agrees with itself in any case, so colour must tell.

Two witnesses: the colours that the same surface has in two views (`core.color_shift`), which need poses that fit, and
the edges of depth and of colour (`core.edge_offset`), which need none, but mislead where other edges run beside. A
shift is told only if colours are sure of it in both halves of the pairs, or if both witnesses name the same.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from numpy import ndarray

from bask_data.core.color_shift import WIDTH, color_view, likeness
from bask_data.core.depth import SIGMA_FROM_MAD
from bask_data.core.edge_offset import depth_edges, edge_match
from bask_data.core.geometry import invert_rigid
from bask_data.core.image_pairs import spread_pairs
from bask_data.formats.recording import CameraRecording
from bask_data.formats.verdict import Registration

N_EDGE_FRAMES = 8
"""Frames whose edges are compared, spread over the recording. Sensitivity not measured."""

N_SHOWN = 4
"""Frames of a picture."""

REACH_SHARE = 0.1
"""Largest shift looked for, as a share of the image's width: 64 pixels of 640. A camera 4 cm
beside is 37 off at 60 cm."""

CLEAR, WEAK = 4.5, 2.0
"""Scores of edges, in robust standard deviations over shifts: a peak counts from the first, and no shift counts as no
fit below the second. The one recording known to be shifted has 4.9 and -0.3; registered ones have 4.0 to 14.5 at no
shift, or no peak at all."""

NEAR_PX, ALIKE_PX = 3, 8
"""Pixels of 640: an edge peak within the first counts as no shift; two shifts within the second are the same one, and
colours that are most alike within it fit."""

COLOR_GAPS, PAIRS_PER_GAP, ALL_PAIRS = (2, 4, 8, 16, 32, 64), 4, 7
"""Distances between the frames of a pair, pairs for each, and the number of frames up to which all pairs are taken."""

LEAST_PAIRS = 6
"""Pairs from which colours may tell a shift. The shift of a clean recording, found on three pairs, was 26 pixels."""

SHIFT_T, HALF_T, FIT_T = 3.0, 2.0, 4.0
"""Standard errors over pairs: by which the shift beats no shift, by which it does so in the half of the pairs that it
was not found in, and by which colours without a shift are more alike than at the median shift. Chosen on `amazon_box`
and the APC shelf; on parts of five other recordings (39 with shifts of 10 to 30 pixels, 13 without) no shift was told
of one without, and of 25 with enough pairs and texture 22 were told, within 4 pixels."""

SHIFTED_SHARE, FIT_SHARE = 0.75, 0.8
"""Shares of the best likeness that no shift must stay below to be beaten, and reach to fit. Registered recordings have
0.81 to 1."""

LEAST_LIKENESS, FIT_LIKENESS = 0.05, 0.1
"""Likeness above the median shift's from which a shift counts at all, and from which none may fit. Registered
recordings have 0.12 to 0.4, one of plain walls and blurred frames 0.07."""

LEAST_EDGE_FRAMES = 3
"""Frames with edges from which they may tell a shift: two frames of a registered shelf share a wrong one."""

AGREEING, FRAMES_ALIKE_PX = 0.6, 14
"""Least share of frames whose own edge peak is near the common one, and how near, pixels of 640: parallax moves it. Of
recordings of a camera 4 cm beside the colour camera, 6 of 8 have it; of 19 parts of registered recordings with three
frames or more none."""


def registration(camera: CameraRecording, poses_fit: bool = True) -> Registration:
    """Whether the depth of a camera lies on its colour.

    Args:
        poses_fit: whether depth agrees with the poses; otherwise only edges are asked.
    """
    reach = max(6, round(REACH_SHARE * camera.width))
    if min(camera.height, camera.width) < 4 * reach:
        return Registration("cannot tell")
    color = _by_colors(camera) if poses_fit else None
    edges, is_sure = _by_edges(camera, reach)
    unsure = Registration("cannot tell")
    if edges.verdict == "fits":
        return edges if color is None or color.shift == (0, 0) else unsure
    if color is not None and color.verdict == "shifted":
        return color
    if edges.verdict == "shifted" and is_sure:
        return edges
    if edges.verdict == "shifted" and color is not None and color.shift != (0, 0):
        alike = ALIKE_PX * camera.width / 640
        if np.hypot(*np.subtract(color.shift, edges.shift)) <= alike < np.hypot(*edges.shift):
            return Registration("shifted", edges.shift, "edges and colours of the same surface")
    # Before a plane, colours fit wherever depth of a camera beside lies: they accuse, but do not acquit.
    is_fit = color is not None and color.verdict == "fits" and edges.verdict != "shifted"
    return replace(unsure, by=color.by) if color is not None and is_fit else unsure


def _by_colors(camera: CameraRecording) -> Registration | None:
    """What colours of the same surface say; `cannot tell` with a shift if they are most alike there, but not surely.

    Returns:
        None if too few pairs see the same surface.
    """
    pairs = _color_pairs(camera.n_frames)
    views = {}
    for i in sorted({i for pair in pairs for i in pair}):
        rgb, raw = camera.read(i)
        views[i] = color_view(rgb, raw * np.float32(camera.depth_scale), camera.Ks[i])
    poses, reach = camera.world_from_cameras, round(REACH_SHARE * WIDTH)
    maps = [likeness(views[a], views[b], invert_rigid(poses[b]) @ poses[a], reach) for a, b in pairs]
    seen = np.array([one for one in maps if one is not None])
    if len(seen) < LEAST_PAIRS:
        return None
    mean = seen.mean(axis=0)
    (u, v), at_zero = _peak(mean), seen[:, reach, reach]
    best, unshifted = float(mean[v, u]), float(mean[reach - 1 : reach + 2, reach - 1 : reach + 2].max())
    to_pixels = camera.width / WIDTH
    shift = (round((u - reach) * to_pixels), round((v - reach) * to_pixels))
    alike = ALIKE_PX * camera.width / 640
    if best < LEAST_LIKENESS or min(u, v) == 0 or max(u, v) == 2 * reach:
        return Registration("cannot tell")
    is_near = np.hypot(*shift) <= alike and best >= FIT_LIKENESS
    if is_near and unshifted >= FIT_SHARE * best and _t(at_zero) >= FIT_T:
        return Registration("fits", by="colours of the same surface in two views")
    is_sure = unshifted <= SHIFTED_SHARE * best and _t(seen[:, v, u] - at_zero) >= SHIFT_T
    for half, other in ((seen[::2], seen[1::2]), (seen[1::2], seen[::2])):
        u_half, v_half = _peak(half.mean(axis=0))
        is_same = np.hypot(u_half - u, v_half - v) * to_pixels <= alike
        is_sure = is_sure and is_same and _t(other[:, v_half, u_half] - other[:, reach, reach]) >= HALF_T
    if is_sure and np.hypot(*shift) >= alike:
        return Registration("shifted", shift, "colours of the same surface in two views")
    return Registration("cannot tell", shift if unshifted < SHIFTED_SHARE * best else (0, 0))


def _by_edges(camera: CameraRecording, reach: int) -> tuple[Registration, bool]:
    """What edges say, and whether most frames alone say the same."""
    scores = []
    for i in _compared(camera.n_frames):
        rgb, raw = camera.read(i)
        score = edge_match(rgb, raw * np.float32(camera.depth_scale), reach)
        if score is not None:
            scores.append(score)
    if not scores:
        return Registration("cannot tell"), False
    mean = np.mean(scores, axis=0)
    mean = (mean - np.median(mean)) / (SIGMA_FROM_MAD * np.median(np.abs(mean - np.median(mean))) + 1e-9)
    scale = camera.width / 640
    near = max(1, round(NEAR_PX * scale))
    middle = slice(reach - near, reach + near + 1)
    peak, unshifted = _peak(mean), float(mean[middle, middle].max())
    if unshifted >= CLEAR - 0.5 and unshifted >= 0.8 * mean.max():
        return Registration("fits", by=f"the edges of {len(scores)} frames"), True
    if mean.max() < CLEAR or unshifted >= WEAK:
        return Registration("cannot tell"), False
    if len(scores) < LEAST_EDGE_FRAMES:
        return Registration("cannot tell"), False
    alike = np.mean([np.hypot(*np.subtract(_peak(score), peak)) <= FRAMES_ALIKE_PX * scale for score in scores])
    shift = (peak[0] - reach, peak[1] - reach)
    return Registration("shifted", shift, f"the edges of {len(scores)} frames"), bool(alike >= AGREEING)


def _color_pairs(n_frames: int) -> list[tuple[int, int]]:
    """Pairs of frames at doubling distances, spread over the recording; all of few frames."""
    if n_frames <= ALL_PAIRS:
        return [(a, b) for a in range(n_frames) for b in range(a + 1, n_frames)]
    return spread_pairs(n_frames, COLOR_GAPS, PAIRS_PER_GAP)


def _t(differences: np.ndarray) -> float:
    """Mean in standard errors, as if pairs were independent; those that share frames are not, so it is a threshold
    only."""
    if len(differences) < 2:
        return 0.0
    return float(differences.mean() / (differences.std(ddof=1) / np.sqrt(len(differences)) + 1e-9))


def save_picture(
    file: Path,
    cameras: Sequence[tuple[int, Callable[[int], tuple[UInt8[ndarray, "h w 3"], Float32[ndarray, "h w"]]]]],
) -> None:
    """Write some frames' colour with the edges of depth in red: a row for each camera.

    Args:
        cameras: number of frames, and what reads the colour and the depth (metres) of one.
    """
    rows = [np.concatenate(edge_pictures(n_frames, read), axis=1) for n_frames, read in cameras]
    width = max(row.shape[1] for row in rows)
    padded = [np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0))) for row in rows]
    file.parent.mkdir(parents=True, exist_ok=True)
    written, data = cv2.imencode(".png", np.concatenate(padded)[..., ::-1])
    assert written
    file.write_bytes(data.tobytes())


def edge_pictures(
    n_frames: int, read: Callable[[int], tuple[UInt8[ndarray, "h w 3"], Float32[ndarray, "h w"]]]
) -> list[UInt8[ndarray, "h w 3"]]:
    """Colour of some frames with the edges of depth (metres) in red."""
    tiles = []
    for i in _compared(n_frames)[:: max(1, N_EDGE_FRAMES // N_SHOWN)]:
        rgb, depth = read(i)
        edges = depth_edges(depth).astype(np.uint8)
        rgb = rgb.copy()
        rgb[cv2.dilate(edges, np.ones((2, 2), np.uint8)) > 0] = (255, 0, 0)
        tiles.append(rgb)
    return tiles


def _compared(n_frames: int) -> list[int]:
    return [int(i) for i in np.unique(np.linspace(0, n_frames - 1, N_EDGE_FRAMES).astype(int))]


def _peak(scores: np.ndarray) -> tuple[int, int]:
    """(u, v) of the largest score."""
    v, u = np.unravel_index(int(np.argmax(scores)), scores.shape)
    return int(u), int(v)
