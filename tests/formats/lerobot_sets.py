"""Small LeRobot datasets with known content, written by PyArrow and FFmpeg as LeRobot lays them out."""

from __future__ import annotations

import json
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy import ndarray

from tests.formats.folders import rigid

HEIGHT, WIDTH, FPS = 32, 48, 10
INTRINSICS = "40,41,23.5,15.5"
K = np.array([[40.0, 0, 23.5], [0, 41, 15.5], [0, 0, 1]])
LENGTHS = (3, 4)
N_FRAMES = sum(LENGTHS)
WRIST, WRIST_DEPTH = "observation.images.wrist", "observation.images.wrist_depth"
LOG = {"video.depth_min": 0.01, "video.depth_max": 10.0, "video.shift": 3.5, "video.use_log": True}
LINEAR = {"video.depth_min": 0.0, "video.depth_max": 4.0, "video.shift": 0.0, "video.use_log": False}
V3_PATHS = (
    "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
    "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
)
V2_PATHS = (
    "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
    "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
)
POSES = np.stack([rigid(np.random.default_rng(i)) for i in range(N_FRAMES)])


def color(i: int) -> ndarray:
    """Colour of a frame: brightness tells its number."""
    return np.full((HEIGHT, WIDTH, 3), 30 * i + 20, np.uint8)


def depth_mm(i: int) -> ndarray:
    """Depth of a frame, millimetres: smooth, with a hole."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    depth = (900 + 40 * i + 3 * u + 2 * v).astype(np.uint16)
    depth[4:8, 4:9] = 0
    return depth


def codes(metres: ndarray, info: dict[str, Any]) -> ndarray:
    """LeRobot's codes of depth, which has no code for 0: it becomes the smallest."""
    low, high = info["video.depth_min"], info["video.depth_max"]
    if info["video.use_log"]:
        metres, low, high = (np.log(value + info["video.shift"]) for value in (metres, low, high))
    return np.rint((metres - low) / (high - low) * 4095).clip(0, 4095).astype(np.uint16)


