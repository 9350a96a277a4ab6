"""Lenses of source cameras: stated by options, scaled to other sizes, checked against the images."""

from __future__ import annotations

from bask_data.core.lens import Distortion, Lens, Undistortion, undistortion
from bask_data.errors import BadData, UsageError
from bask_data.formats.intrinsics import check_intrinsics
from bask_data.formats.recording import SourceCamera


def check_lens(camera: SourceCamera, lens: Lens, stated: str, instead: str = "") -> None:
    """Check that intrinsics fit the images they are for, and that the distortion can be taken out; `BadData`.

    Args:
        stated, instead: see `check_intrinsics`.
    """
    for K in lens.K if lens.K.ndim == 3 else [lens.K]:
        check_intrinsics(camera.name, K, lens.size, stated, instead)
    maps_of(camera.name, lens.at(0))


def maps_of(camera: str, lens: Lens) -> Undistortion | None:
    """The maps that take the distortion of a lens with one K out; `BadData` if it cannot be."""
    try:
        return undistortion(lens)
    except ValueError as error:
        raise BadData(
            camera,
            "lens",
            expected="a distortion that can be taken out",
            got=str(error),
            fix="check the order of its numbers, and the model's name.",
        ) from error


def scaled_lens(lens: Lens, size: tuple[int, int]) -> Lens:
    """The lens of the same camera's images of another size.

    K is scaled plainly, without moving the principal point by half a pixel before and after: so do the phone apps' own
    readers, whose K refers to pixel centres at integers in both sizes.
    """
    K = lens.K.copy()
    K[..., 0, :] *= size[1] / lens.size[1]
    K[..., 1, :] *= size[0] / lens.size[0]
    return Lens(K, size, lens.distortion)


def parse_distortion(text: str) -> Distortion:
    """The lens in `MODEL:NUMBERS`; `UsageError` for anything else."""
    model, _, numbers = text.partition(":")
    try:
        values = tuple(float(word) for word in numbers.replace(",", " ").split())
        return Distortion("OPENCV_FISHEYE" if model.lower() == "fisheye" else model, values)
    except ValueError as error:
        raise UsageError(
            "--distortion",
            expected="MODEL:NUMBERS",
            got=f"{text!r} ({error})",
            fix="for instance opencv:-0.12,0.05,0.001,-0.0008.",
        ) from error
