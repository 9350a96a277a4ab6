"""LeRobot, dataset format v3.0: tables of frames and episodes, video files shared by episodes, and statistics."""

from __future__ import annotations

import json
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bask_data.errors import BadData
from bask_data.export.calibration import calibration_columns, calibration_values
from bask_data.export.columns import Column
from bask_data.export.description import write_description
from bask_data.export.episodes import SPLITS, Episode, Episodes
from bask_data.export.lerobot_files import DATA_BYTES, FILE, FILES_PER_CHUNK, VIDEO_BYTES, ImageColumn, Tables, Videos
from bask_data.export.lerobot_stats import merged_stats, vector_stats
from bask_data.progress import progress

if TYPE_CHECKING:
    import numpy as np

VERSION = "v3.0"

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
    """Write the folder; notes on the frame rate and on depth."""
    fps, notes = rate(episodes)
    columns, tasks = _columns(episodes), _tasks(episodes)
    rows: list[dict[str, Any]] = []
    stats: list[dict[str, Any]] = []
    with ExitStack() as open_files:
        images = _image_columns(episodes)
        tables = open_files.enter_context(Tables(out, columns, images))
        filmed = episodes.cameras if episodes.settings.videos else {}
        videos = [open_files.enter_context(Videos(out, *camera, fps)) for camera in filmed.items()]
        for i, episode in enumerate(progress(episodes, "exporting demonstrations", len(episodes))):
            begin, n = rows[-1]["dataset_to_index"] if rows else 0, episode.entry.n_frames
            values = _numbered(episode, i, begin, tasks.index(episode.entry.task), fps)
            row = {"episode_index": i, "tasks": [episode.entry.task], "length": n}
            row |= {"dataset_from_index": begin, "dataset_to_index": begin + n, **tables.append(values, episode)}
            features = {column.name: vector_stats(values[column.name]) for column in columns}
            features |= {image.key: image.stats(n) for image in images}
            features |= {video.key: video.append(row, episode) for video in videos}
            row |= {f"stats/{name}/{key}": value for name, of in features.items() for key, value in of.items()}
            rows.append(row | {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0})
            stats.append(features)
    features = {column.name: _feature(column) for column in columns}
    features |= {image.key: image.feature for image in images} | {video.key: video.feature for video in videos}
    _write_meta(out, episodes, features, stats, rows, fps)
    return [*notes, *(image.note for image in images if image.note)]


def _image_columns(episodes: Episodes) -> list[ImageColumn]:
    """Depth of every camera with `--cameras`, and colour unless it goes into videos, which lose some of it."""
    if not episodes.settings.cameras:
        return []
    kinds = (True,) if episodes.settings.videos else (False, True)
    return [ImageColumn(name, size, is_depth=is_depth) for name, size in episodes.cameras.items() for is_depth in kinds]


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
        *calibration_columns(episodes),
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
        **calibration_values(episode),
        "timestamp": (number / fps).astype(np.float32),
        "frame_index": number,
        "episode_index": np.full_like(number, i),
        "index": begin + number,
        "task_index": np.full_like(number, task),
    }


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
        "video_path": f"videos/{{video_key}}/{FILE}.mp4" if episodes.settings.videos else None,
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
