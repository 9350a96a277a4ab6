"""Simulate: recordings of a simulated tabletop, each with exact ground truth."""

from __future__ import annotations

import re
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bask_data.artifact import digest_of
from bask_data.dataset import Dataset, Source
from bask_data.engine import Origin, Outcome, progress, scratches
from bask_data.errors import UsageError
from bask_data.kinds import CameraFrames, Demonstration, Robot, Scan, Truth
from bask_data.kinds.truth import TruthMetadata, TruthWriter
from bask_data.sim.options import CAMERAS, TASKS, CameraName, SimOptions
from bask_data.sources.recordings import is_current, published_recording, refuse_other_scope, undone_if_new, up_to_date
from bask_data.spelling import suggestion

if TYPE_CHECKING:
    import numpy as np
    import zarr

    from bask_data.sim.rendering import Renderer
    from bask_data.sim.take import Take
    from bask_data.sim.world import World

SIMULATE_VERSION = 2
"""To be raised when the same options give another result."""
FORMAT = "sim"
MAX_ATTEMPTS = 20
"""Failed attempts at a demonstration after which it is given up: so many in a row are a fault, not chance."""
_SCAN, _DEMONSTRATION = 0, 1
_ONLY_SCANS = {"frames", "gripper_in_view", "distance_spread", "finished"}
"""Options that affect scans only."""
_NOTHING_WHEN_UNSET = {"background_seed", "distance_spread", "finished"}
"""Options left out of keys at their defaults, so that recordings made before they existed stay up to date."""


@dataclass(frozen=True)
class Job:
    """A recording to make: the scan or demonstration with number `index` of a task and seed."""

    makes: type[Scan] | type[Demonstration]
    index: int
    options: SimOptions

    @property
    def item(self) -> str:
        """The recording's name in the dataset."""
        return f"{self.options.task}_{'scan' if self.makes is Scan else 'demo'}{self.index}"

    @property
    def params(self) -> dict[str, Any]:
        """Options that determine the content."""
        unused = _ONLY_SCANS if self.makes is Demonstration else set()
        fields = SimOptions.model_fields
        unused = unused | {name for name in _NOTHING_WHEN_UNSET if getattr(self.options, name) == fields[name].default}
        return {"index": self.index, **self.options.model_dump(mode="json", exclude=unused)}

    @cached_property
    def key(self) -> str:
        """Skip key: equal keys mean equal content."""
        return digest_of(
            {
                "kind": self.makes.kind,
                "schema": [self.makes.schema_version, Truth.schema_version],
                "stage": f"ingest {FORMAT}",
                "version": SIMULATE_VERSION,
                "params": self.params,
            }
        )

    @property
    def shows_finished(self) -> bool:
        """Whether the recording is a scan of the finished task; these are spread evenly over the scans."""
        share = self.options.finished
        return self.makes is Scan and int((self.index + 1) * share) > int(self.index * share)

    def seed(self, attempt: int = 0) -> list[int]:
        """Seed of the scene and motions; each attempt at a demonstration has another."""
        stream = _SCAN if self.makes is Scan else _DEMONSTRATION
        return [self.options.seed, TASKS.index(self.options.task), 10 + stream, self.index, attempt]


