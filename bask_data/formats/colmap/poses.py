"""Poses of a COLMAP source: from its model or from its images, in metres, and in the world of known poses."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.lens import Lens
from bask_data.errors import BadData
from bask_data.formats.bad_frames import bad_frames, chosen_frames
from bask_data.formats.colmap.align import aligned_model
from bask_data.formats.colmap.lens import with_lens
from bask_data.formats.colmap.model import ImagePose, SparseModel
from bask_data.formats.colmap.scale import in_words, metric, model_scale
from bask_data.formats.colmap.sfm import structure_from_motion
from bask_data.formats.images import image_header
from bask_data.formats.options.colmap import ColmapOptions
from bask_data.formats.recording import SourceCamera, SourceRecording


@dataclass(frozen=True)
class ColmapSource:
    """What is known before poses are found, scaled and aligned.

    Args:
        color: image files, by frame.
        model: None: to be found from the images.
        lens: to find it with; None: to be estimated.
        known: world_from_camera, metres, of images that the model is aligned with.
    """

    path: Path
    options: ColmapOptions
    color: tuple[Path | None, ...]
    model: SparseModel | None
    lens: Lens | None
    known: dict[str, Float[ndarray, "4 4"]]


def completed(source: ColmapSource, recording: SourceRecording) -> SourceRecording:
    """The recording with its poses and lens.

    Raises:
        BadData: no image registers, or model, images, depth and known poses do not belong together.
        UsageError: there are too few or too many images to find poses from.
    """
    [camera] = recording.cameras
    chosen = chosen_frames(camera, source.options.frames)
    stated = dict(recording.assumptions)
    model, camera = source.model, replace(camera, faults=dict(camera.faults))
    if model is None:
        usable = _usable(source, camera, chosen)
        model, n_parts = structure_from_motion(usable, source.lens)
        stated |= _as_found(model, n_parts, len(usable), source.lens)
    poses = {
        i: image
        for i, name in enumerate(camera.frames)
        if (image := model.images.get(name)) is not None and image.world_from_camera is not None
    }
    camera = _registered(source, camera, poses, chosen)
    here = {i: poses[i] for i in chosen if i in poses}
    if source.lens is not None:
        camera = replace(camera, lens=source.lens)
    elif here:
        files = [path for i in here if (path := source.color[i]) is not None]
        camera, text = with_lens(source.path, camera, here, files)
        stated.setdefault("intrinsics", text)
    bad = {fault.index for fault in bad_frames(camera, chosen, source.options)}
    fit = [i for i in chosen if i not in bad]
    if not fit:
        return replace(recording, cameras=(camera,), assumptions=stated)
    scale = model_scale(source.path, camera, {i: poses[i] for i in fit}, model, source.options)
    stated["scale"] = in_words(scale)
    metres = {camera.frames[i]: metric(pose, scale.metres_per_unit) for i, pose in poses.items()}
    stated["world"] = "the model's: its origin and its orientation are arbitrary"
    if source.known:
        by = source.options.align_to
        metres, stated["world"] = aligned_model(metres, source.known, by, scale.metres_per_unit)
    world_from_cameras = np.stack([metres.get(name, np.full((4, 4), np.nan)) for name in camera.frames])
    camera = replace(camera, world_from_cameras=world_from_cameras)
    return replace(recording, cameras=(camera,), assumptions=stated)


def _usable(source: ColmapSource, camera: SourceCamera, chosen: list[int]) -> dict[str, Path]:
    """Images that are whole, and of one size, as COLMAP decodes them itself; others become faults."""
    size = source.lens.size if source.lens else None
    usable: dict[str, Path] = {}
    for i in chosen:
        path = source.color[i]
        if path is not None and i not in camera.faults:
            try:
                header = image_header(path)
                size = size or (header.height, header.width)
                if (header.height, header.width) != size:
                    raise BadData(
                        path,
                        "size",
                        expected=f"{size[1]} x {size[0]} as the images before",
                        got=f"{header.width} x {header.height}",
                        fix="read the images of one size: --images, --frames, or --skip-bad.",
                    )
            except BadData as error:
                camera.faults[i] = error
        if path is not None and i not in camera.faults:
            usable[camera.frames[i]] = path
        elif not source.options.skip_bad:
            # Finding poses takes long: what would be refused afterwards is refused before.
            raise camera.faults[i]
    return usable


def _as_found(model: SparseModel, n_parts: int, n_images: int, lens: Lens | None) -> dict[str, str]:
    """What was found from images alone, in words."""
    stated = {
        "pose": f"found from the images by COLMAP's structure from motion: {model.n_registered} of {n_images} "
        f"registered, {model.n_points} points, mean reprojection error {model.error_px:.2f} pixels"
    }
    if n_parts > 1:
        stated["models"] = f"the images broke into {n_parts} parts that do not connect; the largest is taken"
    if lens is None:
        found = next(iter(model.images.values())).lens
        numbers = ", ".join(f"{value:.4g}" for value in found.distortion.parameters) if found.distortion else ""
        distortion = f"distortion {found.distortion.model} {numbers}" if found.distortion else "no distortion"
        start = "EXIF's" if model.has_prior_focal_length else "1.2 times the longer side"
        stated["intrinsics"] = (
            f"estimated from the images, for colour and depth alike: focal length {found.K[0, 0]:.1f} pixels (from "
            f"{start} at first), principal point in the middle, {distortion}; "
            "measured --intrinsics are better"
        )
    else:
        stated["intrinsics"] = "--intrinsics, for colour and depth alike, kept as they are; pixel (0, 0) is a centre"
    return stated


def _registered(
    source: ColmapSource, camera: SourceCamera, poses: dict[int, ImagePose], chosen: list[int]
) -> SourceCamera:
    """The camera with the model's poses, in its units; images that the model lacks are left out, as COLMAP does."""
    faults, expected = dict(camera.faults), {}
    for i in chosen:
        if i not in poses and (source.model is not None or i not in faults):
            expected[i] = "not registered"
            faults[i] = BadData(
                f"{camera.name} {camera.frames[i]}",
                "pose",
                expected="an image that COLMAP registered",
                got="one that it left out",
                fix="take more images between this one and the others.",
            )
    world_from_cameras = np.full((len(camera.frames), 4, 4), np.nan)
    for i, pose in poses.items():
        world_from_cameras[i] = pose.world_from_camera
    return replace(camera, faults=faults, expected=expected, world_from_cameras=world_from_cameras)
