"""Refine: a scan with corrected poses beside the given one, and what was found of its poses."""

from __future__ import annotations

import shlex
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field

from bask_data.artifact import digest_of, read_manifest
from bask_data.dataset import Dataset, Source, check_name
from bask_data.engine import Origin, Outcome, progress, published, scratches
from bask_data.errors import UsageError
from bask_data.findings import Finding
from bask_data.kinds import (
    Camera,
    CameraFrames,
    Demonstration,
    PoseRefinement,
    Recording,
    RefinedCamera,
    ResidualRow,
    Scan,
)
from bask_data.params import Params
from bask_data.sources.recordings import is_current, refuse_other_scope, up_to_date

if TYPE_CHECKING:
    import numpy as np

    from bask_data.core.pose_refinement import Refinement, Residual

REFINE_VERSION = 1
"""To be raised when the same scan and options give another result."""


class RefineParams(Params):
    """Parameters of the refinement."""

    model: Literal["auto", "hand-eye", "drift"] = Field(
        "auto",
        description="hand-eye: one rigid correction of all poses of a camera; drift: a correction of each pose; auto: "
        "the simplest that held-out pairs of frames support.",
    )
    near: float = Field(0.15, ge=0, description="Depth below this is not used, metres: it is the robot's own gripper.")
    far: float = Field(4.0, gt=0, description="Depth above this is not used, metres.")


@dataclass(frozen=True)
class Refined:
    """What `refine` made and found of a recording.

    Args:
        written: name of the recording with corrected poses; empty if none was written.
    """

    outcomes: list[Outcome]
    written: str = ""
    cameras: list[RefinedCamera] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)


def refine(dataset: Dataset, scene: str, name: str, params: RefineParams, *, force: bool = False) -> Refined:
    """Look for errors in a scan's poses, and write a scan without them under another name.

    The scan is written only where held-out pairs of frames meet better.

    Args:
        name: of the scan with corrected poses.

    Raises:
        UsageError: a name is invalid, or belongs to a demonstration.
        WouldOverwrite: another recording has the name and `force` is not set.
    """
    if params.near >= params.far:
        raise UsageError("refine", "near", expected=f"less than far ({params.far} m)", got=f"{params.near} m")
    _check_target(dataset, Scan, scene, name)
    begun = time.perf_counter()
    scan = Scan(dataset.path(Scan, scene))
    origin = _origin(dataset, Scan, scene, PoseRefinement, params)
    target, fix = dataset.path(PoseRefinement, scene), "choose another --as, or pass --force."
    of_scan = _origin(dataset, Scan, scene, Scan, params)
    has_scan = not force and is_current(dataset.root, Scan, name, of_scan.key, fix, False)
    if not force and target.exists() and read_manifest(target).key == origin.key:
        present = PoseRefinement(target)
        if has_scan or not present.is_refined:
            outcome = up_to_date(dataset.root, PoseRefinement, scene)
            return _reported(dataset, scene, name, [outcome])
    found = {camera.name: _refined(camera, scene, params) for camera in scan.cameras}
    rows = [_row(camera, each) for camera, each in found.items()]
    poses = {camera: each.world_from_cameras for camera, each in found.items()}
    outcomes = []
    with scratches(dataset.root, [PoseRefinement, Scan]) as written:
        PoseRefinement.write(written[PoseRefinement], rows, poses)
        is_refined = any(row.verdict == "refined" for row in rows)
        if is_refined:
            _write_recording(written[Scan], Scan, scan, poses, {"poses": _words(scene, rows)})
        # The scan last: after a kill between the two, the next run writes it.
        outcomes.append(_published(dataset, PoseRefinement, scene, written[PoseRefinement], origin, begun))
        if is_refined:
            outcomes.append(_published(dataset, Scan, name, written[Scan], of_scan, begun))
    if is_refined:
        dataset.add("scene", name, Source(format="refine", path="", options={"scan": scene}))
    return _reported(dataset, scene, name, outcomes)


