"""Depth images of an episode and their unit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.errors import BadData, UsageError
from bask_data.formats.lerobot.cameras import CameraFeatures
from bask_data.formats.lerobot.columns import EpisodeRows
from bask_data.formats.lerobot.depth import decoded_codes, default_codes, depth_codes, unit_of
from bask_data.formats.lerobot.episodes import EpisodeEntry
from bask_data.formats.lerobot.images import FrameImages, depth_images
from bask_data.formats.lerobot.videos import of_video
from bask_data.formats.options.lerobot import LerobotOptions
from bask_data.formats.recording import Depth


@dataclass(frozen=True)
class EpisodeDepth:
    """Depth of a camera in an episode.

    Args:
        scale: metres per unit.
        farthest: largest depth there can be, metres; None if the files do not state one.
    """

    images: FrameImages
    scale: float
    statement: str
    farthest: float | None = None


def episode_depth(
    rows: EpisodeRows, entry: EpisodeEntry, camera: CameraFeatures, time: Float[ndarray, " t"], options: LerobotOptions
) -> EpisodeDepth:
    """Depth of a camera, by whatever it is stored as.

    Raises:
        BadData: it is for the eye only, or damaged.
        UsageError: `--depth-scale` is given, and the files state a formula.
    """
    feature = camera.depth
    if feature.dtype == "video":
        return _filmed_depth(rows, entry, camera, time, options)
    images = depth_images(rows, entry, feature)
    column = f"camera.{camera.name}.depth_scale"
    scale, why = unit_of(feature, images.is_float)
    if options.depth_scale is not None:
        scale, why = options.depth_scale, "given"
    elif rows.has(column):
        scales = np.unique(rows.column(column))
        if len(scales) != 1 or not scales[0] > 0:
            raise BadData(rows.table.path, column, expected="one number above 0", got=str(scales[:3].tolist()))
        scale, why = float(scales[0]), f"column {column}"
    return EpisodeDepth(images, scale, f"z-depth on colour, {scale:g} m per unit ({why}), 0 = no measurement")


def _filmed_depth(
    rows: EpisodeRows, entry: EpisodeEntry, camera: CameraFeatures, time: Float[ndarray, " t"], options: LerobotOptions
) -> EpisodeDepth:
    """Depth in a video: codes of a formula, or 16-bit values."""
    film = of_video(rows, entry, camera.depth, time)
    path, bits = film.video.path, film.video.bits
    if bits < 12:
        raise BadData(
            path,
            "depth",
            expected="12 or 16 bits per pixel",
            got=f"{bits}: depth for the eye",
            fix="record depth as LeRobot's depth video, 16-bit images or arrays.",
        )
    codes = depth_codes(rows.info.path, camera.depth)
    if codes is None and bits == 12 and options.depth_scale is None:
        codes = default_codes()
    if codes is None:
        scale, why = unit_of(camera.depth, is_float=False)
        scale, why = (scale, why) if options.depth_scale is None else (options.depth_scale, "given")
        images = FrameImages(film.video.size, (path,), film.values, film.faults)
        return EpisodeDepth(images, scale, f"z-depth in a video, {scale:g} m per unit ({why}), 0 = no measurement")
    if options.depth_scale is not None:
        raise UsageError(
            "--depth-scale",
            expected=f"none: {camera.depth.key} states a formula",
            got=f"{options.depth_scale:g}",
            fix="leave it out.",
        )
    metres = codes.metres

    def read(i: int) -> Depth:
        return decoded_codes(path, film.values(i), metres)

    images = FrameImages(film.video.size, (path,), read, film.faults)
    return EpisodeDepth(images, 1.0, codes.statement, codes.farthest)
