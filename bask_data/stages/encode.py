"""Keypoint tracks of a demonstration."""

from __future__ import annotations

import shutil
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import fields
from itertools import compress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from pydantic import Field, field_validator

from bask_data.core.filters.calibrated import calibrated_settings, likelihood_text
from bask_data.core.filters.table import DEFAULT, FILTERS, FilterSettings, SettingsName, filter_named
from bask_data.engine import Params, progress, stage
from bask_data.errors import BadData, UsageError
from bask_data.kinds import Camera, Demonstration, DescriptorNet, KeypointTrack, ReferenceKeypoints, Truth
from bask_data.kinds.reference import LARGEST_MEASURED
from bask_data.progress import note
from bask_data.spelling import number_of
from bask_data.stages.true_track import write_truth

if TYPE_CHECKING:
    import numpy as np

    from bask_data.core.calibration import Calibration
    from bask_data.kinds.keypoints import KeypointsWriter
    from bask_data.observing import Described, Moment
    from bask_data.tracker import KeypointTracker, TrackedKeypoints

    FilterName = str
else:
    FilterName = Literal[tuple(FILTERS)]

A = TypeVar("A")
B = TypeVar("B")

STATE = "state.safetensors"
"""State that an interrupted track is resumed from; no part of the artifact."""

MOST_CELLS = 4096
"""Most rows or columns of a belief: more than a usual image has."""

AHEAD = 2
"""Frames that are read ahead of the network, and described ahead of the filter: enough to keep all threads busy, few
enough for images of any size. Chosen, sensitivity not measured."""


def _is_none(value: object) -> bool:
    return value is None


class EncodeParams(Params):
    """Source of the keypoints, the filter and its settings.

    A field named like a setting of the filter is that setting; other filters ignore it. A field added for a further
    filter is None by default and excluded from the dump while it is (pydantic's `exclude_if`), so that the skip keys of
    tracks made without it stay the same.
    """

    source: Literal["network", "truth"] = Field(
        "network",
        description="network: found by descriptors. truth: ground truth of a simulator or of labels; no filter is "
        "used.",
    )
    cameras: tuple[str, ...] = Field((), description="Cameras to use. Default: all of the demonstration.")
    filter: FilterName = Field(
        DEFAULT, description=" ".join(f"{name}: {entry.help}" for name, entry in FILTERS.items())
    )
    settings: SettingsName = Field(
        "default",
        description="The filter's settings: our own, the paper's, or those of its authors' code. The "
        "options below take precedence.",
    )
    calibrated: bool = Field(
        True,
        exclude_if=lambda value: value is True,
        description="Take alpha and tau of each keypoint as `reference` measured them, if it could, for the default "
        "settings.",
    )
    alpha: float | None = Field(
        None,
        gt=0,
        le=LARGEST_MEASURED,
        description="Temperature: a pixel at descriptor distance z has likelihood exp(-alpha z). "
        "Default: as measured, else 4; particle: 2, because errors of successive frames are correlated; expectation: "
        "20, because with less the many pixels of background outweigh the match.",
    )
    tau: float | None = Field(
        None,
        gt=0,
        lt=1,
        description="Likelihood of an image if the keypoint is hidden or out of view. "
        "Default: as measured, else from each image, twice the likelihood of its average pixel.",
    )
    n_particles: int | None = Field(None, ge=10, description="Particles of each keypoint. Default: 2000.")
    tau_match: float | None = Field(
        None,
        ge=0,
        le=1,
        description="Particle: without tau, at least this share of the track's average match. Default: 0.03; 0.1 to "
        "0.25 is better for descriptors whose distances are all similar.",
    )
    walk: float | None = Field(
        None, ge=0, description="Particle: random walk in one frame and along each axis, metres. Default: 0.002."
    )
    walk_px: float | None = Field(
        None, ge=0, description="Discrete: random walk in one frame, pixels of the distance map. Default: 1."
    )
    grid: tuple[int, ...] = Field(
        (),
        description="Discrete: rows and columns of the belief, separated by a comma. Default: those of the distance "
        "map.",
    )
    gripper_probability: float | None = Field(
        None,
        ge=0,
        le=1,
        description="Probability that a keypoint near the gripper moves with it. Default: 0.2; discrete: 0.35.",
    )
    gripper_reach: float | None = Field(
        None,
        ge=0,
        description="Particle, discrete: metres around the gripper that count as near it. Default: 0.15.",
    )
    dropout: float = Field(
        0.0,
        ge=0,
        lt=1,
        description="Probability that a camera's frame is ignored, to test how robust tracks are to missing frames.",
    )
    seed: int = Field(0, ge=0, description="Seed of the particle filter and of the dropout.")
    every: int | None = Field(
        None,
        ge=1,
        exclude_if=_is_none,
        description="Only every so many-th frame of a camera goes through the network, and counts twice; between them "
        "the belief follows the gripper. Cameras take turns. With 2, tracks at 20 frames a second had 1.02 times the "
        "error, 1.11 times on moving keypoints, and a ResNet took 0.56 times as long. Default: every frame.",
    )
    scale: float | None = Field(
        None,
        gt=0,
        le=1,
        exclude_if=_is_none,
        description="Height of the network's input, as a share of the one it was trained for. With 0.5, tracks had "
        "1.05 times the error, 1.10 times while visible, in half the time, with a ResNet in a third. Default: 1.",
    )

    @field_validator("grid")
    @classmethod
    def _has_rows_and_columns(cls, grid: tuple[int, ...]) -> tuple[int, ...]:
        if grid and (len(grid) != 2 or min(grid) < 1 or max(grid) > MOST_CELLS):
            raise ValueError(f"rows and columns, 1 to {MOST_CELLS} of each")
        return grid

    @property
    def savings(self) -> dict[str, Any]:
        """Arguments of `KeypointTracker` that save time."""
        return {"every": self.every or 1, "scale": self.scale or 1.0}

    def reads(self, kind: str) -> tuple[str, ...] | None:
        """Ground truth only if it is the source."""
        return () if kind == Truth.kind and self.source == "network" else None


