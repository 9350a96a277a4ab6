"""Read a Rerun recording back, with Rerun's own reader."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rerun.chunk import RrdReader

from bask_data.artifact import write_group
from bask_data.dataset import Dataset
from bask_data.kinds import CameraFrames, Demonstration, Robot
from tests.datasets import publish_artifact


class Recording:
    """Values of a recording by entity and component."""

    def __init__(self, file: Path) -> None:
        reader = RrdReader(file)
        assert (len(reader.recordings()), len(reader.blueprints())) == (1, 1)
        self.entities: set[str] = set()
        self.times: dict[str, set[str]] = {}
        self._values: dict[tuple[str, str], dict[int | None, Any]] = {}
        for chunk in reader.stream():
            path, batch = chunk.entity_path, chunk.to_record_batch()
            self.entities.add(path)
            self.times.setdefault(path, set()).update(chunk.timeline_names)
            index = next((name for name in ("pair", "frame") if name in chunk.timeline_names), None)
            frames = batch[index].to_pylist() if index else [None] * chunk.num_rows
            for name in batch.schema.names:
                if ":" in name:
                    column = self._values.setdefault((path, name), {})
                    column.update(
                        (frame, value)
                        for frame, value in zip(frames, batch[name].to_pylist(), strict=True)
                        if value is not None
                    )

    def all(self, path: str, component: str) -> dict[int | None, Any]:
        """By pair, or else by frame; the key is None for what holds at all times."""
        return self._values[(path, component)]

    def array(self, path: str, component: str, frame: int | None = None) -> np.ndarray:
        return np.array(self.all(path, component)[frame])

    def bytes(self, path: str, component: str, frame: int) -> np.ndarray:
        return np.array(self.all(path, component)[frame][0], np.uint8)


def colours(packed: np.ndarray) -> list[tuple[int, int, int]]:
    """Red, green and blue of Rerun's 32-bit colours."""
    return [(int(c) >> 24 & 255, int(c) >> 16 & 255, int(c) >> 8 & 255) for c in packed]


def publish_demonstration(dataset: Dataset, item: str, source: str, robot: Robot) -> Path:
    """Give a demonstration of the dataset a robot: `source`'s frames again, and what the robot did."""
    cameras = dataset.path(Demonstration, source)
    old = Demonstration(cameras)

    def fill(out: Path) -> None:
        group = Demonstration.start(out, "test", {}, action_names=robot.action_names)
        for camera in old.cameras:
            Demonstration.write_camera(
                group,
                camera.name,
                CameraFrames(
                    K=camera.Ks,
                    world_from_cameras=camera.world_from_cameras,
                    time=camera.time,
                    depth_scale=camera.depth_scale,
                    size=(camera.height, camera.width),
                    read=lambda i, camera=camera: (camera.rgb(i), camera.depth_raw(i)),
                ),
            )
        write_group(out / "robot", {"bask": {"role": "robot"}})
        Demonstration.write_robot(out, group, robot)

    return publish_artifact(dataset, Demonstration, item, fill)
