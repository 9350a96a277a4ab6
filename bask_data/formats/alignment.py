"""Colour and depth of a frame on the same pinhole pixels: undistorted, and one registered to the other.

Depth that lies on colour stays as it is. Depth of the same camera in another resolution (phones) keeps its pixels, and
colour is brought to them; depth of another camera is registered into colour by z-buffered splatting.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, UInt8, UInt16
from numpy import ndarray

from bask_data.core.geometry import pixel_grid, unproject
from bask_data.core.lens import Distortion, Lens, Undistortion, undistorted
from bask_data.core.registration import color_at_depth_size, labels_at_depth_size, registered_depth
from bask_data.errors import BadData, UsageError
from bask_data.formats.choices import CAMERA
from bask_data.formats.depth_values import DepthValues, depth_values
from bask_data.formats.files import Folder, folder_of
from bask_data.formats.intrinsics import parse_intrinsics
from bask_data.formats.lenses import check_lens, maps_of, parse_distortion, scaled_lens
from bask_data.formats.options.common import SourceOptions
from bask_data.formats.poses import read_pose
from bask_data.formats.recording import Depth, SourceCamera


@dataclass(frozen=True)
class AlignedFrames:
    """A camera's kept frames, on the pixels of one pinhole camera.

    Args:
        camera: with lenses and extrinsics as files and options state them.
        kept: indices of the frames among the source's.
        to: whose pixels are kept, `color` or `depth`; None where depth lies on colour.
        assumptions: what was done, and lost.
        is_ray: whether the source's depth is the length of the ray, not z.
    """

    camera: SourceCamera
    kept: list[int]
    to: str | None
    values: DepthValues
    assumptions: dict[str, str]
    least_confidence: int | None = None
    is_ray: bool = False

    @property
    def _lens(self) -> Lens:
        lens = self.camera.depth_lens if self.to == "depth" else None
        return lens or self.camera.lens

    @property
    def K(self) -> Float[ndarray, "*t 3 3"]:
        """(3, 3), or (t, 3, 3) of the kept frames, pixels."""
        K = self._lens.K
        return K[self.kept] if K.ndim == 3 else K

    @property
    def size(self) -> tuple[int, int]:
        """(height, width), pixels."""
        return self._lens.size

    @property
    def depth_scale(self) -> float:
        """Metres per unit of the depth that `read` returns."""
        return self.values.scale

    @property
    def distortion(self) -> Distortion | None:
        """The lens distortion that is taken out."""
        distortion = self._lens.distortion
        return None if distortion is None or distortion.is_none else distortion

    def read_color(self, k: int) -> UInt8[ndarray, "h w 3"]:
        """RGB of the k-th kept frame."""
        i = self.kept[k]
        lens = self.camera.lens.at(i)
        color = undistorted(self._checked("colour", i, self.camera.color(i), self.camera.lens), self._maps(lens))
        if self.to == "depth":
            depth_lens = (self.camera.depth_lens or self.camera.lens).at(i)
            try:
                color = color_at_depth_size(color, lens.K, depth_lens.K, depth_lens.size)
            except ValueError as error:
                raise BadData(self.camera.name, "lens", got=str(error), fix="pass --align color.") from error
        return color

    def read_depth(self, k: int) -> UInt16[ndarray, "h w"]:
        """Raw depth of the k-th kept frame."""
        i = self.kept[k]
        lens, depth_lens = self.camera.lens.at(i), (self.camera.depth_lens or self.camera.lens).at(i)
        raw = undistorted(self._measured(i, depth_lens), self._maps(depth_lens))
        if self.is_ray:
            raw = z_of_ray_length(raw, depth_lens.K)
        if self.to == "color":
            metres = self.values.metres(raw)
            raw = self.values.quantised(
                registered_depth(metres, depth_lens.K, lens.K, lens.size, _extrinsics(self.camera))
            )
        return self.values.stored(raw)

    def read_labels(self, k: int) -> UInt8[ndarray, "h w"]:
        """Labels of the k-th kept frame."""
        assert self.camera.labels is not None
        i = self.kept[k]
        lens = self.camera.lens.at(i)
        labels = self.camera.labels(i)
        if self.to == "depth" and self.camera.depth_lens and labels.shape == self.camera.depth_lens.size:
            return undistorted(labels, self._maps(self.camera.depth_lens.at(i)))
        labels = undistorted(self._checked("labels", i, labels, self.camera.lens), self._maps(lens))
        if self.to == "depth" and self.camera.depth_lens:
            depth_lens = self.camera.depth_lens.at(i)
            return labels_at_depth_size(labels, lens.K, depth_lens.K, depth_lens.size)
        return labels

    def _maps(self, lens: Lens) -> Undistortion | None:
        return maps_of(self.camera.name, lens)

    def _measured(self, i: int, lens: Lens) -> UInt16[ndarray, "h w"] | Float32[ndarray, "h w"]:
        """Raw depth without values that mean none, and of enough confidence."""
        raw = self.values.cleaned(self._checked("depth", i, self.camera.depth(i), lens))
        if self.camera.confidence is not None and self.least_confidence is not None:
            confidence = self._checked("confidence", i, self.camera.confidence(i), lens)
            raw = np.where(confidence >= self.least_confidence, raw, raw.dtype.type(0))
        return raw

    def _checked(self, what: str, i: int, image: Any, lens: Lens) -> Any:
        if image.shape[:2] != lens.size:
            raise BadData(
                f"{self.camera.name} {self.camera.frames[i]}",
                f"size of {what}",
                expected=f"{lens.size[1]} x {lens.size[0]}",
                got=f"{image.shape[1]} x {image.shape[0]}",
                fix=SIZE_FIX
                if what == "depth"
                else f"resize them: {what} must have the size of the images they belong to.",
            )
        return image


DEPTH_OPTION = "--depth-intrinsics"

SCALED = "scaled"
"""Value of `--depth-intrinsics` for colour's in another resolution."""

