"""What figures and section of the keypoint study share: colours, labels, and the command that measures again."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from typing import Any

from bask_data.dataset import Dataset

COLOURS = ("#a0673a", "#7fb2e5", "#2f6db5", "#e08a1e", "#2f9e5b", "#8a5fb5")
"""Colours of methods; the first, brown, is that of the base DON."""
LABELS = {
    "apart": "Distance between mean and mode, cm",
    "error": "Distance to ground truth, cm",
}


def method_colours(result: Mapping[str, Any]) -> dict[str, str]:
    """A colour for each method; other networks than that of the last method come first."""
    names = [method["name"] for method in result["methods"]]
    n_others = sum(method["variant"] != result["methods"][-1]["variant"] for method in result["methods"])
    others = [COLOURS[0], *COLOURS[5:]]
    return {
        name: others[i % len(others)] if i < n_others else COLOURS[1 + (i - n_others) % (len(COLOURS) - 1)]
        for i, name in enumerate(names)
    }


def remeasured(dataset: Dataset) -> str:
    """The command that measures a study again."""
    return f"bask-data evaluate keypoints {shlex.quote(str(dataset.root))}"
