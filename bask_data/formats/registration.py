"""Whether depth lies on colour, as far as its edges tell. Geometry cannot: depth agrees with itself in any case."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from numpy import ndarray

from bask_data.core.edge_offset import depth_edges, edge_match
from bask_data.formats.recording import CameraRecording

N_EDGE_FRAMES = 8
"""Frames whose edges are compared, spread over the recording. Sensitivity not measured."""

N_SHOWN = 4
"""Frames of a picture."""

REACH_SHARE = 0.06
"""Largest shift looked for, as a share of the image's width: 38 pixels of 640."""

CLEAR, WEAK = 4.5, 2.0
"""Scores, in robust standard deviations over shifts: a peak counts from the first, and no shift counts as no fit below
the second. The one recording known to be shifted has 4.9 and -0.3; registered ones have 4.0 to 14.5 at no shift, or no
peak at all."""

NEAR_PX, ALIKE_PX = 3, 6
"""Pixels of 640: a peak within the first counts as no shift, and frames' own peaks must lie within the second of the
common one."""

AGREEING = 0.6
"""Least share of frames whose own peak is at the common shift."""


@dataclass(frozen=True)
class Registration:
    """What the edges say: `fits`, `shifted` or `cannot tell`, and the shift (u, v) of depth against colour, pixels."""

    verdict: str
    shift: tuple[int, int] = (0, 0)
    n_frames: int = 0

    @property
    def text(self) -> str:
        """A sentence for the recording's assumptions."""
        if self.verdict == "fits":
            return f"edges of depth lie on edges of colour ({self.n_frames} frames)"
        if self.verdict == "shifted":
            (u, v), distance = self.shift, float(np.hypot(*self.shift))
            return (
                f"edges of depth fit those of colour {distance:.0f} pixels away (u {u:+d}, v {v:+d}, {self.n_frames} "
                "frames): depth seems not to be registered to colour; masks will lie beside the objects"
            )
        return "cannot tell from edges whether depth lies on colour; --picture FILE shows them"


def registration(camera: CameraRecording) -> Registration:
    """Whether the depth of a camera lies on its colour."""
    reach = max(6, round(REACH_SHARE * camera.width))
    if min(camera.height, camera.width) < 4 * reach:
        return Registration("cannot tell")
    scores = []
    for i in _compared(camera.n_frames):
        rgb, raw = camera.read(i)
        score = edge_match(rgb, raw * np.float32(camera.depth_scale), reach)
        if score is not None:
            scores.append(score)
    if not scores:
        return Registration("cannot tell")
    mean = np.mean(scores, axis=0)
    mean = (mean - np.median(mean)) / (1.4826 * np.median(np.abs(mean - np.median(mean))) + 1e-9)
    scale = camera.width / 640
    near = max(1, round(NEAR_PX * scale))
    middle = slice(reach - near, reach + near + 1)
    peak, unshifted = _peak(mean), float(mean[middle, middle].max())
    if unshifted >= CLEAR - 0.5 and unshifted >= 0.8 * mean.max():
        return Registration("fits", n_frames=len(scores))
    alike = np.mean([np.hypot(*np.subtract(_peak(score), peak)) <= ALIKE_PX * scale for score in scores])
    shift = (peak[0] - reach, peak[1] - reach)
    if mean.max() >= CLEAR and unshifted < WEAK and alike >= AGREEING and len(scores) > 2:
        return Registration("shifted", shift, len(scores))
    return Registration("cannot tell", n_frames=len(scores))


def save_picture(
    file: Path,
    cameras: Sequence[tuple[int, Callable[[int], tuple[UInt8[ndarray, "h w 3"], Float32[ndarray, "h w"]]]]],
) -> None:
    """Write some frames' colour with the edges of depth in red: a row for each camera.

    Args:
        cameras: number of frames, and what reads the colour and the depth (metres) of one.
    """
    rows = []
    for n_frames, read in cameras:
        tiles = []
        for i in _compared(n_frames)[:: max(1, N_EDGE_FRAMES // N_SHOWN)]:
            rgb, depth = read(i)
            edges = depth_edges(depth).astype(np.uint8)
            rgb = rgb.copy()
            rgb[cv2.dilate(edges, np.ones((2, 2), np.uint8)) > 0] = (255, 0, 0)
            tiles.append(rgb)
        rows.append(np.concatenate(tiles, axis=1))
    width = max(row.shape[1] for row in rows)
    padded = [np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0))) for row in rows]
    file.parent.mkdir(parents=True, exist_ok=True)
    written, data = cv2.imencode(".png", np.concatenate(padded)[..., ::-1])
    assert written
    file.write_bytes(data.tobytes())


def _compared(n_frames: int) -> list[int]:
    return [int(i) for i in np.unique(np.linspace(0, n_frames - 1, N_EDGE_FRAMES).astype(int))]


def _peak(scores: np.ndarray) -> tuple[int, int]:
    """(u, v) of the largest score."""
    v, u = np.unravel_index(int(np.argmax(scores)), scores.shape)
    return int(u), int(v)
