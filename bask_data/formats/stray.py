"""Recordings of the app Stray Scanner: a video, depth and confidence images, and a table of poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.lens import Lens, one_if_same
from bask_data.errors import BadData
from bask_data.formats.clock import seconds
from bask_data.formats.depth_files import read_any_depth
from bask_data.formats.files import Folder, first_readable, numbers, read_lines, source_folder
from bask_data.formats.images import read_labels
from bask_data.formats.intrinsics import parse_intrinsics
from bask_data.formats.lenses import scaled_lens
from bask_data.formats.options.stray import StrayOptions
from bask_data.formats.poses import parse_transform
from bask_data.formats.recording import SourceCamera, SourceRecording
from bask_data.formats.video_frames import VideoFrames

COLUMNS = ("timestamp", "frame", "x", "y", "z", "qx", "qy", "qz", "qw")
"""Columns of odometry.csv that all versions of the app write, and their order where there is no header."""

INTRINSICS = ("fx", "fy", "cx", "cy")
"""Columns of newer versions."""


def read(source: Path, options: StrayOptions) -> SourceRecording:
    """The rows of odometry.csv, each with the frame of the video and the images of its number."""
    folder = source_folder(source, options.follow_links)
    table = _odometry(folder)
    video = _video(folder.member("rgb.mp4", "rgb.mp4"), table.number[-1] + 1)
    depth = _by_number(folder, "depth", (".png", ".npy"))
    confidence = _by_number(folder, "confidence", (".png",)) if folder.has("confidence") else {}
    in_video = _places_in_video(table, video)
    faults = _faults(source, table, depth, in_video)
    usable = [depth[number] for i, number in enumerate(table.number) if i not in faults]
    if not usable:
        raise faults[0]
    lens, intrinsics_files = _lens(folder, table, video.size)
    depth_size = first_readable(read_any_depth, usable).shape[:2]
    names = tuple(f"{number:06d}" for number in table.number)
    camera = SourceCamera(
        name=options.camera,
        frames=names,
        lens=lens,
        world_from_cameras=table.world_from_cameras,
        time=table.time,
        color=lambda i: video.color(in_video[i]),
        depth=lambda i: read_any_depth(depth[table.number[i]]),
        depth_scale=0.001,
        depth_lens=None if depth_size == video.size else scaled_lens(lens, depth_size),
        confidence=(lambda i: read_labels(_confidence(folder, confidence, table.number[i]))) if confidence else None,
        faults=faults,
        pose_places=tuple(f"{table.path}: frame {name}" for name in names),
    )
    assumptions = {
        "pose": "odometry.csv holds world_from_camera, metres, x y z w",
        "camera axes": "opencv: x right, y down, z forward; the app has turned ARKit's",
        "depth": "z-depth in millimetres, 0 = no measurement",
        "intrinsics": f"pinhole, of the video's picture, pixel (0, 0) a centre, {table.intrinsics_place}; for depth "
        "scaled by the ratio of the sizes",
        "time": table.clock,
        "video": f"{_surplus(video.n_frames, in_video)}; colours are lossy; the rotation for players is ignored, as "
        "intrinsics and depth are of the stored picture",
    }
    if confidence:
        assumptions["confidence levels"] = "0 low, 1 medium, 2 high: --confidence 1 keeps medium and high"
    return SourceRecording(
        (camera,),
        None,
        {},
        assumptions,
        (table.path, video.path, *intrinsics_files, *depth.values(), *confidence.values()),
    )


@dataclass(frozen=True)
class _Odometry:
    """The rows of odometry.csv.

    Args:
        number: of each row's frame: depth/000012.png is frame 12.
        K: (t, 3, 3) in pixels of the video; None in files of older versions.
    """

    path: Path
    number: tuple[int, ...]
    world_from_cameras: Float[ndarray, "t 4 4"]
    time: Float[ndarray, " t"]
    clock: str
    K: Float[ndarray, "t 3 3"] | None

    @property
    def intrinsics_place(self) -> str:
        """Where the intrinsics stand, in words."""
        return "from camera_matrix.csv" if self.K is None else "each frame's own, from odometry.csv"


def _odometry(folder: Folder) -> _Odometry:
    path = folder.member("odometry.csv", "odometry.csv")
    lines = read_lines(path)
    header = tuple(word.strip().lower() for word in lines[0].split(",")) if lines else ()
    if "timestamp" not in header:
        header = COLUMNS
    else:
        lines = lines[1:]
    missing = [name for name in COLUMNS if name not in header]
    if missing or not lines:
        got = f"no column {', '.join(missing)}" if missing else "no rows"
        raise BadData(path, "header", expected=", ".join(COLUMNS), got=got)
    rows = [_row(path, line, header) for line in lines]
    column = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    number = column["frame"]
    is_whole = ((number >= 0) & (number < 1e9) & (number == np.floor(number))).all()
    if not (is_whole and (np.diff(number) > 0).all()):
        fix = "sort the rows by frame, and remove those that repeat."
        raise BadData(path, "frame", expected="whole numbers that increase", got=str(number[:20].tolist()), fix=fix)
    poses = [parse_transform(f"{path}: frame {int(row['frame'])}", [row[name] for name in COLUMNS[2:]]) for row in rows]
    clock = seconds(column["timestamp"], path, option="")
    has_K = all(name in column and np.isfinite(column[name]).all() for name in INTRINSICS)
    K = None
    if has_K:
        K = np.tile(np.eye(3), (len(rows), 1, 1))
        K[:, [0, 1, 0, 1], [0, 1, 2, 2]] = np.stack([column[name] for name in INTRINSICS], axis=1)
    return _Odometry(path, tuple(int(n) for n in number), np.stack(poses), clock.time, clock.statement, K)


def _row(path: Path, line: str, header: Sequence[str]) -> dict[str, float]:
    """Values by column; NaN where a field is empty, as those of the distortion's centre may be."""
    words = [word.strip() for word in line.split(",")]
    if len(words) < len(COLUMNS) or len(words) > len(header):
        raise BadData(path, "row", expected=f"{len(header)} values", got=repr(line[:80]))
    values = [numbers(path, word) if word else [float("nan")] for word in words]
    if any(len(value) != 1 for value in values):
        raise BadData(path, "row", expected="one number in each column", got=repr(line[:80]))
    values += [[float("nan")]] * (len(header) - len(values))
    return {name: value for name, [value] in zip(header, values, strict=True)}


