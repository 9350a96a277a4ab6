"""Datasets with every artifact a report can show, written from the truth of an analytic scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bask_data.core.geometry import invert_rigid, pixel_grid, project, transform, unproject
from bask_data.core.tsdf import Mesh
from bask_data.dataset import Dataset
from bask_data.kinds import (
    Correspondences,
    Demonstration,
    DescriptorNet,
    InstanceRow,
    KeypointTrack,
    ObjectInstances,
    PairRow,
    Pick,
    Recognition,
    Reconstruction,
    ReferenceKeypoints,
    Scan,
    Truth,
    VisibleMasks,
)
from bask_data.kinds.objects import NeighbourRow, PlaneRow
from bask_data.kinds.reconstruction import FrameRow, Quality, UnmeasuredRegion
from tests.datasets import publish_artifact, publish_recording
from tests.scenes import Box, Scene, View, intrinsics, orbit

HEIGHT, WIDTH = 96, 128
LABELS = (48, 132)
"""The true labels of the scene's objects, in order; their instances are 1 and 2."""
OFFSET = 0.01
"""Metres by which every tracked keypoint is wrong."""


@dataclass(frozen=True)
class Views:
    """Frames of one arrangement of the boxes."""

    K: np.ndarray
    world_from_cameras: np.ndarray
    world_from_boxes: list[np.ndarray]
    views: list[View]

    def labels(self, i_frame: int) -> np.ndarray:
        return np.array([0, *LABELS], np.uint8)[self.views[i_frame].instance]


RECOGNITION = Recognition(error=0.0234, share_found=0.6, n_frames=5, scans=("scan-a",), is_ambiguous=True)
"""Of the second keypoint; the first has none."""