def write_frames(path: Path, frames: list[ndarray], codec: str, pixels: str, options: dict[str, str]) -> None:
    """A video of colour (h, w, 3), or of values of 12 or 16 bits (h, w)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=FPS, options=options)
        stream.height, stream.width, stream.pix_fmt = HEIGHT, WIDTH, pixels
        for i, values in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(values, format="rgb24" if values.ndim == 3 else pixels)
            frame = frame.reformat(format=pixels)
            frame.pts, frame.time_base = i, Fraction(1, FPS)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def png(image: ndarray) -> bytes:
    return bytes(cv2.imencode(".png", image[..., ::-1] if image.ndim == 3 else image)[1])


def tiff(image: ndarray) -> bytes:
    return bytes(cv2.imencode(".tiff", image)[1])


def feature(dtype: str, shape: list[int], info: dict[str, Any] | None = None, names: Any = None) -> dict[str, Any]:
    return {"dtype": dtype, "shape": shape, "names": names, **({"info": info} if info is not None else {})}


class LerobotSet:
    """A dataset of two episodes, of 3 and 4 frames, in one file of each kind; tests may change it before `write`.

    Args:
        features: `meta/info.json`'s.
        columns: values of each frame by name, or whole Arrow arrays.
        videos: codec, pixel format, options and frame by feature.
        episodes: further columns of the list of episodes.
    """

    def __init__(self) -> None:
        lossless = {"x265-params": "lossless=1:log-level=none"}
        self.version = "v3.0"
        self.features: dict[str, Any] = {
            WRIST: feature("video", [HEIGHT, WIDTH, 3], {"is_depth_map": False}, ["height", "width", "channels"]),
            WRIST_DEPTH: feature("video", [HEIGHT, WIDTH, 1], {"is_depth_map": True, "depth_unit": "mm", **LOG}),
            "timestamp": feature("float32", [1]),
            "episode_index": feature("int64", [1]),
        }
        episode = np.repeat([0, 1], LENGTHS)
        time = np.concatenate([np.arange(n) for n in LENGTHS]) / FPS
        self.columns: dict[str, Any] = {"timestamp": time.astype(np.float32), "episode_index": episode}
        self.videos: dict[str, tuple[str, str, dict[str, str], Callable[[int], ndarray]]] = {
            WRIST: ("libx264", "yuv420p", {"crf": "4", "g": "2"}, color),
            WRIST_DEPTH: ("libx265", "gray12le", lossless, lambda i: codes(depth_mm(i) / 1000, LOG)),
        }
        self.episodes: dict[str, list[Any]] = {}
        self.info: dict[str, Any] = {}
        self.add("observation.camera.wrist.world_from_camera", POSES.reshape(N_FRAMES, 16))

    def add(self, name: str, values: ndarray, **more: Any) -> None:
        """A column of numbers (t,) or (t, n), with its feature."""
        self.columns[name] = values
        self.features[name] = {**feature(str(values.dtype), list(values.shape[1:]) or [1]), **more}

    def replace_video(self, key: str, column: Any, **stated: Any) -> None:
        """A column instead of a video."""
        del self.videos[key]
        self.columns[key] = column
        self.features[key] |= stated

    def files(self, files: list[bytes | None], paths: list[str | None] | None = None) -> pa.Array:
        """A column of image files, inside the table or by path."""
        kind = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
        paths = paths or [None] * len(files)
        return pa.array([{"bytes": data, "path": path} for data, path in zip(files, paths, strict=True)], kind)

    def write(self, folder: Path) -> Path:
        """Write it; returns `folder`."""
        (folder / "meta").mkdir(parents=True)
        arrays = {name: self._arrow(values) for name, values in self.columns.items()}
        if self.version == "v3.0":
            self._write_v3(folder, arrays)
        else:
            self._write_v2(folder, arrays)
        data, video = V3_PATHS if self.version == "v3.0" else V2_PATHS
        info = {"codebase_version": self.version, "fps": FPS, "total_episodes": 2, "chunks_size": 1000}
        info |= {"data_path": data, "video_path": video, "features": self.features, **self.info}
        (folder / "meta/info.json").write_text(json.dumps(info))
        return folder

    def _arrow(self, values: Any) -> pa.Array:
        if not isinstance(values, np.ndarray):
            return values
        if values.ndim == 1:
            return pa.array(values)
        return pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1)), values.shape[1])

    def _write_v3(self, folder: Path, arrays: dict[str, pa.Array]) -> None:
        path = folder / "data/chunk-000/file-000.parquet"
        path.parent.mkdir(parents=True)
        pq.write_table(pa.table(arrays), path, row_group_size=2)
        ends = np.cumsum(LENGTHS)
        listed: dict[str, list[Any]] = {
            "episode_index": [0, 1],
            "tasks": [["pour"], ["stir"]],
            "length": list(LENGTHS),
            "data/chunk_index": [0, 0],
            "data/file_index": [0, 0],
            "stats/timestamp/mean": [[0.1], [0.1]],
        }
        for key, (codec, pixels, options, frame) in self.videos.items():
            listed |= {f"videos/{key}/chunk_index": [0, 0], f"videos/{key}/file_index": [0, 0]}
            listed[f"videos/{key}/from_timestamp"] = [0.0, ends[0] / FPS]
            listed[f"videos/{key}/to_timestamp"] = list(ends / FPS)
            frames = [frame(i) for i in range(N_FRAMES)]
            write_frames(folder / f"videos/{key}/chunk-000/file-000.mp4", frames, codec, pixels, options)
        path = folder / "meta/episodes/chunk-000/file-000.parquet"
        path.parent.mkdir(parents=True)
        pq.write_table(pa.table({**listed, **self.episodes}), path)

    def _write_v2(self, folder: Path, arrays: dict[str, pa.Array]) -> None:
        begin, lines = 0, []
        for i, n in enumerate(LENGTHS):
            path = folder / f"data/chunk-000/episode_{i:06d}.parquet"
            path.parent.mkdir(parents=True, exist_ok=True)
            pq.write_table(pa.table(arrays).slice(begin, n), path)
            for key, (codec, pixels, options, frame) in self.videos.items():
                frames = [frame(k) for k in range(begin, begin + n)]
                video = folder / f"videos/chunk-000/{key}/episode_{i:06d}.mp4"
                write_frames(video, frames, codec, pixels, options)
            lines.append(json.dumps({"episode_index": i, "tasks": [f"task {i}"], "length": n}))
            begin += n
        (folder / "meta/episodes.jsonl").write_text("\n".join(lines) + "\n")
