"""Binary files of COLMAP's models, checked before COLMAP reads them."""

from __future__ import annotations

import struct
from pathlib import Path

from bask_data.errors import BadData

MAX_MODEL_BYTES = 4 * 2**30
"""Largest file of a model that is read, bytes: 10 million points. Keeps wrong files from filling memory."""


def check_entries(file: Path) -> None:
    """Refuse a file that is too large, or claims more entries than it has bytes for; `BadData`.

    COLMAP reads as many entries as a file claims, past its end, and keeps them.
    """
    size = file.stat().st_size
    if size > MAX_MODEL_BYTES:
        raise BadData(file, "size", expected=f"at most {MAX_MODEL_BYTES} bytes", got=f"{size}")
    if file.suffix != ".bin":
        return
    data = file.read_bytes()
    try:
        [count] = struct.unpack_from("<Q", data)
        position = 8
        for _ in range(count):
            position = AFTER[file.stem](data, position)
            if position > size:
                break
    except (struct.error, ValueError, IndexError):
        position = size + 1
    if position > size:
        raise BadData(
            file,
            "entries",
            expected="as many as it says",
            got=f"fewer in {size} bytes: a truncated or corrupted file",
            fix="copy it again from its source.",
        )


def _after_camera(data: bytes, position: int) -> int:
    """Least end of an entry of cameras.bin: id, model, width, height, and two parameters or more."""
    return position + 40 if len(data) >= position + 40 else len(data) + 1


def _after_image(data: bytes, position: int) -> int:
    """End of an entry of images.bin: id, quaternion, translation, camera, name, and points of 24 bytes."""
    after_name = data.index(b"\0", position + 64) + 1
    [n_points] = struct.unpack_from("<Q", data, after_name)
    return after_name + 8 + 24 * n_points


def _after_point(data: bytes, position: int) -> int:
    """End of an entry of points3D.bin: id, position, colour, error, and a track with 8 bytes for each image."""
    [length] = struct.unpack_from("<Q", data, position + 43)
    return position + 51 + 8 * length


def _after_rig(data: bytes, position: int) -> int:
    """End of an entry of rigs.bin: id, and sensors, all but the first of which may have a pose."""
    [n_sensors] = struct.unpack_from("<I", data, position + 4)
    position += 16 if n_sensors else 8
    for _ in range(n_sensors - 1):
        position += 9 + 56 * (data[position + 8] > 0)
    return position


def _after_frame(data: bytes, position: int) -> int:
    """End of an entry of frames.bin: id, rig, pose, and 16 bytes for each image."""
    [n_images] = struct.unpack_from("<I", data, position + 64)
    return position + 68 + 16 * n_images


AFTER = {
    "cameras": _after_camera,
    "images": _after_image,
    "points3D": _after_point,
    "rigs": _after_rig,
    "frames": _after_frame,
}
"""Where an entry of each file ends, from where it begins."""