def make_views(angle: float, n_frames: int) -> Views:
    world_from_boxes = []
    for x, turn in ((-0.12, angle), (0.12, -angle)):
        world_from_box = np.eye(4)
        world_from_box[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
        world_from_box[:3, 3] = [x, 0.1 * angle, 0.06]
        world_from_boxes.append(world_from_box)
    boxes = [
        Box((0.05, 0.06, 0.06), world_from_boxes[0], (200, 80, 60)),
        Box((0.06, 0.04, 0.06), world_from_boxes[1], (60, 120, 200)),
    ]
    K, cameras = intrinsics(HEIGHT, WIDTH), orbit(n_frames, n_turns=0.6)
    views = [Scene(tuple(boxes)).render(K, camera, HEIGHT, WIDTH) for camera in cameras]
    return Views(K, cameras, world_from_boxes, views)


def filled_dataset(
    root: Path, *, names: tuple[str, str] = ("corner", "side"), label_name: str = "tissue box", title: str = "filled"
) -> Dataset:
    """A scan, a demonstration with the boxes elsewhere, and everything between but a descriptor network.

    Args:
        names: of the two keypoints, one on each box.
    """
    dataset = Dataset.create(root, title, "CC0-1.0")
    scan, demonstration = make_views(0.3, 6), make_views(0.8, 5)
    for item, seen, kind in (("scan-a", scan, Scan), ("demo-a", demonstration, Demonstration)):
        publish_frames(dataset, item, seen, kind)
        publish_truth(dataset, item, seen, label_name)
    publish_scene(dataset, "scan-a", scan)
    publish_keypoints(dataset, scan, demonstration, list(names))
    return dataset


def publish_frames(dataset: Dataset, item: str, seen: Views, kind: type[Scan] | type[Demonstration] = Scan) -> None:
    publish_recording(
        dataset,
        item,
        rgb=[view.rgb for view in seen.views],
        depth=[view.depth for view in seen.views],
        K=seen.K,
        world_from_cameras=seen.world_from_cameras,
        kind=kind,
    )


def publish_truth(dataset: Dataset, item: str, seen: Views, label_name: str) -> None:
    publish_artifact(
        dataset,
        Truth,
        item,
        lambda out: Truth.write(
            out,
            {LABELS[0]: "stems", LABELS[1]: label_name},
            {"wrist": (len(seen.views), (HEIGHT, WIDTH), seen.labels)},
            {label: pose.tolist() for label, pose in zip(LABELS, seen.world_from_boxes, strict=True)},
            dict.fromkeys(LABELS, 0.004),
        ),
    )


def publish_scene(dataset: Dataset, item: str, seen: Views) -> None:
    vertices, triangles, vertex_instance, colors = frame_mesh(seen)
    publish_artifact(
        dataset,
        Reconstruction,
        item,
        lambda out: Reconstruction.write(
            out,
            Mesh(vertices, triangles, colors),
            voxel_size=0.004,
            bounds=(-1, -1, -0.1, 1, 1, 0.3),
            quality=Quality(
                frames=6,
                frames_of_distinct_views=6,
                frames_fused=5,
                frames_without_depth=1,
                frames_suspect=1,
                workspace="given",
                voxel_blocks=99,
                explained=0.9,
                residual=0.0001,
                residual_abs=0.0008,
                seen_from_behind=0.02,
            ),
            frames=[frame_row(i) for i in range(6)],
            unmeasured=[UnmeasuredRegion(centre=(0.1, 0.2, 0.03), size=(0.08, 0.06, 0.1), volume=2e-4)],
            warnings=["frame 4 of wrist was left out"],
        ),
    )
    rows = [
        InstanceRow(id=i, n_vertices=9, area_m2=0.01, centroid=(0, 0, 0), extents=(0.1, 0.12, 0.12)) for i in (1, 2)
    ]
    publish_artifact(
        dataset,
        ObjectInstances,
        item,
        lambda out: ObjectInstances.write(
            out,
            vertex_instance=vertex_instance,
            support_plane=np.array([0.0, 0, 1, 0]),
            instances=rows,
            warnings=["2 small clusters were dropped"],
            planes=[
                PlaneRow(role="support", plane=(0, 0, 1, 0), area_m2=0.5, noise_m=0.0007),
                PlaneRow(role="structure", plane=(1, 0, 0, -0.4), area_m2=0.1, noise_m=0.001),
            ],
            neighbours=[NeighbourRow(a=1, b=2, gap_m=0.011)],
        ),
    )
    publish_artifact(dataset, VisibleMasks, item, lambda out: _write_masks(out, seen))
    publish_artifact(dataset, Correspondences, item, lambda out: _write_matches(out, seen))


def frame_row(i_frame: int) -> FrameRow:
    """Frame 3 does not fit the others, frame 5 measured nothing."""
    bad, empty = i_frame == 3, i_frame == 5
    return FrameRow(
        camera="wrist",
        frame=i_frame,
        fused=not empty,
        suspect=bad,
        valid_depth=0.0 if empty else 0.9,
        n_judged=0 if empty else 900,
        explained=np.nan if empty else 0.2 if bad else 0.95,
        residual=np.nan if empty else 0.02 if bad else 0.0001,
        residual_abs=np.nan if empty else 0.03 if bad else 0.0008,
        from_behind=np.nan if empty else 0.01,
    )


def frame_mesh(seen: Views) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The surface one frame shows, a vertex a pixel: vertices, triangles, instance and colour of each vertex."""
    view = seen.views[-1]
    points = transform(
        seen.world_from_cameras[-1], unproject(pixel_grid(HEIGHT, WIDTH), view.depth.astype(float), seen.K)
    )
    corner = np.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH)
    a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, :-1], corner[1:, 1:]
    triangles = np.concatenate([np.stack([a, c, b], -1).reshape(-1, 3), np.stack([b, c, d], -1).reshape(-1, 3)])
    depth = view.depth.ravel()[triangles]
    triangles = triangles[(depth.min(axis=1) > 0) & (np.ptp(depth, axis=1) < 0.03)]
    return (
        points.reshape(-1, 3).astype(np.float32),
        triangles.astype(np.int32),
        view.instance.ravel().astype(np.int32),
        view.rgb.reshape(-1, 3),
    )


def _write_masks(out: Path, seen: Views) -> None:
    """The true masks, but for the last instance's lower half of the image, which is lost; the left third of the image
    was not measured."""
    with VisibleMasks.writer(out, 2) as writer:
        camera = writer.camera("wrist", len(seen.views), HEIGHT, WIDTH)
        for view in seen.views:
            instance = view.instance.copy()
            instance[HEIGHT // 2 :][instance[HEIGHT // 2 :] == 2] = 0
            measured = np.ones((HEIGHT, WIDTH), bool)
            measured[:, : WIDTH // 3] = False
            camera.append(instance, np.array([1.0, 0.5], np.float32), measured)


def _write_matches(out: Path, seen: Views) -> None:
    with Correspondences.writer(out) as writer:
        for a, b in ((0, 1), (0, 3), (2, 5)):
            v, u = np.nonzero(seen.views[a].instance > 0)
            u, v = u[::20], v[::20]
            uv = np.stack([u, v], axis=1).astype(float)
            points = transform(
                seen.world_from_cameras[a], unproject(uv, seen.views[a].depth[v, u].astype(float), seen.K)
            )
            other = project(transform(invert_rigid(seen.world_from_cameras[b]), points), seen.K)[0]
            columns = {"u_a": uv[:, 0], "v_a": uv[:, 1], "u_b": other[:, 0], "v_b": other[:, 1]}
            writer.append(
                PairRow(
                    camera_a="wrist",
                    frame_a=a,
                    camera_b="wrist",
                    frame_b=b,
                    n_attempts=len(u) + 124,
                    distance=0.1 * b,
                    angle=0.25 * b,
                ),
                {
                    "instance": seen.views[a].instance[v, u],
                    **{name: x.astype(np.float32) for name, x in columns.items()},
                },
                {(1, "hidden_in_b"): 100, (2, "hidden_in_b"): 7, (1, "outside_b"): 15, (2, "cycle"): 2},
            )


def picked(scan: Views, i_frame: int, instance: int) -> tuple[np.ndarray, np.ndarray]:
    """A pixel well inside an object and the point it shows."""
    v, u = np.nonzero(scan.views[i_frame].instance == instance)
    middle = np.argmin((u - u.mean()) ** 2 + (v - v.mean()) ** 2)
    uv = np.array([u[middle], v[middle]], float)
    depth = scan.views[i_frame].depth[v[middle], u[middle]].astype(float)
    return uv, transform(scan.world_from_cameras[i_frame], unproject(uv, np.array(depth), scan.K))


def true_places(scan: Views, demonstration: Views) -> np.ndarray:
    return np.array(
        [
            transform(
                demonstration.world_from_boxes[i] @ np.linalg.inv(scan.world_from_boxes[i]), picked(scan, 2, i + 1)[1]
            )
            for i in (0, 1)
        ]
    )


def publish_keypoints(dataset: Dataset, scan: Views, demonstration: Views, names: list[str]) -> None:
    picks = []
    for i, name in enumerate(names):
        uv, point = picked(scan, 2, i + 1)
        picks.append(
            Pick(
                name=name,
                recording="scan-a",
                camera="wrist",
                frame=2,
                u=uv[0],
                v=uv[1],
                instance=i + 1,
                point_world=tuple(point.tolist()),
                recognition=RECOGNITION if i else None,
            )
        )
    descriptors = np.eye(2, 8, dtype=np.float32)
    publish_artifact(
        dataset, ReferenceKeypoints, "", lambda out: ReferenceKeypoints.write(out, descriptors=descriptors, picks=picks)
    )
    places = true_places(scan, demonstration) + np.array([0, 0, OFFSET])
    publish_artifact(dataset, KeypointTrack, "demo-a", lambda out: _write_track(out, demonstration, names, places))


def _write_track(out: Path, seen: Views, names: list[str], places: np.ndarray) -> None:
    with KeypointTrack.writer(out, names=names, filter="particle", cameras=["wrist"]) as writer:
        for world_from_camera in seen.world_from_cameras:
            pixel = project(transform(invert_rigid(world_from_camera), places), seen.K)[0]
            writer.append(
                mean=places.astype(np.float32),
                covariance=np.tile(np.diag([1e-4, 1e-4, 2e-4]), (2, 1, 1)).astype(np.float32),
                mode=places.astype(np.float32),
                n_eff=np.full(2, 100, np.float32),
                log_evidence=np.zeros(2, np.float32),
                cameras={"wrist": (pixel.astype(np.float32), np.array([True, False]))},
            )


def publish_network(
    dataset: Dataset,
    loss_name: str = "loss",
    validated_on: str = "held-out frames of scan-a",
    variant: str = "main",
    seed: int = 0,
    chosen_by: str | None = "validation_pck_4",
) -> None:
    """A small descriptor network nobody trained, whose curve is made up."""
    import torch

    from bask_data.nn.network import DescriptorNetwork, NetworkSettings

    def fill(out: Path) -> None:
        curve = [(step, loss_name, 1.0 / (step + 1)) for step in range(100)]
        curve += [(step, "validation_pck_4", step / 100) for step in range(0, 100, 20)]
        DescriptorNet.write(
            out,
            validated_on=validated_on,
            metrics={"validation_pck_4": 0.8},
            curve=curve,
            step=80,
            chosen_by=chosen_by,
        )
        torch.manual_seed(seed)
        DescriptorNetwork(NetworkSettings("resnet18", descriptor_dim=8, height=32)).save(out)

    publish_artifact(dataset, DescriptorNet, "", fill, variant)
