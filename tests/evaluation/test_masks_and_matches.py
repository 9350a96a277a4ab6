from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from bask_data.cli.app import app
from bask_data.core.geometry import invert_rigid, project, transform, unproject
from bask_data.dataset import Dataset
from bask_data.errors import BadData, UsageError
from bask_data.evaluation import evaluated_correspondences, evaluated_masks
from bask_data.kinds import Correspondences, PairRow, Truth, VisibleMasks
from bask_data.kinds.truth import ROBOT, TruthMetadata
from tests.datasets import publish_artifact, publish_recording
from tests.scenes import Plane, Scene, Sphere, intrinsics, look_at

HEIGHT, WIDTH = 40, 60
N_FRAMES = 2


def labels() -> np.ndarray:
    """A pot (1) with its lid (2) on, a cup (3), and the gripper."""
    image = np.zeros((HEIGHT, WIDTH), np.uint8)
    image[10:20, 5:25], image[20:30, 5:25], image[10:20, 40:50], image[30:34, 20:40] = 1, 2, 3, ROBOT
    return image


def publish_truth(dataset: Dataset, names: dict[int, str], touching: list[tuple[int, int]]) -> None:
    metadata = TruthMetadata(label_names=names, touching=touching)

    def fill(out: Path) -> None:
        with Truth.writer(out, metadata, np.zeros((N_FRAMES, 0, 4, 4))) as writer:
            camera = writer.camera("wrist", N_FRAMES, (HEIGHT, WIDTH), 1e-4)
            for _ in range(N_FRAMES):
                camera.append(labels(), np.ones((HEIGHT, WIDTH), np.uint16), np.eye(4))

    publish_artifact(dataset, Truth, "table", fill)


@pytest.fixture
def pot_with_lid(tmp_path: Path) -> Dataset:
    """A scan `table` with the ground truth of a pot and its lid, which touch, a cup and a gripper."""
    dataset = Dataset.create(tmp_path / "d")
    blank = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    publish_recording(
        dataset,
        "table",
        rgb=[blank] * N_FRAMES,
        depth=[np.ones((HEIGHT, WIDTH), np.float32)] * N_FRAMES,
        K=intrinsics(HEIGHT, WIDTH),
        world_from_cameras=np.stack([np.eye(4)] * N_FRAMES),
    )
    publish_truth(dataset, {1: "pot", 2: "lid", 3: "cup", ROBOT: "gripper"}, [(1, 2)])
    return dataset


def publish_masks(dataset: Dataset, instance: np.ndarray, n_instances: int) -> None:
    def fill(out: Path) -> None:
        with VisibleMasks.writer(out, n_instances) as writer:
            camera = writer.camera("wrist", N_FRAMES, HEIGHT, WIDTH)
            for _ in range(N_FRAMES):
                camera.append(instance, np.ones(n_instances, np.float32))

    publish_artifact(dataset, VisibleMasks, "table", fill)


def test_touching_objects_are_compared_with_one_instance(pot_with_lid: Dataset) -> None:
    instance = np.zeros((HEIGHT, WIDTH), np.uint8)
    instance[10:30, 5:25], instance[10:20, 40:48] = 2, 1
    publish_masks(pot_with_lid, instance, 2)
    found = evaluated_masks(pot_with_lid)
    pot, cup = found["scenes"]["table"]["objects"]
    assert (pot["names"], pot["instance"], pot["iou"]) == (("pot", "lid"), 2, 1.0)
    assert (cup["names"], cup["instance"], cup["iou"]) == (("cup",), 1, 0.8)
    assert found["all"] == {"counted": 1.0, "iou": 0.9, "worst": 0.8, "on_robot": 0.0}


def test_an_extra_instance_makes_the_count_incorrect(pot_with_lid: Dataset) -> None:
    publish_masks(pot_with_lid, np.minimum(labels(), 3), 3)
    assert evaluated_masks(pot_with_lid)["all"]["counted"] == 0.0


def test_mask_pixels_on_the_robot_are_counted(pot_with_lid: Dataset) -> None:
    instance = np.zeros((HEIGHT, WIDTH), np.uint8)
    instance[30:34, 0:40] = 1  # Half of it is on the gripper, which is no object.
    publish_masks(pot_with_lid, instance, 1)
    assert evaluated_masks(pot_with_lid)["all"]["on_robot"] == 0.5
    assert [one["names"] for one in evaluated_masks(pot_with_lid)["scenes"]["table"]["objects"]] == [
        ("pot", "lid"),
        ("cup",),
    ]


def test_a_scene_without_masks_is_an_error(pot_with_lid: Dataset) -> None:
    with pytest.raises(UsageError, match="expected a scene with ground truth and masks, got none"):
        evaluated_masks(pot_with_lid)
    with pytest.raises(UsageError, match="--only: expected one of table, got chair"):
        evaluated_masks(pot_with_lid, ["chair"])


def test_figures_are_plain_values(pot_with_lid: Dataset) -> None:
    publish_masks(pot_with_lid, np.zeros((HEIGHT, WIDTH), np.uint8), 0)
    found = json.loads(json.dumps(evaluated_masks(pot_with_lid)))
    assert found["all"] == {"counted": 0.0, "iou": 0.0, "worst": 0.0, "on_robot": None}


