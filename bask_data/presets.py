"""Presets: named sets of parameters of published methods, and the default for a laptop.

A preset sets the fields below, and no others. Settings that the paper on Bayesian scene keypoints (von Hartz et al.
2023, cited by section) leaves open are those of its public code; docs/presets.md compares them.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Literal

from bask_data.engine import Config, Stage

PresetName = Literal["tabletop", "bask", "bask-code", "florence"]

_CONTRASTIVE: dict[str, Any] = {
    "loss": "contrastive",
    "image_height": 256,
    "crop_share": 1.0,
    "non_matches": 150,
    "learning_rate": 1e-4,
    "weight_decay": 1e-4,
    "schedule": "step",
    "decay": 0.9,
    "warmup": 0,
    "pairs_per_step": 1,
}

_BASK: dict[str, Any] = {
    **_CONTRASTIVE,
    "backbone": "resnet101",
    "descriptor_dim": 64,
    "normalised": True,
    "margin_foreground": 0.25,
    "margin_background": 0.75,
    "foreground_share": None,
    "flip": 0.5,
    "background": 0.5,
    "steps": 10000,
    "decay_every": 500,
}

PRESETS: dict[PresetName, dict[str, dict[str, Any]]] = {
    # The parameters' own defaults.
    "tabletop": {},
    # Eq. 1 applies the hinge to the squared distance and sums over the matches the mean over the non-matches of each;
    # III-A.3: distances divided by sqrt(D), several scales, full rotation, crops of random size down to half of the
    # image, padded with blank pixels.
    "bask": {
        "train": {
            **_BASK,
            "hinge": "squared",
            "non_match_term": "sum",
            "match_root": False,
            "background_normalised": True,
            "crop": "padded",
            "zoom": (1.0, 2.0),
            "rotation_deg": 180.0,
            "composition": 0.0,
        },
        "encode": {"filter": "particle", "settings": "paper"},
    },
    # The code squares the hinge of the distance and divides by the number of hard negatives, on and off the object
    # together; of the distances it divides those of non-matches on the object by sqrt(D), the squared ones of matches
    # likewise by sqrt(D), and those of other non-matches by nothing. It resizes crops to the image's size, does not
    # rotate, and pastes a further object into three of ten pairs.
    "bask-code": {
        "train": {
            **_BASK,
            "hinge": "plain",
            "non_match_term": "hard",
            "match_root": True,
            "background_normalised": False,
            "crop": "resized",
            "zoom": (1.0, 2.0),
            "rotation_deg": 0.0,
            "composition": 0.3,
        },
        "encode": {"filter": "particle", "settings": "code"},
    },
    # The base DON: ResNet-34 and 16 dimensions (Florence et al. 2019), trained as the code of their first paper does.
    "florence": {
        "train": {
            **_CONTRASTIVE,
            "backbone": "resnet34",
            "descriptor_dim": 16,
            "normalised": False,
            "hinge": "plain",
            "non_match_term": "hard",
            "match_root": False,
            "background_normalised": True,
            "margin_foreground": 0.5,
            "margin_background": 0.5,
            "foreground_share": 0.5,
            "crop": "resized",
            "zoom": (1.0, 1.0),
            "rotation_deg": 0.0,
            "flip": 0.5,
            "background": 0.5,
            "composition": 0.0,
            "steps": 3500,
            "decay_every": 250,
        },
        # Every frame on its own, without a filter.
        "encode": {"filter": "expectation", "settings": "default"},
    },
}


def preset(name: PresetName, stages: Iterable[Stage]) -> Config:
    """Every field that any preset sets, with this preset's value or the default, so that no other one has an effect."""
    defaults = {stage.name: stage.params().model_dump() for stage in stages}
    chosen = PRESETS[name]
    fields: dict[str, list[str]] = {}
    for sections in PRESETS.values():
        for section, values in sections.items():
            fields.setdefault(section, []).extend(values)
    return {
        section: {field: chosen.get(section, {}).get(field, defaults[section][field]) for field in names}
        for section, names in fields.items()
    }
