"""Scenes in the layout of the BOP benchmark (BOP-scenewise), and of YCB-Video.

Source: github.com/thodan/bop_toolkit, docs/bop_datasets_format.md. Lengths are millimetres there, and matrices are
written row by row.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bask_data.core.lens import Lens
from bask_data.errors import BadData, UsageError
from bask_data.formats.bop.cameras import poses_of, read_views
from bask_data.formats.bop.truth import read_annotations, scene_truth
from bask_data.formats.choices import chosen_episode
from bask_data.formats.files import Folder, first_readable, listed, natural, paired, source_folder
from bask_data.formats.images import image_header, read_color
from bask_data.formats.options.bop import BopOptions
from bask_data.formats.recording import SourceCamera, SourceRecording
from bask_data.formats.stated_images import camera_assumptions, intrinsics_of, scaled_depth
from bask_data.formats.ycb_video import META, read_ycb_video

IMAGES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
"""Endings of image files in BOP's data sets."""

CAMERAS = "scene_camera"
"""What the name of the file with a scene's cameras begins with."""


def read(source: Path, options: BopOptions) -> SourceRecording:
    """The scene at `source`, or the one of `source` that `--episode` chooses."""
    folder = source_folder(source, options.follow_links)
    inside = "."
    if not _is_scene(source) or options.episode:
        names = episodes(source, options)
        if not names:
            _refuse(source)
        inside = chosen_episode(source, names, options.episode)
    prefix = "" if inside == "." else f"{inside}/"
    if any((source / inside).glob(f"*{META}")):
        return read_ycb_video(folder, prefix, options)
    return _read_scene(folder, prefix, options)


def episodes(source: Path, options: BopOptions) -> tuple[str, ...]:
    """Paths of the scenes in a split or a whole data set, relative to `source`; empty if `source` is a scene."""
    if _is_scene(source):
        return ()
    for depth in ("*", "*/*"):
        found = [path for path in source.glob(depth) if path.is_dir() and _is_scene(path)]
        if found:
            return tuple(sorted((path.relative_to(source).as_posix() for path in found), key=natural))
    return ()


def _is_scene(path: Path) -> bool:
    return any(path.glob(f"{CAMERAS}*.json")) or any(path.glob(f"*{META}"))


def _refuse(source: Path) -> None:
    """Say which of BOP's other layouts this is, if it is one."""
    got = "neither"
    if any(source.glob("*.camera.json")):
        got = "BOP-imagewise"
    elif any(source.glob("*.tar")):
        got = "archives: BOP-webdataset, or not unpacked"
    raise BadData(
        source,
        "SOURCE",
        expected="a scene with scene_camera.json (BOP-scenewise) or *-meta.mat (YCB-Video), or a folder of such scenes",
        got=got,
        fix="take the data set's scenes as bop.felk.cvut.cz offers them for download, unpacked.",
    )


def _read_scene(folder: Folder, prefix: str, options: BopOptions) -> SourceRecording:
    suffix = _sensor(folder.path / prefix, options.sensor)
    camera_file = folder.member(f"{prefix}{CAMERAS}{suffix}.json", "cameras")
    views = read_views(camera_file)
    groups = {
        "color": folder.files_in(_color_folder(folder, prefix, suffix), IMAGES, "colour"),
        "depth": folder.files_in(f"{prefix}depth{suffix}", IMAGES, "depth"),
    }
    names, faults = paired(folder.path, groups, patterns=False)
    ids = _ids(folder.path / prefix, names)
    for name, i_image in zip(names, ids, strict=True):
        if i_image not in views:
            fix = "pass --skip-bad to leave it out."
            fault = BadData(camera_file, f"image {i_image}", expected="its camera", got="none", fix=fix)
            faults.setdefault(name, fault)
    annotated, gt_file = read_annotations(folder, f"{prefix}scene_gt{suffix}.json")
    seen, stated = [views.get(i) for i in ids], [annotated.get(i, []) for i in ids]
    poses, world = poses_of(camera_file, seen, stated, options.world_object)
    color, depth = ([groups[kind].get(name, folder.path) for name in names] for kind in ("color", "depth"))
    header = first_readable(image_header, groups["color"].values())
    size = (header.height, header.width)
    truth = scene_truth(folder, f"{prefix}mask_visib{suffix}", names, stated, poses, size)
    depth_scale, read_depth_image = scaled_depth(depth, [view.depth_scale / 1000 if view else None for view in seen])
    camera = SourceCamera(
        name=options.camera,
        frames=tuple(names),
        lens=Lens(intrinsics_of([view.K if view else None for view in seen]), size),
        world_from_cameras=poses,
        time=np.array(ids, np.float64) / options.fps,
        color=lambda i: read_color(color[i]),
        depth=read_depth_image,
        depth_scale=depth_scale,
        labels=truth.labels,
        faults={names.index(name): fault for name, fault in faults.items()},
        pose_places=tuple(f"{camera_file}: image {i_image}" for i_image in ids),
        # T-LESS has crops, whose principal points are anywhere: K of each image is known to be for its size.
        intrinsics_size=f"{size[1]}x{size[0]}",
    )
    return SourceRecording(
        cameras=(camera,),
        robot=None,
        label_names=truth.names,
        assumptions={
            "world": world,
            "pose": "camera_from_world in the files, millimetres, OpenCV axes; inverted",
            **camera_assumptions(camera),
            "time": f"image id / {options.fps:g} per second: the files state none",
            "labels": truth.statement,
        },
        files=(camera_file, *gt_file, *groups["color"].values(), *groups["depth"].values(), *truth.files),
        object_poses=truth.poses,
    )


def _color_folder(folder: Folder, prefix: str, suffix: str) -> str:
    """Where the colour images are, or the grey ones of sensors without colour."""
    grey = f"{prefix}gray{suffix}"
    return grey if (folder.path / grey).is_dir() and not folder.has(f"{prefix}rgb{suffix}") else f"{prefix}rgb{suffix}"


def _sensor(scene: Path, wanted: str) -> str:
    """What the names of the chosen sensor's files and folders end in: nothing, or `_` and its name."""
    found = sorted(path.stem[len(CAMERAS) :] for path in scene.glob(f"{CAMERAS}*.json"))
    chosen = f"_{wanted}" if wanted else ("" if "" in found or len(found) != 1 else found[0])
    if chosen in found:
        return chosen
    known = listed([name[1:] for name in found if name])
    raise UsageError(
        scene,
        "--sensor",
        expected=f"one of {known}" if known else "none: the scene has one sensor",
        got=wanted or "none",
        fix=f"pass --sensor {known.split(',')[0]}." if known else "leave it out.",
    )


def _ids(scene: Path, names: list[str]) -> list[int]:
    """Image ids, which are not contiguous."""
    bad = [name for name in names if not (name.isascii() and name.isdigit())]
    if bad:
        raise BadData(
            scene, "names of images", expected="numbers", got=listed(bad), fix="remove what is no image of the scene."
        )
    return [int(name) for name in names]
