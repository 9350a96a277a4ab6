"""The report's heat maps: where networks find points in other views, and where these truly are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bask_data.dataset import Dataset
from bask_data.kinds import Camera, Pick, Recording
from bask_data.report import figures
from bask_data.report import pictures as draw
from bask_data.report.figures import find_recording, spread_frames
from bask_data.report.points import (
    BEHIND,
    SEEN,
    UNKNOWN,
    Finder,
    Sight,
    TruePixels,
    TruePlaces,
    frame_of,
    reference_points,
)
from bask_data.report.sections import Chosen, Part, per_item

N_POINTS = 5
"""Points looked for; each has a row for every network."""
N_FRAMES = 4
TILE, CROP = 280, 200


def heat_maps(chosen: Chosen) -> list[Part]:
    """Where each network finds some points in other views, and where they truly are; held-out scenes come first."""
    dataset = chosen.dataset
    picks = reference_points(dataset, [*chosen.networks, *chosen.variants])
    if not picks:
        return []
    if not chosen.networks:
        return [{"title": "", "why_not": "the descriptor network they were described with is not there"}]
    finders: dict[str, Finder] = {}
    failed = []
    for variant, network in chosen.networks.items():
        try:
            finders[variant] = Finder(dataset, variant, network, picks)
        except figures.UNREADABLE as error:
            failed.append({"title": variant, "error": figures.what_is_wrong(error)})
    shown = _heat_recordings(chosen, picks) if finders else {}
    return [*failed, *per_item(list(shown), lambda name: _heat_part(chosen, name, shown[name], picks, finders))]


def _heat_recordings(chosen: Chosen, picks: Sequence[Pick]) -> dict[str, str]:
    """What points are looked for in, and what it is: a held-out scene, their own scan, a demonstration."""
    splits, found = chosen.dataset.file.splits, {}
    held_out = [name for name in (*splits.test, *splits.validation) if find_recording(chosen.dataset, name)]
    # The objects of another task are nowhere to be found.
    with_place = (
        name for name in held_out if any(p is not None for p in TruePlaces(chosen.dataset, picks, name).places)
    )
    for name in [next(with_place, *held_out[:1] or [""])]:
        found[name] = "a held-out scene"
    for name in [pick.recording for pick in picks[:1]]:
        found.setdefault(name, "the scan they were picked in")
    for name in chosen.demonstrations[:1]:
        found.setdefault(name, "a demonstration")
    return {name: what for name, what in found.items() if find_recording(chosen.dataset, name)}


def _heat_part(chosen: Chosen, name: str, what: str, picks: Sequence[Pick], finders: dict[str, Finder]) -> Part:
    recording, places = find_recording(chosen.dataset, name), TruePlaces(chosen.dataset, picks, name)
    assert recording is not None, "looked for before"
    described = np.all([finder.described for finder in finders.values()], axis=0)
    indices = _one_of_each_object(picks, places.absent, described)
    if not indices:
        return {"title": name, "why_not": "the points were picked in images that this dataset does not hold"}
    n_frames = max(min(chosen.n_frames // 2, N_FRAMES), 1)
    camera, frames = _frames_in_view(recording, places, picks, indices, n_frames)
    colours = draw.palette(len(picks))
    tiles: dict[tuple[int, str], list[Part]] = {(i, variant): [] for i in indices for variant in finders}
    for i_frame in frames:
        rgb, truth = camera.rgb(i_frame), places.pixels(camera, i_frame)
        for variant, finder in finders.items():
            sight = finder.look(rgb, indices)
            for row, i in enumerate(indices):
                tiles[i, variant].append(_heat_tile(rgb, sight, row, truth, i, colours[i], i_frame))
    first = next(iter(finders))
    return {
        "title": f"{name}, {camera.name}: {what}",
        "rows": [
            {
                "number": i + 1,
                "name": picks[i].name,
                "variant": variant if len(finders) > 1 else "",
                "colour": draw.css(colours[i]),
                "crop": _crop(chosen.dataset, picks[i]) if variant == first else "",
                "absent": places.absent[i],
                "tiles": tiles[i, variant],
            }
            for i in indices
            for variant in finders
        ],
        "n_columns": len(frames),
        "n_left_out": len(picks) - len(indices),
        "alphas": [(variant, finder.alpha) for variant, finder in finders.items()],
        "gradient": draw.heat_gradient(),
        "with_truth": any(place is not None for place in places.places),
        "why_not": "",
    }


def _frames_in_view(
    recording: Recording, places: TruePlaces, picks: Sequence[Pick], indices: Sequence[int], n_frames: int
) -> tuple[Camera, list[int]]:
    """The camera that sees the points most often, and frames spread over those that show most of them, but not the
    ones they were picked in; of a recording in which no place is known, any."""
    own = {(pick.camera, pick.frame) for pick in picks if pick.recording == recording.path.name}
    best: tuple[int, Camera, list[int]] | None = None
    for camera in recording.cameras:
        counts = np.array([int(places.in_view(camera, i)[indices].sum()) for i in range(camera.n_frames)])
        candidates = [i for i in range(camera.n_frames) if (camera.name, i) not in own]
        many = [i for i in candidates if 2 * counts[i] > counts.max(initial=0)] or candidates
        if best is None or counts.sum() > best[0]:
            best = int(counts.sum()), camera, many
    assert best is not None, "a recording has a camera"
    _, camera, frames = best
    return camera, [frames[i] for i in spread_frames(len(frames), n_frames)]


def _heat_tile(
    rgb: np.ndarray, sight: Sight, row: int, truth: TruePixels, i: int, colour: draw.Colour, i_frame: int
) -> Part:
    state = truth.states[i]
    mark = draw.Mark(i + 1, sight.best[row], colour, truth=truth.uv[i] if state in (SEEN, BEHIND) else None)
    uri = draw.jpeg_uri(draw.heat_picture(rgb, sight.heat[row], [mark], TILE, truth_seen=state == SEEN))
    error = float(np.linalg.norm(sight.best[row] - truth.uv[i]))
    text = {SEEN: f"{error:.1f} px off", UNKNOWN: ""}.get(state, state)
    nearest = f"nearest {float(sight.nearest[row]):.2f}"
    return {"uri": uri, "text": ", ".join(part for part in (f"frame {i_frame}", text, nearest) if part)}


def _one_of_each_object(picks: Sequence[Pick], absent: Sequence[bool], described: np.ndarray) -> list[int]:
    """A few points, taking turns between the objects they were picked on; those that cannot be found come last."""
    turns: dict[int, int] = {}
    order = []
    for i, pick in enumerate(picks):
        if described[i]:
            turns[pick.instance] = turns.get(pick.instance, 0) + 1
            order.append((absent[i], turns[pick.instance], i))
    return sorted(i for _, _, i in sorted(order)[:N_POINTS])


def _crop(dataset: Dataset, pick: Pick) -> str:
    image = frame_of(dataset, pick)
    if image is None or not np.isfinite([pick.u, pick.v]).all():
        return ""
    half = max(12, image.shape[1] // 8)
    return draw.jpeg_uri(draw.crop_picture(image, np.array([pick.u, pick.v]), half, CROP, draw.WHITE))