AS_WRITTEN = "read the recording as it was written: images that were resized or cropped do not fit its intrinsics."
"""What to do about a recording whose own intrinsics do not fit its images."""

SIZE_FIX = (
    "pass --depth-intrinsics with the depth camera's, and --color-from-depth if it is another camera than colour's; "
    "--depth-intrinsics scaled if it is the same camera in another resolution."
)
"""What to do about depth of another size than colour."""


def aligned(source: Path, camera: SourceCamera, kept: list[int], options: SourceOptions) -> AlignedFrames:
    """The frames of a camera on one set of pixels, as files and options say.

    Raises:
        BadData: intrinsics do not fit the images, or depth's size does not fit colour's and nothing says why.
        UsageError: an option does not apply, or is invalid.
    """
    camera, assumptions = _with_options(folder_of(source, options.follow_links), camera, kept[0], options)
    if camera.color_from_depth is None and _are_same(camera.lens, camera.depth_lens):
        camera = replace(camera, depth_lens=None)
    check_lens(camera, camera.lens, camera.intrinsics_size, "" if options.has("intrinsics") else AS_WRITTEN)
    camera.color(kept[0])  # Its errors come first: swapped colour and depth are easier to see in colour.
    to = None
    if camera.depth_lens is not None or camera.color_from_depth is not None:
        camera = camera if camera.depth_lens else replace(camera, depth_lens=camera.lens)
        assert camera.depth_lens is not None
        check_lens(camera, camera.depth_lens, "", "pass --depth-intrinsics with those of depth's own images.")
        to = options.align if options.align != "auto" else ("depth" if camera.color_from_depth is None else "color")
        if to == "depth" and camera.color_from_depth is not None:
            raise UsageError(
                "--align",
                expected="color: depth was measured by another camera",
                got="depth",
                fix="leave out --align.",
            )
    if options.confidence is not None and camera.confidence is None:
        raise UsageError("--confidence", expected="a source with confidence maps", got="none", fix="leave it out.")
    values = depth_values(camera, kept, has_scale_option=options.has("depth_scale"))
    assumptions |= _stated(camera, to, options, values)
    return AlignedFrames(camera, kept, to, values, assumptions, options.confidence, options.depth_is == "ray")


def _are_same(lens: Lens, depth_lens: Lens | None) -> bool:
    """Whether depth lies on colour, although the source states a lens of its own for it."""
    if depth_lens is None or lens.size != depth_lens.size or lens.distortion != depth_lens.distortion:
        return False
    return lens.K.shape == depth_lens.K.shape and bool((lens.K == depth_lens.K).all())


