"""Recordings that show the same: under two names, or in two splits, even if encoded, cut or refined otherwise.

Digests only find exact copies. Here frames of one recording are compared with those of another that were taken from the
same place, or at the same time or share of the recording. Two recordings of one scene never have equal images, not even
from a camera on a stand: noise alone differs, and something was moved.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import combinations

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from numpy import ndarray

from bask_data.dataset import Dataset
from bask_data.errors import BadData
from bask_data.evaluation.lookup import spread_frames
from bask_data.findings import Finding
from bask_data.kinds import Camera, Demonstration, Recording, Scan

N_LOOKED_FOR = 6
"""Frames of the shorter recording that are looked for in the longer one. Sensitivity not measured."""

ALIKE_SHARE = 1 / 3
"""Share of them that must be found, and at least two: recordings of which a part is the same leak as well. Sensitivity
not measured."""

COMPARED_SIZE = (48, 36)
"""Width and height of compared images, pixels: small, so that encoding and scaling hardly matter."""

ALIKE = {98.0: 4.0, 99.7: 14.0}
"""Largest percentiles of the difference between two thumbnails of the same image, grey levels: JPEG of quality 50 and
scaling by half give up to 3 and 8 on textured images. An object of 0.5 % of the image that was moved gives more."""

LEAST_TEXTURE = 6.0
"""Standard deviation of a thumbnail, grey levels, below which it has nothing to compare. Sensitivity not measured."""

NEAR_M, NEAR_DEG = 0.05, 5.0
"""Poses of the same frame in two readings differ by less, metres and degrees, even after refinement."""


@dataclass
class _Film:
    """A camera's frames as thumbnails, each decoded once."""

    name: str
    camera: Camera
    seen: dict[int, Float32[ndarray, "h w"]] = field(default_factory=dict)

    def thumbnail(self, i: int) -> Float32[ndarray, "h w"]:
        """A frame in grey, small, smooth, and of mean 0: exposure of a copy may be changed."""
        if i not in self.seen:
            self.seen[i] = thumbnail(self.camera.rgb(i))
        return self.seen[i]


def thumbnail(rgb: UInt8[ndarray, "h w 3"]) -> Float32[ndarray, "h w"]:
    """An image as it is compared: grey levels, of mean 0."""
    grey = cv2.resize(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), COMPARED_SIZE, interpolation=cv2.INTER_AREA).astype(
        np.float32
    )
    return grey - grey.mean()


def twin_findings(dataset: Dataset) -> list[Finding]:
    """Recordings that are the same, and those of them that different splits share."""
    findings = list(_listed_twice(dataset))
    split_of = {name: split for split, names in dataset.file.splits.model_dump().items() for name in names}
    for scope, kind in (("scene", Scan), ("demonstration", Demonstration)):
        films = [film for item in dataset.items(scope) for film in _films(dataset, kind, item)]
        paired: set[tuple[str, str]] = set()
        for one, other in combinations(films, 2):
            names = (one.name, other.name)
            if one.name == other.name or names in paired:
                continue
            n_found, n = _shared(one, other)
            if n_found:
                paired.add(names)
                evidence = f"{n_found} of {n} frames that were looked for are in both"
                findings.append(_finding(dataset, names, split_of, evidence))
    return findings


def _listed_twice(dataset: Dataset) -> Iterator[Finding]:
    """Scenes that dataset.json names in two splits."""
    splits = dataset.file.splits.model_dump()
    for one, other in combinations(splits, 2):
        for name in sorted(set(splits[one]) & set(splits[other])):
            fix = f"bask-data split {shlex.quote(str(dataset.root))}: name it in one of them"
            yield Finding("split-leak", name, f"it is in the splits {one} and {other}", fix)


def _finding(dataset: Dataset, names: tuple[str, str], split_of: dict[str, str], evidence: str) -> Finding:
    one, other = names
    place, splits = f"{one} and {other}", [split_of.get(name, "") for name in names]
    if all(splits) and splits[0] != splits[1]:
        fix = f"bask-data split {shlex.quote(str(dataset.root))}: put both into one split, or leave one out"
        return Finding("split-leak", place, f"{evidence}; {one} is for {splits[0]}, {other} for {splits[1]}", fix)
    fix = f"leave one out of training: bask-data split {shlex.quote(str(dataset.root))}"
    for refined, original in (names, names[::-1]):
        if _is_refined_from(dataset, refined, original):
            evidence = f"{evidence}: {refined} is {original} with refined poses"
            fix = f"train on {refined} only: bask-data split {shlex.quote(str(dataset.root))}"
    return Finding("scene-twice", place, evidence, fix)


def _is_refined_from(dataset: Dataset, item: str, original: str) -> bool:
    """Whether a recording was written by `refine`, from the other."""
    kind = Scan if item in dataset.file.scenes else Demonstration
    manifest = kind(dataset.path(kind, item)).manifest
    return manifest.stage == "refine" and f"{kind.kind}/{original}" in manifest.inputs


def _films(dataset: Dataset, kind: type[Recording], item: str) -> Iterator[_Film]:
    path = dataset.path(kind, item)
    if not path.exists():
        return
    try:
        recording = kind(path)
        recording.check_complete()
        for camera in recording.cameras:
            if camera.n_frames and len(camera.world_from_cameras):
                yield _Film(item, camera)
    except BadData:
        return  # It is reported as damaged.


def _shared(one: _Film, other: _Film) -> tuple[int, int]:
    """How many of some frames of the shorter are found in the longer, and of how many; 0 if they are too few."""
    short, long = sorted((one, other), key=lambda film: film.camera.n_frames)
    wanted = spread_frames(short.camera.n_frames, N_LOOKED_FOR + 2)[1:-1] or [0]
    least = min(len(wanted), max(2, math.ceil(ALIKE_SHARE * len(wanted))))
    n_found = 0
    for k, i in enumerate(wanted):
        try:
            n_found += _is_found(short, i, long)
        except BadData:
            return 0, len(wanted)
        if n_found + len(wanted) - k - 1 < least:
            return 0, len(wanted)
    return n_found, len(wanted)


def _is_found(short: _Film, i: int, long: _Film) -> bool:
    """Whether a frame's image is in the other recording, where it should be if it is a copy."""
    image = short.thumbnail(i)
    if image.std() < LEAST_TEXTURE:
        return False
    return any(are_alike(image, long.thumbnail(k)) for k in _places(short.camera, i, long.camera))


def are_alike(a: Float32[ndarray, "h w"], b: Float32[ndarray, "h w"]) -> bool:
    """Whether two thumbnails are of the same image."""
    return bool((np.percentile(np.abs(a - b), list(ALIKE)) < list(ALIKE.values())).all())


def _places(camera: Camera, i: int, other: Camera) -> list[int]:
    """Frames of another camera that may be a frame: of the same share of the recording, time, or pose."""
    same_share = round(i * (other.n_frames - 1) / max(camera.n_frames - 1, 1))
    places = [same_share, int(np.abs(other.time - camera.time[i]).argmin())]
    pose, poses = camera.world_from_cameras[i], other.world_from_cameras
    distance = np.linalg.norm(poses[:, :3, 3] - pose[:3, 3], axis=1)
    cosine = (np.einsum("tij,ij->t", poses[:, :3, :3], pose[:3, :3]) - 1) / 2
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    far = distance / NEAR_M + angle / NEAR_DEG
    places += [int(k) for k in np.argsort(far, kind="stable")[:3] if far[k] < 2]
    return list(dict.fromkeys(places))
