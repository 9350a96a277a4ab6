"""The section on heat maps: keypoints that networks find in other views, compared with ground truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bask_data.dataset import Dataset
from bask_data.drawing.colours import WHITE, Colour, css, heat_gradient, palette
from bask_data.drawing.images import jpeg_uri
from bask_data.drawing.pictures import Mark, crop_picture, heat_picture
from bask_data.evaluation.artifact_figures import is_still
from bask_data.evaluation.finder import Finder, Sight
from bask_data.evaluation.lookup import UNREADABLE, find, find_recording, spread_frames, what_is_wrong
from bask_data.evaluation.reference_points import (
    BEHIND,
    SEEN,
    UNKNOWN,
    PointsInFrame,
    TruePlaces,
    frame_of,
    reference_points,
)
from bask_data.kinds import Camera, Pick, Recording, ReferenceKeypoints, Scan
from bask_data.report.chosen import Chosen, Part, per_item

N_SCANS = 3
"""Scans whose picks are looked for, at most."""
N_HEAT_POINTS, N_HEAT_POINTS_OF_MANY = 5, 2
"""Keypoints shown of a single scan, and of each of several; each has a row for every network."""
N_HEAT_FRAMES = 4
"""Frames shown, the columns of the table of heat maps, at most."""
N_LOOKED_AT = 24
"""Frames of each camera that are searched for those that show the keypoints."""
HEAT_TILE, CROP = 280, 200
"""Widths in pixels: of a heat map, and of the crop around a pick."""


def heat_maps(chosen: Chosen) -> list[Part]:
    """Heat maps of some keypoints by each network, with ground truth; held-out scenes come first."""
    dataset = chosen.dataset
    if not chosen.networks:
        reason = "the descriptor network of the reference keypoints is missing"
        has_reference = any(find(dataset, ReferenceKeypoints, "", variant) for variant in chosen.variants)
        return [{"title": "", "why_not": reason}] if has_reference else []
    picks = reference_points(dataset, [*chosen.networks, *chosen.variants])
    if not picks:
        return []
    finders: dict[str, Finder] = {}
    failed = []
    for variant, network in chosen.networks.items():
        try:
            finders[variant] = Finder(dataset, variant, network, picks)
        except UNREADABLE as error:
            failed.append({"title": variant, "error": what_is_wrong(error)})
    described = np.all([finder.described for finder in finders.values()], axis=0) if finders else np.zeros(0, bool)
    if finders and not described.any():
        failed.append({"title": "", "why_not": "the keypoints were picked in frames that are not in this dataset"})
    searches = _searches(chosen, picks, described) if described.any() else {}
    return [*failed, *per_item(list(searches), lambda title: _heat_part(chosen, searches[title], picks, finders))]


@dataclass(frozen=True)
class _Search:
    """A recording with its title, and the keypoints that are looked for in it."""

    recording: Recording
    title: str
    places: TruePlaces
    indices: list[int]


def _searches(chosen: Chosen, picks: Sequence[Pick], described: np.ndarray) -> dict[str, _Search]:
    """Searches in held-out scenes, in the scans that keypoints were picked in, and in a demonstration.

    Keypoints of several scans are on different objects: each scan gets its own held-out scene, and fewer keypoints.
    """
    scans = list(dict.fromkeys(pick.recording for pick in picks))[:N_SCANS]
    n_points = N_HEAT_POINTS if len(scans) == 1 else N_HEAT_POINTS_OF_MANY
    wanted = [(_held_out_scene(chosen, picks, scan, len(scans) == 1), "a held-out scene", scan) for scan in scans]
    if len(scans) == 1 or not any(name for name, _, _ in wanted):
        wanted += [(scan, "the scan they were picked in", scan) for scan in scans]
    wanted += [(name, "a demonstration", scans[0]) for name in chosen.demonstrations[:1]]
    searches = {}
    for name, title, scan in wanted:
        recording, places = find_recording(chosen.dataset, name), TruePlaces(chosen.dataset, picks, name)
        mine = described & np.array([pick.recording == scan for pick in picks])
        indices = _one_of_each_object(picks, places.absent, mine, n_points)
        if recording is not None and indices:
            searches[f"{name}: {title}"] = _Search(recording, title, places, indices)
    return searches


def _held_out_scene(chosen: Chosen, picks: Sequence[Pick], scan: str, is_only: bool) -> str:
    """The first held-out scene with ground truth for a keypoint of the scan, as others may lack its objects; else, for
    the only scan, the first held-out scene. Empty without any."""
    dataset, mine = chosen.dataset, [pick for pick in picks if pick.recording == scan]
    splits = dataset.file.splits
    held_out = [name for name in (*splits.test, *splits.validation) if name != scan and find_recording(dataset, name)]
    known = (name for name in held_out if any(TruePlaces(dataset, mine, name).known))
    return next(known, held_out[0] if is_only and held_out else "")


def _heat_part(chosen: Chosen, search: _Search, picks: Sequence[Pick], finders: dict[str, Finder]) -> Part:
    recording, places, indices = search.recording, search.places, search.indices
    n_frames = max(min(chosen.n_frames // 2, N_HEAT_FRAMES), 1)
    camera, frames = _frames_that_show(recording, places, picks, indices, n_frames)
    colours = palette(len(picks))
    tiles: dict[tuple[int, str], list[Part]] = {(i, variant): [] for i in indices for variant in finders}
    for i_frame in frames:
        rgb, truth = camera.rgb(i_frame), places.pixels(camera, i_frame)
        for variant, finder in finders.items():
            sight = finder.look(rgb, indices)
            for row, i in enumerate(indices):
                tiles[i, variant].append(_heat_tile(rgb, sight, row, truth, i, colours[i], i_frame))
    first = next(iter(finders))
    return {
        "title": f"{recording.path.name}, {camera.name}: {search.title}",
        "rows": [
            {
                "number": i + 1,
                "name": picks[i].name,
                "variant": variant if len(finders) > 1 else "",
                "colour": css(colours[i]),
                "crop": _crop(chosen.dataset, picks[i]) if variant == first else "",
                "absent": places.absent[i],
                "tiles": tiles[i, variant],
            }
            for i in indices
            for variant in finders
        ],
        "n_columns": len(frames),
        "n_left_out": sum(pick.recording == picks[indices[0]].recording for pick in picks) - len(indices),
        "alphas": [(variant, finder.alpha) for variant, finder in finders.items()],
        "gradient": heat_gradient(),
        "with_truth": any(places.known[i] for i in indices),
        "why_not": "",
    }


def _frames_that_show(
    recording: Recording, places: TruePlaces, picks: Sequence[Pick], indices: Sequence[int], n_frames: int
) -> tuple[Camera, list[int]]:
    """The camera that sees the keypoints most often, and frames spread over those that show most of them, except those
    they were picked in; any frames where no ground truth is known."""
    own = {(pick.camera, pick.frame) for pick in picks if pick.recording == recording.path.name}
    best: tuple[int, Camera, list[int]] | None = None
    for camera in recording.cameras:
        candidates = [i for i in range(camera.n_frames) if (camera.name, i) not in own]
        if isinstance(recording, Scan) and is_still(camera):
            candidates = candidates[:1]  # The others would show the same.
        candidates = [candidates[i] for i in spread_frames(len(candidates), N_LOOKED_AT)]
        counts = np.array([_n_seen(places.pixels(camera, i), indices) for i in candidates], dtype=int)
        many = [i for i, n in zip(candidates, counts, strict=True) if 2 * n > counts.max(initial=0)]
        if best is None or counts.sum() > best[0]:
            best = int(counts.sum()), camera, many or candidates
    assert best is not None, "a recording has a camera"
    _, camera, frames = best
    return camera, [frames[i] for i in spread_frames(len(frames), n_frames)]


def _n_seen(truth: PointsInFrame, indices: Sequence[int]) -> int:
    return sum(truth.states[i] == SEEN for i in indices)


def _heat_tile(
    rgb: np.ndarray, sight: Sight, row: int, truth: PointsInFrame, i: int, colour: Colour, i_frame: int
) -> Part:
    state = truth.states[i]
    mark = Mark(i + 1, sight.best[row], colour, truth=truth.uv[i] if state in (SEEN, BEHIND) else None)
    uri = jpeg_uri(heat_picture(rgb, sight.heat[row], [mark], HEAT_TILE, truth_seen=state == SEEN))
    error = float(np.linalg.norm(sight.best[row] - truth.uv[i]))
    text = {SEEN: f"{error:.1f} px off", UNKNOWN: ""}.get(state, state)
    nearest = f"nearest {float(sight.nearest[row]):.2f}"
    return {"uri": uri, "text": ", ".join(part for part in (f"frame {i_frame}", text, nearest) if part)}


def _one_of_each_object(picks: Sequence[Pick], absent: Sequence[bool], among: np.ndarray, n: int) -> list[int]:
    """Indices of n keypoints, alternating between the objects they were picked on; absent objects come last."""
    turns: dict[int, int] = {}
    order = []
    for i, pick in enumerate(picks):
        if among[i]:
            turns[pick.instance] = turns.get(pick.instance, 0) + 1
            order.append((absent[i], turns[pick.instance], i))
    return sorted(i for _, _, i in sorted(order)[:n])


def _crop(dataset: Dataset, pick: Pick) -> str:
    image = frame_of(dataset, pick)
    if image is None or not np.isfinite([pick.u, pick.v]).all():
        return ""
    half = max(12, image.shape[1] // 8)
    return jpeg_uri(crop_picture(image, np.array([pick.u, pick.v]), half, CROP, WHITE))
