"""The frames of a dataset as the page shows them: pictures, and where a descriptor is found in them."""

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
"""Bytes of descriptors kept in memory: of 256x256 images with 32 dimensions more than a thousand frames. A page shows
seven at a time, so that a tenth would do; frames that were dropped take the network's time again."""

MOST_PIXELS = 128 * 128
"""Pixels of a heat map. Descriptors are smooth over eight pixels of what the network sees, so more would show nothing
more, and take longer to arrive and to draw."""

SAME_POINT_DEPTH = 0.02
"""Metres by which a measured depth may differ from a point's depth and still show the point."""


class FrameName(NamedTuple):
    """A frame of a dataset."""

    recording: str
    camera: str
    frame: int


@dataclass(frozen=True)
class FrameDescriptors:
    """A frame's descriptors at stride 8, and what distances need of them at every pixel.

    The product of descriptors with a reference can be up-sampled after it is taken, their squared lengths cannot: kept
    so, a frame takes little more than its cells, and a distance map a product with the cells only.
    """

    cells: torch.Tensor
    squares: torch.Tensor
    origin: torch.Tensor

    @property
    def n_bytes(self) -> int:
        return 4 * (self.cells.numel() + self.squares.numel() + self.origin.numel())

    def distances(self, reference: torch.Tensor) -> torch.Tensor:
        """Distance z of every pixel (h, w) to a reference descriptor (d,)."""
        from bask_data.nn.resnet import upsampled

        centred = reference - self.origin
        size = self.squares.shape[0], self.squares.shape[1]
        product = upsampled((centred @ self.cells.flatten(1)).reshape(1, 1, *self.cells.shape[1:]), size)[0, 0]
        z_squared = self.squares - 2.0 * product + centred.square().sum()
        return (z_squared.clamp_(min=0.0) / len(centred)).sqrt_()


@dataclass(frozen=True)
class HeatMap:
    """Where a descriptor is found in a frame.

    Args:
        z: distance of every pixel (h, w) float32; spans the image, edge to edge.
        best: (u, v) of the least distance, pixels of the frame's image.
        z_best: the distance there.
    """

    z: np.ndarray
    best: tuple[float, float]
    z_best: float


class Gallery:
    """The recordings and their frames; descriptors are computed when first asked for."""

    def __init__(
        self, recordings: Mapping[str, Recording], network: DescriptorNetwork, most_bytes: int = MOST_DESCRIPTOR_BYTES
    ) -> None:
        self.recordings = recordings
        self._cameras = {name: {one.name: one for one in recording.cameras} for name, recording in recordings.items()}
        self._network = network
        self._most_bytes = most_bytes
        self._described: OrderedDict[FrameName, FrameDescriptors] = OrderedDict()
        # A pixel that is hovered over asks for depth many times a second, and always of the few frames on the page.
        self._depth = lru_cache(maxsize=32)(lambda frame: self.camera(frame).depth(frame.frame))
        self._using_network = threading.Lock()
        self._keeping = threading.Lock()

    def listed(self) -> list[dict[str, Any]]:
        """Recordings, their cameras, number and size of their frames."""
        return [
            {
                "name": name,
                "scope": self.recordings[name].scope,
                "cameras": [
                    {"name": one.name, "n_frames": one.n_frames, "width": one.width, "height": one.height}
                    for one in cameras.values()
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
        """Refuse what is outside of the frame's image; `UsageError`."""
        camera = self.camera(frame)
        if not (-0.5 <= u < camera.width - 0.5 and -0.5 <= v < camera.height - 0.5):
            size = f"u 0..{camera.width - 1}, v 0..{camera.height - 1}"
            raise UsageError("pixel", "", expected=size, got=f"{u:g}, {v:g}")

    def picture(self, frame: FrameName) -> bytes:
        """The frame as JPEG."""
        import cv2

        rgb = self.camera(frame).rgb(frame.frame)
        done, data = cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
        assert done
        return data.tobytes()

    def is_described(self, frame: FrameName) -> bool:
        """Whether its descriptors are in memory."""
        return frame in self._described

    def describe(self, frame: FrameName) -> FrameDescriptors:
        """The frame's descriptors, computed where they are not in memory."""
        camera = self.camera(frame)
        found = self._recent(frame)
        if found is None:
            with self._using_network:
                found = self._recent(frame) or self._computed(camera, frame.frame)
            self._keep(frame, found)
        return found

    def descriptor_at(self, frame: FrameName, u: float, v: float) -> torch.Tensor:
        """The descriptor (d,) of a pixel of the frame's image, as reference keypoints get it."""
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
        """Where a descriptor is found in a frame."""
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
        # Each pixel of the smaller map is the least distance in its block: a small match must not vanish.
        return HeatMap(_least_of_blocks(z, step), (float(u), float(v)), float(z[row, column]))

    def same_place(self, frame: FrameName, u: float, v: float, others: Sequence[FrameName]) -> list[Any]:
        """Where other frames show the point that a pixel shows, by depth and cameras; None where that is not known.

        It is known in the frames of the same scan, where nothing moves, and in what the other cameras of a
        demonstration saw at the same moment.

        Returns:
            [u, v] of each frame's image, or None.
        """
        import numpy as np

        self.check_pixel(frame, u, v)
        camera = self.camera(frame)
        depth = float(self._depth(frame)[round(v), round(u)])
        if depth <= 0:
            return [None] * len(others)
        [point] = camera.points_world(frame.frame, np.array([[u, v]]), np.array([depth]))
        is_scan = self.recordings[frame.recording].scope == "scene"
        known = [other.recording == frame.recording and (is_scan or other.frame == frame.frame) for other in others]
        return [self._seen(point, other) if one else None for one, other in zip(known, others, strict=True)]

    def _seen(self, point_world: np.ndarray, frame: FrameName) -> list[float] | None:
        """The pixel that shows a world point (3,), if the measured depth agrees."""
        from bask_data.core.geometry import in_image, invert_rigid, project, transform

        camera = self.camera(frame)
        camera_from_world = invert_rigid(camera.world_from_cameras[frame.frame])
        uv, z = project(transform(camera_from_world, point_world[None]), camera.K)
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
            # Squared lengths far from the origin would cost the small distances their digits.
            origin = cells.mean(dim=(1, 2))
            cells = cells - origin[:, None, None]
            full = upsampled(cells[None], self._network.input_size((rgb.shape[0], rgb.shape[1])))[0]
            return FrameDescriptors(cells, full.square().sum(dim=0), origin)

    def _recent(self, frame: FrameName) -> FrameDescriptors | None:
        with self._keeping:
            if frame in self._described:
                self._described.move_to_end(frame)
            return self._described.get(frame)

    def _keep(self, frame: FrameName, found: FrameDescriptors) -> None:
        with self._keeping:
            self._described[frame] = found
            self._described.move_to_end(frame)
            while len(self._described) > 1 and sum(one.n_bytes for one in self._described.values()) > self._most_bytes:
                self._described.popitem(last=False)


def _least_of_blocks(z: np.ndarray, step: int) -> np.ndarray:
    """The least of each block of step x step pixels; what is left over at the edges is left out."""
    import numpy as np

    whole = z[: z.shape[0] // step * step, : z.shape[1] // step * step]
    # Of whole rows, then of whole columns: NumPy is ten times slower with a minimum over two axes of four.
    rows = reduce(np.minimum, [whole[i::step] for i in range(step)])
    return np.ascontiguousarray(reduce(np.minimum, [rows[:, i::step] for i in range(step)]))
