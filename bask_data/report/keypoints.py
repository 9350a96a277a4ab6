"""The sections on keypoints: picks and tracks."""

from __future__ import annotations

import numpy as np

from bask_data.core.track_scores import object_shares
from bask_data.drawing.colours import Colour, css, palette
from bask_data.drawing.images import jpeg_uri
from bask_data.drawing.marks import N_TRAIL, camera_tracks
from bask_data.drawing.pictures import Mark, marks_picture
from bask_data.drawing.plots import Curve, line_plot
from bask_data.evaluation.lookup import find, spread_frames
from bask_data.evaluation.reference_points import frame_of
from bask_data.evaluation.track_figures import TOLERANCE_PX, TrackScores, figures_of_track
from bask_data.kinds import Pick, ReferenceKeypoints
from bask_data.kinds.reference import ambiguous
from bask_data.report.chosen import N_CAMERAS, N_ROWS, PICTURE, Chosen, Part, per_item, untitled_if_alone


def reference(chosen: Chosen) -> list[Part]:
    """The frames in which the keypoints of each variant were picked."""

    def part(variant: str) -> Part | None:
        references = find(chosen.dataset, ReferenceKeypoints, "", variant)
        if references is None:
            return None
        colours = palette(len(references.picks))
        by_frame: dict[tuple[str, str, int], list[int]] = {}
        for i, pick in enumerate(references.picks):
            by_frame.setdefault((pick.recording, pick.camera, pick.frame), []).append(i)
        tiles: list[Part] = []
        unseen = []
        for (recording, camera, i_frame), indices in by_frame.items():
            image = frame_of(chosen.dataset, references.picks[indices[0]])
            if image is None:
                unseen.append(f"{recording}, {camera}, frame {i_frame}")
            elif len(tiles) < 2 * chosen.n_frames:
                marks = [_pick_mark(references.picks[i], i, colours[i]) for i in indices]
                uri = jpeg_uri(marks_picture(image, marks, 640 if len(by_frame) < 3 else PICTURE))
                tiles.append({"uri": uri, "text": f"{recording}, {camera}, frame {i_frame}"})
        return {
            "title": variant,
            "tiles": tiles,
            "n_frames_left_out": max(len(by_frame) - len(unseen) - len(tiles), 0),
            "unseen": unseen,
            "ambiguous": ambiguous(references.picks),
            "rows": [
                {"number": i + 1, "colour": css(colours[i]), **pick.model_dump()}
                for i, pick in enumerate(references.picks[: 2 * N_ROWS])
            ],
            "n_rows_left_out": max(len(references.picks) - 2 * N_ROWS, 0),
        }

    return untitled_if_alone(per_item(chosen.variants, part))


def _pick_mark(pick: Pick, i: int, colour: Colour) -> Mark:
    return Mark(number=i + 1, pixel=np.array([pick.u, pick.v]), colour=colour)


def tracks(chosen: Chosen) -> list[Part]:
    """Keypoints in the frames of each demonstration, with their spread and their error."""
    labels = {f"{name}/{variant}": (name, variant, scored) for name, variant, scored in chosen.tracks}

    def part(label: str) -> Part:
        name, variant, scored = labels[label]
        numbers = figures_of_track(scored)
        colours = palette(len(scored.track.names))
        return {
            "title": name + (f" ({variant})" if len(chosen.variants) > 1 else ""),
            "numbers": numbers,
            "strips": _strips(
                scored, colours, chosen.n_frames if variant == chosen.variants[0] else chosen.n_frames // 2
            ),
            "n_cameras_left_out": max(len(scored.track.camera_names) - N_CAMERAS, 0),
            "plots": _track_plots(scored, colours),
            "rows": [
                {"number": i + 1, "colour": css(colours[i]), **row}
                for i, row in enumerate(numbers["keypoints"][: 2 * N_ROWS])
            ],
            "n_rows_left_out": max(len(numbers["keypoints"]) - 2 * N_ROWS, 0),
            "n_trail": N_TRAIL,
        }

    parts = per_item(list(labels), part)
    compared = [{"title": part["title"], **part["numbers"]} for part in parts if "numbers" in part]
    return [{"title": "", "compared": compared}, *parts] if len(compared) > 1 else parts


def _strips(scored: TrackScores, colours: list[Colour], n_frames: int) -> list[Part]:
    """A strip of frames per camera, with keypoints, trails, one-sigma ellipses and ground truth."""
    recording = scored.recording
    if recording is None:
        return []
    first = scored.track.camera_names[:N_CAMERAS]
    strips = []
    for seen in camera_tracks(scored.track, recording.cameras, scored.places):
        camera = seen.camera
        if camera.name not in first:
            continue
        tiles = []
        for i_frame in spread_frames(min(camera.n_frames, len(seen.pixel)), n_frames):
            uri = jpeg_uri(marks_picture(camera.rgb(i_frame), seen.marks(i_frame, colours), PICTURE))
            tiles.append({"uri": uri, "text": f"frame {i_frame}"})
        strips.append({"camera": camera.name, "tiles": tiles})
    return strips


def _track_plots(scored: TrackScores, colours: list[Colour]) -> list[Part]:
    plots = []
    if not scored.why_no_error():
        plots.append(
            {
                "title": "Error",
                "svg": _over_time(scored.error * 1000, colours, "error, mm"),
                "caption": "Distance between each keypoint's mean and ground truth; the thick line is the median.",
            }
        )
    plots.append(
        {
            "title": "Spread",
            "svg": _over_time(scored.spread * 1000, colours, "spread, mm"),
            "caption": "Square root of the covariance's trace, the filter's uncertainty; the thick line is the median.",
        }
    )
    if not scored.why_no_share():
        plots.append(
            {
                "title": "On the correct object",
                "svg": _share_plot(scored),
                "caption": "Share of the keypoints whose object is in view that lie on it (solid) or within "
                f"{TOLERANCE_PX:g} px of it (dashed), by the labels. "
                "Orange: chance level.",
            }
        )
    return plots


def _over_time(values: np.ndarray, colours: list[Colour], y_label: str) -> str:
    t = np.arange(len(values))
    curves = [
        Curve(t, values[:, i], css(colour)) for i, colour in enumerate(colours) if np.isfinite(values[:, i]).any()
    ]
    known = np.isfinite(values).any(axis=1)
    middle = np.full(len(values), np.nan)
    middle[known] = np.nanmedian(values[known], axis=1)
    return line_plot([*curves, Curve(t, middle, "", thick=True)], x_label="frame", y_label=y_label)


def _share_plot(scored: TrackScores) -> str:
    per_frame = [object_shares(list(frame)) for frame in zip(*scored.landings.values(), strict=True)]
    t = np.arange(len(per_frame))
    return line_plot(
        [
            Curve(t, np.array([shares.chance for shares in per_frame]), "#d08020", dashed=True),
            Curve(t, np.array([shares.near for shares in per_frame]), "", dashed=True),
            Curve(t, np.array([shares.right for shares in per_frame]), "", thick=True),
        ],
        x_label="frame",
        y_label="share",
        y_range=(0, 1.02),
    )
