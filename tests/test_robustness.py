"""What goes wrong in a laboratory, from files on disk through the command line: each has an outcome one can act on."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import Result
from typer.testing import CliRunner

from bask_data.cli.app import app
from bask_data.kinds import Correspondences, ObjectInstances, Reconstruction, VisibleMasks
from tests.scenes import Box, Plane, Scene, intrinsics, look_at, noisy, orbit

HEIGHT, WIDTH, N_FRAMES = 120, 160, 12
K = intrinsics(HEIGHT, WIDTH)
UPRIGHT = np.eye(4)
BLOCK, OTHER = UPRIGHT.copy(), UPRIGHT.copy()
BLOCK[:3, 3], OTHER[:3, 3] = (-0.08, 0.0, 0.04), (0.1, 0.03, 0.03)
TABLE = Scene((Box((0.04, 0.03, 0.04), BLOCK), Box((0.03, 0.05, 0.03), OTHER)), (Plane(extent=0.45),))
RECONSTRUCT, CORRESPONDENCES = ("--voxel-size", "0.006"), ("--n-pairs", "20")


@dataclass
class Recording:
    """Frames about to be written; the tests spoil them first."""

    cameras: list[np.ndarray]
    rgb: list[np.ndarray]
    depth: list[np.ndarray]
    numbers: list[int] = field(default_factory=list)

    def write(self, folder: Path) -> Path:
        """As `frame-*.color.png`, `.depth.png` in units of 0.1 mm and `.pose.txt`."""
        folder.mkdir()
        for i in range(len(self.cameras)):
            number = self.numbers[i] if self.numbers else i
            stem = str(folder / f"frame-{number:06d}")
            assert cv2.imwrite(f"{stem}.color.png", self.rgb[i][..., ::-1])
            assert cv2.imwrite(f"{stem}.depth.png", np.round(self.depth[i] * 1e4).astype(np.uint16))
            np.savetxt(f"{stem}.pose.txt", self.cameras[i])
        return folder


def recorded(scene: Scene = TABLE, cameras: np.ndarray | None = None) -> Recording:
    rng = np.random.default_rng(0)
    cameras = orbit(N_FRAMES, radius=0.5) if cameras is None else cameras
    views = [scene.render(K, camera, HEIGHT, WIDTH) for camera in cameras]
    return Recording(
        [camera.copy() for camera in cameras],
        [view.rgb for view in views],
        [noisy(view.depth, 0.001, rng) for view in views],
    )


def cli(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(one) for one in arguments])


def ingested(recording: Recording, tmp_path: Path, name: str = "d") -> Result:
    return cli(
        *("ingest", "frames", recording.write(tmp_path / f"{name}-source"), tmp_path / name, "--scene", "a"),
        *("--depth-scale", "0.0001", "--intrinsics", f"{K[0, 0]},{K[1, 1]},{K[0, 2]},{K[1, 2]}"),
    )


def made(recording: Recording, tmp_path: Path, name: str = "d") -> dict[str, list[str]]:
    """All stages up to correspondences; the notes printed by each."""
    assert ingested(recording, tmp_path, name).exit_code == 0
    notes = {}
    for stage, *options in (
        ("reconstruct", *RECONSTRUCT),
        ("objects",),
        ("masks",),
        ("correspondences", *CORRESPONDENCES),
    ):
        ended = cli(stage, tmp_path / name, *options)
        assert ended.exit_code == 0, ended.stderr
        notes[stage] = [line.split(": ", 2)[2] for line in ended.stderr.splitlines() if line.startswith("  note: ")]
    validated = cli("validate", tmp_path / name)
    assert validated.exit_code == 0, validated.stderr
    return notes


def mesh_of(root: Path) -> Reconstruction:
    return Reconstruction(root / "reconstruction" / "a")


def ious(root: Path, scene: Scene, cameras: list[np.ndarray]) -> np.ndarray:
    """(k,) IoU of each object's masks over all frames with its exact visible mask, best instance each."""
    masks = VisibleMasks(root / "masks" / "a").camera("camera")
    exact = np.stack([scene.render(K, camera, HEIGHT, WIDTH).instance for camera in cameras])
    found = np.stack([masks.instance(i) for i in range(len(cameras))])
    return np.array(
        [
            max(
                ((exact == k) & (found == j)).sum() / ((exact == k) | (found == j)).sum()
                for j in range(1, max(int(found.max()), 1) + 1)
            )
            for k in range(1, scene.n_objects + 1)
        ]
    )


