"""Frames in words, as findings list them."""

from __future__ import annotations

from collections.abc import Iterable


def frames_in_words(numbers: Iterable[int], most: int = 6) -> str:
    """Numbers of frames in words, with stretches: `frames 3, 7-9`."""
    listed = sorted(set(numbers))
    runs: list[list[int]] = []
    for k in listed:
        if runs and k == runs[-1][1] + 1:
            runs[-1][1] = k
        else:
            runs.append([k, k])
    words = [f"{first}" if first == last else f"{first}-{last}" for first, last in runs]
    more = f" and {len(words) - most} more stretches" if len(words) > most else ""
    head = "frame" if len(listed) == 1 else f"{len(listed)} frames:" if len(runs) > 1 else "frames"
    return f"{head} {', '.join(words[:most])}{more}"
