"""Reading recordings in every format against decoding the same files by the libraries that the readers use.

`files`: the reader alone, colour and depth of every frame. `ingest`: all but writing, that is also the checks, the
agreement of depth between frames, and what becomes of depth and lens; most of it costs the same for any number of
frames. The plain way decodes colour and depth of every frame and does nothing with them: no conversion of colours, no
poses, no checks. Bar: readers take at most 1.3 times its time, a ratio of 0.77 here.

    python benchmarks/run.py readers                  times
    python benchmarks/bench_readers.py                peak memory at 60 and 240 frames, which must not grow
    python benchmarks/bench_readers.py FORMAT N       one format of N frames, for a profiler
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import av
import cv2
import h5py
import lzfse
import numpy as np
import OpenEXR
from rosbags.highlevel import AnyReader

from bask_data.formats import FORMATS, Format
from bask_data.formats.options.common import SourceOptions
from bask_data.formats.recognise import recognise
from tests.formats.views import Views, rendered
from tests.formats.written_sources import SOURCES, Written

N_FRAMES, N_MORE = 60, 240
HEIGHT, WIDTH = 480, 640
N_RENDERED = 12
"""Different images; further frames repeat them with their poses."""


def views(n: int) -> Views:
    """Frames of 640x480."""
    seen = rendered(N_RENDERED, HEIGHT, WIDTH)
    order = np.concatenate([np.arange(N_RENDERED), np.arange(N_RENDERED)[::-1]])[np.arange(n) % (2 * N_RENDERED)]
    time = seen.time[0] + np.arange(n) / 10
    return replace(seen, poses=seen.poses[order], color=seen.color[order], depth_mm=seen.depth_mm[order], time=time)


def cases() -> Iterator[tuple[str, Callable[[], object], Callable[[], object]]]:
    """One recording of 60 frames in each convention."""
    seen = views(N_FRAMES)
    for name, write in SOURCES.items():
        with tempfile.TemporaryDirectory(prefix="bask-benchmark-") as folder:
            written = write(Path(folder), seen)
            plain = partial(PLAIN[name], written.path)
            yield f"{name}, files of {N_FRAMES} frames", partial(read_files, written), plain
            yield f"{name}, ingest of {N_FRAMES} frames", partial(read_all, written), plain


def found(written: Written) -> tuple[Format, Path, SourceOptions]:
    """The format of a source, and how it is read."""
    [guess] = recognise(written.path).guesses
    format = next(format for format in FORMATS if format.name == guess.format)
    names = [word.removeprefix("--").replace("-", "_") for word in written.options[::2]]
    options = {**guess.options, **dict(zip(names, written.options[1::2], strict=True))}
    return format, guess.source, format.options.model_validate(options)


def read_files(written: Written) -> None:
    """Read every frame as the files hold it."""
    format, source, options = found(written)
    for camera in format.opened(source, options).cameras:
        for i in range(len(camera.frames)):
            camera.color(i)
            camera.depth(i)


def read_all(written: Written) -> None:
    """Read every frame as it is written to a dataset."""
    format, source, options = found(written)
    for camera in format.read(source, options).cameras:
        for i in range(camera.n_frames):
            camera.read(i)


def decode_images(folder: Path, *, color: str, depth: str) -> None:
    """Decode images by OpenCV, and other depth by the library of its format."""
    for path in sorted(folder.glob(color)):
        cv2.imread(str(path))
    for path in sorted(folder.glob(depth)):
        if path.suffix == ".npy":
            np.load(path)
        elif path.suffix == ".exr":
            OpenEXR.File(str(path)).channels()["Z"].pixels  # noqa: B018
        else:
            cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


def decode_record3d(path: Path) -> None:
    """Unpack and decode by zipfile, OpenCV and lzfse."""
    with zipfile.ZipFile(path) as archive:
        for name in archive.namelist():
            if name.endswith(".jpg"):
                cv2.imdecode(np.frombuffer(archive.read(name), np.uint8), cv2.IMREAD_COLOR)
            elif name.endswith(".depth"):
                np.frombuffer(lzfse.decompress(archive.read(name)), np.float32)


def decode_stray(folder: Path) -> None:
    """Decode the video by PyAV and depth by OpenCV."""
    with av.open(str(folder / "rgb.mp4")) as container:
        for frame in container.decode(video=0):
            frame.to_ndarray(format="rgb24")
    decode_images(folder, color="no", depth="depth/*.png")


def decode_hdf5(path: Path, color: str, depth: str) -> None:
    """Decode by h5py, all frames at once: each chunk is decoded once."""
    with h5py.File(path) as file:
        for name in (color, depth):
            file[name][:]


def decode_bag(path: Path) -> None:
    """Decode messages with images by rosbags."""
    with AnyReader([path]) as reader:
        images = [connection for connection in reader.connections if connection.msgtype == "sensor_msgs/msg/Image"]
        for connection, _, data in reader.messages(connections=images):
            message = reader.deserialize(data, connection.msgtype)
            message.data.reshape(message.height, -1)


PLAIN: dict[str, Callable[[Path], None]] = {
    "matrices": partial(decode_images, color="rgb/*.png", depth="depth/*.png"),
    "opengl_millimetres": partial(decode_images, color="*.color.png", depth="*.depth.png"),
    "quaternions_wxyz": partial(decode_images, color="images/*.png", depth="depths/*.png"),
    "open3d": partial(decode_images, color="color/*.png", depth="depth/*.npy"),
    "tum": partial(decode_images, color="rgb/*.png", depth="depth/*.png"),
    "scannet": partial(decode_images, color="color/*.jpg", depth="depth/*.png"),
    "arkitscenes": partial(decode_images, color="lowres_wide/*.png", depth="lowres_depth/*.png"),
    "bop": partial(decode_images, color="rgb/*.png", depth="depth/*.png"),
    "nerfstudio": partial(decode_images, color="images/*.png", depth="depth/*.exr"),
    "polycam": partial(decode_images, color="keyframes/images/*.png", depth="keyframes/depth/*.png"),
    "record3d": decode_record3d,
    "stray": decode_stray,
    "colmap": partial(decode_images, color="images/*.png", depth="depth/*.png"),
    "rosbag": decode_bag,
    "rlbench": partial(
        decode_images,
        color="variation0/episodes/episode0/wrist_rgb/*.png",
        depth="variation0/episodes/episode0/wrist_depth/*.png",
    ),
    "maniskill": partial(
        decode_hdf5,
        color="traj_0/obs/sensor_data/hand_camera/rgb",
        depth="traj_0/obs/sensor_data/hand_camera/depth",
    ),
    "robomimic": partial(
        decode_hdf5,
        color="data/demo_0/obs/robot0_eye_in_hand_image",
        depth="data/demo_0/obs/robot0_eye_in_hand_depth",
    ),
}


def peak_mb() -> int:
    """Most memory that this process has held, megabytes. `getrusage` would count that of its parent before `exec`."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:")) // 1024


