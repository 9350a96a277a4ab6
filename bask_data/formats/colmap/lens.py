"""Lenses of a model's images, one for all or one for each; and COLMAP's camera for a lens of ours."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from bask_data.core.lens import Distortion, Lens, undistorted, undistortion
from bask_data.errors import BadData, UsageError
from bask_data.formats.colmap.model import ImagePose, one_size
from bask_data.formats.files import first_readable
from bask_data.formats.images import image_header
from bask_data.formats.recording import SourceCamera


def with_lens(
    source: Path, camera: SourceCamera, poses: dict[int, ImagePose], files: Sequence[Path]
) -> tuple[SourceCamera, str]:
    """The camera with the lens of its images, and what it is, in words.

    Args:
        poses: registered images, at least one, by the frame's index.
        files: of these images, those that there are.

    Raises:
        BadData: images differ in size from each other, or from their files.
    """
    size = one_size(source, {pose.name: pose for pose in poses.values()})
    first, header = first_readable(lambda path: (path, image_header(path)), files) if files else (source, None)
    if header is not None and (header.height, header.width) != size:
        raise BadData(
            first,
            "size",
            expected=f"{size[1]} x {size[0]} as in the model",
            got=f"{header.width} x {header.height}",
            fix="pass --images with the folder of the images that the model was made from.",
        )
    other = next(iter(poses.values())).lens
    lenses = [poses[i].lens if i in poses else other for i in range(len(camera.frames))]
    Ks = np.stack([lens.K for lens in lenses])
    has_one_K = bool((Ks == Ks[0]).all())
    has_one_distortion = len({lens.distortion for lens in lenses}) == 1
    lens = Lens(Ks[0] if has_one_K else Ks, size, other.distortion if has_one_distortion else None)
    text = f"the model's{'' if has_one_K else ', one K per image'}, for colour and depth alike"
    if has_one_distortion:
        return replace(camera, lens=lens), text
    text += "; each image's own lens distortion was taken out"
    return _taken_out(replace(camera, lens=lens), lenses), text


def _taken_out(camera: SourceCamera, lenses: list[Lens]) -> SourceCamera:
    """A camera of pinhole images, from one whose images have different lens distortions."""

    def pinhole(read: Callable[[int], Any]) -> Callable[[int], Any]:
        def undistorted_image(i: int) -> Any:
            try:
                return undistorted(read(i), undistortion(lenses[i]))
            except ValueError as error:
                fix = "undistort the images first: colmap image_undistorter."
                raise BadData(f"{camera.name} {camera.frames[i]}", "lens", got=str(error), fix=fix) from error

        return undistorted_image

    return replace(
        camera,
        color=pinhole(camera.color),
        depth=pinhole(camera.depth),
        labels=pinhole(camera.labels) if camera.labels else None,
    )


def colmap_camera(lens: Lens) -> Any:
    """COLMAP's camera for a lens with one K; `UsageError` if its model cannot be written in COLMAP's."""
    distortion = lens.distortion or Distortion("PINHOLE", ())
    name, values = distortion.name, distortion.parameters
    if name == "OPENCV" and len(values) > 4:
        # COLMAP's OPENCV has four numbers; what k3 to k6 are in OpenCV's is its FULL_OPENCV.
        name, values = "FULL_OPENCV", (*values[:8], *[0.0] * (8 - len(values)))
    height, width = lens.size
    K = lens.K.copy()
    K[:2, 2] += 0.5  # COLMAP's pixel (0, 0) is the corner of the image.
    camera = pycolmap.Camera.create_from_model_name(1, name, float(K[0, 0]), width, height)
    parameters = np.array(camera.params)
    focal = list(camera.focal_length_idxs())
    if (len(distortion.parameters) > 8 and name == "FULL_OPENCV") or K[0, 1] != 0:
        got = "skew in K" if K[0, 1] else f"{distortion.model} with {len(distortion.parameters)} numbers"
        raise UsageError("--distortion", expected="a lens that COLMAP has", got=got, fix="undistort the images first.")
    parameters[focal] = [K[0, 0], K[1, 1]] if len(focal) == 2 else (K[0, 0] + K[1, 1]) / 2
    parameters[list(camera.principal_point_idxs())] = K[:2, 2]
    parameters[list(camera.extra_params_idxs())] = values
    camera.params = parameters
    return camera
