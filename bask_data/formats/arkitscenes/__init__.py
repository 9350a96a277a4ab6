"""Videos of ARKitScenes: images named by their time, intrinsics of each, and a trajectory with times of its own.

Source: github.com/apple/ARKitScenes, DATA.md, raw/README.md and threedod/benchmark_scripts/utils/tenFpsDataLoader.py.
Assets are recorded at 10 to 60 per second, and not every stamp has all of them, so frames without depth or pose are
left out without being asked.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from bask_data.core.lens import Lens
from bask_data.core.time_pairs import nearest
from bask_data.errors import BadData
from bask_data.formats.arkitscenes.assets import (
    SAME_STAMP,
    Asset,
    image_size,
    intrinsics_at,
    poses_at,
    read_asset,
)
from bask_data.formats.files import Folder, first_readable, source_folder
from bask_data.formats.images import read_color, read_depth, read_labels
from bask_data.formats.lenses import scaled_lens
from bask_data.formats.options.arkitscenes import ArkitscenesOptions
from bask_data.formats.recording import SourceCamera, SourceRecording

TRAJECTORY = "lowres_wide.traj"
"""File of the poses, which are those of the wide camera at any resolution."""

METRES_PER_UNIT_OF_DEPTH = 0.001
"""Source: DATA.md, depth in millimetres."""

SAME_FRAME = 0.009
"""Largest difference, seconds, between a colour image and its depth: half an interval of depth, 60 per second. Matters
to colour at 30 or 10 per second, whose stamps are not those of depth."""


def read(source: Path, options: ArkitscenesOptions) -> SourceRecording:
    """The video in `source`, at the moments of its colour images."""
    folder = source_folder(source, options.follow_links)
    prefix = _prefix(folder)
    kind = _color_kind(folder, prefix, options.color)
    color = read_asset(folder, prefix, kind, (".png", ".jpg"))
    poses = poses_at(folder.member(f"{prefix}{TRAJECTORY}", "poses"), color.time, options.max_pose_gap)
    size = first_readable(image_size, color.files)
    pincams = read_asset(folder, prefix, f"{kind}_intrinsics", (".pincam",))
    K, has_K, used = intrinsics_at(pincams, color.time, size)
    depth = _depth(folder, prefix, options.depth, color, Lens(K, size))
    faults = {i: _missing(pincams, color.names[i]) for i in np.flatnonzero(~has_K).tolist()}
    if options.confidence is not None and depth.confidence:
        lacking = np.flatnonzero((depth.file_of >= 0) & (depth.confidence_of < 0)).tolist()
        faults |= {i: _missing(depth.confidence, color.names[i]) for i in lacking}
    without_depth = np.flatnonzero(depth.file_of < 0).tolist()
    expected = {i: "no pose" for i in poses.why if i not in faults} | {
        i: "no depth" for i in without_depth if i not in faults
    }
    no_depth = {
        i: BadData(color.files[i], "depth", expected=f"{options.depth} of its time", got="none") for i in without_depth
    }
    camera = SourceCamera(
        name=options.camera,
        frames=color.names,
        lens=Lens(K, size),
        world_from_cameras=poses.world_from_cameras,
        time=color.time,
        color=lambda i: read_color(color.files[i]),
        depth=lambda i: read_depth(depth.asset.files[depth.file_of[i]]),
        depth_scale=METRES_PER_UNIT_OF_DEPTH,
        depth_lens=depth.lens,
        confidence=depth.read_confidence if depth.confidence else None,
        faults={**poses.why, **no_depth, **faults},
        expected=expected,
        intrinsics_size=f"{size[1]}x{size[0]}",
        pose_places=tuple(f"{poses.path}: time {time:.3f}" for time in color.time),
    )
    return SourceRecording(
        cameras=(camera,),
        robot=None,
        label_names={},
        assumptions={
            "world": "as in the trajectory; images stand as the sensor saw them, not turned upright",
            "pose": poses.statement,
            "depth": f"z-depth of {options.depth}, {METRES_PER_UNIT_OF_DEPTH:g} m per unit, 0 = no measurement, of the "
            f"camera that took {kind}{depth.delay}",
            "intrinsics": f"of each image, from {kind}_intrinsics, no lens distortion",
            "time": "seconds, from the files' names",
        },
        files=(poses.path, *color.files, *(pincams.files[k] for k in used), *depth.files),
    )


@dataclass(frozen=True)
class _DepthImages:
    """Depth of the colour images.

    Args:
        file_of: index of the file for each colour image; -1 for none.
        lens: of depth in a resolution of its own; None if that is colour's.
        confidence: of the phone's depth, 0 to 2, if it was downloaded.
        confidence_of: as `file_of`.
        delay: what is said about depth that was not taken at the moment of its colour, or empty.
    """

    asset: Asset
    file_of: Int[ndarray, " t"]
    lens: Lens | None
    confidence: Asset | None
    confidence_of: Int[ndarray, " t"]
    delay: str

    @property
    def files(self) -> tuple[Path, ...]:
        """All files that are used."""
        depth = [self.asset.files[k] for k in sorted({*self.file_of.tolist()} - {-1})]
        confidence = self.confidence.files if self.confidence else ()
        return (*depth, *(confidence[k] for k in sorted({*self.confidence_of.tolist()} - {-1})))

    def read_confidence(self, i: int) -> UInt8[ndarray, "h w"]:
        """Confidence at the pixels of depth."""
        assert self.confidence is not None
        return read_labels(self.confidence.files[self.confidence_of[i]])


def _depth(folder: Folder, prefix: str, kind: str, color: Asset, lens: Lens) -> _DepthImages:
    """The depth images nearest to the colour images in time."""
    asset = read_asset(folder, prefix, kind, (".png",))
    file_of = nearest(color.time, asset.time, SAME_FRAME)
    time = np.where(file_of >= 0, asset.time[file_of], color.time)
    delay = float(np.abs(time - color.time).max())
    size = first_readable(image_size, asset.files)
    own_lens = None
    if size != lens.size:
        own_lens = _lens_of_depth(folder, prefix, kind, time, size) or scaled_lens(lens, size)
    confidence, confidence_of = None, np.full(len(file_of), -1)
    if kind == "lowres_depth" and (folder.path / prefix / "confidence").is_dir():
        confidence = read_asset(folder, prefix, "confidence", (".png",))
        confidence_of = nearest(time, confidence.time, SAME_STAMP)
    stated = f"; up to {1000 * delay:.0f} ms from its colour" if delay > SAME_STAMP else ""
    return _DepthImages(asset, file_of, own_lens, confidence, confidence_of, stated)


def _lens_of_depth(
    folder: Folder, prefix: str, kind: str, time: Float[ndarray, " t"], size: tuple[int, int]
) -> Lens | None:
    """The lens of depth, by intrinsics of colour in its resolution; None where some frames lack them."""
    name = {"lowres_depth": "lowres_wide_intrinsics", "highres_depth": "wide_intrinsics"}[kind]
    if not (folder.path / prefix / name).is_dir():
        return None
    asset = read_asset(folder, prefix, name, (".pincam",))
    if (nearest(time, asset.time, SAME_STAMP) < 0).any():
        return None
    K, _, _ = intrinsics_at(asset, time, size)
    return Lens(K, size)


def _prefix(folder: Folder) -> str:
    """Where the assets are, empty or with a slash at its end: SOURCE, or `<video>_frames` in it, as the detection set
    unpacks."""
    if folder.has(TRAJECTORY):
        return ""
    inside = sorted(path.name for path in folder.path.glob("*_frames") if (path / TRAJECTORY).exists())
    return f"{inside[0]}/" if inside else ""


def _color_kind(folder: Folder, prefix: str, wanted: str) -> str:
    if wanted != "auto":
        return wanted
    kinds = ("lowres_wide", "vga_wide", "wide")
    return next((kind for kind in kinds if (folder.path / prefix / kind).is_dir()), kinds[0])


def _missing(asset: Asset, frame: str) -> BadData:
    fix = "pass --skip-bad to leave the frame out."
    return BadData(asset.folder, f"frame {frame}", expected="a file of its time", got="none", fix=fix)
