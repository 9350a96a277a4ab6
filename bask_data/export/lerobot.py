"""LeRobot, dataset format v3.0: tables of frames and episodes, video files shared by episodes, and statistics."""

from __future__ import annotations

import json
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bask_data.errors import BadData
from bask_data.export.columns import Column
from bask_data.export.description import write_description
from bask_data.export.episodes import SPLITS, Episode, Episodes
from bask_data.export.images import frames
from bask_data.export.parquet import arrow, arrow_type
from bask_data.progress import progress

if TYPE_CHECKING:
    import numpy as np

    from bask_data.formats.video import VideoWriter

VERSION = "v3.0"
FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
FILES_PER_CHUNK = 1000
"""Most files in a folder: LeRobot's default of `chunks_size`."""

DATA_BYTES, VIDEO_BYTES = 100 * 2**20, 200 * 2**20
"""Sizes in bytes at which a file ends after its episode: LeRobot's defaults, 100 and 200 MB."""

QUANTILES = (0.01, 0.10, 0.50, 0.90, 0.99)
"""Quantiles among the statistics of format v3.0."""

RATE_TOLERANCE = 0.02
"""Relative difference within which two rates, or a rate and an integer, count as equal, as clocks jitter; 29.97 and 30
frames per second differ by 0.001. Sensitivity not measured."""

NUMBERING = tuple(
    Column(name, (), dtype, description)
    for name, dtype, description in (
        ("timestamp", "float32", "Seconds since the episode's first frame at the even rate `fps`."),
        ("frame_index", "int64", "Number in the episode."),
        ("episode_index", "int64", "Number of the episode."),
        ("index", "int64", "Number in the dataset."),
        ("task_index", "int64", "Number of the task."),
    )
)


def write(out: Path, episodes: Episodes) -> list[str]:
    """Write the folder; notes on the frame rate."""
    fps, notes = rate(episodes)
    columns, tasks = _columns(episodes), _tasks(episodes)
    rows: list[dict[str, Any]] = []
    stats: list[dict[str, Any]] = []
    with ExitStack() as open_files:
        tables = open_files.enter_context(_Tables(out, columns))
        videos = [open_files.enter_context(_Videos(out, *camera, fps)) for camera in episodes.cameras.items()]
        for i, episode in enumerate(progress(episodes, "exporting demonstrations", len(episodes))):
            begin, n = rows[-1]["dataset_to_index"] if rows else 0, episode.entry.n_frames
            values = _numbered(episode, i, begin, tasks.index(episode.entry.task), fps)
            row = {"episode_index": i, "tasks": [episode.entry.task], "length": n}
            row |= {"dataset_from_index": begin, "dataset_to_index": begin + n, **tables.append(values)}
            features = {column.name: vector_stats(values[column.name]) for column in columns}
            features |= {video.key: video.append(row, episode) for video in videos}
            row |= {f"stats/{name}/{key}": value for name, of in features.items() for key, value in of.items()}
            rows.append(row | {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0})
            stats.append(features)
    features = {column.name: _feature(column) for column in columns} | {video.key: video.feature for video in videos}
    _write_meta(out, episodes, features, stats, rows, fps)
    return notes


def _feature(column: Column) -> dict[str, Any]:
    return {"dtype": column.dtype, "shape": [column.width], "names": list(column.values) or None}


def rate(episodes: Episodes) -> tuple[float, list[str]]:
    """Frame rate of all episodes, frames per second, rounded if close to an integer; and notes.

    Raises:
        BadData: a demonstration's rate differs from the first one's.
    """
    first = episodes.entries[0]
    for entry in episodes.entries:
        if abs(entry.fps / first.fps - 1) > RATE_TOLERANCE:
            expected = f"about {first.fps:.3g} frames per second, as {first.name} has"
            fix = "export demonstrations of one rate with --only."
            raise BadData(episodes.path_of(entry), "time", expected=expected, got=f"{entry.fps:.3g}", fix=fix)
    mean = sum(entry.fps for entry in episodes.entries) / len(episodes)
    whole = round(mean)
    if whole and abs(mean / whole - 1) <= RATE_TOLERANCE:
        return whole, []
    return round(mean, 3), [f"the rate of {mean:.3f} frames per second is not an integer; some LeRobot tools need one."]


