"""Posed RGB-D frames of scans and demonstrations, one group per camera."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import BaseModel, ConfigDict, FiniteFloat

from bask_data.artifact import REMAKE, Artifact, Metadata, read_json, write_group
from bask_data.errors import BadData
from bask_data.kinds.arrays import FrameWriter, read_all, read_frame, start, write_array
from bask_data.specs import ArraySpec

if TYPE_CHECKING:
    import numpy as np
    import zarr

CAMERA_ARRAYS = {
    "{camera}/rgb": ArraySpec(("t", "h", "w", "c"), "uint8", "Colour, channels red, green, blue."),
    "{camera}/depth": ArraySpec(
        ("t", "h", "w"),
        "uint16",
        "z-depth in units of `scale_m` metres; 0 means no measurement.",
        attributes=("scale_m",),
    ),
    "{camera}/intrinsics": ArraySpec(
        ("3", "3"),
        "float64",
        "Pinhole matrix. Pixel (0, 0) is the centre of the top-left pixel.",
        "pixel",
        other_dims=("t", "3", "3"),
    ),
    "{camera}/world_from_camera": ArraySpec(
        ("t", "4", "4"),
        "float64",
        "Takes camera coordinates to world coordinates; camera x right, y down, z forward.",
        "metre",
    ),
    "{camera}/time": ArraySpec(("t",), "float64", "Time of each frame.", "second"),
}


class LensModel(BaseModel):
    """A lens distortion that was taken out of the images when they were read; what is stored is a pinhole camera's.

    Args:
        model: name of the model, as COLMAP and OpenCV call it.
        parameters: in the model's order, without focal lengths and principal point.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    model: str
    parameters: list[FiniteFloat]


class RecordingMetadata(Metadata):
    """Source format of a recording, and the assumptions made when it was read.

    Args:
        origin: of our world frame in the source's, metres: source_position = position + origin. Coordinates far from
            zero, such as UTM's, are kept small by it; exports add it again.
        left_out: frames of the source that were left out, as `camera/number`, and why.
        lenses: distortion that was taken out of the images, by camera.
    """

    format: str
    assumptions: dict[str, str] = {}
    origin: tuple[FiniteFloat, FiniteFloat, FiniteFloat] = (0.0, 0.0, 0.0)
    left_out: dict[str, str] = {}
    lenses: dict[str, LensModel] = {}


