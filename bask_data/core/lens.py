"""Lens distortion, and its removal: an image as a pinhole camera with the same K would have taken it.

A model maps the normalised coordinates (x / z, y / z) of a ray to distorted ones, and K takes these to pixels. K stays
as it is, so pixels that a pinhole camera has and the lens did not see are 0, and what the lens saw beyond is lost.
OpenCV and COLMAP evaluate the models. Both do so with f = 1 and the principal point at 0, so COLMAP's pixel centres at
(0.5, 0.5), its models with one focal length for both axes and a skew in K play no part here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Shaped
from numpy import ndarray

from bask_data.core.geometry import pixel_grid, unproject

MODELS = {
    "PINHOLE": (0,),
    "SIMPLE_PINHOLE": (0,),
    "OPENCV": (4, 5, 8, 12, 14),
    "FULL_OPENCV": (8,),
    "OPENCV_FISHEYE": (4,),
    "SIMPLE_RADIAL": (1,),
    "RADIAL": (2,),
    "FOV": (1,),
    "SIMPLE_DIVISION": (1,),
    "DIVISION": (1,),
    "EUCM": (2,),
    "SIMPLE_FISHEYE": (0,),
    "FISHEYE": (0,),
    "SIMPLE_RADIAL_FISHEYE": (1,),
    "RADIAL_FISHEYE": (2,),
    "THIN_PRISM_FISHEYE": (8,),
    "RAD_TAN_THIN_PRISM_FISHEYE": (12,),
}
"""Models by COLMAP's names, and the numbers of distortion parameters each may have, in COLMAP's order without focal
lengths and principal point. OPENCV takes OpenCV's longer forms, too: k1 k2 p1 p2 [k3 [k4 k5 k6 [s1..s4 [tx ty]]]].
COLMAP's EQUIRECTANGULAR has no pinhole image."""

SAME_AS = {
    "PLUMB_BOB": "OPENCV",
    "RATIONAL_POLYNOMIAL": "OPENCV",
    "EQUIDISTANT": "OPENCV_FISHEYE",
}
"""ROS's names for the same models."""

N_MAPS_KEPT = 4
"""Undistortion maps kept for the next frame: one each for as many cameras read in turn. 25 MB each at 1920 x 1440.
Chosen, sensitivity not measured."""


@dataclass(frozen=True)
class Distortion:
    """A lens model and its numbers.

    Args:
        model: a name of `MODELS` or `SAME_AS`, in any case.
        parameters: in the order of COLMAP or OpenCV, without focal lengths and principal point.

    Raises:
        ValueError: the model is unknown, has another number of parameters, or a parameter is not finite.
    """

    model: str
    parameters: tuple[float, ...]

    def __post_init__(self) -> None:
        """Check the numbers where their source is still known."""
        allowed = MODELS.get(self.name)
        if allowed is None:
            raise ValueError(f"lens model {self.model!r}: expected one of {', '.join([*MODELS, *SAME_AS])}")
        if len(self.parameters) not in allowed:
            counts = " or ".join(map(str, allowed))
            raise ValueError(f"lens model {self.model}: expected {counts} parameters, got {len(self.parameters)}")
        if not all(map(math.isfinite, self.parameters)):
            raise ValueError(f"lens model {self.model}: expected finite parameters, got {list(self.parameters)}")

    @property
    def name(self) -> str:
        """The name in `MODELS`, if there is one."""
        upper = self.model.upper()
        return SAME_AS.get(upper, upper)

    @property
    def is_none(self) -> bool:
        """Whether this is a pinhole camera. A fisheye lens is none even if all its parameters are 0."""
        return "FISHEYE" not in self.name and not any(self.parameters)


@dataclass(frozen=True)
class Lens:
    """How a camera maps rays to pixels.

    Args:
        K: pixels; (t, 3, 3) if it differs from frame to frame.
        size: (height, width) of the image, pixels.
        distortion: None for a pinhole camera.
    """

    K: Float[ndarray, "3 3"] | Float[ndarray, "t 3 3"]
    size: tuple[int, int]
    distortion: Distortion | None = None

    def at(self, i_frame: int) -> Lens:
        """The lens of a frame, with one K."""
        return self if self.K.ndim == 2 else Lens(self.K[i_frame], self.size, self.distortion)


def one_if_same(Ks: Float[ndarray, "t 3 3"]) -> Float[ndarray, "3 3"] | Float[ndarray, "t 3 3"]:
    """K of all frames if it never changes, otherwise that of each."""
    return Ks[0] if (Ks == Ks[0]).all() else Ks


@dataclass(frozen=True)
class Undistortion:
    """Where each pixel of the pinhole image lies in the distorted one.

    Args:
        u, v: pixels of the distorted image.
        inside: whether the distorted image has the pixel.
    """

    u: Float32[ndarray, "h w"]
    v: Float32[ndarray, "h w"]
    inside: Bool[ndarray, "h w"]