def _columns(episodes: Episodes) -> list[Column]:
    """Columns by LeRobot's names: policies use those named `observation...` and `action`, and ignore the others."""
    everything = tuple(name for column in episodes.state for name in column.values)
    state = Column("observation.state", everything, "float32", "Keypoints, their spread, gripper.")
    # ACT and Diffusion refuse a state alone: they require images or the environment's state as well.
    around = tuple(name for column in episodes.state if column.name in _AROUND for name in column.values)
    environment = Column("observation.environment_state", around, "float32", "Keypoints and their spread again.")
    action = [episodes.column("action")] if episodes.has("action") else []
    beside = [episodes.column(name) for name in _BESIDE if episodes.has(name)]
    return [
        state,
        environment,
        *action,
        *(Column(_BESIDE[c.name], c.values, c.dtype, c.description) for c in beside),
        *NUMBERING,
    ]


_AROUND = ("keypoints", "spread")
_BESIDE = {
    "observed": "keypoints.observed",
    "localised": "keypoints.localised",
    "time": "recorded_time",
    "keypoints_world": "keypoints.world",
    "gripper_position_world": "gripper_position.world",
}
"""LeRobot's names of columns that no policy uses unasked."""


def _numbered(episode: Episode, i: int, begin: int, task: int, fps: float) -> dict[str, np.ndarray]:
    import numpy as np

    number = np.arange(episode.entry.n_frames)
    return {
        "observation.state": episode.state,
        "observation.environment_state": np.concatenate([episode.values[name] for name in _AROUND], axis=1),
        **({"action": episode.values["action"]} if "action" in episode.values else {}),
        **{name: episode.values[of] for of, name in _BESIDE.items() if of in episode.values},
        "timestamp": (number / fps).astype(np.float32),
        "frame_index": number,
        "episode_index": np.full_like(number, i),
        "index": begin + number,
        "task_index": np.full_like(number, task),
    }