def _by_number(folder: Folder, name: str, suffixes: tuple[str, ...]) -> dict[int, Path]:
    files = folder.files_in(name, suffixes, name)
    wrong = [stem for stem in files if not (stem.isascii() and stem.isdecimal() and len(stem) < 10)]
    if wrong:
        raise BadData(folder.path / name, name, expected="files named by the number of their frame", got=wrong[0])
    return {int(stem): path for stem, path in files.items()}


def _video(path: Path, n_frames: int) -> VideoFrames:
    """The video with the frames that the rows are of.

    The app's first picture lies before the start that the video states to players, who hide it. It is the first row's,
    unless just the frames that players show are as many as the rows.
    """
    whole = VideoFrames(path, user="stray", whole=True)
    if whole.n_frames != n_frames:
        shown = VideoFrames(path, user="stray")
        if shown.n_frames == n_frames:
            return shown
    return whole


def _places_in_video(table: _Odometry, video: VideoFrames) -> dict[int, int]:
    """Place in the video of each row's frame, where there is one: its number, or the row if the video lacks frames of
    which there are no rows."""
    n_rows = len(table.number)
    if table.number[-1] >= video.n_frames == n_rows:
        return {i: i for i in range(n_rows)}
    return {i: number for i, number in enumerate(table.number) if number < video.n_frames}


def _surplus(n_frames: int, in_video: Mapping[int, int]) -> str:
    """Number of the video's frames, and of those without a row, which cannot be used."""
    n_surplus = n_frames - len(in_video)
    return f"{n_frames} frames" + (f", {n_surplus} of them without a row in odometry.csv left out" if n_surplus else "")


def _faults(
    source: Path, table: _Odometry, depth: Mapping[int, Path], in_video: Mapping[int, int]
) -> dict[int, BadData]:
    faults = {}
    for i, number in enumerate(table.number):
        lacks = [
            what for what, has in (("depth image", number in depth), ("frame in rgb.mp4", i in in_video)) if not has
        ]
        if lacks:
            faults[i] = BadData(
                source,
                f"frame {number:06d}",
                expected="a depth image and a frame in rgb.mp4 for every row of odometry.csv",
                got=f"no {' and no '.join(lacks)}",
                fix="pass --skip-bad to leave out the frames that lack something.",
            )
    return faults


def _lens(folder: Folder, table: _Odometry, size: tuple[int, int]) -> tuple[Lens, tuple[Path, ...]]:
    if table.K is not None:
        return Lens(one_if_same(table.K), size), ()
    K, files = parse_intrinsics(folder, "camera_matrix.csv")
    return Lens(K, size), files


def _confidence(folder: Folder, files: Mapping[int, Path], number: int) -> Path:
    if number not in files:
        place = folder.path / "confidence" / f"{number:06d}.png"
        fix = "leave out --confidence, or these frames by --frames."
        raise BadData(place, "confidence", expected="an image for every frame", got="none", fix=fix)
    return files[number]
