"""A filter's settings with the temperature and tau that were measured for the keypoints."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from bask_data.core.filters.table import FilterSettings, PerKeypoint, SettingsName, filter_named, settings_named

if TYPE_CHECKING:
    from bask_data.core.calibration import Calibration

MOST_LOG_RATIO = 80.0
"""Largest natural logarithm of `tau_ratio`: its exponential is finite in single precision. Filters bound tau at
`TAU_MOST` long before, so that another value changes nothing."""


def calibrated_settings(
    filter: str, calibration: Calibration | None, name: SettingsName = "default", **overrides: Any
) -> FilterSettings:
    """Settings of a filter as of `settings_named`, with alpha and tau of each keypoint as measured.

    The presets `paper` and `code` and fields that are given take precedence. With alpha given and tau not, tau keeps
    the distance at which a match is as likely at a rival as at the keypoint.

    Args:
        calibration: of the keypoints; None if nothing could be measured.
        overrides: fields to change, except those that are None.
    """
    if calibration is None or name != "default":
        return settings_named(filter, name, **overrides)
    given = {field: value for field, value in overrides.items() if value is not None}
    found = filter_named(filter)
    if found.by_single_frames:
        return settings_named(filter, name, **{"alpha": tuple(calibration.sharp_alpha.tolist()), **given})
    alpha, ratio = calibration.alpha.tolist(), calibration.tau_ratio.tolist()
    if "alpha" in given:
        logs = [math.log(one) * given["alpha"] / own for one, own in zip(ratio, alpha, strict=True)]
        ratio = [math.exp(min(one, MOST_LOG_RATIO)) for one in logs]
    measured = {"alpha": tuple(alpha), "tau_ratio": tuple(ratio)}
    return settings_named(filter, name, **{**found.if_calibrated, **measured, **given})


def likelihood_text(settings: FilterSettings) -> str:
    """The settings of a filter's likelihood in a line; empty without any."""
    alpha, tau, ratio = (getattr(settings, name, None) for name in ("alpha", "tau", "tau_ratio"))
    parts = [] if alpha is None else [f"alpha {_range(alpha)}"]
    if tau is not None:
        parts.append(f"tau {_range(tau)}")
    elif ratio is not None:
        parts.append(f"tau {_range(ratio)} times the likelihood of an image's average pixel")
    return ", ".join(parts)


def _range(value: PerKeypoint) -> str:
    """A setting in words."""
    if not isinstance(value, tuple):
        return f"{value:.2g}"
    return f"{range_text(value)} (measured)"


def range_text(values: Iterable[float]) -> str:
    """The smallest and the largest of some numbers, to two digits, or the one number that both are."""
    among = list(values)
    least, most = f"{min(among):.2g}", f"{max(among):.2g}"
    return least if least == most else f"{least} to {most}"
