"""What a study of keypoints says of its tracks, as plain JSON values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from bask_data.evaluation.study_tracks import Method, Tracked
from bask_data.kinds import Pick

if TYPE_CHECKING:
    import numpy as np


N_MOMENTS = 101
"""Moments of the normalised time axis."""
N_EXAMPLE_FRAMES = 6
"""Frames of a demonstration that an example shows, evenly over time: what fits beside each other on a page."""


def told_of(
    picks: Sequence[Pick], objects: Sequence[str], tracks: Sequence[Tracked], methods: Sequence[Method]
) -> dict[str, Any]:
    """Figures over the keypoints and demonstrations of one set of objects."""
    import numpy as np

    from bask_data.core.keypoint_scores import PHASES, phases, share_over_time, z_edges

    of_frames = [phases(one.places, one.seen) for one in tracks]
    return {
        "demonstrations": {one.name: {"cameras": one.cameras, "n_frames": len(one.places)} for one in tracks},
        "keypoints": [
            {"object": name, **pick.model_dump(exclude={"instance", "point_world"})}
            for pick, name in zip(picks, objects, strict=True)
        ],
        "moments": np.linspace(0.0, 1.0, N_MOMENTS).tolist(),
        "share_of": {
            phase: _plain(share_over_time([found[phase] for found in of_frames], N_MOMENTS)) for phase in PHASES
        },
        "methods": {one.name: _told_method(one.name, picks, objects, tracks, of_frames) for one in methods},
        "distances": {
            "edges": z_edges().tolist(),
            "counts": {
                variant: {
                    group: np.sum([one.counts[variant][group] for one in tracks if variant in one.counts], axis=0)
                    .astype(int)
                    .tolist()
                    for group in ("near", "objects", "background")
                }
                for variant in dict.fromkeys(one.variant for one in methods)
            },
        },
        "examples": _examples(objects, tracks, methods),
    }


def _told_method(
    name: str,
    picks: Sequence[Pick],
    objects: Sequence[str],
    tracks: Sequence[Tracked],
    of_frames: Sequence[Mapping[str, np.ndarray]],
) -> dict[str, Any]:
    import numpy as np

    from bask_data.core.keypoint_scores import PHASES, Errors, distances, errors, over_time

    known_places = [np.isfinite(one.places).all(axis=2) for one in tracks]
    error = [distances(one.mean[name], one.places) for one in tracks]
    of_mode = [distances(one.mode[name], one.places) for one in tracks]
    apart = [distances(one.mean[name], one.mode[name]) for one in tracks]

    def told(values: Sequence[np.ndarray], chosen: Sequence[np.ndarray]) -> dict[str, float | int | None]:
        figures: Errors = errors(values, chosen)
        return {key: None if value != value else value for key, value in asdict(figures).items()}

    def of_keypoints(mine: np.ndarray) -> list[np.ndarray]:
        return [known & mine for known in known_places]

    def split(values: Sequence[np.ndarray]) -> dict[str, dict[str, float | int | None]]:
        return {
            "all": told(values, known_places),
            **{phase: told(values, [found[phase] for found in of_frames]) for phase in PHASES},
        }

    object_of = np.array(objects)
    along = {"error": over_time(error, N_MOMENTS), "apart": over_time(apart, N_MOMENTS)}
    return {
        "error": split(error),
        "error_of_mode": split(of_mode),
        "apart": split(apart),
        "by_object": {one: told(error, of_keypoints(object_of == one)) for one in dict.fromkeys(objects)},
        "by_keypoint": {
            pick.name: told(error, of_keypoints(np.arange(len(picks)) == i)) for i, pick in enumerate(picks)
        },
        "by_demonstration": {
            one.name: told([mine], [there]) for one, mine, there in zip(tracks, error, known_places, strict=True)
        },
        "over_time": {
            f"{what}_{figure}": _plain(getattr(found, figure))
            for what, found in along.items()
            for figure in ("mean", "deviation")
        },
    }


def _examples(objects: Sequence[str], tracks: Sequence[Tracked], methods: Sequence[Method]) -> list[dict[str, Any]]:
    """Of each object, one keypoint in some frames of the first demonstration: the median one of the last method, so
    that it is neither the best nor the worst that is shown."""
    import numpy as np

    from bask_data.core.keypoint_scores import distances

    one, last = tracks[0], methods[-1].name
    error = distances(one.mean[last], one.places)
    frames = np.linspace(0, len(error) - 1, min(N_EXAMPLE_FRAMES, len(error))).round().astype(int)
    examples = []
    for name in dict.fromkeys(objects):
        known_ones = [i for i, other in enumerate(objects) if other == name and np.isfinite(error[:, i]).any()]
        if not known_ones:
            continue
        i = sorted(known_ones, key=lambda i: float(np.nanmean(error[:, i])))[len(known_ones) // 2]
        examples.append(
            {
                "demonstration": one.name,
                "camera": one.cameras[0],
                "object": name,
                "keypoint": i,
                "frames": frames.tolist(),
                "truth": [_plain(one.uv[0, t, i]) for t in frames],
                "visible": [bool(one.seen.visible[t, i]) for t in frames],
                "first_map": {variant: [_plain(row) for row in maps[i]] for variant, maps in one.first_maps.items()},
                "pixel": {method.name: [_plain(one.pixel[method.name][t, 0, i]) for t in frames] for method in methods},
                "error": {
                    method.name: _plain(distances(one.mean[method.name], one.places)[frames, i]) for method in methods
                },
            }
        )
    return examples


def _plain(values: np.ndarray) -> list[float | None]:
    """Numbers for JSON, which knows no NaN, to a tenth of a millimetre or less."""
    return [None if value != value else round(value, 5) for value in values.tolist()]
