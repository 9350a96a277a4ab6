from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest

from bask_data.errors import BadData
from bask_data.formats.video_frames import VideoFrames
from tests.formats.videos import plain, write_video

STEP = 7
"""Difference in brightness from frame to frame."""


def video(path: Path) -> VideoFrames:
    return VideoFrames(path, user="stray")


def write_steps(path: Path, n: int = 30, **options: object) -> None:
    write_video(path, (plain(STEP * i) for i in range(n)), **options)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "codec", "options"),
    [
        ("frames_predicted_from_later_ones.mp4", "libx264", {"g": "8", "bf": "3"}),
        ("keyframes_only.mkv", "libx264", {"g": "1"}),
        ("open_groups.mp4", "libx265", {"x265-params": "keyint=8:open-gop=1:bframes=3:log-level=0"}),
    ],
)
def test_each_frame_is_found_by_its_number_in_any_order(
    tmp_path: Path, name: str, codec: str, options: dict[str, str]
) -> None:
    write_steps(tmp_path / name, codec=codec, options=options)
    frames = video(tmp_path / name)
    assert (frames.n_frames, frames.size, frames.bits) == (30, (48, 64), 8)
    assert np.allclose(frames.time, np.arange(30) / 30, atol=0.001)
    shuffled = np.random.default_rng(0).permutation(30).tolist()
    for i in [*range(30), *shuffled, 29, 29, 0, *range(0, 30, 9)]:
        assert abs(frames.color(i).mean() - STEP * i) < STEP / 2, i


def test_colours_follow_the_standard_and_range_that_the_file_states(tmp_path: Path) -> None:
    image = plain(0)
    image[:, :20], image[:, 20:40], image[:, 40:] = (200, 40, 30), (30, 180, 60), (20, 50, 210)
    for standard in ("ITU601", "ITU709"):
        for full_range in (False, True):
            path = tmp_path / f"{standard}{full_range}.mp4"
            write_video(path, [image], standard=standard, full_range=full_range, options={"crf": "1"})
            difference = video(path).color(0)[:, 10::20].astype(int) - image[:, 10::20]
            # Another standard or range differs by 10 to 40.
            assert np.abs(difference).max() <= 5, (standard, full_range)


def test_the_rotation_for_players_is_ignored(tmp_path: Path) -> None:
    image = plain(0)
    image[:24, :32] = 200
    write_video(tmp_path / "a.mp4", [image], rotation=-90)
    with av.open(str(tmp_path / "a.mp4")) as container:
        assert abs(next(container.decode(video=0)).rotation) == 90
    decoded = video(tmp_path / "a.mp4").color(0)
    assert decoded.shape == (48, 64, 3)
    assert decoded[:24, :32].mean() > 190
    assert decoded[24:].mean() < 10


