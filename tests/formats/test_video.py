from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from bask_data.errors import BaskError, MissingDependency
from bask_data.formats.video import VideoWriter


def picture(i: int, size: tuple[int, int] = (48, 64)) -> np.ndarray:
    """A smooth picture that moves to the left and changes its hue with i."""
    v, u = np.mgrid[: size[0], : size[1]]
    channels = (2 * (u + i) % 256, 3 * v % 256, np.full_like(u, 40 * (i % 6)))
    return np.stack(channels, axis=-1).astype(np.uint8)


def append_all(writer: VideoWriter, images: Iterable[np.ndarray]) -> None:
    with writer as video:
        for image in images:
            video.append(image)


def write(path: Path, n_frames: int = 12, size: tuple[int, int] = (48, 64), **options: Any) -> bytes:
    writer = VideoWriter(path, **{"fps": 12.5, "size": size, **options})
    append_all(writer, (picture(i, size) for i in range(n_frames)))
    return path.read_bytes()


def read(path: Path) -> Iterator[Any]:
    with av.open(str(path)) as container:
        yield from container.decode(video=0)


def test_frames_are_read_back_in_order_with_their_times_and_colours(tmp_path: Path) -> None:
    write(tmp_path / "a.mp4")
    frames = list(read(tmp_path / "a.mp4"))
    assert [frame.time for frame in frames] == pytest.approx(np.arange(12) / 12.5)
    for i, frame in enumerate(frames):
        difference = frame.to_ndarray(format="rgb24").astype(int) - picture(i)
        assert np.abs(difference).mean() < 4
        # Colours decoded by another standard differ by ten or more.
        assert np.abs(difference.mean(axis=(0, 1))).max() < 3


def test_the_file_is_h264_in_mp4_and_begins_with_its_index(tmp_path: Path) -> None:
    data = write(tmp_path / "a.mp4")
    assert data.index(b"moov") < data.index(b"mdat")
    with av.open(str(tmp_path / "a.mp4")) as container:
        [stream] = container.streams
        assert (container.format.name.split(",")[1], stream.codec_context.name) == ("mp4", "h264")
        assert (stream.codec_context.pix_fmt, stream.codec_context.colorspace) == ("yuv420p", 6)


def test_the_same_frames_give_the_same_bytes(tmp_path: Path) -> None:
    assert write(tmp_path / "a.mp4") == write(tmp_path / "b.mp4")


def test_odd_sizes_are_made_even_by_repeating_the_edge(tmp_path: Path) -> None:
    write(tmp_path / "a.mp4", 2, (47, 63), quality=0)
    first, _ = read(tmp_path / "a.mp4")
    assert (first.height, first.width) == (48, 64)
    image = first.to_ndarray(format="rgb24").astype(int)
    assert np.abs(image[:47, :63] - picture(0, (47, 63))).mean() < 4
    assert np.abs(image[47] - image[46]).mean() < 3 and np.abs(image[:, 63] - image[:, 62]).mean() < 3


def test_keyframes_have_the_requested_distance(tmp_path: Path) -> None:
    write(tmp_path / "a.mp4", 7, keyframe_every=2)
    assert [frame.key_frame for frame in read(tmp_path / "a.mp4")] == [True, False] * 3 + [True]


def test_lower_quality_gives_a_smaller_file(tmp_path: Path) -> None:
    size = (192, 256)
    assert (
        len(write(tmp_path / "a.mp4", size=size, quality=40))
        < len(write(tmp_path / "b.mp4", size=size, quality=10)) / 2
    )


def test_an_interrupted_video_leaves_the_previous_file(tmp_path: Path) -> None:
    whole = write(tmp_path / "a.mp4")

    def interrupted() -> Iterator[np.ndarray]:
        yield picture(0)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        append_all(VideoWriter(tmp_path / "a.mp4", 10, (48, 64)), interrupted())
    assert [file.name for file in tmp_path.iterdir()] == ["a.mp4"]
    assert (tmp_path / "a.mp4").read_bytes() == whole


def test_a_frame_of_another_size_is_refused(tmp_path: Path) -> None:
    with (
        pytest.raises(ValueError, match=r"a frame of \(48, 65\) pixels in a video of \(48, 64\)"),
        VideoWriter(tmp_path / "a.mp4", 10, (48, 64)) as video,
    ):
        video.append(picture(0, (48, 65)))


def test_a_video_without_frames_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="a video without frames"), VideoWriter(tmp_path / "a.mp4", 10, (48, 64)):
        pass
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("fps", "size"), [(0.0, (48, 64)), (float("nan"), (48, 64)), (10.0, (0, 64))])
def test_a_video_without_rate_or_size_is_refused(tmp_path: Path, fps: float, size: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="a video of .* frames per second, .* pixels"):
        VideoWriter(tmp_path / "a.mp4", fps, size)


def test_without_pyav_the_command_that_installs_it_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(MissingDependency, match=r"expected PyAV, got none.  fix: pip install 'bask-data\[export\]'"):
        VideoWriter(tmp_path / "a.mp4", 10, (48, 64))


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="only Linux has a device that is always full")
def test_a_full_disk_is_reported(tmp_path: Path) -> None:
    video = VideoWriter(tmp_path / "a.mp4", 10, (48, 64))
    video._unfinished.symlink_to("/dev/full")
    with pytest.raises(BaskError, match="expected a writable file, got .*No space left on device"):
        append_all(video, map(picture, range(12)))
    assert list(tmp_path.iterdir()) == []