def simulate(
    root: Path,
    options: SimOptions,
    *,
    n_scans: int,
    n_demonstrations: int,
    only: Sequence[str] = (),
    force: bool = False,
) -> tuple[list[Outcome], int]:
    """Simulate recordings of a task in the dataset at `root`, which is created if it does not exist.

    All names are checked before anything is written.

    Args:
        only: names of the recordings to make, instead of the counts.

    Returns:
        Outcomes, and the number of failed attempts at demonstrations, which were repeated with other seeds.

    Raises:
        WouldOverwrite: a recording of that name exists with other content and `force` is not set.
        UsageError: no recording is requested, a name is invalid, or the objects do not fit the table.
    """
    jobs = _jobs(options, n_scans, n_demonstrations, only)
    fix = "choose another dataset, or pass --force."
    existing = Dataset.open_if_any(root)
    for job in jobs:
        refuse_other_scope(existing, job.makes, job.item)
    current = {job.item for job in jobs if not force and is_current(root, job.makes, job.item, job.key, fix, True)}
    outcomes, n_failed = [], 0
    with undone_if_new(root), _Studio(options) as studio:
        dataset = Dataset.open_or_create(root)
        dataset.recover()
        for job in jobs:
            if job.item not in current:
                made, n_retries = _record(dataset, job, studio)
                outcomes += made
                n_failed += n_retries
                continue
            # A kill between publishing and listing leaves a recording that is not in `dataset.json`.
            if job.item not in dataset.items(job.makes.scope):
                _enter(dataset, job)
            outcomes.append(up_to_date(root, job.makes, job.item))
    return outcomes, n_failed


def _jobs(options: SimOptions, n_scans: int, n_demonstrations: int, only: Sequence[str]) -> list[Job]:
    if not only:
        jobs = [Job(Scan, i, options) for i in range(n_scans)]
        jobs += [Job(Demonstration, i, options) for i in range(n_demonstrations)]
        if not jobs:
            raise UsageError(
                "ingest sim", expected="--scans or --demonstrations", got="neither", fix="for instance --scans 5"
            )
        return jobs
    jobs = []
    names = [f"{options.task}_scan0", f"{options.task}_demo0"]
    for name in dict.fromkeys(only):
        match = re.fullmatch(rf"{options.task}_(scan|demo)(\d{{1,6}})", name)
        if not match:
            raise UsageError(
                "ingest sim",
                "--only",
                expected=f"names like {options.task}_scan0, {options.task}_demo12",
                got=name,
                fix=suggestion(name, names) or f"for instance --only {','.join(names)}",
            )
        jobs.append(Job(Scan if match[1] == "scan" else Demonstration, int(match[2]), options))
    return jobs


def _enter(dataset: Dataset, job: Job) -> None:
    changed = job.options.model_dump(mode="json", exclude_defaults=True)
    dataset.add(job.makes.scope, job.item, Source(format=FORMAT, path="", options=changed, truth=True))


class _Studio:
    """The world and its renderer, created for the first recording."""

    def __init__(self, options: SimOptions) -> None:
        self._options = options

    @cached_property
    def world(self) -> World:
        from bask_data.sim.world import World

        return World(self._options)

    @cached_property
    def renderer(self) -> Renderer:
        from bask_data.sim.rendering import Renderer

        return Renderer(self.world)

    def __enter__(self) -> _Studio:
        return self

    def __exit__(self, *_: object) -> None:
        if "renderer" in self.__dict__:
            self.renderer.close()


def _record(dataset: Dataset, job: Job, studio: _Studio) -> tuple[list[Outcome], int]:
    """Simulate, render, publish and list one recording."""
    begun = time.perf_counter()
    take, n_failed = _take(job, studio)
    origin = Origin(f"ingest {FORMAT}", SIMULATE_VERSION, job.params, {}, job.key)
    with scratches(dataset.root, [Truth, job.makes]) as written:
        _write(written[job.makes], written[Truth], job, take, studio)
        outcomes = published_recording(dataset, job.item, written, origin, begun)
    _enter(dataset, job)
    return outcomes, n_failed


def _take(job: Job, studio: _Studio) -> tuple[Take, int]:
    """Motions of a recording, and the number of failed attempts before it."""
    import numpy as np

    from bask_data.sim.experts import demonstrate
    from bask_data.sim.scan import scan

    if job.makes is Scan and not job.shows_finished:
        return scan(studio.world, np.random.default_rng(job.seed())), 0
    for attempt in range(MAX_ATTEMPTS):
        rng = np.random.default_rng(job.seed(attempt))
        take = demonstrate(studio.world, rng)
        if take is None:
            continue
        if job.shows_finished:
            take = scan(studio.world, rng, replace(take.layout, qpos=take.qpos[-1]))
        return take, attempt
    raise UsageError(
        "ingest sim",
        job.item,
        expected=f"a demonstration that succeeds in {MAX_ATTEMPTS} attempts",
        got="none",
        fix="use less --clutter.",
    )


