"""Identities: which objects of different scans are the same one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from bask_data.artifact import Artifact, Metadata
from bask_data.findings import Finding
from bask_data.kinds.arrays import start
from bask_data.kinds.tables import read_table, write_table
from bask_data.specs import TableSpec

if TYPE_CHECKING:
    import pyarrow as pa


LEAST_SIMILAR = 0.01
"""Probability from which the most similar object of an unknown one is worth a word. Chosen."""


class MemberRow(Metadata):
    """An object of a scan.

    Args:
        scene, instance: name of the scan, and the object's id there.
        confidence: probability that it is the same as the other members.
    """

    scene: str
    instance: int
    confidence: float


class IdentityRow(Metadata):
    """One object that several scans show.

    Args:
        id: number, from 1; those that more scans show come first.
        name: as stated; empty if none was.
        twins: whether some scan has two objects of this look, so that which one is which cannot be told.
    """

    id: int
    name: str = ""
    twins: bool = False
    members: list[MemberRow]


class UnknownRow(Metadata):
    """An object that was matched with none.

    Args:
        why: no partner: no other scan has a likely one; tie: several are about as likely and exclude each other.
        similar: the most similar object of another scan, SCENE/ID; empty if there is no other scan.
        confidence: probability that it is the same.
        name: as stated.
    """

    scene: str
    instance: int
    why: Literal["no partner", "tie"]
    similar: str = ""
    confidence: float = 0.0
    name: str = ""


class IdentitiesMetadata(Metadata):
    """Identities, objects without one, and warnings for the user."""

    identities: list[IdentityRow]
    unknown: list[UnknownRow]
    warnings: list[str] = []


class Identities(Artifact):
    """Objects that several scans show, with the evidence of every pair and a picture of each object."""

    kind = "identities"
    scope = "dataset"
    has_variants = True
    metadata_model = IdentitiesMetadata
    tables = {
        "pairs.parquet": TableSpec(
            {
                "scene_a": ("string", "scan of the first object"),
                "instance_a": ("int32", "its id there"),
                "scene_b": ("string", "scan of the second object"),
                "instance_b": ("int32", "its id there"),
                "colour": ("float32", "difference in chromaticity, 0 to 1, less under another light"),
                "appearance": ("float32", "one minus the cosine between the network's features"),
                "size": ("float32", "mean absolute logarithm of the ratios of the two longest edges"),
                "log_odds": ("float32", "that both are the same object"),
            }
        )
    }
    files = {"identities.png": "views of each object, a row per identity; 1 x 1 pixel if there are no objects"}

    @property
    def identities(self) -> list[IdentityRow]:
        """The objects that several scans show."""
        return self.metadata.identities

    def of_instances(self) -> dict[tuple[str, int], IdentityRow]:
        """The identity by scan and id of an object; those without one are missing."""
        return {(member.scene, member.instance): row for row in self.identities for member in row.members}

    def of_scans(self) -> dict[str, dict[int, int]]:
        """The numbers of identities by scan and by id of an object; those without one are missing."""
        scans: dict[str, dict[int, int]] = {}
        for (scene, instance), row in self.of_instances().items():
            scans.setdefault(scene, {})[instance] = row.id
        return scans

    def names_of_instances(self) -> dict[tuple[str, int], str]:
        """A name by scan and id of an object: as stated, else the identity's number. Objects of one identity have one
        name and no others have it; those without an identity and a name are missing."""
        everything: list[tuple[str, Sequence[MemberRow | UnknownRow]]] = [
            *((row.name, row.members) for row in self.identities),
            *((row.name, [row]) for row in self.metadata.unknown if row.name),
        ]
        given = [name for name, _ in everything]
        names: dict[tuple[str, int], str] = {}
        for i, (name, members) in enumerate(everything):
            is_identity = i < len(self.identities)
            own = f"identity {self.identities[i].id}" if is_identity else f"{members[0].scene}/{members[0].instance}"
            words = own if not name else name if given.count(name) == 1 else f"{name} ({own})"
            names.update({(member.scene, member.instance): words for member in members})
        return names

    def findings(self) -> list[Finding]:
        """What the user should look at: twins, ties, and objects that no other scan shows."""
        where = f"look at {self.path / 'identities.png'}; then bask-data identify ROOT: "
        return [
            replace(each, place=f"identities, {each.place}", fix=f"{where}{each.fix}")
            for each in identity_findings(self.identities, self.metadata.unknown)
        ]

    def pairs(self) -> pa.Table:
        """The evidence of each pair of objects."""
        return read_table(self, "pairs.parquet")

    def summary(self) -> list[str]:
        """A line for each identity, then the unknown objects."""
        lines = [_line(row) for row in self.identities]
        lines += [
            f"unknown  {row.scene}/{row.instance}: {row.why}"
            + (
                f", most similar {row.similar} ({percent(row.confidence)})"
                if row.similar and row.confidence >= LEAST_SIMILAR
                else ""
            )
            for row in self.metadata.unknown
        ]
        return [*lines, f"look at {self.path / 'identities.png'}"]

    @staticmethod
    def write(
        out: Path,
        *,
        identities: list[IdentityRow],
        unknown: list[UnknownRow],
        pairs: dict[str, list[object]],
        picture: bytes,
        warnings: list[str],
    ) -> None:
        """Write identities, unknown objects, the evidence by column, and the picture, a PNG file's bytes."""
        metadata = {
            "identities": [row.model_dump() for row in identities],
            "unknown": [row.model_dump() for row in unknown],
            "warnings": warnings,
        }
        start(out, Identities, metadata)
        write_table(out, Identities, "pairs.parquet", pairs)
        (out / "identities.png").write_bytes(picture)


def identity_findings(identities: Sequence[IdentityRow], unknown: Sequence[UnknownRow]) -> list[Finding]:
    """What the user should look at: twins, ties, and objects that no other scan shows."""
    found = []
    for row in (each for each in identities if each.twins):
        places = ", ".join(f"{member.scene}/{member.instance}" for member in row.members)
        evidence = f"objects of one scan look the same, so which one is which cannot be told: {places}"
        found.append(Finding("identity-twins", f"identity {row.id}", evidence, "state --different, if they differ."))
    for each in unknown:
        place = f"{each.scene}/{each.instance}"
        if each.why == "tie":
            evidence = f"several objects of one scan are about as likely to be the same, {each.similar} among them"
            found.append(Finding("identity-unknown", place, evidence, f"--same {place}={each.similar}, or another."))
    alone = [f"{each.scene}/{each.instance}" for each in unknown if each.why == "no partner"]
    if alone:
        evidence = f"no other scan shows a likely match of {', '.join(alone)}"
        found.append(Finding("identity-unknown", "objects", evidence, "state --same, if one does."))
    return found


def percent(confidence: float) -> str:
    """A probability in percent, rounded down: 100 % would claim too much."""
    return f"{int(100 * confidence)}%"


def _line(row: IdentityRow) -> str:
    members = ", ".join(f"{member.scene}/{member.instance} {percent(member.confidence)}" for member in row.members)
    return f"{row.id:>3}  {row.name or 'no name'}{' (twins)' if row.twins else ''}: {members}"