def test_a_good_recording_gives_masks_and_matches_and_no_word_of_warning_from_the_surface(tmp_path: Path) -> None:
    recording = recorded()
    notes = made(recording, tmp_path)
    assert notes["reconstruct"] == []
    assert len(ObjectInstances(tmp_path / "d" / "objects" / "a").instances) == 2
    assert (ious(tmp_path / "d", TABLE, recording.cameras) > 0.85).all()
    assert Correspondences(tmp_path / "d" / "correspondences" / "a").metadata.n_matches > 100


def test_a_pose_that_is_no_number_is_refused_by_file(tmp_path: Path) -> None:
    recording = recorded()
    recording.cameras[4][0, 3] = np.nan
    ended = ingested(recording, tmp_path)
    assert ended.exit_code == 4
    assert "frame-000004.pose.txt" in ended.stderr
    assert "a value that is not finite" in ended.stderr
    assert not (tmp_path / "d").exists(), "nothing half made is left"


def test_a_frame_recorded_twice_changes_next_to_nothing(tmp_path: Path) -> None:
    once, twice = recorded(), recorded()
    for frames in (twice.cameras, twice.rgb, twice.depth):
        frames.insert(5, frames[5])
    made(once, tmp_path, "once")
    notes = made(twice, tmp_path, "twice")
    assert notes["reconstruct"] == []
    assert mesh_of(tmp_path / "twice").metadata.quality.frames_fused == N_FRAMES + 1
    one, other = (mesh_of(tmp_path / name).vertices.astype(float) for name in ("once", "twice"))
    assert abs(len(one) - len(other)) < 0.02 * len(one)
    assert np.median(TABLE.surface_distance(other)) < 1.1 * np.median(TABLE.surface_distance(one)) + 1e-4
    pairs = Correspondences(tmp_path / "twice" / "correspondences" / "a").pairs().to_pydict()
    assert (5, 6) not in set(zip(pairs["frame_a"], pairs["frame_b"], strict=True)), "a pair without a view change"


def test_a_frame_without_depth_is_counted_named_and_skipped(tmp_path: Path) -> None:
    recording = recorded()
    recording.depth[7] = np.zeros_like(recording.depth[7])
    notes = made(recording, tmp_path)
    assert notes["reconstruct"] == ["1 of 12 frames have no depth between 0.15 and 4 m and were skipped: camera 7."]
    assert mesh_of(tmp_path / "d").metadata.quality.frames_fused == N_FRAMES - 1
    assert len(ObjectInstances(tmp_path / "d" / "objects" / "a").instances) == 2


@pytest.mark.parametrize("i_bad", [0, 6])
def test_a_frame_with_a_pose_10_cm_off_is_named_and_left_out(tmp_path: Path, i_bad: int) -> None:
    recording = recorded()
    true_cameras = [camera.copy() for camera in recording.cameras]
    recording.cameras[i_bad][:3, 3] += 0.1 * np.array([0.0, 0.6, 0.8])
    [warning] = made(recording, tmp_path)["reconstruct"]
    assert "1 of 12 frames disagree with the others, which have 9" in warning
    assert f"camera {i_bad} (" in warning
    assert "They were left out of the mesh" in warning
    assert np.median(TABLE.surface_distance(mesh_of(tmp_path / "d").vertices.astype(float))) < 0.001
    good = [i for i in range(N_FRAMES) if i != i_bad]
    masks = VisibleMasks(tmp_path / "d" / "masks" / "a").camera("camera")
    exact = np.stack([TABLE.render(K, true_cameras[i], HEIGHT, WIDTH).instance > 0 for i in good])
    found = np.stack([masks.instance(i) > 0 for i in good])
    assert (exact & found).sum() / (exact | found).sum() > 0.85, "the other frames' masks do not suffer"


