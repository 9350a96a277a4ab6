"""Automatic choice of reference keypoints on the objects of a scan."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from bask_data.errors import BadData, UsageError
from bask_data.kinds import Camera, Pick, Scan, VisibleMasks
from bask_data.progress import Steps
from bask_data.stages.keypoint_quality import N_FRAMES, Pool, in_own_scan, search, view_of

if TYPE_CHECKING:
    import numpy as np
    import torch

    from bask_data.nn.network import DescriptorNetwork

N_VIEWS = 5
"""Frames of an object that candidates are taken from and searched in. Each costs a forward pass. Chosen, sensitivity
not measured."""

STEPS_OF_PASS = 8
"""Progress steps of the network's pass over a view, where a search in it is one: about their times with ResNet-18 on
apc_shelf. It affects the estimate of the time left only."""

STEPS_OF_OBJECT = 2 * N_VIEWS * STEPS_OF_PASS + N_VIEWS * (N_VIEWS - 1)
"""Progress steps of an object: views described, views that give candidates, and views that these are searched in."""

CANDIDATES_PER_FRAME = 120
"""Fewest candidates from each of these frames. Chosen, sensitivity not measured."""

N_POOL = 96
"""Candidates of an object that are searched in other scans: those found again most often in its own. Each costs some
milliseconds a frame. Chosen, sensitivity not measured."""

POOL_PER_KEYPOINT = 6
"""Fewest such candidates for each keypoint, so that there is a choice. Chosen, sensitivity not measured."""

MASK_BORDERS = (0.02, 0.01, 0.0)
"""Distances from a mask's edge, as shares of the image's height; the next is tried where an object is too slim. Chosen,
sensitivity not measured."""


@dataclass(frozen=True)
class Wanted:
    """What to choose.

    Args:
        n: number of keypoints, divided among the objects.
        instances: objects to put them on, by number; empty: all of the scene.
        seed: of the candidates.
    """

    n: int
    instances: tuple[int, ...] = ()
    seed: int = 0


@dataclass(frozen=True)
class _Candidates:
    """Candidate points of one object, one a row, and the frame of each."""

    frames: list[tuple[Camera, int]]
    i_frame: np.ndarray
    uv: np.ndarray
    points_world: np.ndarray
    descriptors: torch.Tensor

    def taken(self, rows: np.ndarray) -> _Candidates:
        """Some of them."""
        return _Candidates(
            self.frames, self.i_frame[rows], self.uv[rows], self.points_world[rows], self.descriptors[rows]
        )

    def pick(self, row: int, name: str, **more: Any) -> Pick:
        """A candidate as a pick of that name."""
        camera, i_frame = self.frames[self.i_frame[row]]
        (u, v), (x, y, z) = self.uv[row].tolist(), self.points_world[row].tolist()
        return Pick(name=name, camera=camera.name, frame=i_frame, u=u, v=v, point_world=(x, y, z), **more)


def chosen(
    wanted: Wanted,
    scene: str,
    scan: Scan,
    masks: VisibleMasks,
    network: DescriptorNetwork,
    others: Mapping[str, tuple[Scan, VisibleMasks]] | None = None,
) -> tuple[list[Pick], np.ndarray]:
    """Keypoints chosen automatically on the objects of a scan, and their descriptors (k, d).

    Args:
        others: further scans, by name, in which candidates are searched.
    """
    import numpy as np

    from bask_data.nn.selection import spread_out

    instances = _instances(wanted, scene, masks)
    # The first objects get one more where the number does not divide evenly.
    n_of = {i: wanted.n // len(instances) + (k < wanted.n % len(instances)) for k, i in enumerate(instances)}
    instances = tuple(i for i in instances if n_of[i])
    others = others or {}
    # An object takes seconds to minutes; smaller steps let a listener cancel the work soon.
    steps_of_scan = N_FRAMES * STEPS_OF_PASS
    steps = Steps("choosing keypoints", STEPS_OF_OBJECT * len(instances) + steps_of_scan * len(others))
    candidates, pools = [], []
    for order, instance in enumerate(instances):
        steps.reach(STEPS_OF_OBJECT * order)
        found, pool = _of_instance(instance, n_of[instance], scan, masks, network, seed=wanted.seed, steps=steps)
        candidates.append(found)
        pools.append(pool)
    steps.reach(STEPS_OF_OBJECT * len(instances))
    for _ in steps.over(search(pools, others, network, wanted.seed), steps_of_scan):
        pass
    steps.reach(STEPS_OF_OBJECT * len(instances) + steps_of_scan * len(others))
    picks, descriptors = [], []
    for instance, found, pool in zip(instances, candidates, pools, strict=True):
        rows = spread_out(found.points_world, -pool.ranks.astype(float), n_of[instance])
        for i, row in enumerate(rows):
            more = {"recording": scene, "instance": instance, "recognition": pool.recognition(int(row), scene)}
            picks.append(found.pick(int(row), f"object_{instance}_{i}", **more))
            descriptors.append(found.descriptors[row].cpu().numpy())
    return picks, np.stack(descriptors)


def _instances(wanted: Wanted, scene: str, masks: VisibleMasks) -> tuple[int, ...]:
    """The objects to put keypoints on; `UsageError` if they do not exist."""
    instances = wanted.instances or tuple(range(1, masks.n_instances + 1))
    unknown = [i for i in instances if not 1 <= i <= masks.n_instances]
    if unknown or not instances:
        if not masks.n_instances:
            fix = "leave --scene out to take the first that has objects."
            raise UsageError("reference", "scene", expected="one with objects", got=f"{scene}, without any", fix=fix)
        expected, fix = f"objects of {scene}, 1..{masks.n_instances}", "`bask-data view` shows their numbers."
        raise UsageError("reference", "instances", expected=expected, got=str(unknown), fix=fix)
    return instances


def _of_instance(
    instance: int, n: int, scan: Scan, masks: VisibleMasks, network: DescriptorNetwork, *, seed: int, steps: Steps
) -> tuple[_Candidates, Pool]:
    """The candidates on an object that its own scan finds again most often; at most `STEPS_OF_OBJECT` steps."""
    import numpy as np

    from bask_data.nn.selection import found_again

    frames = _best_frames(instance, scan, masks)
    views = [view_of(camera, i_frame, network, masks) for camera, i_frame in steps.over(frames, STEPS_OF_PASS)]
    for border in MASK_BORDERS:
        rng = np.random.default_rng((seed, instance))
        # A second border is an exception that the steps do not include.
        taken_from = steps.over(frames, STEPS_OF_PASS) if border == MASK_BORDERS[0] else frames
        candidates = _candidates(instance, taken_from, masks, network, border, max(CANDIDATES_PER_FRAME, 2 * n), rng)
        if len(candidates.uv) >= n:
            break
    else:
        raise BadData(
            masks.path,
            f"instance {instance}",
            expected=f"{n} pixels with measured depth",
            got=len(candidates.uv),
            fix="ask for fewer (--n) or for other --instances.",
        )
    share_found = np.zeros(len(candidates.uv))
    for i_view in range(len(frames)):
        mine = np.flatnonzero(candidates.i_frame == i_view)
        others = [view for i, view in enumerate(views) if i != i_view]
        if len(mine) and others:
            searched = steps.over(others)
            share_found[mine], _ = found_again(candidates.points_world[mine], candidates.descriptors[mine], searched)
    # Among those found equally often, which are many, chance decides, not the order of the frames.
    order = np.lexsort((rng.random(len(share_found)), -share_found))
    pooled = candidates.taken(order[: max(N_POOL, POOL_PER_KEYPOINT * n)])
    own, familiar = in_own_scan(pooled.points_world, pooled.descriptors, pooled.i_frame, views)
    return pooled, Pool(pooled.points_world, pooled.descriptors, own, familiar)


def _best_frames(instance: int, scan: Scan, masks: VisibleMasks) -> list[tuple[Camera, int]]:
    """Frames that show most of the object, by its visible pixels times its visible share."""
    import numpy as np

    scored = []
    for camera in scan.cameras:
        labels = masks.camera(camera.name)
        fraction = np.nan_to_num(labels.visible_fraction[:, instance - 1])
        # It is enough to count pixels in the few frames with the largest share.
        for i_frame in np.argsort(-fraction, kind="stable")[: 6 * N_VIEWS]:
            area = int((labels.instance(int(i_frame)) == instance).sum())
            scored.append((float(fraction[i_frame]) * area, camera, int(i_frame)))
    scored = sorted((frame for frame in scored if frame[0] > 0), key=lambda frame: -frame[0])
    # Every second of the best, so that not all are consecutive.
    best = scored[: 2 * N_VIEWS]
    return [(camera, i_frame) for _, camera, i_frame in (best[::2] if len(best) == 2 * N_VIEWS else best[:N_VIEWS])]


def _candidates(
    instance: int,
    frames: Iterable[tuple[Camera, int]],
    masks: VisibleMasks,
    network: DescriptorNetwork,
    border: float,
    n: int,
    rng: np.random.Generator,
) -> _Candidates:
    import numpy as np
    import torch

    from bask_data.nn.selection import inner_pixels

    seen, i_frames, pixels, points, descriptors = [], [], [np.empty((0, 2))], [np.empty((0, 3))], []
    for i, (camera, i_frame) in enumerate(frames):
        seen.append((camera, i_frame))
        depth = camera.depth(i_frame)
        mask = masks.camera(camera.name).instance(i_frame) == instance
        uv = inner_pixels(mask, depth, border * camera.height, n, rng)
        column, row = uv.astype(int).T
        i_frames += [i] * len(uv)
        pixels.append(uv)
        points.append(camera.points_world(i_frame, uv, depth[row, column]))
        descriptors.append(network.descriptors_at(camera.rgb(i_frame), uv.astype(np.float32)))
    joined = torch.cat(descriptors) if descriptors else torch.empty(0, network.settings.descriptor_dim)
    return _Candidates(seen, np.array(i_frames, int), np.concatenate(pixels), np.concatenate(points), joined)
