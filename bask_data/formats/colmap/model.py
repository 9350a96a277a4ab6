"""COLMAP's models: cameras, poses and sparse points, as pycolmap reads them, text or binary, with rigs or without."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.lens import Distortion, Lens
from bask_data.errors import BadData
from bask_data.formats.colmap.entries import check_entries
from bask_data.formats.files import Folder, listed, natural
from bask_data.formats.options.colmap import MODEL_PLACES

MODEL_FILES = ("cameras", "images", "points3D", "rigs", "frames")
"""Files of a model, `.bin` or `.txt`; the last two since COLMAP 3.12, and only where it wrote them."""


@dataclass(frozen=True)
class ImagePose:
    """An image of a model.

    Args:
        name: as the model has it, a path relative to its folder of images.
        lens: of its camera; pixel (0, 0) is a centre.
        world_from_camera: in the model's world and units; None if the image is not registered.
    """

    name: str
    lens: Lens
    world_from_camera: Float[ndarray, "4 4"] | None


@dataclass(frozen=True)
class SparseModel:
    """A model.

    Args:
        images: in natural order of their names in the model, by that name, or by one of the caller's.
        error_px: mean reprojection error, pixels.
        n_points: number of sparse points.
        has_prior_focal_length: whether its first camera's focal length was known before (EXIF, or given).
    """

    images: dict[str, ImagePose]
    error_px: float
    n_points: int
    has_prior_focal_length: bool
    reconstruction: Any

    @property
    def n_registered(self) -> int:
        """Number of images with a pose."""
        return sum(image.world_from_camera is not None for image in self.images.values())

    def points_camera(self, pose: ImagePose) -> Float[ndarray, "n 3"]:
        """Sparse points that an image observes, in its camera's frame, units of the model."""
        image = self.reconstruction.find_image_with_name(pose.name)
        points = self.reconstruction.points3D
        seen = [points[point.point3D_id].xyz for point in image.points2D if point.has_point3D()]
        return np.array(image.cam_from_world() * np.array(seen)) if seen else np.zeros((0, 3))


def model_folders(folder: Folder, place: str) -> tuple[str, ...]:
    """Folders of the models in a source, relative to it; empty if there is none.

    Args:
        place: where to look; empty: in `MODEL_PLACES`.
    """
    for candidate in [place] if place else MODEL_PLACES:
        if _is_model(folder, candidate):
            return (candidate,)
        numbered = sorted(
            (path.name for path in (folder.path / candidate).glob("*") if path.name.isdecimal()), key=natural
        )
        parts = tuple(f"{candidate}/{name}" for name in numbered if _is_model(folder, f"{candidate}/{name}"))
        if parts:
            return parts
    return ()


def _is_model(folder: Folder, place: str) -> bool:
    return any(all(folder.has(f"{place}/{name}{suffix}") for name in MODEL_FILES[:3]) for suffix in (".bin", ".txt"))


def read_model(folder: Folder, place: str) -> tuple[SparseModel, tuple[Path, ...]]:
    """The model in a folder of the source, and its files. Binary files are read if there are both.

    Raises:
        BadData: a file is missing, corrupted, larger than `MAX_MODEL_BYTES`, or has a camera that we do not know.
    """
    suffix = ".bin" if folder.has(f"{place}/images.bin") and folder.has(f"{place}/points3D.bin") else ".txt"
    files = tuple(
        folder.member(f"{place}/{name}{suffix}", "model")
        for name in MODEL_FILES
        if name in MODEL_FILES[:3] or folder.has(f"{place}/{name}{suffix}")
    )
    for file in files:
        check_entries(file)
    reconstruction = pycolmap.Reconstruction()
    read = reconstruction.read_binary if suffix == ".bin" else reconstruction.read_text
    with quiet():
        try:
            read(os.fspath(folder.path / place))
        except Exception as error:  # pybind turns C++ exceptions into many types: ValueError, IndexError, MemoryError.
            raise BadData(
                folder.path / place,
                "model",
                expected="a COLMAP model",
                got=f"one that does not read: {str(error).splitlines()[0][:120]}",
                fix="copy it again, or write it once more: colmap model_converter.",
            ) from error
    return sparse_model(folder.path / place, reconstruction), files


def sparse_model(where: Path | str, reconstruction: Any) -> SparseModel:
    """A model of pycolmap's, with our conventions; `BadData` if a camera has no pinhole image."""
    lenses = {number: _lens(where, camera) for number, camera in reconstruction.cameras.items()}
    images = {}
    for image in reconstruction.images.values():
        pose = None
        if image.has_pose:
            pose = np.eye(4)
            pose[:3] = image.cam_from_world().inverse().matrix()
        images[image.name] = ImagePose(image.name, lenses[image.camera_id], pose)
    return SparseModel(
        images={name: images[name] for name in sorted(images, key=natural)},
        error_px=float(reconstruction.compute_mean_reprojection_error()) if reconstruction.num_points3D() else np.nan,
        n_points=reconstruction.num_points3D(),
        has_prior_focal_length=any(camera.has_prior_focal_length for camera in reconstruction.cameras.values()),
        reconstruction=reconstruction,
    )


def _lens(where: Path | str, camera: Any) -> Lens:
    name = camera.model.name
    try:
        parameters = tuple(float(camera.params[i]) for i in camera.extra_params_idxs())
        distortion = Distortion(name, parameters)
        K = np.array(camera.calibration_matrix(), dtype=np.float64)
    except (ValueError, RuntimeError) as error:
        raise BadData(
            where,
            f"camera {camera.camera_id}",
            expected="a camera that has a pinhole image",
            got=f"{name}: {str(error).splitlines()[0]}",
            fix="undistort the images first: colmap image_undistorter.",
        ) from error
    K[:2, 2] -= 0.5  # COLMAP's pixel (0, 0) is the corner of the image.
    return Lens(K, (int(camera.height), int(camera.width)), None if distortion.is_none else distortion)


def one_size(where: Path | str, images: dict[str, ImagePose]) -> tuple[int, int]:
    """(height, width) of all registered images; `BadData` if they differ."""
    names: dict[tuple[int, int], list[str]] = {}
    for name, image in images.items():
        if image.world_from_camera is not None:
            names.setdefault(image.lens.size, []).append(name)
    if len(names) > 1:
        found = "; ".join(f"{size[1]} x {size[0]}: {listed(some, 2)}" for size, some in names.items())
        raise BadData(
            where,
            "cameras",
            expected="images of one size",
            got=found,
            fix="choose those of one camera by --frames, or ingest the cameras one by one with models of their own.",
        )
    return next(iter(names))


@contextmanager
def quiet() -> Iterator[None]:
    """Without COLMAP's log on the screen, and as before at the end."""
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = 4
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before
