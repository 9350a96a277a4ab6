"""Whether tracks are as accurate as they claim: covariance, `localised` and `observed` compared with ground truth."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np

    from bask_data.core.coverage import Claims, Coverage
    from bask_data.evaluation.study_tracks import Tracked

OF_CERTAINTY = ("visible", "occluded", "out of view", "not seen yet")
"""The classes of frames by which certainty is broken down; they exclude each other."""


def certainty_figures(
    name: str, tracks: Sequence[Tracked], of_frames: Sequence[Mapping[str, np.ndarray]]
) -> dict[str, Any]:
    """Figures of one method over all tracks, for JSON.

    `coverage`, over all frames and keypoints with ground truth and by visibility, is that of `coverage`. `localised` is
    the claim that a position is known, and true once a camera has shown the keypoint. `observed` is a claim for each
    camera, and true where it shows the keypoint.

    Args:
        name: of the method.
        of_frames: frames in each class, for each track.
    """
    import numpy as np

    from bask_data.core.coverage import claims, coverage

    offset = np.concatenate([_flat(track.places - track.mean[name]) for track in tracks])
    covariance = np.concatenate([_flat(track.covariance[name]) for track in tracks])
    known = np.concatenate([_flat(np.isfinite(track.places).all(axis=2)) for track in tracks])
    chosen = {"all": known, **{phase: np.concatenate([_flat(of[phase]) for of in of_frames]) for phase in OF_CERTAINTY}}
    localised = known & np.isfinite(offset).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2))
    seen_by_now = np.concatenate([_flat(np.logical_or.accumulate(track.seen.visible, axis=0)) for track in tracks])
    return {
        "coverage": {group: _coverage(coverage(offset[mask], covariance[mask])) for group, mask in chosen.items()},
        "localised": _claims(claims(localised, seen_by_now, known)),
        "observed": {
            camera: _claims(claims(*_observed(name, camera, tracks)))
            for camera in dict.fromkeys(camera for track in tracks for camera in track.cameras)
        },
    }


def _flat(values: np.ndarray) -> np.ndarray:
    """Values (t, k, ...) as (t k, ...)."""
    return values.reshape(-1, *values.shape[2:])


def _observed(name: str, camera: str, tracks: Sequence[Tracked]) -> list[np.ndarray]:
    """Whether a method claims that a camera sees each keypoint, whether it does, and whether that is known."""
    import numpy as np

    parts: list[list[np.ndarray]] = [[], [], []]
    for track in tracks:
        if camera in track.cameras:
            i = track.cameras.index(camera)
            known = np.isfinite(track.places).all(axis=2)
            for part, values in zip(parts, (track.observed[name][:, i], track.shown[i], known), strict=True):
                part.append(values.ravel())
    return [np.concatenate(part) for part in parts]


def _coverage(found: Coverage) -> dict[str, Any]:
    from bask_data.core.coverage import LEVELS

    return {
        "n": found.n,
        "n_unknown": found.n_unknown,
        "n_invalid": found.n_invalid,
        "within_sigmas": _plain(found.within),
        "nominal": list(LEVELS),
        "measured": _plain(found.measured),
        "calibration_error": None if found.error != found.error else found.error,
    }


def _claims(found: Claims) -> dict[str, Any]:
    from dataclasses import asdict

    return {key: None if value != value else value for key, value in asdict(found).items()}


def _plain(values: np.ndarray) -> list[float | None]:
    """Values for JSON, with five decimals; NaN becomes None."""
    return [None if value != value else round(value, 5) for value in values.tolist()]


# Text -----------------------------------------------------------------------------------------------------------------


OF_COLUMNS = (
    "sigma: share of true positions in these ellipsoids of the covariance; error: mean |measured - nominal| share",
    "  over nominal 5 to 95 %, also by visibility; localised, observed: precision / recall against visibility",
)
"""Explanation of the columns, once for all tables."""


def certainty_lines(methods: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    """A head, and for each method a line with its calibration and its claims.

    Args:
        methods: figures of a study by method.
    """
    import numpy as np

    from bask_data.core.coverage import SIGMAS, chi_square_share

    cameras = list(next(iter(methods.values()))["certainty"]["observed"])
    heads = "".join(f"{head:>13}" for head in (*(f"{n} sigma" for n in SIGMAS), "error", *OF_CERTAINTY))
    claimed = "".join(f"{head:>22}" for head in ("localised", *(f"{camera} observed" for camera in cameras)))
    yield f"{'  certainty, %':<38}{heads}{claimed}"
    for method, figures in methods.items():
        certainty = figures["certainty"]
        of_all = certainty["coverage"]["all"]
        errors = [certainty["coverage"][phase]["calibration_error"] for phase in OF_CERTAINTY]
        shares = [*of_all["within_sigmas"], of_all["calibration_error"], *errors]
        cells = "".join(f"{_percent(share):>13}" for share in shares)
        said = [certainty["localised"], *(certainty["observed"][camera] for camera in cameras)]
        pairs = [f"{_percent(one['precision'])} / {_percent(one['recall'])}" for one in said]
        yield f"    {method:<34}{cells}" + "".join(f"{pair:>22}" for pair in pairs)
    calibrated = [*chi_square_share(np.square(SIGMAS, dtype=np.float64)).tolist(), *[0.0] * (1 + len(OF_CERTAINTY))]
    yield f"    {'a calibrated belief':<34}" + "".join(f"{_percent(share):>13}" for share in calibrated)


def _percent(share: float | None) -> str:
    return "-" if share is None else format(100 * share, ".1f")