@stage(makes=KeypointTrack, version=8, resumable=True)
def encode(
    demonstration: Demonstration,
    descriptor: DescriptorNet,
    reference: ReferenceKeypoints,
    truths: list[Truth],
    params: EncodeParams,
    out: Path,
) -> None:
    """Track the reference keypoints through a demonstration, in 3D.

    All cameras of the demonstration are used; frames with the same number belong together. Only a few frames are in
    memory at a time, and an interrupted track is resumed.
    """
    try:
        cameras = cameras_of(demonstration, params.cameras)
        if params.source == "truth":
            _clear(out)
            write_truth(demonstration, cameras, reference, {truth.path.name: truth for truth in truths}, out)
        else:
            _track(demonstration, cameras, descriptor, reference, params, out)
    except BaseException:
        if out.exists() and not (out / STATE).exists():
            _clear(out)
        raise


def cameras_of(demonstration: Demonstration, wanted: tuple[str, ...] = ()) -> list[Camera]:
    """The cameras by name, all or those wanted.

    Raises:
        UsageError: there is no such camera.
        BadData: they have different numbers of frames.
    """
    known = demonstration.camera_names
    for name in wanted:
        if name not in known:
            fix = "leave --cameras out to use all of them."
            raise UsageError(demonstration.path, "cameras", expected=f"some of {', '.join(known)}", got=name, fix=fix)
    cameras = [demonstration.camera(name) for name in known if not wanted or name in wanted]
    n_frames = cameras[0].n_frames
    for camera in cameras:
        if camera.n_frames != n_frames:
            raise BadData(
                demonstration.path,
                f"camera {camera.name}",
                expected=f"as many frames as camera {cameras[0].name} ({n_frames})",
                got=f"{camera.n_frames}",
                fix="ingest the cameras with frames that were taken together.",
            )
    return cameras


def settings_of(params: EncodeParams, calibration: Calibration | None = None) -> FilterSettings:
    """The settings of the chosen filter; those of the others are ignored.

    Args:
        calibration: of the reference keypoints, used by the default settings unless `params` say otherwise.
    """
    names = {field.name for field in fields(filter_named(params.filter).settings)}
    # An option that takes several values has none of them where it was not given.
    given = {name: None if value == () else value for name, value in params.model_dump().items() if name in names}
    return calibrated_settings(params.filter, calibration if params.calibrated else None, params.settings, **given)


def grippers_of(demonstration: Demonstration, n_frames: int) -> np.ndarray | None:
    """`world_from_gripper` (t, 4, 4) in each frame; None if it was not recorded.

    Raises:
        BadData: their number differs from the number of frames.
    """
    robot = demonstration.robot
    if robot is None or robot.world_from_gripper is None:
        return None
    if len(robot.world_from_gripper) != n_frames:
        raise BadData(
            demonstration.path,
            "robot/world_from_gripper",
            expected=f"one transform for each of the {n_frames} frames",
            got=f"{len(robot.world_from_gripper)}",
            fix="ingest the demonstration again.",
        )
    return robot.world_from_gripper