@pytest.mark.parametrize(("pixels", "bits"), [("gray16le", 16), ("gray12le", 12), ("gray", 8), ("yuv420p10le", 10)])
def test_grey_values_come_as_they_are_stored(tmp_path: Path, pixels: str, bits: int) -> None:
    stored = np.random.default_rng(0).integers(0, 2**bits, (2, 48, 50), dtype=np.uint16)
    with av.open(str(tmp_path / "a.mkv"), "w") as container:
        stream = container.add_stream("ffv1", rate=30)
        stream.width, stream.height, stream.pix_fmt = 50, 48, pixels
        for image in stored:
            frame = av.VideoFrame(50, 48, pixels)
            plane = frame.planes[0]
            rows = np.zeros((48, plane.line_size // (1 if bits == 8 else 2)), np.uint8 if bits == 8 else "<u2")
            rows[:, :50] = image
            plane.update(rows.tobytes())
            for colour in frame.planes[1:]:
                colour.update(bytes(colour.buffer_size))
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    frames = video(tmp_path / "a.mkv")
    assert frames.bits == bits
    assert np.array_equal(frames.grey(1), stored[1])
    assert np.array_equal(frames.grey(0), stored[0])


def test_colour_without_a_plane_of_brightness_has_no_grey_values(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mkv", [plain(9)], codec="ffv1", pixels="bgr0", options={"level": "3"})
    with pytest.raises(BadData, match="pixels: expected brightness in a plane of its own, grey or YUV, got bgr0"):
        video(tmp_path / "a.mkv").grey(0)


def test_a_list_of_files_named_as_a_video_leads_nowhere(tmp_path: Path) -> None:
    write_steps(tmp_path / "secret.mp4", 2)
    (tmp_path / "rgb.mp4").write_text("ffconcat version 1.0\nfile secret.mp4\n")
    with pytest.raises(
        BadData, match=r"rgb\.mp4: video: expected a video in mp4, mov, mkv or webm, got [^/]*'rgb\.mp4'"
    ):
        video(tmp_path / "rgb.mp4")


def test_what_is_no_video_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.mp4").write_bytes(b"no video" * 100)
    with pytest.raises(BadData, match=r"a\.mp4: video: expected a video in mp4, mov, mkv or webm"):
        video(tmp_path / "a.mp4")
    with av.open(str(tmp_path / "sound.mp4"), "w") as container:
        stream = container.add_stream("aac", rate=8000)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
        frame.sample_rate = 8000
        container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    with pytest.raises(BadData, match="expected a video stream, got none in the file"):
        video(tmp_path / "sound.mp4")


def test_more_pixels_than_allowed_are_refused_by_the_header(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_steps(tmp_path / "a.mp4", 2)
    monkeypatch.setattr("bask_data.formats.video_frames.MAX_PIXELS", 48 * 64 - 1)
    with pytest.raises(BadData, match="size: expected 1 to 3071 pixels, got 64 x 48 in the header"):
        video(tmp_path / "a.mp4")


def test_a_frame_that_is_damaged_is_refused_and_those_of_other_groups_are_read(tmp_path: Path) -> None:
    path = tmp_path / "a.mkv"
    noise = np.random.default_rng(0).integers(0, 256, (8, 48, 64, 3), dtype=np.uint8)
    write_video(path, noise, codec="ffv1", pixels="yuv420p", options={"level": "3", "slicecrc": "1", "g": "1"})
    whole = [video(path).color(i) for i in range(8)]
    with av.open(str(path)) as container:
        third = [(packet.pos, packet.size) for packet in container.demux(video=0)][3]
    data = bytearray(path.read_bytes())
    data[third[0] + 20 : third[0] + third[1]] = bytes(third[1] - 20)
    path.write_bytes(data)
    frames = video(path)
    with pytest.raises(BadData, match=r"a\.mkv: video: expected frame 3"):
        frames.color(3)
    for i in (4, 2, 7, 0):
        assert np.array_equal(frames.color(i), whole[i])


def test_frames_of_another_size_than_the_header_are_refused(tmp_path: Path) -> None:
    # Each picture of Motion JPEG states its own size.
    motion_jpeg = {"codec": "mjpeg", "pixels": "yuv420p", "full_range": True, "options": {"qmin": "1"}}
    write_video(tmp_path / "small.mkv", [plain(9)], **motion_jpeg)  # type: ignore[arg-type]
    write_video(tmp_path / "large.mkv", [plain(9, (96, 128))], **motion_jpeg)  # type: ignore[arg-type]
    with av.open(str(tmp_path / "a.mkv"), "w") as container:
        stream = None
        for i, name in enumerate(("small.mkv", "large.mkv")):
            with av.open(str(tmp_path / name)) as part:
                stream = stream or container.add_stream_from_template(part.streams.video[0])
                for packet in part.demux(video=0):
                    if packet.size:
                        packet.stream, packet.pts, packet.dts = stream, 33 * i, 33 * i
                        container.mux(packet)
    frames = video(tmp_path / "a.mkv")
    assert frames.color(0).shape == (48, 64, 3)
    with pytest.raises(BadData, match="expected frame 1 of 64 x 48, got 128 x 96"):
        frames.color(1)


def test_a_frame_beyond_the_end_is_refused(tmp_path: Path) -> None:
    write_steps(tmp_path / "a.mp4", 3)
    with pytest.raises(BadData, match="frame 3: expected a frame below 3, got none"):
        video(tmp_path / "a.mp4").color(3)


def test_frames_that_players_do_not_show_are_counted_on_demand(tmp_path: Path) -> None:
    write_steps(tmp_path / "a.mp4", 6, first=-1, options={"bf": "0"})
    shown, whole = video(tmp_path / "a.mp4"), VideoFrames(tmp_path / "a.mp4", user="stray", whole=True)
    assert (shown.n_frames, whole.n_frames) == (5, 6)
    for i in (4, 0, 2):
        assert abs(shown.color(i).mean() - STEP * (i + 1)) < STEP / 2
        assert abs(whole.color(i).mean() - STEP * i) < STEP / 2
