"""Cameras of an RLBench episode: folders `<camera>_rgb`, `_depth` and `_mask` of PNG files, and calibration in `misc`.

Depth is a colour image: a 24-bit code between the near and the far plane. Cameras have CoppeliaSim's axes: x left, y
up, z forward. Facts by RLBench's `dataset_generator.py` and `utils.py` and PyRep's `vision_sensor.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8, UInt32
from numpy import ndarray

from bask_data.core.lens import Lens
from bask_data.errors import BadData
from bask_data.formats.files import Folder, first_readable, frame_number, listed, read_bytes
from bask_data.formats.images import decode_color, image_header, read_color
from bask_data.formats.recording import SourceCamera
from bask_data.formats.simulated import at_pixel_centres, labelled

CAMERAS = ("front", "left_shoulder", "right_shoulder", "overhead", "wrist")
"""RLBench's cameras; those of forks are found by their folders and keys, too."""

PICKLE = "low_dim_obs.pkl"
"""File of an episode with everything but its images."""

FARTHEST_CODE = 2**24 - 1
"""Code of the far plane: nothing was hit."""

OPENCV_FROM_COPPELIASIM = np.diag([-1.0, -1.0, 1.0, 1.0])
"""Camera axes: x left and y up become x right and y down."""


@dataclass(frozen=True)
class Images:
    """PNG files of one camera and kind, by frame."""

    files: dict[int, Path]

    def color(self, i: int) -> UInt8[ndarray, "h w 3"]:
        return read_color(self.files[i])

    def numbers(self, i: int) -> UInt32[ndarray, "h w"]:
        """Numbers coded by colour, the first channel last: CoppeliaSim's object handles."""
        return _numbers(self.files[i], 1)

    def codes(self, i: int) -> UInt32[ndarray, "h w"]:
        """Numbers coded by colour, the first channel first: depth."""
        return _numbers(self.files[i], -1)


def found_cameras(
    episode: Folder, observations: list[dict[str, Any]]
) -> tuple[dict[str, dict[str, Images]], dict[str, str]]:
    """Images of each camera that can be used, by kind; and why others cannot."""
    misc = _misc(observations[0])
    folders = {path.name for path in episode.path.iterdir() if path.is_dir()}
    named = sorted(
        {name.removesuffix("_rgb") for name in folders if name.endswith("_rgb")}
        | {key.removesuffix("_camera_extrinsics") for key in misc if key.endswith("_camera_extrinsics")},
        key=lambda name: (CAMERAS.index(name) if name in CAMERAS else len(CAMERAS), name),
    )
    usable: dict[str, dict[str, Images]] = {}
    reasons = {}
    for camera in named:
        images = {
            kind: Images(
                {
                    number: file
                    for name, file in episode.files_in(f"{camera}_{kind}", (".png",), f"camera {camera}").items()
                    if (number := frame_number(name)) is not None
                }
            )
            for kind in ("rgb", "depth", "mask")
            if any((episode.path / f"{camera}_{kind}").glob("*.png"))
        }
        lacking = [kind for kind in ("rgb", "depth") if kind not in images]
        keys = [f"{camera}_camera_{key}" for key in ("extrinsics", "intrinsics", "near", "far")]
        lacking += [f"misc {key}" for key in keys if misc.get(key) is None]
        if lacking:
            reasons[camera] = f"no {listed(lacking)}"
        else:
            usable[camera] = images
    return usable, reasons


