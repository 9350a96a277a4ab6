"""LeRobot datasets, v3.0 and v2: an episode whose frames lie inside tables and videos that episodes share."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.lens import Lens
from bask_data.errors import BadData
from bask_data.formats.choices import by_camera, chosen_episode
from bask_data.formats.files import listed, source_folder
from bask_data.formats.lerobot.cameras import CameraFeatures, find_cameras
from bask_data.formats.lerobot.columns import EpisodeRows, episode_rows
from bask_data.formats.lerobot.depth_images import episode_depth
from bask_data.formats.lerobot.episodes import EpisodeEntry, find_episode, list_episodes
from bask_data.formats.lerobot.images import color_images
from bask_data.formats.lerobot.info import Info, read_info
from bask_data.formats.lerobot.intrinsics import find_intrinsics
from bask_data.formats.lerobot.poses import PoseFinder
from bask_data.formats.lerobot.robot import RECORDED, read_robot
from bask_data.formats.options.lerobot import LerobotOptions
from bask_data.formats.parquet_rows import ParquetRows
from bask_data.formats.recording import SourceCamera, SourceRecording

EVEN = 1e-3
"""Seconds by which the times of a table may differ from frame number / rate and still be these, rounded to float32."""


def episodes(source: Path, options: LerobotOptions) -> tuple[str, ...]:
    """Numbers of the episodes."""
    return list_episodes(read_info(source_folder(source, options.follow_links)))


def read(source: Path, options: LerobotOptions) -> SourceRecording:
    """An episode of the dataset in `source`."""
    info = read_info(source_folder(source, options.follow_links))
    name = chosen_episode(source, list_episodes(info), options.episode)
    entry = find_episode(info, name)
    rows = episode_rows(info, ParquetRows(_table(info, entry)), entry.index, entry.length)
    chosen, assumptions = find_cameras(source, info, options)
    even, time_statement = _time(rows)
    robot = read_robot(rows, options)
    names = [camera.name for camera in chosen]
    intrinsics = by_camera("--intrinsics", options.intrinsics, names)
    finder = PoseFinder(rows, chosen, options, robot.gripper)
    used = list(robot.used)
    cameras, files = [], [info.path, rows.table.path, *entry.files]
    for camera in chosen:
        prefix = "" if len(chosen) == 1 else f"{camera.name}: "
        lens = find_intrinsics(rows, entry, camera, len(chosen), intrinsics)
        poses = finder.poses(camera)
        color = color_images(rows, entry, camera.color, even)
        depth = episode_depth(rows, entry, camera, even, options)
        time, statement = _recorded_time(rows, camera, even, time_statement)
        cameras.append(
            SourceCamera(
                name=camera.name,
                frames=tuple(f"{i:06d}" for i in range(rows.n_frames)),
                lens=Lens(lens.K, color.size, lens.distortion),
                world_from_cameras=poses.world_from_cameras,
                time=time,
                color=color.read,
                depth=depth.images.read,
                depth_scale=depth.scale,
                faults={**depth.images.faults, **color.faults},
                pose_places=tuple(f"{poses.place} of frame {i}" for i in range(rows.n_frames)),
                intrinsics_size=options.intrinsics_size or lens.size,
                otherwise=poses.otherwise,
                farthest=depth.farthest,
            )
        )
        used += [poses.column, lens.column]
        files += [*color.files, *depth.images.files, *lens.files, *poses.files]
        stated = {"pose": poses.statement, "depth": depth.statement, "intrinsics": lens.statement, "time": statement}
        assumptions |= {prefix + key: text for key, text in stated.items()}
    return SourceRecording(
        cameras=tuple(cameras),
        robot=robot.robot,
        label_names={},
        assumptions={
            "episode": f"{name} of {info.fields.get('total_episodes', '?')}",
            **({"task": "; ".join(entry.tasks)} if entry.tasks else {}),
            "camera axes": options.axes + ("" if options.axes == "opencv" else "; turned to OpenCV's"),
            **assumptions,
            **robot.assumptions,
            **_not_read(rows, used),
        },
        files=tuple(dict.fromkeys(files)),
    )


def _not_read(rows: EpisodeRows, used: list[str]) -> dict[str, str]:
    """Observations that the dataset to be made has no place for."""
    columns = {column.split("[")[0] for column in used}
    lost = [name for name in rows.numeric if name.startswith("observation.") and name not in columns]
    return {"not read": listed(lost)} if lost else {}


def _table(info: Info, entry: EpisodeEntry) -> Path:
    """The table with the episode's rows."""
    if info.is_v2:
        return info.file("data_path", {"episode_chunk": info.chunk_of(entry.index), "episode_index": entry.index})
    chunk, file = (entry.fields.get(f"data/{name}") for name in ("chunk_index", "file_index"))
    if not isinstance(chunk, int) or not isinstance(file, int):
        raise BadData(entry.files[0], "data/chunk_index", expected="the place of the episode's rows", got="none")
    return info.file("data_path", {"chunk_index": chunk, "file_index": file})


def _time(rows: EpisodeRows) -> tuple[Float[ndarray, " t"], str]:
    """Seconds since the episode's beginning, by which frames are found in videos."""
    fps = rows.info.fps
    even = np.arange(rows.n_frames) / fps
    if not rows.has("timestamp"):
        return even, f"frame number / {fps:g} per second"
    time = rows.column("timestamp")[:, 0]
    if np.allclose(time - time[0], even, rtol=0, atol=EVEN) and abs(time[0]) < EVEN:
        return even, f"frame number / {fps:g} per second, which the column timestamp holds in float32"
    return time, "column timestamp, seconds"


def _recorded_time(
    rows: EpisodeRows, camera: CameraFeatures, time: Float[ndarray, " t"], statement: str
) -> tuple[Float[ndarray, " t"], str]:
    """Times as recorded, where `bask-data export lerobot` kept them beside LeRobot's even ones."""
    for column in (f"camera.{camera.name}.time", f"{RECORDED}time"):
        if rows.has(column):
            return rows.column(column)[:, 0], f"column {column}, seconds, as recorded"
    return time, statement
