"""Choices among what a source holds: one of its episodes, and values of options for each of its cameras."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from bask_data.errors import UsageError
from bask_data.formats.files import listed, natural

CAMERA = "{camera}"
"""What stands for a camera's name in an option."""


def chosen_episode(source: Path, names: Sequence[str], wanted: str) -> str:
    """The name that `--episode` gives, in full or by its number; the only one if it gives none.

    Raises:
        UsageError: no or several episodes fit.
    """
    fitting = list(names)
    if wanted:
        exact = [name for name in names if name == wanted]
        fitting = exact or [name for name in names if _number(name) is not None and _number(name) == _number(wanted)]
    if len(fitting) == 1:
        return fitting[0]
    known = listed(sorted(names, key=natural))
    raise UsageError(
        source,
        "--episode",
        expected=f"one of {known}" if names else "an episode in the source",
        got=(wanted or f"none, but the source holds {len(names)}") if names else "none",
        fix=f"pass --episode {min(names, key=natural)}, or --episode all." if names else "check SOURCE.",
    )


def _number(name: str) -> int | None:
    """The number that a name ends with: demo_3 and 3 alike."""
    digits = name[len(name.rstrip("0123456789")) :]
    return int(digits) if digits.isascii() and digits else None


def by_camera(option: str, text: str, cameras: Sequence[str]) -> dict[str, str]:
    """The value of an option for each camera that it names; empty for an empty option.

    `VALUE` is for a source of one camera, `NAME=VALUE;NAME=VALUE` for some, and with `{camera}` in VALUE for all.

    Raises:
        UsageError: a camera is unknown, or one value is given for several cameras.
    """
    if not text:
        return {}
    if CAMERA in text:
        return {camera: text.replace(CAMERA, camera) for camera in cameras}
    if "=" not in text:
        if len(cameras) > 1:
            raise UsageError(
                option,
                expected=f"NAME=VALUE;NAME=VALUE for {', '.join(cameras)}",
                got=text,
                fix=f"pass {option} '{cameras[0]}={text};{cameras[1]}=...', or read one camera with --cameras.",
            )
        return dict.fromkeys(cameras, text)
    values = {}
    for part in text.split(";"):
        name, _, value = part.strip().partition("=")
        if name not in cameras or not value:
            raise UsageError(
                option,
                expected=f"NAME=VALUE with a name among {', '.join(cameras)}",
                got=part.strip(),
                fix="put quotes around the whole of it: ';' ends commands.",
            )
        values[name] = value.strip()
    return values