class _Numbering:
    """Position of the current file: `chunk_index` and `file_index`."""

    def __init__(self) -> None:
        self.n = -1

    def where(self) -> dict[str, int]:
        return {"chunk_index": self.n // FILES_PER_CHUNK, "file_index": self.n % FILES_PER_CHUNK}


class _Tables(_Numbering):
    """The frames of all episodes, in Parquet files of a bounded size."""

    def __init__(self, out: Path, columns: list[Column]) -> None:
        import pyarrow as pa

        super().__init__()
        self._out, self._columns = out, columns
        self._schema = pa.schema([pa.field(column.name, arrow_type(_single(column))) for column in columns])
        self._writer: Any = None
        self._n_bytes = 0

    def __enter__(self) -> _Tables:
        return self

    def __exit__(self, *_: object) -> None:
        if self._writer is not None:
            self._writer.close()
            self._writer = None

    def append(self, values: dict[str, np.ndarray]) -> dict[str, int]:
        """Append an episode; returns its file's position."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        if self._writer is None:
            self.n, self._n_bytes = self.n + 1, 0
            path = self._out / "data" / f"{FILE.format(**self.where())}.parquet"
            path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = pq.ParquetWriter(path, self._schema, compression="snappy")
        table = pa.Table.from_arrays([arrow(values[c.name], _single(c)) for c in self._columns], schema=self._schema)
        self._writer.write_table(table)
        self._n_bytes += table.nbytes
        where = {f"data/{key}": n for key, n in self.where().items()}
        if self._n_bytes >= DATA_BYTES:
            self.__exit__()
        return where


class _Videos(_Numbering):
    """The images of one camera in all episodes, in video files of a bounded size."""

    def __init__(self, out: Path, name: str, size: tuple[int, int], fps: float) -> None:
        super().__init__()
        self.key = f"observation.images.{name}"
        self._out, self._name, self._size, self._fps = out, name, size, fps
        self._video: VideoWriter | None = None
        self.feature: dict[str, Any] = {}

    def __enter__(self) -> _Videos:
        return self

    def __exit__(self, *error: Any) -> None:
        if self._video is not None:
            video, self._video = self._video, None
            video.__exit__(*error)

    def append(self, row: dict[str, Any], episode: Episode) -> dict[str, Any]:
        """Append an episode and enter its position in `row`; returns the statistics of its images."""
        import numpy as np

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


def vector_stats(values: np.ndarray) -> dict[str, Any]:
    """Statistics of an episode's values (t, w) or (t,), each a list of w."""
    import numpy as np

    columns = values.reshape(len(values), -1).astype(np.float64)
    stats = {"min": columns.min(0), "max": columns.max(0), "mean": columns.mean(0), "std": columns.std(0)}
    stats |= {_quantile_name(share): np.quantile(columns, share, axis=0) for share in QUANTILES}
    return {**{name: value.tolist() for name, value in stats.items()}, "count": [len(values)]}


def image_stats(counts: np.ndarray, n_images: int) -> dict[str, Any]:
    """Statistics of images, each (3, 1, 1), with brightness from 0 to 1.

    Args:
        counts: (3, 256) histograms of the channels.
    """
    import numpy as np

    brightness = np.arange(256) / 255.0
    share = counts / counts.sum(axis=1, keepdims=True)
    occurs = counts > 0
    mean = share @ brightness
    stats = {
        "min": brightness[occurs.argmax(axis=1)],
        "max": brightness[255 - occurs[:, ::-1].argmax(axis=1)],
        "mean": mean,
        "std": np.sqrt(np.maximum(share @ brightness**2 - mean**2, 0.0)),
    }
    reached = share.cumsum(axis=1)
    # The tolerance covers the rounding of the cumulative sums.
    stats |= {_quantile_name(q): brightness[(reached >= q - 1e-12).argmax(axis=1)] for q in QUANTILES}
    return {**{name: value.reshape(3, 1, 1).tolist() for name, value in stats.items()}, "count": [n_images]}


def merged_stats(episodes: list[dict[str, Any]]) -> dict[str, Any]:
    """Statistics of all episodes from those of each: exact except for quantiles, which are averaged as in LeRobot."""
    import numpy as np

    counts = np.array([stats["count"][0] for stats in episodes], dtype=np.float64)
    names = [name for name in episodes[0] if name != "count"]
    of = {name: np.array([stats[name] for stats in episodes], dtype=np.float64) for name in names}

    def averaged(values: np.ndarray) -> np.ndarray:
        mean: np.ndarray = np.average(values, axis=0, weights=counts)
        return mean

    mean = averaged(of["mean"])
    merged = {name: averaged(of[name]) for name in of if name.startswith("q")}
    merged |= {"min": of["min"].min(axis=0), "max": of["max"].max(axis=0), "mean": mean}
    merged["std"] = np.sqrt(averaged(of["std"] ** 2 + (of["mean"] - mean) ** 2))
    return {**{name: value.tolist() for name, value in merged.items()}, "count": [int(counts.sum())]}


def _quantile_name(share: float) -> str:
    return f"q{round(share * 100):02d}"


def _write_meta(
    out: Path,
    episodes: Episodes,
    features: dict[str, Any],
    stats: list[dict[str, Any]],
    rows: list[dict[str, Any]],
    fps: float,
) -> None:
    """Write `meta/`: info, statistics, tasks, episodes, and our description."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    tasks = _tasks(episodes)
    info = {
        "codebase_version": VERSION,
        "robot_type": None,
        "total_episodes": len(rows),
        "total_frames": episodes.n_frames,
        "total_tasks": len(tasks),
        "chunks_size": FILES_PER_CHUNK,
        "data_files_size_in_mb": DATA_BYTES // 2**20,
        "video_files_size_in_mb": VIDEO_BYTES // 2**20,
        "fps": fps,
        "splits": _splits(episodes),
        "data_path": f"data/{FILE}.parquet",
        "video_path": f"videos/{{video_key}}/{FILE}.mp4" if episodes.cameras else None,
        "features": features,
    }
    meta = out / "meta"
    (meta / "episodes" / "chunk-000").mkdir(parents=True)
    _write_json(meta / "info.json", info)
    merged = {name: merged_stats([of_episode[name] for of_episode in stats]) for name in stats[0]}
    _write_json(meta / "stats.json", merged)
    pq.write_table(pa.Table.from_pylist(rows), meta / "episodes" / "chunk-000" / "file-000.parquet")
    _write_tasks(meta / "tasks.parquet", tasks)
    write_description(out, episodes.described("lerobot"))


def _write_tasks(file: Path, tasks: list[str]) -> None:
    """Write the tasks as a pandas table with the tasks as index, which the schema's metadata states."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns = [
        {"name": name, "field_name": name, "pandas_type": pandas, "numpy_type": numpy, "metadata": None}
        for name, pandas, numpy in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    ]
    metadata = {"index_columns": ["task"], "column_indexes": [], "columns": columns, "pandas_version": "2.0.0"}
    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), "task": tasks})
    pq.write_table(table.replace_schema_metadata({"pandas": json.dumps(metadata)}), file)


def _tasks(episodes: Episodes) -> list[str]:
    return list(dict.fromkeys(entry.task for entry in episodes.entries))


def _splits(episodes: Episodes) -> dict[str, str]:
    """Range of episodes of each split, `begin:end`; episodes are in the order of splits."""
    ranges = {split: episodes.in_split(split) for split in SPLITS}
    return {split: f"{numbers[0]}:{numbers[-1] + 1}" for split, numbers in ranges.items() if numbers}


def _write_json(file: Path, value: object) -> None:
    file.write_text(json.dumps(value, indent=4, ensure_ascii=False, allow_nan=False) + "\n")
