"""Frames of a dataset for the page: images, descriptors, and the best match of a descriptor."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, reduce
from typing import TYPE_CHECKING, Any, NamedTuple

from bask_data.errors import UsageError

if TYPE_CHECKING:
    import numpy as np
    import torch

    from bask_data.kinds import Camera, Recording
    from bask_data.nn.network import DescriptorNetwork

MOST_DESCRIPTOR_BYTES = 512 * 2**20
"""Bytes of descriptors cached in memory: more than a thousand frames of 256x256 pixels and 32 dimensions. A page shows
at most nine, so a tenth would do; a frame that was dropped takes another forward pass."""

MOST_PIXELS = 128 * 128
"""Most pixels of a distance map sent to the page. Descriptors are smooth over eight pixels of the network's input, so
more pixels would show no more detail and take longer to send and draw."""

SAME_POINT_DEPTH = 0.02
"""Largest difference, metres, between a measured depth and a point's depth at which the point counts as visible."""


class FrameName(NamedTuple):
    """A frame of a dataset."""

    recording: str
    camera: str
    frame: int


@dataclass(frozen=True)
class FrameDescriptors:
    """A frame's descriptors at stride 8, and their squared lengths at every pixel.

    Up-sampling commutes with the product of descriptors and a reference, but not with squared lengths. Storing these
    takes little more memory than the cells, and a distance map then needs a product with the cells only.

    Args:
        cells: (d, h / 8, w / 8) descriptors minus `origin`.
        squares: (h, w) squared lengths of the up-sampled `cells`.
        origin: (d,) mean descriptor of the frame.
    """

    cells: torch.Tensor
    squares: torch.Tensor
    origin: torch.Tensor

    @property
    def n_bytes(self) -> int:
        return 4 * (self.cells.numel() + self.squares.numel() + self.origin.numel())

    def distances(self, reference: torch.Tensor) -> torch.Tensor:
        """Distance z (h, w) of every pixel to a reference descriptor (d,)."""
        from bask_data.nn.resnet import upsampled

        centred = reference - self.origin
        size = self.squares.shape[0], self.squares.shape[1]
        product = upsampled((centred @ self.cells.flatten(1)).reshape(1, 1, *self.cells.shape[1:]), size)[0, 0]
        z_squared = self.squares - 2.0 * product + centred.square().sum()
        return (z_squared.clamp_(min=0.0) / len(centred)).sqrt_()


@dataclass(frozen=True)
class HeatMap:
    """The distance map of a descriptor in a frame, and its best match.

    Args:
        z: (h, w) float32 descriptor distance; it spans the image from edge to edge.
        best: (u, v) of the smallest distance, pixels of the frame's image.
        z_best: smallest distance.
    """

    z: np.ndarray
    best: tuple[float, float]
    z_best: float


