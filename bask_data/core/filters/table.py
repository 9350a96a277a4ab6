"""The table of filters, by name or by settings: the only way in which other modules access a filter.

Nothing here needs NumPy, and a filter's module is loaded on first use: the command line reads the names only.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Literal, get_args

SettingsName = Literal["default", "paper", "code"]
"""Our own settings, those of von Hartz et al. 2023, and those of its authors' published code."""


PerKeypoint = float | tuple[float, ...]
"""A setting that is the same for all keypoints, or one value for each."""


@dataclass(frozen=True)
class FilterSettings:
    """Base of the settings of every filter; their type identifies the filter."""


@dataclass(frozen=True)
class Filter:
    """The interface of a filter.

    Attributes:
        settings: class of its settings.
        belief: class of its belief, which is all that it needs for the next frame.
        step: `(belief, observations, motion, rng, settings) -> (belief, Estimate)`.
        hypotheses: `(belief, observations, settings) -> WeightedPoints | PixelMaps`: the belief for a picture.
        presets: by name, the settings that differ from the defaults.
        if_calibrated: settings that differ from the defaults where alpha and tau were measured.
        by_single_frames: whether it takes each frame by itself: the baseline of every other filter.
        alpha_is_of_one_frame: whether its setting `alpha` is the temperature of a single frame's heat map. False for a
            filter whose `alpha` is chosen for many frames together.
    """

    settings: type[FilterSettings]
    belief: type
    step: Callable[..., tuple[Any, Any]]
    hypotheses: Callable[..., Any]
    presets: Mapping[str, Mapping[str, Any]] = field(default_factory=lambda: MappingProxyType({}))
    if_calibrated: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))
    by_single_frames: bool = False
    alpha_is_of_one_frame: bool = True


@dataclass(frozen=True)
class FilterEntry:
    """A row of the table.

    Attributes:
        module: that defines the filter as `FILTER`.
        help: its text in `bask-data encode --help`.
    """

    module: str
    help: str


FILTERS: dict[str, FilterEntry] = {
    "expectation": FilterEntry("bask_data.core.filters.expectation", "each frame by itself."),
    "discrete": FilterEntry("bask_data.core.filters.discrete", "belief over pixels."),
    "particle": FilterEntry(
        "bask_data.core.filters.particle", "belief over 3D points, which is kept while they are hidden or out of view."
    ),
}
"""All filters, in the order they are listed in."""

DEFAULT = "particle"
"""The filter of `encode`, and of a tracker without settings."""


def filter_named(name: str) -> Filter:
    """A filter of the table.

    Raises:
        ValueError: there is no such filter.
    """
    if name not in FILTERS:
        raise ValueError(f"filter: expected one of {', '.join(FILTERS)}, got {name}")
    loaded: Filter = importlib.import_module(FILTERS[name].module).FILTER
    return loaded


def filter_of(settings: FilterSettings) -> Filter:
    """The filter that settings are for.

    Raises:
        ValueError: no filter has settings of this type.
    """
    for name in FILTERS:
        found = filter_named(name)
        if type(settings) is found.settings:
            return found
    raise ValueError(f"settings: expected those of {', '.join(FILTERS)}, got {type(settings).__name__}")


def settings_named(filter: str, name: SettingsName = "default", **overrides: Any) -> FilterSettings:
    """Settings of a filter: our own, the paper's or those of its authors' published code.

    The paper leaves most values open; these are as in the code.

    Args:
        overrides: fields to change, except those that are None.

    Raises:
        ValueError: there is no such filter, or no settings of that name.
    """
    if filter not in FILTERS or name not in get_args(SettingsName):
        known = f"one of {', '.join(FILTERS)} and one of {', '.join(get_args(SettingsName))}"
        raise ValueError(f"settings: expected {known}, got {filter} and {name}")
    found = filter_named(filter)
    given = {field: value for field, value in overrides.items() if value is not None}
    return replace(found.settings(), **{**found.presets.get(name, {}), **given})


def alpha_of_one_frame(filter: str, name: SettingsName = "default", alpha: float | None = None) -> float | None:
    """Temperature of one frame's heat map softmax(-alpha z) as a filter uses it.

    Args:
        filter: may be absent from the table, as that of a track made from ground truth.
        alpha: the temperature given by the user, if any.

    Returns:
        None where the filter has no temperature of a single frame.
    """
    if filter not in FILTERS or (alpha is None and not filter_named(filter).alpha_is_of_one_frame):
        return None
    found: float | None = getattr(settings_named(filter, name), "alpha", None) if alpha is None else alpha
    return found