def _write(out: Path, out_truth: Path, job: Job, take: Take, studio: _Studio) -> None:
    """Render every camera's frames once: with defects for the recording, without for ground truth."""
    world, options = studio.world, job.options
    assumptions = {"source": f"simulated: {options.task}, seed {options.seed}", "defects": _defects(options)}
    arguments: dict[str, Any] = {} if take.robot is None else {"action_names": take.robot.action_names}
    group = job.makes.start(out, FORMAT, assumptions, **arguments)
    world.restore(take.layout)
    studio.renderer.shows_gripper = take.shows_gripper
    with Truth.writer(out_truth, _truth_metadata(job, take, world), take.world_from_objects) as truth:
        for name in options.cameras:
            _write_camera(group, truth, name, job, take, studio)
    if take.robot is not None:
        robot = take.robot
        Demonstration.write_robot(out, group, Robot(robot.world_from_gripper, robot.gripper_width, robot.action))


def _truth_metadata(job: Job, take: Take, world: World) -> TruthMetadata:
    labels = list(world.labels.values())
    metadata = TruthMetadata(label_names=world.label_names, object_labels=labels, touching=take.touching)
    if job.makes is Demonstration:
        return metadata
    poses = dict(zip(labels, take.world_from_objects[0].tolist(), strict=True))
    return metadata.model_copy(update={"world_from_object": poses, "pose_error": dict.fromkeys(labels, 0.0)})


def _write_camera(
    group: zarr.Group, truth: TruthWriter, name: CameraName, job: Job, take: Take, studio: _Studio
) -> None:
    import numpy as np

    from bask_data.sim.defects import DEPTH_SCALE, measured, noisy_poses, stored

    world, renderer, options = studio.world, studio.renderer, job.options
    size, K, seed = options.size(name), renderer.K(name), [*job.seed(), 50 + CAMERAS.index(name)]
    exact = truth.camera(name, len(take.qpos), size, DEPTH_SCALE)

    def read(i_frame: int) -> tuple[np.ndarray, np.ndarray]:
        world.show(take.qpos[i_frame])
        view = renderer.view(name)
        exact.append(view.instance, stored(view.depth), view.world_from_camera)
        return view.rgb, stored(measured(view, K, options, np.random.default_rng([*seed, i_frame])))

    world_from_cameras = noisy_poses(
        _poses(world, renderer, name, take), options.pose_noise, name == "overhead", np.random.default_rng([*seed])
    )
    job.makes.write_camera(
        group,
        name,
        CameraFrames(
            K=K, world_from_cameras=world_from_cameras, time=take.time, depth_scale=DEPTH_SCALE, size=size, read=read
        ),
        frames=lambda frames: progress(frames, f"{job.item}: rendering {name}"),
    )


def _poses(world: World, renderer: Renderer, camera: str, take: Take) -> np.ndarray:
    """Exact world_from_camera (t, 4, 4) at each frame."""
    import numpy as np

    poses = []
    for qpos in take.qpos:
        world.show(qpos)
        poses.append(renderer.world_from_camera(camera))
    return np.stack(poses)


def _defects(options: SimOptions) -> str:
    depth = f"{options.depth_noise:.1%} of depth and 1 mm" if options.depth_noise else "none"
    return (
        f"depth noise {depth}; flying pixels {options.flying:.1%} of edges; holes {options.holes:.1%} of pixels; "
        f"pose noise {options.pose_noise:g} x (2 mm, 0.2 degrees)"
    )