def undistortion(lens: Lens) -> Undistortion | None:
    """The maps of a lens with one K; None for a pinhole camera, whose images need no resampling.

    The last maps are kept, so frames with the same lens share them.

    Raises:
        ValueError: the lens has one K per frame, or its distortion folds the image over: further out in the pinhole
            image comes further in again in the distorted one, which no lens does. Parameters that were fitted to the
            middle of an image do so at its corners, and parameters in another model's order anywhere.
    """
    if lens.K.shape != (3, 3):
        raise ValueError(f"K: expected one matrix, got {lens.K.shape}: choose a frame by Lens.at")
    if lens.distortion is None or lens.distortion.is_none:
        return None
    return _undistortion(lens.distortion, np.ascontiguousarray(lens.K, np.float64).tobytes(), lens.size)


def undistorted(image: Shaped[ndarray, "h w *c"], maps: Undistortion | None) -> Shaped[ndarray, "h w *c"]:
    """The pinhole image: colour (h, w, 3) interpolated bilinearly, depth and labels (h, w) from the nearest pixel.

    Args:
        image: z-depth needs no other value, as the optical axis stays.
        maps: None leaves the image as it is.

    Raises:
        ValueError: the image has another size than the maps.
    """
    if maps is None:
        return image
    if image.shape[:2] != maps.u.shape:
        raise ValueError(f"image: expected the size of the lens, {maps.u.shape}, got {image.shape[:2]}")
    how = cv2.INTER_NEAREST if image.ndim == 2 else cv2.INTER_LINEAR
    # Replicated, and then cut off: a constant border would darken the outermost half pixel.
    result = cv2.remap(image, maps.u, maps.v, how, borderMode=cv2.BORDER_REPLICATE)
    result[~maps.inside] = 0
    return result


@lru_cache(N_MAPS_KEPT)
def _undistortion(distortion: Distortion, K_bytes: bytes, size: tuple[int, int]) -> Undistortion:
    K = np.frombuffer(K_bytes).reshape(3, 3)
    height, width = size
    x, y = _distorted(distortion, K, height, width)
    u = (K[0, 0] * x + K[0, 1] * y + K[0, 2]).astype(np.float32)
    v = (K[1, 1] * y + K[1, 2]).astype(np.float32)
    # COLMAP gives NaN for rays that the lens cannot see, and a comparison with NaN is false.
    inside = (u >= -0.5) & (u < width - 0.5) & (v >= -0.5) & (v < height - 0.5)
    if (fold := _fold(u, v, inside)) is not None:
        raise ValueError(
            f"lens model {distortion.model}, parameters {list(distortion.parameters)}: "
            f"expected pixels further out to stay further out, got an image folded over at (u, v) = {fold}"
        )
    u[~inside] = v[~inside] = -1
    for array in (u, v, inside):
        array.setflags(write=False)  # They are shared by all who ask for this lens.
    return Undistortion(u, v, inside)


def _distorted(
    distortion: Distortion, K: Float[ndarray, "3 3"], height: int, width: int
) -> tuple[Float[ndarray, "h w"] | Float32[ndarray, "h w"], Float[ndarray, "h w"] | Float32[ndarray, "h w"]]:
    """Distorted normalised coordinates x, y of each pixel of the pinhole image."""
    parameters = np.array(distortion.parameters)
    unit, size = np.eye(3), (width, height)
    if distortion.name in ("OPENCV", "FULL_OPENCV"):
        return cv2.initUndistortRectifyMap(unit, parameters, None, K, size, cv2.CV_32FC1)
    if distortion.name == "OPENCV_FISHEYE":
        return cv2.fisheye.initUndistortRectifyMap(unit, parameters, unit, K, size, cv2.CV_32FC1)
    import pycolmap

    camera = pycolmap.Camera.create_from_model_name(1, distortion.name, 1.0, width, height)
    values = np.zeros(len(camera.params))
    values[list(camera.focal_length_idxs())] = 1.0
    values[list(camera.extra_params_idxs())] = parameters
    camera.params = values
    rays = unproject(pixel_grid(height, width).reshape(-1, 2), np.ones(height * width), K)
    x, y = camera.img_from_cam(rays).T.reshape(2, height, width)
    return x, y


def _fold(
    u: Float32[ndarray, "h w"], v: Float32[ndarray, "h w"], inside: Bool[ndarray, "h w"]
) -> tuple[int, int] | None:
    """A pixel (u, v) of the pinhole image, seen by the lens, around which the distorted image is turned over; None if
    there is none."""
    u_right, v_right = u[:-1, 1:] - u[:-1, :-1], v[:-1, 1:] - v[:-1, :-1]
    u_down, v_down = u[1:, :-1] - u[:-1, :-1], v[1:, :-1] - v[:-1, :-1]
    turned = (u_right * v_down - u_down * v_right <= 0) & inside[:-1, :-1]
    if not turned.any():
        return None
    row, column = np.unravel_index(int(turned.argmax()), turned.shape)
    return int(column), int(row)