def main() -> None:
    """Peak memory of reading each format, megabytes, in a process of its own."""
    if len(sys.argv) > 1:
        folder = Path(sys.argv[3]) if len(sys.argv) > 3 else Path(tempfile.mkdtemp(prefix="bask-benchmark-"))
        if len(sys.argv) > 3:
            read_all(Written(folder / sys.argv[4], sys.argv[5:]))
            print(peak_mb())
        else:
            read_all(SOURCES[sys.argv[1]](folder, views(int(sys.argv[2]))))
        return
    print(f"{'format':20} {N_FRAMES:>4} frames  {N_MORE:>4} frames   MB")
    seen = {n: views(n) for n in (N_FRAMES, N_MORE)}
    for name, write in SOURCES.items():
        peaks = []
        for n in (N_FRAMES, N_MORE):
            with tempfile.TemporaryDirectory(prefix="bask-benchmark-") as folder:
                written = write(Path(folder), seen[n])
                arguments = [name, str(n), folder, str(written.path.relative_to(folder)), *written.options]
                command = [sys.executable, __file__, *arguments]
                done = subprocess.run(command, capture_output=True, text=True, check=True)
                peaks.append(int(done.stdout.split()[-1]))
        print(f"{name:20} {peaks[0]:>11} {peaks[1]:>12}", flush=True)


if __name__ == "__main__":
    main()
