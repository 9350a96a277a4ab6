"""Figures formatted for readers: numbers, shares, lengths, sizes and durations."""

from __future__ import annotations

import markupsafe

NBSP = "\u00a0"
"""Keeps a number and its unit on one line."""


def number(value: object, digits: int = 3) -> str:
    """A number, list or text for readers; a dash where it is unknown."""
    if value is None or (isinstance(value, float) and value != value):
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, float):
        if value.is_integer() and abs(value) < 1e6:
            return f"{int(value):,}"
        return f"{value:.{digits}g}" if abs(value) < 10**digits else f"{value:,.0f}"
    if isinstance(value, (list, tuple)):
        return ", ".join(number(part, digits) for part in value)
    return str(value)


def percent(value: float | None) -> str:
    """A share in percent."""
    if value is None or value != value:
        return "–"
    return f"{100 * value:.1f}{NBSP}%" if 0 < value < 0.0995 else f"{100 * value:.0f}{NBSP}%"


def millimetres(value: float | None) -> str:
    """A length in metres, written in millimetres below one metre so that columns compare at a glance."""
    if value is None or value != value:
        return "–"
    if value >= 1:
        return f"{value:.2f}{NBSP}m"
    return f"{1000 * value:.1f}{NBSP}mm" if value < 0.0995 else f"{1000 * value:.0f}{NBSP}mm"


def size(value: float | None) -> str:
    """A size in bytes."""
    if value is None:
        return "–"
    return (
        f"{value / 1e9:.1f}{NBSP}GB"
        if value >= 1e9
        else f"{value / 1e6:.1f}{NBSP}MB"
        if value >= 1e5
        else f"{value / 1e3:.0f}{NBSP}kB"
    )


def duration(value: float | None) -> str:
    """A duration in seconds."""
    if value is None:
        return "–"
    return f"{value:.1f}{NBSP}s" if value < 100 else f"{int(value) // 60}{NBSP}min {int(value) % 60:02d}{NBSP}s"


def count(n: int, what: str) -> str:
    """A number with its noun, in the singular or plural."""
    return f"{n:,} {what}" if n == 1 else f"{n:,} {what}s"


def verbatim(text: str) -> markupsafe.Markup:
    """Our own script, which nothing from files is part of."""
    return markupsafe.Markup(text)


def svg(text: str) -> markupsafe.Markup:
    """A plot as markup; everything else on the page is escaped."""
    return markupsafe.Markup(text)  # Drawn by `plots`, without any text from files.


PLAIN = {
    "measured_and_agreeing": "visible: measured depth agrees with the surface",
    "measured_in_front": "occluded: something is measured in front",
    "measured_behind": "not visible: depth is measured behind the surface",
    "measured_through": "not visible: depth is measured where the surface should hide it",
    "measured_where_the_mesh_has_a_hole": "visible: measured where the mesh has a hole",
    "not_measured_and_kept": "visible: inferred, without measured depth",
    "not_measured_and_hidden": "occluded: inferred, without measured depth",
    "not_measured_and_filled": "visible: filled between measured pixels",
    "fixed_to_camera": "occluded by what is fixed to the camera",
    "hidden_by_colour": "occluded, by its colour",
    "frames": "frames of the scan",
    "frames_excluded": "frames excluded by name",
    "frames_of_distinct_views": "frames left after thinning",
    "frames_fused": "frames fused",
    "frames_without_depth": "frames without depth in range",
    "frames_without_depth_in_the_workspace": "frames without depth in the workspace",
    "frames_suspect": "frames that disagree with the others",
    "workspace": "workspace",
    "voxel_blocks": "blocks of the volume",
    "explained": "share of the depth on the mesh",
    "residual": "measured minus mesh depth, median, m",
    "residual_abs": "distance from the mesh, median, m",
    "seen_from_behind": "share of the surface seen from behind only",
    "validation_median_error_px": "median error in validation, pixels",
    **{f"validation_pck_{p}": f"PCK in validation, within {p} % of the diagonal" for p in (1, 2, 4, 8)},
}
"""Names of figures in the glossary's words; others are shown with spaces."""


def plain(name: str) -> str:
    """The name of a figure for readers."""
    return PLAIN.get(name, name.replace("_", " "))


def command(text: str) -> tuple[str, str]:
    """A fix as prose and the command that it ends with, if any."""
    prose, found, rest = text.partition("bask-data ")
    return prose.strip(), (found + rest).strip()


FILTERS = {
    "command": command,
    "number": number,
    "plain": plain,
    "percent": percent,
    "mm": millimetres,
    "size": size,
    "duration": duration,
    "svg": svg,
    "verbatim": verbatim,
}