def test_colour_of_another_size_than_depth_is_refused(tmp_path: Path) -> None:
    recording = recorded()
    recording.rgb[3] = cv2.resize(recording.rgb[3], (2 * WIDTH, 2 * HEIGHT))
    ended = ingested(recording, tmp_path)
    assert ended.exit_code == 4
    assert "frame-000003.color.png: size: expected 160 x 120" in ended.stderr
    assert "got 320 x 240" in ended.stderr


def test_colour_of_16_bits_is_refused(tmp_path: Path) -> None:
    recording = recorded()
    recording.rgb[2] = recording.rgb[2].astype(np.uint16) * 257
    ended = ingested(recording, tmp_path)
    assert ended.exit_code == 4
    assert "frame-000002.color.png: colour: expected 8 bits per channel, got 16" in ended.stderr
    assert "fix: convert the image to 8 bits per channel." in ended.stderr


def test_a_bare_table_gives_empty_masks_and_says_so(tmp_path: Path) -> None:
    notes = made(recorded(Scene((), (Plane(extent=0.45),))), tmp_path)
    assert ObjectInstances(tmp_path / "d" / "objects" / "a").instances == []
    assert any("no object was found" in note for note in notes["objects"])
    masks = VisibleMasks(tmp_path / "d" / "masks" / "a")
    assert masks.n_instances == 0
    assert not any(masks.camera("camera").instance(i).any() for i in range(N_FRAMES))
    assert Correspondences(tmp_path / "d" / "correspondences" / "a").metadata.n_matches == 0
    assert notes["correspondences"], "that there are no matches is said"


def close_views(target: tuple[float, float, float], n: int = N_FRAMES) -> np.ndarray:
    """Cameras so near to the target that it fills their images."""
    angles = np.linspace(-0.6, 0.6, n)
    return np.stack(
        [look_at((target[0] + 0.25 * np.sin(a), target[1] - 0.1, target[2] + 0.25 * np.cos(a)), target) for a in angles]
    )


@pytest.mark.parametrize("support", ["plane", "none"])
def test_an_object_that_fills_the_view_is_no_crash_and_with_no_support_it_is_one_object(
    tmp_path: Path, support: str
) -> None:
    box = UPRIGHT.copy()
    box[:3, 3] = (0.0, 0.0, 0.15)
    scene = Scene((Box((1.0, 1.0, 0.15), box),), (Plane(),))
    recording = recorded(scene, close_views((0.0, 0.0, 0.3)))
    assert all((scene.render(K, camera, HEIGHT, WIDTH).instance == 1).all() for camera in recording.cameras)
    assert ingested(recording, tmp_path).exit_code == 0
    root = tmp_path / "d"
    assert cli("reconstruct", root, *RECONSTRUCT).exit_code == 0
    ended = cli("objects", root, "--support", support, "--max-extent", "3", "--json")
    assert ended.exit_code == 0, ended.stderr
    assert json.loads(ended.stdout)["outcomes"][0]["status"] == "made"
    assert cli("masks", root).exit_code == 0
    masks = VisibleMasks(root / "masks" / "a")
    covered = np.mean([(masks.camera("camera").instance(i) > 0).mean() for i in range(N_FRAMES)])
    if support == "none":
        assert masks.n_instances == 1
        assert covered > 0.9
    else:  # Its top is the only plane there is, and taken for the table: that is said.
        assert covered == 0
        assert "no object was found" in ended.stderr
    ended = cli("correspondences", root, *CORRESPONDENCES)
    assert ended.exit_code == 0, ended.stderr
    found = Correspondences(root / "correspondences" / "a").metadata
    assert (found.n_matches > 100) == (support == "none")
    assert bool(found.warnings) == (support == "plane")