def _with_options(
    folder: Folder, camera: SourceCamera, first: int, options: SourceOptions
) -> tuple[SourceCamera, dict[str, str]]:
    """The camera with what options state instead of its files."""
    assumptions = {}
    depth_intrinsics, color_from_depth = _of_camera(camera, options)
    if options.distortion:
        lens = replace(camera.lens, distortion=parse_distortion(options.distortion))
        camera = replace(camera, lens=lens)
    if depth_intrinsics:
        size = camera.depth(first).shape[:2]
        if depth_intrinsics == SCALED:
            camera = replace(camera, depth_lens=scaled_lens(camera.lens, (size[0], size[1])))
        else:
            K, _ = parse_intrinsics(folder, depth_intrinsics, DEPTH_OPTION)
            camera = replace(camera, depth_lens=Lens(K, (size[0], size[1])))
        assumptions["depth intrinsics"] = depth_intrinsics
        if not color_from_depth and camera.color_from_depth is None:
            assumptions["depth camera"] = "at the place of the colour camera; --color-from-depth FILE says otherwise"
    if color_from_depth:
        camera = replace(camera, color_from_depth=read_pose(_extrinsics_file(folder, color_from_depth)))
    return camera, assumptions


def option_files(source: Path, cameras: Sequence[SourceCamera], options: SourceOptions) -> tuple[Path, ...]:
    """The files that `--depth-intrinsics` and `--color-from-depth` name, for the digest of a recording.

    Raises:
        BadData: a file is missing, or holds something else.
    """
    folder = folder_of(source, options.follow_links)
    files: list[Path] = []
    for camera in cameras:
        depth_intrinsics, color_from_depth = _of_camera(camera, options)
        if depth_intrinsics not in ("", SCALED):
            files += parse_intrinsics(folder, depth_intrinsics, DEPTH_OPTION)[1]
        if color_from_depth:
            files.append(_extrinsics_file(folder, color_from_depth))
    return tuple(dict.fromkeys(files))


def _of_camera(camera: SourceCamera, options: SourceOptions) -> tuple[str, str]:
    """`--depth-intrinsics` and `--color-from-depth` with the camera's name in the place of `{camera}`."""
    depth_intrinsics, color_from_depth = (
        text.replace(CAMERA, camera.name) for text in (options.depth_intrinsics, options.color_from_depth)
    )
    return depth_intrinsics, color_from_depth


def _extrinsics_file(folder: Folder, text: str) -> Path:
    path = Path(text)
    return path if path.is_file() else folder.member(text, "--color-from-depth")


def z_of_ray_length(length: Depth, K: Float[ndarray, "3 3"]) -> Depth:
    """z-depth of each pixel from the length of its ray, in the same units and type."""
    z = length / np.linalg.norm(unproject(pixel_grid(*length.shape), np.ones(length.shape), K), axis=-1)
    return np.rint(z).astype(np.uint16) if length.dtype == np.uint16 else z.astype(np.float32)


def _extrinsics(camera: SourceCamera) -> Float[ndarray, "4 4"]:
    return np.eye(4) if camera.color_from_depth is None else camera.color_from_depth


def _stated(camera: SourceCamera, to: str | None, options: SourceOptions, values: DepthValues) -> dict[str, str]:
    """What was done to the images, and what it costs."""
    stated = dict(values.assumptions)
    width, height = camera.lens.size[::-1]
    if to and camera.depth_lens:
        depth_size = f"{camera.depth_lens.size[1]} x {camera.depth_lens.size[0]}"
        if to == "depth":
            stated["alignment"] = (
                f"colour of {width} x {height} was resampled to depth's pixels, {depth_size}; finer detail is lost"
            )
        else:
            stated["alignment"] = (
                f"depth of {depth_size} was registered into colour, {width} x {height}, by triangles in a "
                "z-buffer; single missing pixels were filled, and what colour alone sees has no depth"
            )
    for what, lens in (("colour", camera.lens), ("depth", camera.depth_lens)):
        if lens is not None and lens.distortion is not None and not lens.distortion.is_none:
            numbers = ", ".join(f"{value:g}" for value in lens.distortion.parameters)
            both = "colour and depth" if camera.depth_lens is None else what
            stated[f"lens of {both}"] = (
                f"{lens.distortion.model} distortion ({numbers}) was taken out, K kept: colour interpolated, depth "
                "from the nearest pixel; what lies outside the pinhole image is lost"
            )
    if options.depth_is == "ray":
        stated["ray length"] = "depth along the ray in the source, converted to z"
    if camera.confidence is not None:
        least = options.confidence
        stated["confidence"] = (
            "all depth is kept; --confidence N leaves out what is below N" if least is None else f"{least} and above"
        )
    return stated