class Gallery:
    """Recordings and their frames; descriptors are computed on demand and cached.

    Args:
        most_bytes: size of the cache; the least recently used frames are dropped.
    """

    def __init__(
        self, recordings: Mapping[str, Recording], network: DescriptorNetwork, most_bytes: int = MOST_DESCRIPTOR_BYTES
    ) -> None:
        self.recordings = recordings
        self._cameras = {name: {camera.name: camera for camera in known.cameras} for name, known in recordings.items()}
        self._network = network
        self._most_bytes = most_bytes
        self._described: OrderedDict[FrameName, FrameDescriptors] = OrderedDict()
        # Hovering reads depth many times a second, always of the few frames on the page.
        self._depth = lru_cache(maxsize=32)(lambda frame: self.camera(frame).depth(frame.frame))
        self._using_network = threading.Lock()
        self._keeping = threading.Lock()

    def listed(self) -> list[dict[str, Any]]:
        """Recordings with their cameras, numbers of frames and image sizes in pixels."""
        return [
            {
                "name": name,
                "scope": self.recordings[name].scope,
                "cameras": [
                    {"name": camera.name, "n_frames": camera.n_frames, "width": camera.width, "height": camera.height}
                    for camera in cameras.values()
                ],
            }
            for name, cameras in self._cameras.items()
        ]

    def camera(self, frame: FrameName) -> Camera:
        """The camera of a frame; `UsageError` if there is no such frame."""
        camera = self._cameras.get(frame.recording, {}).get(frame.camera)
        if camera is None or not 0 <= frame.frame < camera.n_frames:
            raise UsageError("frame", "", expected="a frame of the dataset", got=":".join(map(str, frame)))
        return camera

    def check_pixel(self, frame: FrameName, u: float, v: float) -> None:
        """Raise `UsageError` if a pixel is outside the frame's image."""
        camera = self.camera(frame)
        if not (-0.5 <= u < camera.width - 0.5 and -0.5 <= v < camera.height - 0.5):
            size = f"u 0..{camera.width - 1}, v 0..{camera.height - 1}"
            raise UsageError("pixel", "", expected=size, got=f"{u:g}, {v:g}")

    def picture(self, frame: FrameName) -> bytes:
        """The frame's colour image as JPEG."""
        import cv2

        rgb = self.camera(frame).rgb(frame.frame)
        done, data = cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
        assert done
        return data.tobytes()

    def is_described(self, frame: FrameName) -> bool:
        """Whether the frame's descriptors are in memory."""
        return frame in self._described

    def describe(self, frame: FrameName) -> FrameDescriptors:
        """The frame's descriptors, computed if they are not in memory."""
        camera = self.camera(frame)
        described = self._recent(frame)
        if described is None:
            with self._using_network:
                described = self._recent(frame) or self._computed(camera, frame.frame)
            self._keep(frame, described)
        return described

    def descriptor_at(self, frame: FrameName, u: float, v: float) -> torch.Tensor:
        """The descriptor (d,) at a pixel of the frame's image, interpolated as for reference keypoints."""
        import numpy as np
        import torch

        from bask_data.core.geometry import scale_pixels
        from bask_data.nn.resnet import sampled

        self.check_pixel(frame, u, v)
        described, camera = self.describe(frame), self.camera(frame)
        size = camera.height, camera.width
        uv = scale_pixels(np.array([[u, v]]), size, self._network.input_size(size)).astype(np.float32)
        with torch.inference_mode():
            where = torch.from_numpy(uv).to(described.cells.device)[None]
            return sampled(described.cells[None], where)[0, 0] + described.origin

    def find(self, descriptor: torch.Tensor, frame: FrameName) -> HeatMap:
        """Distance map and best match of a descriptor (d,) in a frame."""
        import numpy as np
        import torch

        from bask_data.core.geometry import scale_pixels

        camera, described = self.camera(frame), self.describe(frame)
        with torch.inference_mode():
            z = described.distances(descriptor).cpu().numpy()
        row, column = np.unravel_index(int(z.argmin()), z.shape)
        u, v = scale_pixels(np.array([float(column), float(row)]), z.shape, (camera.height, camera.width))
        step = 1
        while (z.shape[0] // step) * (z.shape[1] // step) > MOST_PIXELS:
            step += 1
        # Each pixel of the smaller map is the minimum of its block, so that small matches do not vanish.
        return HeatMap(_least_of_blocks(z, step), (float(u), float(v)), float(z[row, column]))

    def same_place(self, frame: FrameName, u: float, v: float, others: Sequence[FrameName]) -> list[Any]:
        """Ground-truth match of a pixel in other frames, by depth and camera poses.

        It is known in frames of the same scan, which is static, and in images of a demonstration taken at the same
        time by other cameras.

        Returns:
            for each frame [u, v] in pixels of its image, or None where unknown or not visible.
        """
        import numpy as np

        self.check_pixel(frame, u, v)
        camera = self.camera(frame)
        depth = float(self._depth(frame)[round(v), round(u)])
        if depth <= 0:
            return [None] * len(others)
        [point] = camera.points_world(frame.frame, np.array([[u, v]]), np.array([depth]))
        is_scan = self.recordings[frame.recording].scope == "scene"
        return [
            self._seen(point, other)
            if other.recording == frame.recording and (is_scan or other.frame == frame.frame)
            else None
            for other in others
        ]

    def _seen(self, point_world: np.ndarray, frame: FrameName) -> list[float] | None:
        """The pixel [u, v] that shows a world point (3,), metres; None if the measured depth disagrees."""
        from bask_data.core.geometry import in_image, invert_rigid, project, transform

        camera = self.camera(frame)
        camera_from_world = invert_rigid(camera.world_from_cameras[frame.frame])
        uv, z = project(transform(camera_from_world, point_world[None]), camera.Ks[frame.frame])
        if not in_image(uv, camera.height, camera.width)[0]:
            return None
        measured = float(self._depth(frame)[round(float(uv[0, 1])), round(float(uv[0, 0]))])
        return uv[0].tolist() if measured > 0 and abs(measured - z[0]) < SAME_POINT_DEPTH else None

    def _computed(self, camera: Camera, i_frame: int) -> FrameDescriptors:
        import torch

        from bask_data.nn.resnet import upsampled

        rgb = camera.rgb(i_frame)
        with torch.inference_mode():
            cells = self._network.cells(rgb)
            # Far from the origin, squared lengths would cancel the digits of small distances.
            origin = cells.mean(dim=(1, 2))
            cells = cells - origin[:, None, None]
            full = upsampled(cells[None], self._network.input_size((rgb.shape[0], rgb.shape[1])))[0]
            return FrameDescriptors(cells, full.square().sum(dim=0), origin)

    def _recent(self, frame: FrameName) -> FrameDescriptors | None:
        with self._keeping:
            if frame in self._described:
                self._described.move_to_end(frame)
            return self._described.get(frame)

    def _keep(self, frame: FrameName, descriptors: FrameDescriptors) -> None:
        with self._keeping:
            cache = self._described
            cache[frame] = descriptors
            cache.move_to_end(frame)
            while len(cache) > 1 and sum(kept.n_bytes for kept in cache.values()) > self._most_bytes:
                cache.popitem(last=False)


def _least_of_blocks(z: np.ndarray, step: int) -> np.ndarray:
    """Minimum of each block of step x step pixels; incomplete blocks at the edges are dropped."""
    import numpy as np

    whole = z[: z.shape[0] // step * step, : z.shape[1] // step * step]
    # Rows first, then columns: a minimum over two of four axes is ten times slower in NumPy.
    rows = reduce(np.minimum, [whole[i::step] for i in range(step)])
    return np.ascontiguousarray(reduce(np.minimum, [rows[:, i::step] for i in range(step)]))
