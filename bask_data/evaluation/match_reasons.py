"""Why pixels are no matches, in words."""

from __future__ import annotations

import re

REASONS = {
    "outside_b": "outside the second image",
    "no_depth_in_b": "no depth in the second frame",
    "hidden_in_b": "occluded in the second frame",
    "other_surface_in_b": "another surface, farther away, is visible",
    "other_instance_in_b": "another object, or none, is visible",
    "doubtful_in_b": "at an edge, or seen at a grazing angle",
    "cycle": "the way back leads to another pixel",
    "edge_in_b": "too close to an occluder's edge",
}
"""Why a pixel is no match, for readers; the artifact has the names."""


def plain_reason(text: str) -> str:
    """The text with reasons of rejections in words."""
    return re.sub(r"\b[a-z_]+\b", lambda word: REASONS.get(word[0], word[0]) if "_" in word[0] else word[0], text)