def apply(dataset: Dataset, scene: str, recording: str, name: str, *, force: bool = False) -> Refined:
    """Write a recording with the hand-eye correction that was found in a scan of the same rig.

    Raises:
        UsageError: no hand-eye correction was found in that scan, for a camera that the recording has.
    """
    makes = Scan if recording in dataset.items("scene") else Demonstration
    _check_target(dataset, makes, recording, name)
    place = dataset.path(PoseRefinement, scene)
    corrections = {} if not place.exists() else _hand_eye(PoseRefinement(place))
    given = makes(dataset.path(makes, recording))
    shared = [camera for camera in given.camera_names if camera in corrections]
    if not shared:
        got = ", ".join(corrections) or "none"
        fix = f"bask-data refine {shlex.quote(str(dataset.root))} {scene} --model hand-eye"
        expected = f"a hand-eye correction of {' or '.join(given.camera_names)}"
        raise UsageError("refine", f"--apply {scene}", expected=expected, got=got, fix=fix)
    begun = time.perf_counter()
    params = RefineParams.model_validate({})
    origin = _origin(dataset, makes, recording, makes, params, {"refinement": read_manifest(place).digest})
    if not force and is_current(dataset.root, makes, name, origin.key, "choose another --as, or pass --force.", False):
        return Refined([up_to_date(dataset.root, makes, name)], name)
    poses = {camera.name: camera.world_from_cameras for camera in given.cameras}
    poses |= {camera: poses[camera] @ corrections[camera] for camera in shared}
    with scratches(dataset.root, [makes]) as written:
        text = f"those of {recording}, {', '.join(shared)} with the hand-eye correction found in {scene}"
        _write_recording(written[makes], makes, given, poses, {"poses": text})
        outcome = _published(dataset, makes, name, written[makes], origin, begun)
    dataset.add(makes.scope, name, Source(format="refine", path="", options={"recording": recording, "apply": scene}))
    return Refined([outcome], name)


def _check_target(dataset: Dataset, makes: type[Recording], given: str, name: str) -> None:
    check_name(name, "refine", "--as")
    if name == given:
        raise UsageError("refine", "--as", expected="a new name", got=name, fix=f"for instance --as {given}-refined")
    refuse_other_scope(dataset, makes, name, "choose another --as.")
    dataset.select([given], makes.scope)


def _origin(
    dataset: Dataset,
    reads: type[Recording],
    item: str,
    makes: type[Any],
    params: RefineParams,
    more: dict[str, str] | None = None,
) -> Origin:
    inputs = {f"{reads.kind}/{item}": read_manifest(dataset.path(reads, item)).digest, **(more or {})}
    values = params.model_dump(mode="json")
    key = digest_of(
        {
            "kind": makes.kind,
            "schema": makes.schema_version,
            "stage": "refine",
            "version": REFINE_VERSION,
            "params": values,
            "inputs": inputs,
        }
    )
    return Origin("refine", REFINE_VERSION, values, inputs, key)


def _published(dataset: Dataset, makes: type[Any], item: str, scratch: Path, origin: Origin, begun: float) -> Outcome:
    target = dataset.path(makes, item)
    dataset.prepare(makes)
    manifest = published(dataset.root, target, scratch, artifact=makes, origin=origin, begun=begun)
    label, seconds = f"refine {makes.kind} {item}", time.perf_counter() - begun
    return Outcome(label, makes.kind, item, "main", str(target), "made", "", seconds, manifest.digest)


def _refined(camera: Camera, scene: str, params: RefineParams) -> Refinement:
    from bask_data.core.depth import in_range
    from bask_data.core.pose_refinement import refined

    def read(i_frame: int) -> np.ndarray:
        return in_range(camera.depth(i_frame), params.near, params.far)

    return refined(
        read,
        camera.Ks,
        camera.world_from_cameras,
        params.model,
        progress=lambda frames: progress(frames, f"{scene}: comparing frames of {camera.name}"),
    )


# Recordings -----------------------------------------------------------------------------------------------------------


def _write_recording(
    out: Path,
    makes: type[Scan] | type[Demonstration],
    given: Scan | Demonstration,
    poses: dict[str, np.ndarray],
    assumptions: dict[str, str],
) -> None:
    """The recording with other poses; everything else is copied."""
    metadata = given.metadata
    arguments: dict[str, Any] = {
        "origin": metadata.origin,
        "left_out": metadata.left_out,
        "lenses": metadata.lenses,
    }
    if isinstance(given, Demonstration):
        arguments["action_names"] = tuple(metadata.action_names or ())
    group = makes.start(out, metadata.format, metadata.assumptions | assumptions, **arguments)
    for camera in given.cameras:
        makes.write_camera(
            group,
            camera.name,
            CameraFrames(
                K=camera.Ks,
                world_from_cameras=poses[camera.name],
                time=camera.time,
                depth_scale=camera.depth_scale,
                size=(camera.height, camera.width),
                read=lambda i, camera=camera: (camera.rgb(i), camera.depth_raw(i)),  # type: ignore[misc]
            ),
            frames=lambda frames, name=camera.name: progress(frames, f"writing {name}"),  # type: ignore[misc]
        )
    if isinstance(given, Demonstration) and given.robot is not None:
        Demonstration.write_robot(out, group, given.robot)


