"""An episode's frames in a video that many episodes share, found by their times."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8, UInt16
from numpy import ndarray

from bask_data.core.time_pairs import nearest
from bask_data.errors import BadData
from bask_data.formats.lerobot.columns import EpisodeRows
from bask_data.formats.lerobot.episodes import EpisodeEntry
from bask_data.formats.lerobot.info import Feature
from bask_data.formats.video_frames import VideoFrames

SAME_TIME = 0.25
"""Share of the interval between frames by which a video's frame may be off the time in the table: half an interval is
the next frame's. LeRobot itself asks for 0.1 ms; videos of rounded rates are off by more. Sensitivity not measured."""


def of_video(rows: EpisodeRows, entry: EpisodeEntry, feature: Feature, time: Float[ndarray, " t"]) -> EpisodeVideo:
    """The frames of an episode in a video.

    Args:
        time: seconds of the frames since the episode's beginning.
    """
    path, begin = _place_in_video(rows, entry, feature.key)
    video = VideoFrames(path, user="ingest lerobot")
    numbers, faults = _matched(video, begin + time, rows.info.fps)
    return EpisodeVideo(video, numbers, faults)


def _place_in_video(rows: EpisodeRows, entry: EpisodeEntry, key: str) -> tuple[Path, float]:
    """The video file of an episode, and the seconds from its beginning to the episode's."""
    if rows.info.is_v2:
        values: dict[str, int | str] = {
            "video_key": key,
            "episode_chunk": rows.info.chunk_of(entry.index),
            "episode_index": entry.index,
        }
        return rows.info.file("video_path", values), 0.0
    chunk, file, begin = (
        entry.fields.get(f"videos/{key}/{name}") for name in ("chunk_index", "file_index", "from_timestamp")
    )
    if not isinstance(chunk, int) or not isinstance(file, int) or not isinstance(begin, float | int):
        raise BadData(
            entry.files[0],
            f"videos/{key}",
            expected="the place of the episode in a video",
            got="none",
            fix="read other cameras with --cameras, or copy meta/ completely.",
        )
    path = rows.info.file("video_path", {"video_key": key, "chunk_index": chunk, "file_index": file})
    return path, float(begin)


@dataclass(frozen=True)
class EpisodeVideo:
    """An episode's frames in a video file, by their numbers in it; -1 where the video has none."""

    video: VideoFrames
    numbers: ndarray
    faults: dict[int, BadData]

    def color(self, i: int) -> UInt8[ndarray, "h w 3"]:
        """RGB of a frame."""
        return self.video.color(self._number(i))

    def values(self, i: int) -> UInt16[ndarray, "h w"]:
        """Values of a frame of one channel."""
        return self.video.grey(self._number(i))

    def _number(self, i: int) -> int:
        if i in self.faults:
            raise self.faults[i]
        return int(self.numbers[i])


def _matched(video: VideoFrames, time: Float[ndarray, " t"], fps: float) -> tuple[ndarray, dict[int, BadData]]:
    """Number of the video's frame at each time, and why there is none."""
    stamps = video.time
    numbers = nearest(time, stamps, SAME_TIME / fps)
    faults = {}
    for i in np.flatnonzero(numbers < 0).tolist():
        faults[i] = BadData(
            video.path,
            f"frame {i} of the episode",
            expected=f"a frame at {time[i]:.4f} s",
            got=f"frames from {stamps[0]:.4f} to {stamps[-1]:.4f} s, and none so near",
            fix="copy videos/ again; --skip-bad leaves such frames out.",
        )
    return numbers, faults