# Matches --------------------------------------------------------------------------------------------------------------

SCENE = Scene((Sphere((0.0, 0.0, 0.0), 0.1),), (Plane(),))
CAMERAS = np.stack([look_at((0.5, 0.0, 0.5)), look_at((0.3, 0.4, 0.5))])


@pytest.fixture
def ball(tmp_path: Path) -> Dataset:
    dataset, K = Dataset.create(tmp_path / "ball"), intrinsics(HEIGHT, WIDTH)
    views = [SCENE.render(K, camera, HEIGHT, WIDTH) for camera in CAMERAS]
    publish_recording(
        dataset,
        "ball",
        rgb=[view.rgb for view in views],
        depth=[view.depth for view in views],
        K=K,
        # The recording's own cameras are inaccurate, and must not be what matches are compared with.
        world_from_cameras=np.stack([np.eye(4)] * 2),
    )

    def fill(out: Path) -> None:
        metadata = TruthMetadata(label_names={1: "ball"})
        with Truth.writer(out, metadata, np.zeros((2, 0, 4, 4))) as writer:
            camera = writer.camera("wrist", 2, (HEIGHT, WIDTH), 1e-4)
            for view, world_from_camera in zip(views, CAMERAS, strict=True):
                camera.append(view.instance, np.round(view.depth * 1e4).astype(np.uint16), world_from_camera)

    publish_artifact(dataset, Truth, "ball", fill)
    return dataset


def publish_matches(dataset: Dataset, uv_a: np.ndarray, uv_b: np.ndarray) -> None:
    row = PairRow(
        camera_a="wrist", frame_a=0, camera_b="wrist", frame_b=1, n_attempts=len(uv_a), distance=0.4, angle=0.8
    )
    columns = {
        "instance": np.ones(len(uv_a), np.uint8),
        **{name: column.astype(np.float32) for name, column in zip(("u_a", "v_a"), uv_a.T, strict=True)},
        **{name: column.astype(np.float32) for name, column in zip(("u_b", "v_b"), uv_b.T, strict=True)},
    }

    def fill(out):
        with Correspondences.writer(out) as writer:
            writer.append(row, columns)

    publish_artifact(dataset, Correspondences, "ball", fill)


def test_matches_are_compared_with_exact_cameras(ball: Dataset) -> None:
    K = intrinsics(HEIGHT, WIDTH)
    view = SCENE.render(K, CAMERAS[0], HEIGHT, WIDTH)
    v, u = np.nonzero(view.instance)
    uv_a = np.stack([u, v], axis=1).astype(float)
    points = transform(CAMERAS[0], unproject(uv_a, view.depth[v, u].astype(float), K))
    uv_b, z = project(transform(invert_rigid(CAMERAS[1]), points), K)
    shown = SCENE.render(K, CAMERAS[1], HEIGHT, WIDTH)
    row, column = np.rint(uv_b[:, 1]).astype(int), np.rint(uv_b[:, 0]).astype(int)
    hidden = z > shown.depth[row, column] + 0.02
    assert 0 < hidden.sum() < len(hidden)
    uv_b[:: len(uv_b) - 1] += [1.5, 0.0]  # The first and the last are off by one and a half pixels.
    publish_matches(ball, uv_a, uv_b)
    figures = evaluated_correspondences(ball)["all"]
    assert figures["matches"] == len(uv_a)
    assert figures["within_1px"] == pytest.approx(1 - 2 / len(uv_a))
    assert figures["within_2px"] == 1.0
    assert figures["hidden"] == hidden.sum()


def test_labels_alone_are_no_ground_truth_for_matches(ball: Dataset) -> None:
    publish_matches(ball, np.zeros((0, 2)), np.zeros((0, 2)))
    assert evaluated_correspondences(ball)["all"]["median_px"] is None
    publish_artifact(
        ball,
        Truth,
        "ball",
        lambda out: Truth.write(
            out, {}, {"wrist": (2, (HEIGHT, WIDTH), lambda _: np.zeros((HEIGHT, WIDTH), np.uint8))}
        ),
    )
    with pytest.raises(
        BadData, match="depth: expected exact depth and cameras, got labels only.  fix: bask-data ingest sim OTHER_ROOT"
    ):
        evaluated_correspondences(ball)


def test_commands_print_figures_for_people_and_scripts(pot_with_lid: Dataset, ball: Dataset) -> None:
    publish_masks(pot_with_lid, np.minimum(labels(), 3), 3)
    shown = CliRunner().invoke(app, ["evaluate", "masks", str(pot_with_lid.root), "--json"])
    assert json.loads(shown.stdout) == {
        "command": "evaluate masks",
        **json.loads(json.dumps(evaluated_masks(pot_with_lid))),
    }
    assert "pot+lid" in CliRunner().invoke(app, ["evaluate", "masks", str(pot_with_lid.root)]).stdout
    missing = CliRunner().invoke(app, ["evaluate", "correspondences", str(ball.root)])
    assert missing.exit_code == UsageError.exit_code
    assert "expected a scene with ground truth and correspondences, got none.  fix: bask-data run" in missing.stderr
