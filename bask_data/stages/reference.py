"""The reference keypoints to track."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import Field

from bask_data.engine import Params, progress, stage
from bask_data.errors import BadData, UsageError
from bask_data.kinds import (
    Camera,
    Demonstration,
    DescriptorNet,
    Pick,
    Recording,
    ReferenceKeypoints,
    Scan,
    VisibleMasks,
)
from bask_data.stages.automatic_keypoints import Wanted, chosen
from bask_data.stages.keypoint_evidence import measured
from bask_data.stages.keypoint_quality import of_picks, other_scans

if TYPE_CHECKING:
    import numpy as np

    from bask_data.nn.network import DescriptorNetwork

PICK = "correct it, or remove it: without any, `bask-data reference --pick` opens a page to choose them on."
"""The fix for an invalid pick."""


class ReferenceParams(Params):
    """Reference keypoints: how they are chosen, or picks by hand."""

    auto: bool = Field(False, description="Choose keypoints automatically even if picks are given.")
    n: int = Field(16, ge=1, description="Number of keypoints, divided among the objects.")
    seed: int = Field(0, ge=0, description="Seed of the candidates.")
    scene: str | None = Field(None, description="Scene to take them from. Default: the first with objects.")
    instances: tuple[int, ...] = Field((), description="Objects to put them on, by number. Default: all of the scene.")
    picks: tuple[str, ...] = Field(
        (),
        description="Keypoints picked by hand, each recording:camera:frame:u:v or recording:camera:frame:u:v:name; a "
        "recording is a scene or a demonstration.",
    )

    def reads(self, kind: str) -> tuple[str, ...] | None:
        """Picks by hand need their own recordings only; automatic choice needs scans."""
        if self.picks and not self.auto:
            recordings = tuple(dict.fromkeys(text.split(":")[0] for text in self.picks))
            return recordings if kind in ("scan", "masks", "demonstration") else None
        return () if kind == "demonstration" else None


@stage(makes=ReferenceKeypoints, version=5)
def reference(
    scans: list[Scan],
    masks: list[VisibleMasks],
    demonstrations: list[Demonstration],
    descriptor: DescriptorNet,
    params: ReferenceParams,
    out: Path,
) -> None:
    """Choose reference keypoints and store their descriptors.

    Automatically, it takes points that are found again in other scans, or else in other views of the same scan, spread
    over the objects, away from their edges and with measured depth. What error to expect of each, and which are
    ambiguous, is measured there, printed and stored. Points picked by hand are given as --picks, or clicked in a
    browser with --pick.

    Where they are picked in scans, other frames of these tell what descriptor distances mean: temperature and tau of
    each keypoint, which `encode` takes.
    """
    network = descriptor.network()
    if params.picks and not params.auto:
        recordings: list[Recording] = [*scans, *demonstrations]
        labels = {mask.path.name: mask for mask in masks}
        picks, descriptors = _picked(params.picks, {one.path.name: one for one in recordings}, labels, network)
        picks = of_picks(picks, descriptors, {scan.path.name: scan for scan in scans}, labels, network)
    else:
        by_name = {scan.path.name: (scan, mask) for scan, mask in zip(scans, masks, strict=True)}
        name = params.scene or next((name for name, (_, mask) in by_name.items() if mask.n_instances), "")
        if not name:
            raise BadData(
                descriptor.path.parent.parent,
                "masks",
                expected="an object in some scene",
                got="none in any",
                fix="see `bask-data objects --help`, or what its notes say.",
            )
        if name not in by_name:
            fix = "leave --scene out to take the first that has objects."
            raise UsageError("reference", "scene", expected=f"one of {', '.join(by_name)}", got=name, fix=fix)
        wanted = Wanted(params.n, params.instances, params.seed)
        others = {other: by_name[other] for other in other_scans(name, list(by_name), descriptor.metadata.learned_from)}
        picks, descriptors = chosen(wanted, name, *by_name[name], network, others)
    calibration = measured(picks, descriptors, {one.path.name: one for one in (*scans, *demonstrations)}, network)
    ReferenceKeypoints.write(out, descriptors=descriptors, picks=picks, calibration=calibration)


def _picked(
    texts: Sequence[str],
    recordings: Mapping[str, Recording],
    masks: Mapping[str, VisibleMasks],
    network: DescriptorNetwork,
) -> tuple[list[Pick], np.ndarray]:
    import numpy as np

    picks: list[Pick] = []
    descriptors: list[np.ndarray] = []
    for i, text in enumerate(progress(texts, "describing keypoints")):
        pick, camera = parsed(text, f"point_{i}", recordings)
        uv = np.array([[pick.u, pick.v]], dtype=np.float32)
        descriptors.append(network.descriptors_at(camera.rgb(pick.frame), uv)[0].cpu().numpy())
        if any(pick.name == other.name for other in picks):
            raise UsageError(
                "reference", "picks", expected="names that differ", got=f"{pick.name} twice", fix="rename one of them."
            )
        picks.append(pick.model_copy(update=_shown(pick, camera, masks.get(pick.recording))))
    return picks, np.stack(descriptors)


def _shown(pick: Pick, camera: Camera, masks: VisibleMasks | None) -> dict[str, Any]:
    """The object at the picked pixel, 0 without masks, and its position, None without depth."""
    import numpy as np

    column, row = round(pick.u), round(pick.v)
    depth = float(camera.depth(pick.frame)[row, column])
    point = camera.points_world(pick.frame, np.array([[pick.u, pick.v]]), np.array([depth]))[0]
    return {
        "instance": 0 if masks is None else int(masks.camera(pick.camera).instance(pick.frame)[row, column]),
        "point_world": tuple(point.tolist()) if depth > 0 else None,
    }


def parsed(text: str, name: str, recordings: Mapping[str, Recording]) -> tuple[Pick, Camera]:
    """A pick from its text in the parameters, and its camera.

    Args:
        name: of a pick without one.

    Raises:
        UsageError: the text is malformed, or names something that does not exist.
    """
    parts = text.split(":")
    if len(parts) not in (5, 6):
        expected = "recording:camera:frame:u:v or recording:camera:frame:u:v:name"
        raise UsageError("reference", "picks", expected=expected, got=text, fix=PICK)
    recording, camera_name = parts[:2]
    if recording not in recordings:
        # The other recordings are not known here: picks read only those that they name.
        expected = "the name of a scan or demonstration of the dataset"
        raise UsageError("reference", "picks", expected=expected, got=text, fix=PICK)
    cameras = recordings[recording].camera_names
    if camera_name not in cameras:
        expected = f"one of the cameras {', '.join(cameras)}"
        raise UsageError("reference", "picks", expected=expected, got=text, fix=PICK)
    camera = recordings[recording].camera(camera_name)
    try:
        frame, u, v = int(parts[2]), float(parts[3]), float(parts[4])
    except ValueError as error:
        raise UsageError("reference", "picks", expected="numbers for frame, u and v", got=text, fix=PICK) from error
    inside = 0 <= frame < camera.n_frames and -0.5 <= u < camera.width - 0.5 and -0.5 <= v < camera.height - 0.5
    if not inside:
        size = f"frame 0..{camera.n_frames - 1}, u 0..{camera.width - 1}, v 0..{camera.height - 1}"
        raise UsageError("reference", "picks", expected=size, got=text, fix=PICK)
    name = parts[5] if len(parts) == 6 and parts[5] else name
    return Pick(name=name, recording=recording, camera=camera_name, frame=frame, u=u, v=v), camera


def as_text(pick: Pick) -> str:
    """A pick as text for the parameters."""
    return f"{pick.recording}:{pick.camera}:{pick.frame}:{pick.u:g}:{pick.v:g}:{pick.name}"