SPOILED: dict[str, Callable[[Recording], None]] = {
    "all frames blind": lambda recording: recording.depth.__setitem__(
        slice(None), [np.zeros_like(image) for image in recording.depth]
    ),
    "far away": lambda recording: recording.depth.__setitem__(
        slice(None), [np.where(image > 0, np.float32(6.0), image) for image in recording.depth]
    ),
}


@pytest.mark.parametrize("how", SPOILED)
def test_a_recording_without_any_depth_to_fuse_is_refused_with_a_remedy(tmp_path: Path, how: str) -> None:
    recording = recorded()
    SPOILED[how](recording)
    ended = ingested(recording, tmp_path)
    if ended.exit_code == 0:
        ended = cli("reconstruct", tmp_path / "d", *RECONSTRUCT)
    assert ended.exit_code == 4, ended.stderr
    assert "fix: " in ended.stderr
    assert "depth" in ended.stderr


def test_a_frame_with_a_speck_of_depth_is_fused_around(tmp_path: Path) -> None:
    recording = recorded()
    speck = np.zeros_like(recording.depth[5])
    speck[61:64, 61:64] = recording.depth[5][61:64, 61:64]  # Open3D looks at every fourth pixel and sees nothing.
    recording.depth[5] = speck
    assert ingested(recording, tmp_path).exit_code == 0
    ended = cli("reconstruct", tmp_path / "d", *RECONSTRUCT)
    assert ended.exit_code == 0, ended.stderr


def test_more_voxels_than_open3d_can_count_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bask_data.core.tsdf.MOST_BLOCKS", 500)
    assert ingested(recorded(), tmp_path).exit_code == 0
    ended = cli("reconstruct", tmp_path / "d", *RECONSTRUCT)
    assert ended.exit_code == 2
    assert "voxel_size: expected at most 500 voxel blocks, which is what Open3D can count, got about" in ended.stderr
    voxel_size = ended.stderr.split("fix: --voxel-size ")[1].split(",")[0]
    assert cli("reconstruct", tmp_path / "d", "--voxel-size", voxel_size).exit_code == 0


def test_leaving_out_every_frame_is_refused(tmp_path: Path) -> None:
    assert ingested(recorded(), tmp_path).exit_code == 0
    ended = cli("reconstruct", tmp_path / "d", "--exclude", f"camera:0-{N_FRAMES - 1}")
    assert ended.exit_code == 2
    assert "exclude: expected some frames left" in ended.stderr


def test_a_chunk_that_is_lost_is_no_frame_without_depth(tmp_path: Path) -> None:
    assert ingested(recorded(), tmp_path).exit_code == 0
    [chunk] = (tmp_path / "d" / "scan" / "a").glob("*/depth/c/0/0/0")
    chunk.unlink()
    ended = cli("reconstruct", tmp_path / "d", *RECONSTRUCT)
    assert ended.exit_code == 4
    assert "depth/c/0/0/0: expected the file, got none." in ended.stderr
    assert not (tmp_path / "d" / "reconstruction" / "a").exists()


def test_memory_is_given_in_words_one_knows(tmp_path: Path) -> None:
    assert ingested(recorded(), tmp_path).exit_code == 0
    ended = cli("reconstruct", tmp_path / "d", "--max-memory", "plenty")
    assert ended.exit_code == 2
    assert "max_memory: expected an amount of memory such as 4GB or 800MB" in ended.stderr
    assert cli("reconstruct", tmp_path / "d", *RECONSTRUCT, "--max-memory", "4gb").exit_code == 0


def test_a_report_is_not_written_over_a_folder(tmp_path: Path) -> None:
    assert ingested(recorded(), tmp_path).exit_code == 0
    before = sorted(tmp_path.iterdir())
    ended = cli("report", tmp_path / "d", "--out", tmp_path)
    assert ended.exit_code == 2
    assert "--out: expected a file to write, got a folder" in ended.stderr
    assert sorted(tmp_path.iterdir()) == before