class Camera:
    """Frames of one camera, read one at a time."""

    def __init__(self, group: zarr.Group, path: Path) -> None:
        self._group = group
        self.path = path
        self.name = path.name

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return self._rgb.shape[0]

    @property
    def height(self) -> int:
        """Height of the images, pixels."""
        return self._rgb.shape[1]

    @property
    def width(self) -> int:
        """Width of the images, pixels."""
        return self._rgb.shape[2]

    @cached_property
    def Ks(self) -> np.ndarray:
        """Pinhole matrix of each frame (t, 3, 3) float64, pixels; the stored one repeated if there is only one."""
        import numpy as np

        stored = read_all(self._group, "intrinsics", self.path)
        if stored.shape not in ((3, 3), (self.n_frames, 3, 3)):
            expected = f"(3, 3) or ({self.n_frames}, 3, 3)"
            raise BadData(self.path, "intrinsics", expected=expected, got=str(stored.shape), fix=REMAKE)
        for i_frame, K in enumerate(stored.reshape(-1, 3, 3)):
            if not np.isfinite(K).all() or K[0, 0] <= 0 or K[1, 1] <= 0:
                field = "intrinsics" if stored.ndim == 2 else f"intrinsics {i_frame}"
                raise BadData(self.path, field, expected="a pinhole matrix", got=str(K.tolist()), fix=REMAKE)
        # Not a broadcast view: Numba would compile its loops a second time for read-only arrays.
        return np.tile(stored, (self.n_frames, 1, 1)) if stored.ndim == 2 else stored

    @cached_property
    def world_from_cameras(self) -> np.ndarray:
        """Poses (t, 4, 4) float64, metres; `BadData` if one is not rigid."""
        from bask_data.core.geometry import rigid_fault

        transforms = read_all(self._group, "world_from_camera", self.path)
        for i_frame, transform in enumerate(transforms):
            if fault := rigid_fault(transform):
                field = f"world_from_camera {i_frame}"
                raise BadData(self.path, field, expected="a rigid transform", got=fault, fix=REMAKE)
        return transforms

    @cached_property
    def time(self) -> np.ndarray:
        """Times of the frames (t,) float64, seconds."""
        return read_all(self._group, "time", self.path)

    @cached_property
    def depth_scale(self) -> float:
        """Metres per unit of stored depth."""
        return float(self._depth.attrs["scale_m"])  # type: ignore[arg-type]

    def rgb(self, i_frame: int) -> np.ndarray:
        """Colour of one frame (h, w, 3) uint8."""
        return read_frame(self._rgb, i_frame, self.path / "rgb")

    def depth_raw(self, i_frame: int) -> np.ndarray:
        """Depth of one frame as stored (h, w) uint16, units of `depth_scale`."""
        return read_frame(self._depth, i_frame, self.path / "depth")

    def depth(self, i_frame: int) -> np.ndarray:
        """z-depth of one frame (h, w) float32 metres; 0 means no measurement."""
        import numpy as np

        return self.depth_raw(i_frame).astype(np.float32) * np.float32(self.depth_scale)

    def points_world(self, i_frame: int, uv: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """World points (n, 3), metres, of pixels (n, 2) of a frame at z-depths (n,), metres."""
        import numpy as np

        from bask_data.core.geometry import transform, unproject

        points_camera = unproject(uv.astype(np.float64), depth.astype(np.float64), self.Ks[i_frame])
        return transform(self.world_from_cameras[i_frame], points_camera)

    @cached_property
    def _rgb(self) -> zarr.Array:
        return self._group["rgb"]  # type: ignore[return-value]

    @cached_property
    def _depth(self) -> zarr.Array:
        return self._group["depth"]  # type: ignore[return-value]


@dataclass(frozen=True)
class CameraFrames:
    """Frames of one camera to be written, read one at a time.

    Args:
        K: (3, 3), or (t, 3, 3) where it changes from frame to frame; pixels.
        world_from_cameras: (t, 4, 4), metres.
        time: (t,), seconds.
        depth_scale: metres per unit of raw depth.
        size: (height, width), pixels.
        read: returns rgb (h, w, 3) uint8 and raw depth (h, w) uint16 of a frame.
    """

    K: np.ndarray
    world_from_cameras: np.ndarray
    time: np.ndarray
    depth_scale: float
    size: tuple[int, int]
    read: Callable[[int], tuple[np.ndarray, np.ndarray]]


class Recording(Artifact):
    """What scans and demonstrations share: named cameras with posed RGB-D frames."""

    schema_version = 2
    opens = (1,)
    metadata_model = RecordingMetadata
    arrays = CAMERA_ARRAYS

    @classmethod
    def start(
        cls,
        out: Path,
        format: str,
        assumptions: dict[str, str],
        *,
        origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
        left_out: dict[str, str] | None = None,
        lenses: dict[str, LensModel] | None = None,
        **of_kind: object,
    ) -> zarr.Group:
        """Begin writing; `write_camera` adds the cameras.

        Args:
            origin, left_out, lenses: see `RecordingMetadata`.
            of_kind: further metadata of the kind.
        """
        stated = {"origin": origin, "left_out": left_out or {}, "lenses": lenses or {}}
        return start(out, cls, {"format": format, "assumptions": assumptions, **stated, **of_kind})

    def camera(self, name: str) -> Camera:
        """The frames of a camera."""
        return Camera(self.group[name], self.path / name)  # type: ignore[arg-type]

    @property
    def cameras(self) -> list[Camera]:
        """All cameras, sorted by name."""
        return [self.camera(name) for name in self.camera_names]

    def camera_shapes(self) -> dict[str, tuple[int, int, int]]:
        """(frames, height, width) of each camera, by name.

        They are read from the JSON documents: opening thousands of arrays with Zarr would take ten times as long.
        """
        shapes = {name: read_json(self.path / name / "depth" / "zarr.json")["shape"] for name in self.camera_names}
        return {name: (n_frames, height, width) for name, (n_frames, height, width) in shapes.items()}

    @classmethod
    def write_camera(
        cls,
        group: zarr.Group,
        name: str,
        camera: CameraFrames,
        *,
        frames: Callable[[range], object] = iter,
    ) -> None:
        """Write a camera's frames, one in memory at a time.

        Args:
            frames: wraps the range of frames, to show progress.
        """
        n_frames, size = len(camera.world_from_cameras), camera.size
        write_group(Path(str(group.store_path.store.root)) / group.path / name, {"bask": {"role": "camera"}})  # type: ignore[attr-defined]
        write_array(group, cls, f"{name}/intrinsics", _stored_intrinsics(camera.K))
        write_array(group, cls, f"{name}/world_from_camera", camera.world_from_cameras)
        write_array(group, cls, f"{name}/time", camera.time)
        rgb = FrameWriter(group, cls, f"{name}/rgb", n_frames, (*size, 3))
        depth = FrameWriter(group, cls, f"{name}/depth", n_frames, size, scale_m=camera.depth_scale)
        for i_frame in frames(range(n_frames)):  # type: ignore[attr-defined]
            color, raw = camera.read(i_frame)
            rgb.append(color)
            depth.append(raw)
        rgb.close()
        depth.close()


class Scan(Recording):
    """RGB-D frames of a static scene from a moving camera."""

    kind = "scan"
    scope = "scene"


def _stored_intrinsics(K: np.ndarray) -> np.ndarray:
    """Intrinsics (3, 3) if they are the same in all frames, otherwise (t, 3, 3)."""
    return K[0] if K.ndim == 3 and (K[:1] == K).all() else K