# What was found -------------------------------------------------------------------------------------------------------


def _row(camera: str, found: Refinement) -> RefinedCamera:
    import numpy as np

    correction, E = found.correction, found.given_from_true
    return RefinedCamera(
        camera=camera,
        model=found.model,
        verdict=found.verdict,
        why=found.why,
        n_pairs=found.n_pairs,
        given_from_true=None if E is None else tuple(tuple(row) for row in E.tolist()),  # type: ignore[arg-type]
        deviation_m=correction.deviation_m if correction else None,
        deviation_deg=float(np.degrees(correction.deviation_rad)) if correction else None,
        of_scale_m=correction.of_scale_m if correction else None,
        before=_residual_row(found.before),
        after=_residual_row(found.after),
    )


def _residual_row(residual: Residual | None) -> ResidualRow | None:
    import math

    if residual is None or not math.isfinite(residual.mean + residual.shift + residual.angle):
        return None
    return ResidualRow(distance_m=residual.mean, shift_m=residual.shift, angle_deg=math.degrees(residual.angle))


def _hand_eye(refinement: PoseRefinement) -> dict[str, np.ndarray]:
    import numpy as np

    return {row.camera: np.array(row.given_from_true) for row in refinement.cameras if row.given_from_true is not None}


def residual_words(row: RefinedCamera) -> str:
    """Residuals before and after in words; empty if there are none."""
    if row.before is None or row.after is None:
        return ""
    before, after = row.before, row.after
    return (
        f"held-out pairs of frames are {1000 * before.distance_m:.1f} mm from meeting, {1000 * after.distance_m:.1f} "
        f"mm with the best correction; each would still have to move by {1000 * before.shift_m:.1f} mm and "
        f"{before.angle_deg:.2f} degrees, {1000 * after.shift_m:.1f} mm and {after.angle_deg:.2f} degrees with it"
    )


def _words(scene: str, rows: list[RefinedCamera]) -> str:
    done = [f"{row.camera}: {row.model}, {residual_words(row)}" for row in rows if row.verdict == "refined"]
    return f"refined from {scene} by depth: {'; '.join(done)}"


_CODES = {"refined": "refined", "no better": "refine-no-better", "cannot tell": "refine-cannot-tell"}


def _finding(scene: str, name: str, row: RefinedCamera, dataset: Dataset) -> Finding:
    evidence = "; ".join(text for text in (row.why, residual_words(row)) if text)
    fix = ""
    root = shlex.quote(str(dataset.root))
    if row.verdict == "refined":
        fix = f"bask-data run {root} --only {name}"
        kept = [other for other in dataset.items("scene") if other not in (scene, name)]
        fix += f"; to train without {scene}: bask-data split {root} --train {','.join([*kept, name])}"
        if row.given_from_true is not None:
            evidence += f"; {_size(row)}"
    elif row.verdict == "cannot tell":
        fix = "record the scene with the camera turned about several axes"
        if row.before is not None:
            fix += f"; if the camera is held by hand: bask-data refine {root} {scene} --model drift"
    return Finding(_CODES[row.verdict], f"{scene}/{row.camera}", evidence, fix)


def _size(row: RefinedCamera) -> str:
    """Size and uncertainty of a hand-eye correction in words."""
    import numpy as np

    from bask_data.core.geometry import rotation_angle

    E = np.array(row.given_from_true)
    shift, angle = 1000 * np.linalg.norm(E[:3, 3]), np.degrees(rotation_angle(E[:3, :3]))
    return (
        f"the camera is {shift:.1f} mm and {angle:.2f} degrees from where it was given, known to "
        f"{2000 * (row.deviation_m or 0):.1f} mm and {2 * (row.deviation_deg or 0):.2f} degrees; depth wrong in scale "
        f"by 0.5 % would look like {1000 * (row.of_scale_m or 0):.1f} mm"
    )


def _reported(dataset: Dataset, scene: str, name: str, outcomes: list[Outcome]) -> Refined:
    """What is there, in the terms of the user: fixes name the dataset and the scans that it has."""
    refinement = PoseRefinement(dataset.path(PoseRefinement, scene))
    findings = [_finding(scene, name, row, dataset) for row in refinement.cameras]
    return Refined(outcomes, name if refinement.is_refined else "", refinement.cameras, findings)
