"""Objects without a partner in another scan, and twins."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from dataclasses import replace

from bask_data.dataset import Dataset
from bask_data.doctor.artifact_checks import unless_damaged
from bask_data.evaluation.lookup import find
from bask_data.findings import Finding
from bask_data.kinds import Identities


def identity_findings(dataset: Dataset) -> list[Finding]:
    """What `identify` could not tell; nothing if it was not run."""
    identities = find(dataset, Identities)
    if identities is None:
        return []

    def check() -> Iterator[Finding]:
        root = shlex.quote(str(dataset.root))
        yield from (replace(each, fix=each.fix.replace("ROOT", root)) for each in identities.findings())

    return unless_damaged(dataset, "identities", [identities], check)
