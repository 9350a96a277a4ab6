"""Names of objects over several scans, as `identify` found them."""

from __future__ import annotations

from bask_data.artifact import MANIFEST
from bask_data.dataset import Dataset
from bask_data.evaluation.lookup import find
from bask_data.kinds import Identities, VisibleMasks


def identity_names(dataset: Dataset) -> dict[tuple[str, int], str]:
    """The name of each object with an identity or a stated name, by scan and instance of its masks.

    Empty without identities. Scans whose masks are others than those that were identified are left out, because their
    instances may be numbered differently.
    """
    identities = find(dataset, Identities)
    if identities is None:
        return {}
    names = identities.names_of_instances()
    inputs = identities.manifest.inputs
    current = set()
    for scene in dict.fromkeys(scene for scene, _ in names):
        path = dataset.path(VisibleMasks, scene)
        digest = inputs.get(path.relative_to(dataset.root).as_posix())
        if digest is not None and (path / MANIFEST).exists() and VisibleMasks(path).manifest.digest == digest:
            current.add(scene)
    return {place: name for place, name in names.items() if place[0] in current}


def outdated_scans(dataset: Dataset) -> list[str]:
    """Scans that have identities of other masks than they have now."""
    identities = find(dataset, Identities)
    if identities is None:
        return []
    current = {scene for scene, _ in identity_names(dataset)}
    return sorted({scene for scene, _ in identities.names_of_instances()} - current)
