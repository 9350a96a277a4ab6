"""Recordings that show the same: under two names, or in two splits, even if encoded, cut or refined otherwise.

Digests only find exact copies. Here frames of one recording are compared with those of another that were taken from the
same place, or at the same time or share of the recording. Two recordings of one scene never have equal images, not even
from a camera on a stand: noise alone differs, and something was moved.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import combinations

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from numpy import ndarray

from bask_data.dataset import Dataset
from bask_data.errors import BadData
from bask_data.findings import Finding
from bask_data.kinds import Camera, Demonstration, Recording, Scan

N_LOOKED_FOR = 6
"""Frames of the shorter recording that are looked for in the longer one. Sensitivity not measured."""

ALIKE_SHARE = 0.8
"""Share of them that must be found: the ends may have been cut. Sensitivity not measured."""

COMPARED_SIZE = (48, 36)
"""Width and height of compared images, pixels: small, so that encoding and scaling hardly matter."""

ALIKE_LEVELS = 4.0
"""Largest 98th percentile of the difference between two thumbnails of the same image, grey levels: JPEG of quality 50
and scaling by half give up to 3 on textured images. An object of 2 % of the image that was moved gives more."""

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
            if one.name == other.name or names in paired or not _are_twins(one, other):
                continue
            paired.add(names)
            findings.append(_finding(dataset, names, split_of))
    return findings


def _listed_twice(dataset: Dataset) -> Iterator[Finding]:
    """Scenes that dataset.json names in two splits."""
    splits = dataset.file.splits.model_dump()
    for one, other in combinations(splits, 2):
        for name in sorted(set(splits[one]) & set(splits[other])):
            fix = f"bask-data split {dataset.root}: name it in one of them"
            yield Finding("split-leak", name, f"it is in the splits {one} and {other}", fix)


def _finding(dataset: Dataset, names: tuple[str, str], split_of: dict[str, str]) -> Finding:
    one, other = names
    place, splits = f"{one} and {other}", [split_of.get(name, "") for name in names]
    evidence = "the same images, frame by frame, as far as compared"
    if all(splits) and splits[0] != splits[1]:
        fix = f"bask-data split {dataset.root}: put both into one split, or leave one out"
        return Finding("split-leak", place, f"{evidence}; {one} is for {splits[0]}, {other} for {splits[1]}", fix)
    fix = (
        "leave one out of training, by `bask-data split`; if one is the other with refined poses, keep the refined one"
    )
    return Finding("scene-twice", place, evidence, fix)


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


def _are_twins(one: _Film, other: _Film) -> bool:
    """Whether most of some frames of the shorter are found in the longer."""
    short, long = sorted((one, other), key=lambda film: film.camera.n_frames)
    n = short.camera.n_frames
    wanted = np.unique(np.linspace(0, n - 1, N_LOOKED_FOR + 2)[1:-1].round().astype(int)).tolist()
    missed, found = 0, []
    for i in wanted:
        try:
            if _is_found(short, i, long):
                found.append(i)
            else:
                missed += 1
        except BadData:
            return False
        if missed > (1 - ALIKE_SHARE) * len(wanted):
            return False
    return bool(found)


def _is_found(short: _Film, i: int, long: _Film) -> bool:
    """Whether a frame's image is in the other recording, where it should be if it is a copy."""
    image = short.thumbnail(i)
    if image.std() < LEAST_TEXTURE:
        return False
    return any(are_alike(image, long.thumbnail(k)) for k in _places(short.camera, i, long.camera))


def are_alike(a: Float32[ndarray, "h w"], b: Float32[ndarray, "h w"]) -> bool:
    """Whether two thumbnails are of the same image."""
    return float(np.percentile(np.abs(a - b), 98)) < ALIKE_LEVELS


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
