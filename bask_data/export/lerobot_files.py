"""Files of a LeRobot dataset: the frames' tables with the images in them, and the videos, each up to a bounded size."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from bask_data.export.columns import Column
from bask_data.export.episodes import Episode
from bask_data.export.images import frames
from bask_data.export.lerobot_stats import image_stats
from bask_data.export.parquet import arrow, arrow_type
from bask_data.progress import progress

if TYPE_CHECKING:
    from bask_data.formats.video import VideoWriter

FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
FILES_PER_CHUNK = 1000
"""Most files in a folder: LeRobot's default of `chunks_size`."""

DATA_BYTES, VIDEO_BYTES = 100 * 2**20, 200 * 2**20
"""Sizes in bytes at which a file ends after its episode: LeRobot's defaults, 100 and 200 MB."""

ROWS_WITH_IMAGES = 16
"""Rows of a row group where the rows hold images: what is in memory at a time. Chosen, sensitivity not measured."""

PNG_LEVEL = 1
"""Compression of PNG files: LeRobot's own, the fastest."""


class _Numbering:
    """Position of the current file: `chunk_index` and `file_index`."""

    def __init__(self) -> None:
        self.n = -1

    def where(self) -> dict[str, int]:
        return {"chunk_index": self.n // FILES_PER_CHUNK, "file_index": self.n % FILES_PER_CHUNK}


class ImageColumn:
    """Images of one camera as PNG files in the tables, without loss: colour, or depth in 16 bits.

    Args:
        size: (height, width), pixels.
    """

    def __init__(self, camera: str, size: tuple[int, int], *, is_depth: bool) -> None:
        self.key = f"observation.images.{camera}" + ("_depth" if is_depth else "")
        self._camera, self._size, self._is_depth = camera, size, is_depth
        self._scales: set[float] = set()
        self._counts = np.zeros((0, 0), np.int64)

    @property
    def feature(self) -> dict[str, Any]:
        """Its entry in `meta/info.json`. LeRobot takes 16-bit depth for millimetres, unless the unit is stated."""
        info: dict[str, Any] = {"is_depth_map": self._is_depth}
        if self._scales == {0.001}:
            info["depth_unit"] = "mm"
        names = ["height", "width", "channels"]
        return {"dtype": "image", "shape": [*self._size, 1 if self._is_depth else 3], "names": names, "info": info}

    @property
    def note(self) -> str:
        """A note for the user on what LeRobot takes it for; empty if there is nothing to say."""
        others = sorted(self._scales - {0.001})
        if not others:
            return ""
        steps = ", ".join(f"{1000 * scale:g}" for scale in others)
        return f"{self.key} is in steps of {steps} mm, but LeRobot takes it for millimetres; `ingest` does not."

    def begin(self, episode: Episode) -> None:
        """Begin with an episode."""
        shape = (1, 2**16) if self._is_depth else (3, 2**8)
        self._counts = np.zeros(shape, np.int64)
        if self._is_depth:
            self._scales.add(episode.cameras[self._camera].depth_scale)

    def encoded(self, episode: Episode, i: int) -> bytes:
        """The PNG file of a frame."""
        camera = episode.cameras[self._camera]
        image = camera.depth_raw(i) if self._is_depth else camera.rgb(i)
        for counts, channel in zip(self._counts, image.reshape(-1, len(self._counts)).T, strict=True):
            counts += np.bincount(channel, minlength=len(counts))
        written, data = cv2.imencode(
            ".png", image if self._is_depth else image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, PNG_LEVEL]
        )
        assert written
        return data.tobytes()

    def stats(self, n_frames: int) -> dict[str, Any]:
        """Statistics of the episode's images: brightness from 0 to 1, or raw depth."""
        return image_stats(self._counts, n_frames, 1.0 if self._is_depth else 1 / 255)


