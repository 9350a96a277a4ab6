"""ScanNet: what its SensReader exports, the benchmark's frames_25k, or the downloaded `.sens` file itself.

3RScan and 12-Scenes have the same files. Frames whose tracking was lost have a pose of -inf; every scan has some, so
they are left out without being asked.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.geometry import invert_rigid
from bask_data.core.lens import Lens
from bask_data.errors import BadData, UsageError
from bask_data.formats.clock import counted
from bask_data.formats.files import Folder, first_readable, listed, paired
from bask_data.formats.images import image_header, read_color, read_depth
from bask_data.formats.options.scannet import ScannetOptions
from bask_data.formats.poses import read_transforms
from bask_data.formats.recording import SourceCamera, SourceRecording
from bask_data.formats.scannet.export import Export, find_export
from bask_data.formats.scannet.labels import instance_labels
from bask_data.formats.scannet.sens import SensFile

IDENTITY_TOLERANCE = 1e-6
"""Largest deviation from the identity of extrinsics that mean one camera: they are written to six decimals."""


def read(source: Path, options: ScannetOptions) -> SourceRecording:
    """The scan at `source`: a `.sens` file, the folder it was exported to, or a folder that holds either."""
    if source.is_file():
        if source.suffix.lower() != ".sens":
            raise UsageError(source, "SOURCE", expected="a folder, or a file .sens", got=f"a file {source.suffix}")
        return _of_sens(Folder(source.parent, options.follow_links), source.name, options)
    _refuse_scannet_pp(source)
    folder = Folder(source, options.follow_links)
    if exported := find_export(folder):
        return _of_files(folder, exported, options)
    packed = sorted(path for path in source.glob("*.sens") if not path.name.startswith("."))
    if len(packed) == 1:
        return _of_sens(folder, packed[0].name, options)
    raise BadData(
        source,
        "SOURCE",
        expected="folders color, depth, pose and intrinsic, an info file, or one .sens file",
        got=listed([path.name for path in packed]) if packed else "none of them",
        fix="name one .sens file as SOURCE." if packed else "choose the folder that SensReader exported to.",
    )


def _refuse_scannet_pp(source: Path) -> None:
    """Refuse ScanNet++, which has another layout under a similar name."""
    if any((source / name).exists() for name in ("iphone", "dslr", "pose_intrinsic_imu.json")):
        raise BadData(
            source,
            "SOURCE",
            expected="a scan of ScanNet",
            got="one of ScanNet++, whose layout is another",
            fix="undistort it with ScanNet++'s toolbox, which writes nerfstudio/transforms.json, and read that by "
            "`bask-data ingest nerfstudio`; or its colmap folder by `bask-data ingest colmap`.",
        )


def _of_files(folder: Folder, export: Export, options: ScannetOptions) -> SourceRecording:
    """What SensReader exported."""
    groups, calibration = export.groups, export.calibration
    names, missing = paired(folder.path, groups, patterns=False)
    color, depth = ([groups[kind].get(name) for name in names] for kind in ("color", "depth"))
    written = dict(zip(groups["pose"], read_transforms(list(groups["pose"].values())), strict=True))
    poses = np.stack([written.get(name, np.full((4, 4), np.nan)) for name in names])
    color_from_depth = _color_from_depth(calibration.color_from_body, calibration.depth_from_body)
    labels = instance_labels(folder, export.prefix, names)
    faults = {names.index(name): fault for name, fault in missing.items()}
    lost = {
        i: _tracking_lost(f"{groups['pose'][name]}", "-inf or NaN")
        for i, name in enumerate(names)
        if name in groups["pose"] and not np.isfinite(poses[i]).all()
    }
    clock = counted(names, options.fps)
    header, depth_header = (first_readable(image_header, groups[kind].values()) for kind in ("color", "depth"))
    camera = SourceCamera(
        name=options.camera,
        frames=tuple(names),
        lens=Lens(calibration.color_K, (header.height, header.width)),
        world_from_cameras=_of_color(poses, calibration.color_from_body),
        time=clock.time,
        color=lambda i: read_color(_file(color[i])),
        depth=lambda i: read_depth(_file(depth[i])),
        depth_scale=calibration.depth_scale,
        depth_lens=Lens(calibration.depth_K, (depth_header.height, depth_header.width)),
        color_from_depth=color_from_depth,
        labels=labels.read if labels.files else None,
        faults={**lost, **faults},
        expected={i: "tracking lost" for i in lost if i not in faults},
        pose_places=tuple(str(groups["pose"].get(name, name)) for name in names),
    )
    return SourceRecording(
        cameras=(camera,),
        robot=None,
        label_names=labels.names,
        assumptions=_assumptions(calibration.depth_scale, color_from_depth)
        | {"time": f"{clock.statement}: the files state none", "labels": labels.statement},
        files=(
            *(file for group in groups.values() for file in group.values()),
            *calibration.files,
            *labels.files,
            *labels.name_files,
        ),
    )


def _of_sens(folder: Folder, name: str, options: ScannetOptions) -> SourceRecording:
    """What a `.sens` file holds, and the labels beside it."""
    path = folder.member(name, "SOURCE")
    sens = SensFile.opened(path)
    color_from_depth = _color_from_depth(sens.color_from_body, sens.depth_from_body)
    time = sens.time
    lost = {
        i: _tracking_lost(f"{path}: frame {i}", "-inf or NaN")
        for i, pose in enumerate(sens.world_from_body)
        if not np.isfinite(pose).all()
    }
    names = [str(i) for i in range(sens.n_frames)]
    labels = instance_labels(folder, "", names)
    camera = SourceCamera(
        name=options.camera,
        frames=tuple(names),
        lens=Lens(sens.color_K, sens.color_size),
        world_from_cameras=_of_color(sens.world_from_body, sens.color_from_body),
        time=counted(names, options.fps).time if time is None else time,
        color=sens.color,
        depth=sens.depth,
        depth_scale=sens.depth_scale,
        depth_lens=Lens(sens.depth_K, sens.depth_size),
        color_from_depth=color_from_depth,
        labels=labels.read if labels.files else None,
        faults=lost,
        expected=dict.fromkeys(lost, "tracking lost"),
        pose_places=tuple(f"{path}: frame {name}" for name in names),
    )
    clock = f"frame number / {options.fps:g} per second: the file's stamps do not increase"
    return SourceRecording(
        cameras=(camera,),
        robot=None,
        label_names=labels.names,
        assumptions=_assumptions(sens.depth_scale, color_from_depth)
        | {
            "time": clock if time is None else "microseconds, from the stamps of the colour images",
            "labels": labels.statement,
        },
        files=(path, *labels.files, *labels.name_files),
    )


def _tracking_lost(where: str, got: str) -> BadData:
    return BadData(where, "pose", expected="a pose", got=f"{got}: tracking was lost")


def _file(path: Path | None) -> Path:
    assert path is not None, "frames without files are in `faults`, and are not read"
    return path


def _color_from_depth(
    color_from_body: Float[ndarray, "4 4"], depth_from_body: Float[ndarray, "4 4"]
) -> Float[ndarray, "4 4"] | None:
    """Pose of the depth camera in the colour camera; None for the identity.

    Extrinsics are camera_from_body. Source: `convertDepthToColorSpace` in BundleFusion and VoxelHashing, whose sensor
    files these are.
    """
    color_from_depth = color_from_body @ invert_rigid(depth_from_body)
    return None if np.abs(color_from_depth - np.eye(4)).max() <= IDENTITY_TOLERANCE else color_from_depth


def _of_color(
    world_from_body: Float[ndarray, "t 4 4"], color_from_body: Float[ndarray, "4 4"]
) -> Float[ndarray, "t 4 4"]:
    """Poses of the colour camera. Lost ones are not multiplied: -inf times 0 would warn of NaN."""
    poses = world_from_body.copy()
    known = np.isfinite(poses).all(axis=(1, 2))
    if np.abs(color_from_body - np.eye(4)).max() > IDENTITY_TOLERANCE:
        poses[known] = poses[known] @ invert_rigid(color_from_body)
    return poses


def _assumptions(depth_scale: float, color_from_depth: Float[ndarray, "4 4"] | None) -> dict[str, str]:
    same = color_from_depth is None
    return {
        "world": "as in the poses; the axis alignment of the scan's .txt is not applied",
        "pose": "world_from_camera, metres, OpenCV axes; -inf where tracking was lost",
        "depth": f"z-depth, {depth_scale:g} m per unit, 0 = no measurement; "
        + ("aligned with colour, as the extrinsics are the identity" if same else "of another camera, by extrinsics"),
        "intrinsics": "of colour and of depth, each for images of its size, no lens distortion",
    }
