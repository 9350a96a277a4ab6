"""Figures of a study of keypoints, as plain JSON values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from bask_data.evaluation.certainty import certainty_figures
from bask_data.evaluation.study_tracks import Method, Tracked
from bask_data.kinds import Pick

if TYPE_CHECKING:
    import numpy as np


N_MOMENTS = 101
"""Moments of the normalised time axis."""
N_EXAMPLE_FRAMES = 6
"""Frames of a demonstration in an example, evenly spaced: as many as fit side by side on a page."""


def group_figures(
    picks: Sequence[Pick], objects: Sequence[str], tracks: Sequence[Tracked], methods: Sequence[Method]
) -> dict[str, Any]:
    """Figures over the keypoints and demonstrations of one set of objects."""
    import numpy as np

    from bask_data.core.keypoint_scores import PHASES, phases, share_over_time, z_edges

    of_frames = [phases(track.places, track.seen) for track in tracks]
    return {
        "demonstrations": {track.name: {"cameras": track.cameras, "n_frames": len(track.places)} for track in tracks},
        "keypoints": [
            {"object": name, **pick.model_dump(exclude={"instance", "point_world"})}
            for pick, name in zip(picks, objects, strict=True)
        ],
        "moments": np.linspace(0.0, 1.0, N_MOMENTS).tolist(),
        "share_of": {
            phase: _plain(share_over_time([frames[phase] for frames in of_frames], N_MOMENTS)) for phase in PHASES
        },
        "methods": {method.name: _method_figures(method.name, picks, objects, tracks, of_frames) for method in methods},
        "distances": {
            "edges": z_edges().tolist(),
            "counts": {
                variant: {
                    group: np.sum([track.counts[variant][group] for track in tracks if variant in track.counts], axis=0)
                    .astype(int)
                    .tolist()
                    for group in ("near", "objects", "background")
                }
                for variant in dict.fromkeys(method.variant for method in methods)
            },
        },
        "examples": _examples(objects, tracks, methods),
    }


def _method_figures(
    name: str,
    picks: Sequence[Pick],
    objects: Sequence[str],
    tracks: Sequence[Tracked],
    of_frames: Sequence[Mapping[str, np.ndarray]],
) -> dict[str, Any]:
    import numpy as np

    from bask_data.core.keypoint_scores import PHASES, Errors, distances, errors, over_time

    known_places = [np.isfinite(track.places).all(axis=2) for track in tracks]
    error = [distances(track.mean[name], track.places) for track in tracks]
    of_mode = [distances(track.mode[name], track.places) for track in tracks]
    apart = [distances(track.mean[name], track.mode[name]) for track in tracks]

    def plain_errors(values: Sequence[np.ndarray], chosen: Sequence[np.ndarray]) -> dict[str, float | int | None]:
        figures: Errors = errors(values, chosen)
        return {key: None if value != value else value for key, value in asdict(figures).items()}

    def of_keypoints(mine: np.ndarray) -> list[np.ndarray]:
        return [known & mine for known in known_places]

    def split(values: Sequence[np.ndarray]) -> dict[str, dict[str, float | int | None]]:
        return {
            "all": plain_errors(values, known_places),
            **{phase: plain_errors(values, [frames[phase] for frames in of_frames]) for phase in PHASES},
        }

    object_of = np.array(objects)
    along = {"error": over_time(error, N_MOMENTS), "apart": over_time(apart, N_MOMENTS)}
    return {
        "error": split(error),
        "error_of_mode": split(of_mode),
        "apart": split(apart),
        "by_object": {body: plain_errors(error, of_keypoints(object_of == body)) for body in dict.fromkeys(objects)},
        "by_keypoint": {
            pick.name: plain_errors(error, of_keypoints(np.arange(len(picks)) == i)) for i, pick in enumerate(picks)
        },
        "by_demonstration": {
            track.name: plain_errors([of_track], [is_known])
            for track, of_track, is_known in zip(tracks, error, known_places, strict=True)
        },
        "certainty": certainty_figures(name, tracks, of_frames),
        "over_time": {
            f"{what}_{figure}": _plain(getattr(curve, figure))
            for what, curve in along.items()
            for figure in ("mean", "deviation")
        },
    }


def _examples(objects: Sequence[str], tracks: Sequence[Tracked], methods: Sequence[Method]) -> list[dict[str, Any]]:
    """For each object, one keypoint in some frames of the first demonstration: the one with the last method's median
    error, which is neither the best nor the worst."""
    import numpy as np

    from bask_data.core.keypoint_scores import distances

    track, last = tracks[0], methods[-1].name
    error = distances(track.mean[last], track.places)
    frames = np.linspace(0, len(error) - 1, min(N_EXAMPLE_FRAMES, len(error))).round().astype(int)
    examples = []
    for name in dict.fromkeys(objects):
        localised = [i for i, other in enumerate(objects) if other == name and np.isfinite(error[:, i]).any()]
        if not localised:
            continue
        i = sorted(localised, key=lambda i: float(np.nanmean(error[:, i])))[len(localised) // 2]
        examples.append(
            {
                "demonstration": track.name,
                "camera": track.cameras[0],
                "object": name,
                "keypoint": i,
                "frames": [track.frames[t] for t in frames],
                "truth": [_plain(track.uv[0, t, i]) for t in frames],
                "visible": [bool(track.seen.visible[t, i]) for t in frames],
                "first_map": {variant: [_plain(row) for row in maps[i]] for variant, maps in track.first_maps.items()},
                "pixel": {
                    method.name: [_plain(track.pixel[method.name][t, 0, i]) for t in frames] for method in methods
                },
                "error": {
                    method.name: _plain(distances(track.mean[method.name], track.places)[frames, i])
                    for method in methods
                },
            }
        )
    return examples


def _plain(values: np.ndarray) -> list[float | None]:
    """Values for JSON, with five decimals; NaN becomes None."""
    return [None if value != value else round(value, 5) for value in values.tolist()]