class Tables(_Numbering):
    """The frames of all episodes, in Parquet files of a bounded size."""

    def __init__(self, out: Path, columns: list[Column], images: list[ImageColumn]) -> None:
        import pyarrow as pa

        super().__init__()
        self._out, self._columns, self._images = out, columns, images
        self._image_type = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
        fields = [pa.field(column.name, arrow_type(_single(column))) for column in columns]
        self._schema = pa.schema(fields + [pa.field(image.key, self._image_type) for image in images])
        self._writer: Any = None
        self._n_bytes = 0

    def __enter__(self) -> Tables:
        return self

    def __exit__(self, *_: object) -> None:
        if self._writer is not None:
            self._writer.close()
            self._writer = None

    def append(self, values: dict[str, np.ndarray], episode: Episode) -> dict[str, int]:
        """Append an episode; returns its file's position."""
        import pyarrow.parquet as pq

        if self._writer is None:
            self.n, self._n_bytes = self.n + 1, 0
            path = self._out / "data" / f"{FILE.format(**self.where())}.parquet"
            path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = pq.ParquetWriter(path, self._schema, compression="snappy")
        for image in self._images:
            image.begin(episode)
        n_frames = episode.entry.n_frames
        step = ROWS_WITH_IMAGES if self._images else n_frames
        for begin in progress(range(0, n_frames, step), f"exporting {episode.entry.name}"):
            self._append_rows(values, episode, range(begin, min(begin + step, n_frames)))
        where = {f"data/{key}": n for key, n in self.where().items()}
        if self._n_bytes >= DATA_BYTES:
            self.__exit__()
        return where

    def _append_rows(self, values: dict[str, np.ndarray], episode: Episode, rows: range) -> None:
        import pyarrow as pa

        arrays = [arrow(values[c.name][rows.start : rows.stop], _single(c)) for c in self._columns]
        for image in self._images:
            files = [{"bytes": image.encoded(episode, i), "path": f"frame-{i:06d}.png"} for i in rows]
            arrays.append(pa.array(files, self._image_type))
        table = pa.Table.from_arrays(arrays, schema=self._schema)
        self._writer.write_table(table)
        self._n_bytes += table.nbytes


class Videos(_Numbering):
    """The images of one camera in all episodes, in video files of a bounded size."""

    def __init__(self, out: Path, name: str, size: tuple[int, int], fps: float) -> None:
        super().__init__()
        self.key = f"observation.images.{name}"
        self._out, self._name, self._size, self._fps = out, name, size, fps
        self._video: VideoWriter | None = None
        self.feature: dict[str, Any] = {}

    def __enter__(self) -> Videos:
        return self

    def __exit__(self, *error: Any) -> None:
        if self._video is not None:
            video, self._video = self._video, None
            video.__exit__(*error)

    def append(self, row: dict[str, Any], episode: Episode) -> dict[str, Any]:
        """Append an episode and enter its position in `row`; returns the statistics of its images."""
        video = self._video = self._video or self._next()
        begin, counts = video.n_frames, np.zeros((3, 256), np.int64)
        for image in frames(episode.cameras[self._name], episode.entry.name):
            video.append(image)
            counts += [np.bincount(image[..., channel].reshape(-1), minlength=256) for channel in range(3)]
        where = {**self.where(), "from_timestamp": begin / self._fps, "to_timestamp": video.n_frames / self._fps}
        row |= {f"videos/{self.key}/{key}": value for key, value in where.items()}
        if video.n_bytes >= VIDEO_BYTES:
            self.__exit__(None, None, None)
        return image_stats(counts, episode.entry.n_frames)

    def _next(self) -> VideoWriter:
        from bask_data.formats.video import VideoWriter

        self.n += 1
        path = self._out / "videos" / self.key / f"{FILE.format(**self.where())}.mp4"
        # Training reads random frames: with every other frame a keyframe, each decodes fast.
        video = VideoWriter(path, self._fps, self._size, keyframe_every=2, quality=20)
        height, width = video.coded_size
        info = {"height": height, "width": width, "codec": "h264", "pix_fmt": "yuv420p", "is_depth_map": False}
        info |= {"fps": self._fps, "channels": 3}
        self.feature = {
            "dtype": "video",
            "shape": [height, width, 3],
            "names": ["height", "width", "channels"],
            "info": {**{f"video.{key}": value for key, value in info.items()}, "has_audio": False},
        }
        return video.__enter__()


def _single(column: Column) -> Column:
    """The column as LeRobot stores it: a list of one value becomes a scalar."""
    return Column(column.name, (), column.dtype, column.description) if column.width == 1 else column
