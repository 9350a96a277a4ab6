"""Videos of keypoints over the frames of a demonstration, playable in browsers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from bask_data.dataset import Dataset
from bask_data.drawing.colours import Colour, palette
from bask_data.drawing.marks import CameraTrack, camera_tracks
from bask_data.drawing.pictures import Mark, marks_picture
from bask_data.errors import BaskError, UsageError, WouldOverwrite
from bask_data.evaluation.lookup import find, find_recording
from bask_data.evaluation.track_figures import TrackScores
from bask_data.formats.video import VideoWriter, import_av
from bask_data.kinds import Camera, KeypointTrack
from bask_data.progress import progress
from bask_data.view.sheet import reading

VIDEO_WIDTH = 480
"""Width of each camera's image in the video, pixels."""
GAP, LINE = 8, 30
"""Pixels between images, and height of a line of text."""
FALLBACK_RATE = 20.0
"""Frames per second where a recording's times give none."""
BACKGROUND, INK = (24, 26, 30), (225, 228, 232)
_FONT, _SCALE = cv2.FONT_HERSHEY_SIMPLEX, 0.45


def write_videos(
    dataset: Dataset, folder: Path, items: Sequence[str], *, variant: str = "main", every: int = 1, force: bool = False
) -> dict[str, Path]:
    """Write a video of each of these demonstrations that has a track: its cameras side by side, in real time.

    A dot is a keypoint that the filter considers visible, a ring an occluded one, a triangle at the edge one out of
    view. Ellipses are one sigma, crosses ground truth.

    Args:
        every: show every n-th frame.
        force: replace existing files, each in one step when the new one is complete.

    Returns:
        The files by demonstration.

    Raises:
        MissingDependency: PyAV is not installed.
        UsageError: none of the items has a track.
        WouldOverwrite: a file exists.
        BadData: a track cannot be read, or is inconsistent with its recording.
        BaskError: the files cannot be written.
    """
    import_av()
    tracked = [name for name in items if find(dataset, KeypointTrack, name, variant) and find_recording(dataset, name)]
    if not tracked:
        fix = f"bask-data encode {dataset.root}"
        expected = f"a demonstration with keypoints ({variant})"
        raise UsageError(dataset.root, "--video", expected=expected, got=f"none of {', '.join(items)}", fix=fix)
    suffix = "" if variant == "main" else f"-{variant}"
    files = {name: folder / f"{name}{suffix}.mp4" for name in tracked}
    try:
        for file in files.values():
            if file.exists() and not force:
                raise WouldOverwrite(file, "", expected="no file", got="one", fix="--force replaces it.")
        folder.mkdir(parents=True, exist_ok=True)
        for name, file in files.items():
            scored = TrackScores(dataset, name, variant)
            with reading(scored.track):
                _write(scored, f"{name} ({variant}, {scored.track.metadata.filter})", file, every)
    except OSError as error:
        fix = "check that the disk has space and that you may write there."
        raise BaskError(
            folder, "", expected="a writable folder and enough disk space", got=str(error)[:200], fix=fix
        ) from error
    return files


def _write(scored: TrackScores, title: str, file: Path, every: int) -> None:
    assert scored.recording is not None, "only recordings with frames are drawn"
    strips = camera_tracks(scored.track, scored.recording.cameras, scored.places)
    colours = palette(len(scored.track.names))
    frames = range(0, min(len(scored.track.mean), *(strip.camera.n_frames for strip in strips)), every)
    with VideoWriter(file, fps=_rate(strips[0].camera) / every, size=_size(strips)) as video:
        for i_frame in progress(frames, f"drawing {file.name}"):
            video.append(_picture(scored, strips, title, i_frame, colours))


def _rate(camera: Camera) -> float:
    """Frames per second, by the median time between frames."""
    steps = np.diff(camera.time)
    step = float(np.median(steps)) if len(steps) else 0.0
    return 1.0 / step if np.isfinite(step) and step > 0 else FALLBACK_RATE


def _size(strips: Sequence[CameraTrack]) -> tuple[int, int]:
    """Height and width of the video, pixels."""
    heights = [max(1, round(strip.camera.height * VIDEO_WIDTH / strip.camera.width)) for strip in strips]
    return max(heights) + 2 * LINE, len(strips) * (VIDEO_WIDTH + GAP) - GAP


def _picture(
    scored: TrackScores, strips: Sequence[CameraTrack], title: str, i_frame: int, colours: list[Colour]
) -> np.ndarray:
    """One frame of the video (h, w, 3) uint8."""
    height, width = _size(strips)
    picture = np.full((height, width, 3), BACKGROUND, np.uint8)
    for i, strip in enumerate(strips):
        marks = strip.marks(i_frame, colours)
        drawn = marks_picture(strip.camera.rgb(i_frame), marks, VIDEO_WIDTH)
        _draw_outside(drawn, marks, VIDEO_WIDTH / strip.camera.width)
        left = i * (VIDEO_WIDTH + GAP)
        picture[LINE : LINE + len(drawn), left : left + VIDEO_WIDTH] = drawn
        _text(picture, strip.camera.name, left + 6, LINE - 10)
    time = strips[0].camera.time
    seconds = f", {time[i_frame] - time[0]:.2f} s" if len(time) > i_frame else ""
    legend = "dot: visible   ring: occluded   triangle: out of view   ellipse: sigma"
    truth = "   cross: ground truth" if scored.with_place.any() else ""
    _text(picture, f"{title}, frame {i_frame}{seconds}", 90, LINE - 10)
    _text(picture, legend + truth, 6, height - 10)
    return picture


def _draw_outside(picture: np.ndarray, marks: Sequence[Mark], factor: float) -> None:
    """Draw triangles at the edge, nearest to keypoints outside the image."""
    height, width = picture.shape[:2]
    for mark in marks:
        point = mark.pixel.astype(np.float64) * factor
        if not np.isfinite(point).all():
            continue
        nearest = np.clip(point, 9, [width - 10, height - 10])
        away = point - nearest
        if (point < 0).any() or (point > [width - 1, height - 1]).any():
            ahead = 8 * away / np.linalg.norm(away)
            aside = 0.7 * np.array([-ahead[1], ahead[0]])
            corners = np.rint([nearest + ahead, nearest - ahead + aside, nearest - ahead - aside]).astype(np.int32)
            cv2.fillPoly(picture, [corners], mark.colour, cv2.LINE_AA)
            cv2.polylines(picture, [corners], True, (0, 0, 0), 1, cv2.LINE_AA)


def _text(picture: np.ndarray, text: str, left: int, bottom: int) -> None:
    # OpenCV's font has no letters beyond ASCII.
    plain = text.encode("ascii", "replace").decode()
    cv2.putText(picture, plain, (left, bottom), _FONT, _SCALE, INK, 1, cv2.LINE_AA)
