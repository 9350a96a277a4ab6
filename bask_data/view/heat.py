"""Heat maps of the reference keypoints in the frames of a scan or demonstration."""

from __future__ import annotations

import numpy as np

from bask_data.core.geometry import scale_pixels
from bask_data.dataset import Dataset
from bask_data.drawing.colours import WHITE, palette
from bask_data.drawing.pictures import Mark, heat_picture, marks_picture
from bask_data.evaluation.finder import Finder, Sight, network_of
from bask_data.evaluation.lookup import spread_frames
from bask_data.evaluation.reference_points import BEHIND, SEEN, PointsInFrame, TruePlaces, frame_of, reference_points
from bask_data.kinds import Camera, Pick, Recording
from bask_data.progress import progress
from bask_data.view.choice import Choice
from bask_data.view.sheet import CORNER, GREY, DrawnItem, Sheet, jpeg, reading

N_HEATED_POINTS = 16
"""Keypoints with heat maps, at most: as many as the paper tracks, and as fit into a grid beside the scene."""
N_HEATED_FRAMES = 40
"""Frames of each camera, at most: the network takes longer for one than all other drawing."""
HEAT_WIDTH = 320
"""Width of a picture, pixels, at most: there are many, and heat maps have no finer detail."""


def draw_heat(sheet: Sheet, drawn: DrawnItem, dataset: Dataset, name: str, source: Recording, choice: Choice) -> None:
    """Draw each keypoint's heat map, with its best match and its ground truth."""
    descriptor = network_of(dataset, choice.variant)
    if descriptor is None:
        drawn.note(False, "heat maps", "bask-data train")
        return
    with reading(descriptor):
        picks = reference_points(dataset, [choice.variant, *dataset.file.variants.get("reference", {}), "main"])
        finder, places = Finder(dataset, choice.variant, descriptor, picks), TruePlaces(dataset, picks, name)
        here = [i for i in range(len(picks)) if finder.described[i] and not places.absent[i]][:N_HEATED_POINTS]
        for camera in source.cameras if here else []:
            _draw_camera(sheet, camera, finder, places, picks, here, choice.every)
            drawn.heated[camera.name] = [place_of(picks[i], i) for i in here]
        if here:
            _draw_reference(sheet, dataset, picks, here)
    drawn.note(
        bool(here),
        "heat maps",
        "none of the keypoints' objects is in this recording" if picks else "bask-data reference",
    )


def place_of(pick: Pick, i: int) -> str:
    """A keypoint's entity name, numbered as in reports, and so unique."""
    return f"{i + 1} {pick.name}"


def _draw_camera(
    sheet: Sheet, camera: Camera, finder: Finder, places: TruePlaces, picks: list[Pick], here: list[int], every: int
) -> None:
    colours = palette(len(picks))
    shown = range(0, camera.n_frames, every)
    chosen = [shown[i] for i in spread_frames(len(shown), N_HEATED_FRAMES)]
    begin = float(camera.time[0]) if len(camera.time) else 0.0
    for i_frame in progress(chosen, f"drawing {sheet.item}, {camera.name}, heat maps"):
        rgb, truth = camera.rgb(i_frame), places.pixels(camera, i_frame)
        sight = finder.look(rgb, here)
        with sheet.at(frame=i_frame, seconds=float(camera.time[i_frame]) - begin):
            for row, i in enumerate(here):
                place = ("heat", camera.name, place_of(picks[i], i))
                _draw_point(sheet, place, rgb, sight, row, truth, i, colours[i])


def _draw_point(
    sheet: Sheet,
    place: tuple[str, ...],
    rgb: np.ndarray,
    sight: Sight,
    row: int,
    truth: PointsInFrame,
    i: int,
    colour: tuple[int, int, int],
) -> None:
    import rerun as rr

    picture = heat_picture(rgb, sight.heat[row], [], min(HEAT_WIDTH, rgb.shape[1]))

    def on_picture(uv: np.ndarray) -> np.ndarray:
        return scale_pixels(uv.reshape(-1, 2), rgb.shape[:2], picture.shape[:2]) + CORNER

    best, seen = on_picture(sight.best[row]), truth.states[i] == SEEN
    true = on_picture(truth.uv[i] if truth.states[i] in (SEEN, BEHIND) else np.zeros((0, 2)))
    sheet.log((*place, "map"), rr.EncodedImage(contents=jpeg(picture), media_type="image/jpeg"))
    # What a frame lacks is logged as empty, or the viewer keeps showing an earlier frame's.
    joined = [np.concatenate([best, true])] if seen else []
    sheet.log((*place, "error"), rr.LineStrips2D(joined, colors=[WHITE], radii=rr.Radius.ui_points(0.75)))
    label = "ground truth" if seen else f"ground truth, {truth.states[i]}"
    sheet.log(
        (*place, "truth"),
        rr.Points2D(
            true,
            colors=[WHITE if seen else GREY],
            labels=[label] * len(true),
            show_labels=False,
            radii=rr.Radius.ui_points(5),
        ),
    )
    sheet.log(
        (*place, "best"),
        rr.Points2D(best, colors=[colour], labels=["best match"], show_labels=False, radii=rr.Radius.ui_points(3.5)),
    )


def _draw_reference(sheet: Sheet, dataset: Dataset, picks: list[Pick], here: list[int]) -> None:
    """Draw the image that most of the keypoints were picked in."""
    import rerun as rr

    frames = [(picks[i].recording, picks[i].camera, picks[i].frame) for i in here]
    most = max(frames, key=frames.count)
    colours = palette(len(picks))
    of_frame = [i for i, frame in zip(here, frames, strict=True) if frame == most]
    image = frame_of(dataset, picks[of_frame[0]])
    if image is None:
        return
    marks = [Mark(i + 1, np.array([picks[i].u, picks[i].v]), colours[i]) for i in of_frame]
    picture = marks_picture(image, marks, max(2 * HEAT_WIDTH, image.shape[1]))
    sheet.fix(("heat", "reference"), rr.EncodedImage(contents=jpeg(picture), media_type="image/jpeg"))
