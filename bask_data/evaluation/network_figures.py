"""Figures of descriptor networks: training, and evaluation on held-out views."""

from __future__ import annotations

from typing import Any

from bask_data.dataset import Dataset
from bask_data.errors import BadData
from bask_data.evaluation.descriptor import DescriptorSettings, evaluated_descriptor
from bask_data.evaluation.held_out import held_out
from bask_data.evaluation.lookup import UNREADABLE, find, what_is_wrong
from bask_data.kinds import DescriptorNet

MOST_NETWORKS = 5
"""Descriptor networks compared, at most: one per preset, and one more."""
PAIRS_EVALUATED, SCENES_EVALUATED = 48, 8
"""Pairs of frames on which networks are compared, shared among at most this many scenes: enough for rough figures
within a minute. `bask-data evaluate descriptor` uses more."""


def descriptor_figures(descriptor: DescriptorNet | None) -> dict[str, Any]:
    """What the network was validated on, its metrics and its settings."""
    if descriptor is None:
        return {}
    steps = descriptor.curve()["step"].to_numpy()
    return {
        "validated_on": descriptor.metadata.validated_on,
        "metrics": dict(descriptor.metadata.metrics),
        "n_steps": int(steps.max()) if len(steps) else 0,
        "step": descriptor.metadata.step,
        "chosen_by": descriptor.metadata.chosen_by,
        "model": {key: value for key, value in descriptor.model.items() if isinstance(value, (str, int, float, bool))},
    }


def networks(dataset: Dataset) -> dict[str, DescriptorNet]:
    """The first few descriptor networks by variant."""
    networks = {variant: find(dataset, DescriptorNet, "", variant) for variant in dataset.variants(DescriptorNet)}
    existing = [(variant, network) for variant, network in networks.items() if network is not None]
    return dict(existing[:MOST_NETWORKS])


def descriptors_figures(dataset: Dataset) -> dict[str, Any]:
    """Evaluation of the first few networks on the same few pairs of held-out views."""
    readable, errors = [], {}
    for variant, network in networks(dataset).items():
        try:
            network.network()
            readable.append(variant)
        except BadData as error:
            errors[variant] = what_is_wrong(error)
    figures: dict[str, Any] = {}
    try:
        if readable:
            scenes = held_out(dataset, readable).scenes
            n_pairs = max(PAIRS_EVALUATED // min(len(scenes), SCENES_EVALUATED), 1)
            some = scenes[:SCENES_EVALUATED] if len(scenes) > SCENES_EVALUATED else ()
            settings = DescriptorSettings(scenes=some, pairs=n_pairs, sweep=True, one_may_be_learned=True)
            figures = evaluated_descriptor(dataset, readable, settings)
    except UNREADABLE as error:
        errors["not measured"] = what_is_wrong(error)
    return {**figures, **({"errors": errors} if errors else {})}
