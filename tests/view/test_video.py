from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from bask_data.cli.app import app
from bask_data.dataset import Dataset
from bask_data.drawing.colours import palette
from bask_data.errors import BaskError, UsageError, WouldOverwrite
from bask_data.kinds import Demonstration, KeypointTrack
from bask_data.view import video
from bask_data.view.video import LINE, VIDEO_WIDTH, write_videos
from tests.datasets import copied, publish_artifact

av = pytest.importorskip("av")


def frames_of(file: Path) -> tuple[list[np.ndarray], float]:
    with av.open(str(file)) as opened:
        rate = float(opened.streams.video[0].average_rate)
        return [frame.to_ndarray(format="rgb24") for frame in opened.decode(video=0)], rate


def is_near(picture: np.ndarray, centre: np.ndarray, colour: tuple[int, int, int], radius: float = 1.5) -> bool:
    """Whether all pixels of a disc have a colour, as nearly as a video keeps it."""
    v, u = np.mgrid[: picture.shape[0], : picture.shape[1]]
    disc = np.hypot(u - centre[0], v - centre[1]) <= radius
    return bool((np.abs(picture[disc].astype(int) - colour).max(axis=1) < 60).all())


def test_a_video_shows_each_frame_in_real_time_with_dots_for_visible_keypoints_and_rings_for_occluded_ones(
    filled: Dataset, tmp_path: Path
) -> None:
    files = write_videos(filled, tmp_path / "deep" / "v", ["scan-a", "demo-a"])
    assert files == {"demo-a": tmp_path / "deep" / "v" / "demo-a.mp4"}
    assert [one.name for one in files["demo-a"].parent.iterdir()] == ["demo-a.mp4"]
    pictures, rate = frames_of(files["demo-a"])
    track = KeypointTrack(filled.path(KeypointTrack, "demo-a"))
    camera = Demonstration(filled.path(Demonstration, "demo-a")).camera("wrist")
    assert (len(pictures), rate) == (5, 30.0)
    height = round(camera.height * VIDEO_WIDTH / camera.width)
    seen, hidden = palette(2)
    for i, picture in enumerate(pictures):
        assert picture.shape == (height + 2 * LINE, VIDEO_WIDTH, 3)
        factor = VIDEO_WIDTH / camera.width
        at = (track.pixel("wrist")[i] + 0.5) * factor - 0.5 + [0, LINE]
        assert is_near(picture, at[0], seen)
        assert not is_near(picture, at[1], hidden)
        ring = at[1] + 5.0 * np.array([np.cos(2.2), np.sin(2.2)])
        assert is_near(picture, ring, hidden, 0.8)


def test_every_nth_frame_keeps_the_time(filled: Dataset, tmp_path: Path) -> None:
    pictures, rate = frames_of(write_videos(filled, tmp_path, ["demo-a"], every=2)["demo-a"])
    assert (len(pictures), rate) == (3, 15.0)


def test_a_keypoint_out_of_view_is_a_triangle_at_the_edge(filled: Dataset, tmp_path: Path) -> None:
    dataset = copied(filled, tmp_path / "d")

    def fill(out: Path) -> None:
        with KeypointTrack.writer(out, names=["away"], filter="particle", cameras=["wrist"]) as writer:
            for _ in range(5):
                writer.append(
                    mean=np.zeros((1, 3), np.float32),
                    covariance=np.full((1, 3, 3), np.nan, np.float32),
                    mode=np.zeros((1, 3), np.float32),
                    n_eff=np.ones(1, np.float32),
                    log_evidence=np.ones(1, np.float32),
                    cameras={"wrist": (np.array([[500.0, 48.0]], np.float32), np.array([False]))},
                )

    publish_artifact(dataset, KeypointTrack, "demo-a", fill)
    pictures, _ = frames_of(write_videos(dataset, tmp_path, ["demo-a"])["demo-a"])
    [colour] = palette(1)
    assert is_near(pictures[2], np.array([VIDEO_WIDTH - 12, LINE + 48.5 * VIDEO_WIDTH / 128 - 0.5]), colour, 1.0)


def test_a_video_is_replaced_only_if_asked_to(filled: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    [file] = write_videos(filled, tmp_path, ["demo-a"]).values()
    before = file.read_bytes()
    with pytest.raises(WouldOverwrite, match=r"demo-a.mp4: expected no file, got one.  fix: --force replaces it"):
        write_videos(filled, tmp_path, ["demo-a"])
    assert write_videos(filled, tmp_path, ["demo-a"], force=True)["demo-a"].read_bytes() == before
    monkeypatch.setattr(video, "_picture", lambda *_: 1 / 0)
    with pytest.raises(Exception, match="division"):
        write_videos(filled, tmp_path, ["demo-a"], force=True)
    assert file.read_bytes() == before
    assert [one.name for one in tmp_path.iterdir()] == ["demo-a.mp4"]


def test_a_folder_that_cannot_be_written_is_an_error(filled: Dataset, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(BaskError, match="expected a writable folder and enough disk space, got .*Not a directory"):
        write_videos(filled, tmp_path / "file" / "v", ["demo-a"])
    answer = CliRunner().invoke(app, ["view", str(filled.root), "--video", "/proc/zz"])
    assert answer.exit_code == 1
    assert "/proc/zz: expected a writable folder and enough disk space" in " ".join(answer.stderr.split())


def test_without_a_track_there_is_no_video(filled: Dataset, tmp_path: Path) -> None:
    with pytest.raises(
        UsageError, match=r"--video: expected a demonstration with keypoints \(main\), got none of scan-a"
    ):
        write_videos(filled, tmp_path, ["scan-a"])


def test_the_command_writes_videos(filled: Dataset, tmp_path: Path) -> None:
    answer = CliRunner().invoke(app, ["view", str(filled.root), "--video", str(tmp_path), "--json"])
    assert answer.exit_code == 0, answer.stderr
    assert json.loads(answer.stdout)["videos"] == {"demo-a": str(tmp_path / "demo-a.mp4")}
    assert (tmp_path / "demo-a.mp4").exists()
