"""The same objects in different scans."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from bask_data.engine import progress, stage
from bask_data.kinds import Identities, ObjectInstances, Reconstruction, Scan, VisibleMasks
from bask_data.kinds.identities import IdentityRow, MemberRow, UnknownRow, identity_findings, percent
from bask_data.stages.identity_statements import IdentifyParams, Statements
from bask_data.stages.identity_views import SeenObject, seen_objects

if TYPE_CHECKING:
    import numpy as np

    from bask_data.core.identity_groups import Grouping, IdentityGroup


@stage(makes=Identities, version=1, on_request=True)
def identify(
    scans: list[Scan],
    reconstructions: list[Reconstruction],
    objects: list[ObjectInstances],
    masks: list[VisibleMasks],
    params: IdentifyParams,
    out: Path,
) -> None:
    """Find out which objects of different scans are the same.

    Compares colour, appearance and size. No object is matched by force: those without a likely partner, or with
    several that are about as likely, are unknown. Look at identities.png in the artifact, and correct with --same and
    --different; like --names they are kept.
    """
    import numpy as np

    from bask_data.core.identity import all_differences, log_odds_of
    from bask_data.core.identity_groups import grouped
    from bask_data.nn.appearance import Appearance

    # Checked before minutes are spent on the images.
    stated = Statements({f"{each.path.name}/{row.id}": row.name for each in objects for row in each.instances}, params)
    appearance = Appearance()
    inputs = list(zip(scans, reconstructions, objects, masks, strict=True))
    seen = [one for each in progress(inputs, "looking at objects") for one in seen_objects(*each, appearance)]
    numbers = {name: i for i, name in enumerate(dict.fromkeys(one.scene for one in seen))}
    scan_of = np.array([numbers[one.scene] for one in seen], int)
    found = all_differences([one.look for one in seen])
    # Of the objects of another scan at most one is the same, and more often than not none of the others.
    odds = log_odds_of(found) - np.log(max(len(seen) / max(len(numbers), 1), 1.0))
    grouping = grouped(scan_of, odds, params.confidence, *stated.pairs([one.place for one in seen]))
    identities, unknown = _identities(grouping, seen, stated), _unknown(grouping, seen, scan_of, odds, stated)
    Identities.write(
        out,
        identities=identities,
        unknown=unknown,
        pairs=_pairs(seen, found, odds),
        picture=_picture(identities, unknown, seen),
        warnings=[f"{finding.place}: {finding.evidence}" for finding in identity_findings(identities, unknown)],
    )


def _identities(grouping: Grouping, seen: Sequence[SeenObject], stated: Statements) -> list[IdentityRow]:
    """Those that more scans show first, then by their first member."""

    def rank(group: IdentityGroup) -> tuple[int, int]:
        return -len({seen[i].scene for i in group.members}), group.members[0]

    return [
        IdentityRow(
            id=number,
            name=stated.name_of([seen[i].place for i in group.members]),
            twins=group.twins,
            members=[
                MemberRow(scene=seen[i].scene, instance=seen[i].instance, confidence=round(confidence, 4))
                for i, confidence in zip(group.members, group.confidences, strict=True)
            ],
        )
        for number, group in enumerate(sorted(grouping.groups, key=rank), 1)
    ]


def _unknown(
    grouping: Grouping, seen: Sequence[SeenObject], scan_of: np.ndarray, odds: np.ndarray, stated: Statements
) -> list[UnknownRow]:
    import numpy as np

    rows = []
    for i in sorted([*grouping.alone, *grouping.tied]):
        others = np.where(scan_of == scan_of[i], -np.inf, odds[i])
        best = int(others.argmax())
        is_known = np.isfinite(others[best])
        rows.append(
            UnknownRow(
                scene=seen[i].scene,
                instance=seen[i].instance,
                why="tie" if i in grouping.tied else "no partner",
                similar=seen[best].place if is_known else "",
                confidence=round(float(1 / (1 + np.exp(-others[best]))), 4) if is_known else 0.0,
                name=stated.name_of([seen[i].place]),
            )
        )
    return rows


def _pairs(seen: Sequence[SeenObject], found: np.ndarray, odds: np.ndarray) -> dict[str, list[object]]:
    """The table of all pairs of objects, by column."""
    import numpy as np

    from bask_data.core.identity import EVIDENCE

    a, b = np.triu_indices(len(seen), 1)
    firsts, seconds = [seen[int(i)] for i in a], [seen[int(i)] for i in b]
    return {
        "scene_a": [one.scene for one in firsts],
        "instance_a": [one.instance for one in firsts],
        "scene_b": [one.scene for one in seconds],
        "instance_b": [one.instance for one in seconds],
        **{name: found[a, b, i].tolist() for i, name in enumerate(EVIDENCE)},
        "log_odds": odds[a, b].tolist(),
    }


def _picture(identities: Sequence[IdentityRow], unknown: Sequence[UnknownRow], seen: Sequence[SeenObject]) -> bytes:
    """The PNG file with a row of pictures for each identity, and the unknown objects below."""
    import cv2
    import numpy as np

    from bask_data.core.contact_sheet import contact_sheet

    crops = {(one.scene, one.instance): one.crop for one in seen}
    rows = [
        (
            f"{row.id} {row.name}{' (twins)' if row.twins else ''}",
            [(f"{m.scene}/{m.instance} {percent(m.confidence)}", crops[m.scene, m.instance]) for m in row.members],
        )
        for row in identities
    ]
    if unknown:
        rows.append(("unknown", [(f"{u.scene}/{u.instance} {u.why}", crops[u.scene, u.instance]) for u in unknown]))
    picture = contact_sheet(rows) if rows else np.full((1, 1, 3), 255, np.uint8)
    return cv2.imencode(".png", picture[:, :, ::-1])[1].tobytes()