def dropped(n_frames: int, n_cameras: int, dropout: float, seed: int) -> np.ndarray:
    """Frames of each camera to ignore, (t, c) bool."""
    import numpy as np

    return np.random.default_rng((seed, 1)).random((n_frames, n_cameras)) < dropout


def _track(
    demonstration: Demonstration,
    cameras: list[Camera],
    descriptor: DescriptorNet,
    reference: ReferenceKeypoints,
    params: EncodeParams,
    out: Path,
) -> None:
    """Filter every frame and write the track."""
    from bask_data.tracker import KeypointTracker

    names, n_frames = [camera.name for camera in cameras], cameras[0].n_frames
    grippers = grippers_of(demonstration, n_frames)
    settings = settings_of(params, reference.calibration)
    tracker = KeypointTracker(descriptor, reference, settings, params.seed, cameras=names, **params.savings)
    note(likelihood_text(settings))
    begin = _resumed(tracker, out)
    shown = ~dropped(n_frames, len(cameras), params.dropout, params.seed)
    begun = time.monotonic()
    with KeypointTrack.writer(out, names=reference.names, filter=params.filter, cameras=names, n_kept=begin) as writer:

        def track(frame: tuple[Moment, Described]) -> None:
            moment, described = frame
            gripper = None if grippers is None else grippers[tracker.n_steps]
            if _append(writer, names, tracker.update(tracker.look(*moment, described), gripper)):
                tracker.save(out / STATE)

        # The network takes most of the time and has this thread to itself: a second thread reads ahead, a third one
        # filters. Both are closed here in any case: closed by the garbage collector, on a thread that they need, they
        # would deadlock.
        with (
            closing(_described(tracker, cameras, shown, begin)) as described,
            closing(_beside(track, described)) as tracked,
        ):
            for _ in progress(tracked, "tracking keypoints", n_frames - begin):
                pass
    (out / STATE).unlink(missing_ok=True)
    n_done, seconds = n_frames - begin, time.monotonic() - begun
    seen = f"{number_of(n_done, 'frame')} of {number_of(len(cameras), 'camera')}"
    note(f"{seen} in {seconds:.1f} s, {n_done / max(seconds, 1e-9):.1f} a second")


def _resumed(tracker: KeypointTracker, out: Path) -> int:
    """Number of frames that an interrupted attempt has tracked; everything else of it is removed."""
    try:
        if (out / STATE).exists():
            tracker.load(out / STATE)
    except BadData:
        tracker.reset()  # A damaged state costs time only.
    if tracker.n_steps:
        for part in (*out.glob("*.part"), *out.rglob("*.partial")):
            part.unlink()
    else:
        _clear(out)
    return tracker.n_steps


def _clear(out: Path) -> None:
    """Remove everything that an interrupted attempt left, if anything."""
    for left in out.iterdir() if out.exists() else ():
        shutil.rmtree(left) if left.is_dir() else left.unlink()


def _append(writer: KeypointsWriter, cameras: list[str], found: TrackedKeypoints) -> bool:
    """Write a frame; True if all frames so far are on disk."""
    return writer.append(
        mean=found.mean,
        covariance=found.covariance,
        mode=found.mode,
        n_eff=found.n_eff,
        log_evidence=found.log_evidence,
        cameras={name: (found.pixel[name], found.observed[name]) for name in cameras},
    )


def _described(
    tracker: KeypointTracker, cameras: list[Camera], shown: np.ndarray, begin: int
) -> Generator[tuple[Moment, Described], None, None]:
    """Images and descriptors of each frame from `begin` on, of the cameras that are not ignored."""
    from bask_data.observing import moment_of

    def read(i_frame: int) -> Moment:
        return moment_of(compress(cameras, shown[i_frame]), i_frame)

    with closing(_beside(read, range(begin, len(shown)))) as moments:
        for i_frame, moment in enumerate(moments, begin):
            yield moment, tracker.describe(moment.images, i_frame)


def _beside(function: Callable[[A], B], items: Iterable[A]) -> Generator[B, None, None]:
    """Results of a function for each item, in order, computed by a thread of its own, up to `AHEAD` items ahead of the
    consumer. It ends at the first exception."""
    waiting: deque[Future[B]] = deque()

    def in_turn(item: A, before: Future[B] | None) -> B:
        if before is not None:
            before.result()
        return function(item)

    with ThreadPoolExecutor(1, thread_name_prefix="encode") as pool:
        try:
            for item in items:
                waiting.append(pool.submit(in_turn, item, waiting[-1] if waiting else None))
                if len(waiting) > AHEAD:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
