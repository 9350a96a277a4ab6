"""Images with depth and COLMAP's model of them, or without: then COLMAP finds the poses. Depth gives the scale."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

import numpy as np

from bask_data.core.lens import Lens
from bask_data.errors import BadData, UsageError
from bask_data.formats.clock import counted
from bask_data.formats.colmap.files import found_images
from bask_data.formats.colmap.known import known_poses
from bask_data.formats.colmap.model import SparseModel, model_folders, read_model
from bask_data.formats.colmap.poses import ColmapSource, completed
from bask_data.formats.depth_files import SCALE_OF_FLOAT, SCALE_OF_WHOLE_NUMBERS
from bask_data.formats.files import Folder, listed, natural, source_folder
from bask_data.formats.image_files import ImageFiles
from bask_data.formats.images import image_header
from bask_data.formats.intrinsics import check_intrinsics, parse_intrinsics
from bask_data.formats.lenses import parse_distortion
from bask_data.formats.options.colmap import ColmapOptions
from bask_data.formats.recording import SourceCamera, SourceRecording


def read(source: Path, options: ColmapOptions) -> SourceRecording:
    """The recording in `source`. Poses are found, scaled and aligned when it is completed."""
    folder = source_folder(source, options.follow_links)
    model, model_files, assumptions = _chosen_model(folder, options)
    images = found_images(folder, options.images, list(model.images) if model else [])
    names = sorted({*images.files, *(model.images if model else ())}, key=natural)
    faults: dict[int, BadData] = {}
    color: list[Path | None] = []
    depth: list[Path | None] = []
    for i, name in enumerate(names):
        try:
            color.append(images.path(name))
        except BadData as error:
            faults[i] = error
            color.append(None)
        depth.append(images.depth(options.depth, name))
    faults = {**_without_depth(folder, options, names, depth), **faults}
    lens, lens_files = _given_lens(folder, options, color, model is not None)
    known, known_files = known_poses(folder, names, options) if options.align_to else ({}, ())
    invalid = tuple(int(word) for word in options.invalid_depth.split(",") if word)
    files = ImageFiles(tuple(color), tuple(depth), invalid_depth=invalid)
    depth_scale = options.depth_scale or (SCALE_OF_FLOAT if files.is_float else SCALE_OF_WHOLE_NUMBERS)
    clock = counted([PurePosixPath(name).stem for name in names], options.fps)
    camera = SourceCamera(
        name=options.camera,
        frames=tuple(names),
        lens=lens or Lens(np.eye(3), (0, 0)),
        world_from_cameras=np.full((len(names), 4, 4), np.nan),
        time=clock.time,
        color=files.read_color,
        depth=files.read_depth,
        depth_scale=depth_scale,
        faults=faults,
        intrinsics_size=options.intrinsics_size,
    )
    assumptions |= {
        "camera axes": "x right, y down, z forward",
        "depth": f"z-depth registered to colour, {depth_scale:g} m per unit, 0 = no measurement",
        "time": clock.statement,
    }
    at_hand = ColmapSource(source, options, tuple(color), model, lens, known)
    return SourceRecording(
        cameras=(camera,),
        robot=None,
        label_names={},
        assumptions=assumptions,
        files=(*model_files, *files.files, *lens_files, *known_files),
        completed=lambda recording: completed(at_hand, recording),
    )


def _chosen_model(
    folder: Folder, options: ColmapOptions
) -> tuple[SparseModel | None, tuple[Path, ...], dict[str, str]]:
    """The model in the source, the one of most images if there are several; None if poses are to be found."""
    if options.model == "none":
        return None, (), {}
    place = "" if options.model == "auto" else options.model.strip("/")
    places = model_folders(folder, place)
    if not places:
        if not place:
            return None, (), {}
        raise BadData(
            folder.path / place,
            "--model",
            expected="cameras, images and points3D, .bin or .txt",
            got="a folder without them" if (folder.path / place).is_dir() else "no such folder",
            fix="pass the folder that has them, or --model none to find poses from the images.",
        )
    if options.intrinsics or options.distortion:
        option = "--intrinsics" if options.intrinsics else "--distortion"
        fix = f"leave {option} out; or --model none finds the poses anew from the images."
        raise UsageError(option, expected=f"nothing: the model in {places[0]} states it", got="a value", fix=fix)
    read = {name: read_model(folder, name) for name in places}
    chosen = max(read, key=lambda name: read[name][0].n_registered)
    model = read[chosen][0]
    if not model.n_registered:
        fix = "pass --model none to find poses from the images."
        raise BadData(folder.path / chosen, "images", expected="registered images", got="none", fix=fix)
    stated = {
        "pose": f"camera_from_world of the COLMAP model in {chosen}, inverted: {model.n_registered} images, "
        f"{model.n_points} points, mean reprojection error {model.error_px:.2f} pixels"
    }
    if len(read) > 1:
        others = [f"{name} with {other.n_registered} images" for name, (other, _) in read.items() if name != chosen]
        stated["models"] = f"{chosen}, the largest of {len(read)}; not {listed(others)}"
    return model, tuple(file for _, files in read.values() for file in files), stated


def _without_depth(
    folder: Folder, options: ColmapOptions, names: list[str], depth: list[Path | None]
) -> dict[int, BadData]:
    """The error of each image that has no depth file."""
    missing = [i for i, path in enumerate(depth) if path is None]
    skip = ", or pass --skip-bad to leave these images out" if len(missing) < len(names) else ""
    return {
        i: BadData(
            folder.path,
            f"depth of {listed([names[i], *(names[k] for k in missing if k != i)])}",
            expected=f"a file {options.depth}",
            got=f"none for {len(missing)} of {len(names)} images",
            fix=f"check --depth{skip}.",
        )
        for i in missing
    }


def _given_lens(
    folder: Folder, options: ColmapOptions, color: list[Path | None], has_model: bool
) -> tuple[Lens | None, tuple[Path, ...]]:
    """The lens that poses are found with; None if it is to be estimated, or stands in the model."""
    if has_model:
        return None, ()
    if not options.intrinsics:
        if options.distortion:
            fix = "pass --intrinsics, too; without both, the lens is estimated."
            raise UsageError("--distortion", expected="the intrinsics it belongs to", got="none", fix=fix)
        return None, ()
    K, files = parse_intrinsics(folder, options.intrinsics)
    header = image_header(next(path for path in color if path is not None))
    check_intrinsics(options.camera, K, (header.height, header.width), options.intrinsics_size)
    distortion = parse_distortion(options.distortion) if options.distortion else None
    return Lens(K, (header.height, header.width), distortion), files