def read_camera(
    episode: Folder,
    name: str,
    images: dict[str, Images],
    observations: list[dict[str, Any]],
    fps: float,
    objects: dict[int, tuple[int, str]],
) -> tuple[SourceCamera, str]:
    """The camera, and a statement on its intrinsics."""
    n_frames = len(observations)
    where = episode.path / PICKLE
    calibration = {
        key: np.stack(
            [numbers_of(where, i, _misc(item), f"{name}_camera_{key}", shape) for i, item in enumerate(observations)]
        )
        for key, shape in {"extrinsics": (4, 4), "intrinsics": (3, 3), "near": (), "far": ()}.items()
    }
    near, far = calibration["near"], calibration["far"]
    if not ((near >= 0) & (near < far) & np.isfinite(far)).all():
        i = int(np.argmin((near >= 0) & (near < far) & np.isfinite(far)))
        got = f"{near[i]:g} and {far[i]:g}"
        raise BadData(where, f"observation {i}: {name}_camera_near, _far", expected="0 <= near < far, metres", got=got)
    faults = {
        i: BadData(
            episode.path / f"{name}_{kind}",
            f"frame {i}",
            expected="an image for every observation",
            got="none",
            fix="pass --skip-bad to leave out the frames without images.",
        )
        for kind in ("depth", "rgb")
        for i in range(n_frames)
        if i not in images[kind].files
    }
    present = [i for i in range(n_frames) if i not in faults]
    if not present:
        raise BadData(episode.path / f"{name}_rgb", "frames", expected=f"images 0 to {n_frames - 1}.png", got="others")
    header = first_readable(image_header, (images["rgb"].files[i] for i in present))
    K = calibration["intrinsics"].copy()
    # PyRep states by negative focal lengths that the axes are turned by 180 degrees about the viewing direction.
    K[:, [0, 1], [0, 1]] = np.abs(K[:, [0, 1], [0, 1]])
    K, about_K = at_pixel_centres(K, (header.height, header.width))
    masks = images.get("mask")
    has_labels = masks is not None and bool(objects) and all(i in masks.files for i in present)
    camera = SourceCamera(
        name=name,
        frames=tuple(map(str, range(n_frames))),
        lens=Lens(K, (header.height, header.width)),
        world_from_cameras=calibration["extrinsics"] @ OPENCV_FROM_COPPELIASIM,
        time=np.arange(n_frames) / fps,
        color=images["rgb"].color,
        depth=_depth(images["depth"], near, far),
        labels=labelled(masks.numbers, objects) if masks and has_labels else None,
        faults=faults,
        pose_places=tuple(f"{where}: observation {i}: {name}_camera_extrinsics" for i in range(n_frames)),
        farthest=float(far.max()),
    )
    return camera, about_K


def _depth(
    images: Images, near: Float[ndarray, " t"], far: Float[ndarray, " t"]
) -> Callable[[int], Float32[ndarray, "h w"]]:
    def read(i: int) -> Float32[ndarray, "h w"]:
        codes = images.codes(i)
        metres = np.multiply(codes, (far[i] - near[i]) / FARTHEST_CODE, dtype=np.float64)
        metres += near[i]
        metres[codes == FARTHEST_CODE] = 0
        return metres.astype(np.float32)

    return read


def _numbers(file: Path, order: int) -> UInt32[ndarray, "h w"]:
    """Numbers of 24 bits whose lowest bits are in red for order 1, in blue for order -1."""
    data = read_bytes(file)
    header = image_header(file, data)
    if header.channels != 3:
        expected = "24-bit codes in three channels"
        raise BadData(file, "image", expected=expected, got=f"{header.channels} channels of {header.bits} bits")
    # OpenCV adds a fourth byte to each pixel many times as fast as NumPy does.
    coded = cv2.cvtColor(decode_color(file, data), cv2.COLOR_RGB2RGBA if order == 1 else cv2.COLOR_RGB2BGRA)
    numbers: UInt32[ndarray, "h w"] = coded.view("<u4")[..., 0] & np.uint32(FARTHEST_CODE)
    return numbers


def _misc(observation: dict[str, Any]) -> dict[str, Any]:
    found = observation.get("misc")
    return found if isinstance(found, dict) else {}


def numbers_of(where: Path, i: int, holder: dict[str, Any], key: str, shape: tuple[int, ...]) -> Float[ndarray, "..."]:
    """Numbers of an observation, in float64; a 3x4 matrix is one of 4x4 without its last row."""
    value = holder.get(key)
    is_numeric = isinstance(value, int | float | ndarray) and np.asarray(value).dtype.kind in "iuf"
    numbers = np.asarray(value, dtype=np.float64) if is_numeric else np.zeros((0,))
    if shape == (4, 4) and numbers.shape == (3, 4):
        numbers = np.vstack([numbers, [0, 0, 0, 1]])
    if numbers.shape != shape:
        expected = f"numbers of shape {shape}" if shape else "a number"
        got = f"shape {numbers.shape}" if is_numeric else "none"
        raise BadData(where, f"observation {i}: {key}", expected=expected, got=got, fix="pass another of --cameras.")
    return numbers


def surplus(images: dict[str, dict[str, Images]], n_frames: int) -> dict[str, str]:
    """A statement on images without an observation, if there are any."""
    n = max((i + 1 for kinds in images.values() for kind in kinds.values() for i in kind.files), default=0) - n_frames
    return {"images": f"{n} after the last of {n_frames} observations are not read"} if n > 0 else {}
