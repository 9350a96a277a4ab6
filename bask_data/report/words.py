"""Figures as people read them: numbers, shares, lengths, sizes and durations."""

from __future__ import annotations

import markupsafe

NBSP = "\u00a0"
"""A number and its unit stay on one line."""


def number(value: object, digits: int = 3) -> str:
    """A number as people write it; a dash where it is not known."""
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
        return ", ".join(number(one, digits) for one in value)
    return str(value)


def percent(value: float | None) -> str:
    """A share in percent."""
    if value is None or value != value:
        return "–"
    return f"{100 * value:.1f}{NBSP}%" if 0 < value < 0.0995 else f"{100 * value:.0f}{NBSP}%"


def millimetres(value: float | None) -> str:
    """Metres, written in millimetres below one metre, so that a column of them compares at a glance."""
    if value is None or value != value:
        return "–"
    if value >= 1:
        return f"{value:.2f}{NBSP}m"
    return f"{1000 * value:.1f}{NBSP}mm" if value < 0.0995 else f"{1000 * value:.0f}{NBSP}mm"


def size(value: float | None) -> str:
    """Bytes."""
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
    """Seconds."""
    if value is None:
        return "–"
    return f"{value:.1f}{NBSP}s" if value < 100 else f"{int(value) // 60}{NBSP}min {int(value) % 60:02d}{NBSP}s"


def count(n: int, what: str) -> str:
    """So many of something."""
    return f"{n:,} {what}" if n == 1 else f"{n:,} {what}s"


def svg(text: str) -> markupsafe.Markup:
    """A plot of ours, which is markup; nothing else on the page is."""
    return markupsafe.Markup(text)  # Drawn by `plots`, which puts no text of others in it.


FILTERS = {
    "number": number,
    "percent": percent,
    "mm": millimetres,
    "size": size,
    "duration": duration,
    "svg": svg,
}
