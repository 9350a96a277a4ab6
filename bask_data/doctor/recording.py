"""A camera of a recording, examined: geometry, sensor, and depth on colour. Frames are decoded once for all checks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8
from numpy import ndarray

from bask_data.doctor.examination import ExaminedCamera, Picture, frames_of
from bask_data.doctor.reading import OF_RIGHT_POSES, agreement_of_stored, bars, is_sure, is_worse, reading_findings
from bask_data.doctor.recording_checks import sensor_findings
from bask_data.drawing.images import resize
from bask_data.errors import BadData
from bask_data.findings import Finding
from bask_data.formats.kept_frames import KeptFrames
from bask_data.formats.recording import CameraRecording
from bask_data.formats.registration import edge_pictures, registration
from bask_data.formats.verdict import Agreement, Registration
from bask_data.kinds import Camera

N_SAMPLED = 8
"""Frames that figures of depth are computed from, and of which some are shown. Sensitivity not measured."""

N_ODD = 8
"""Most frames shown that stand out, of a camera."""

SHOWN_WIDTH = 480
"""Width of pictures on the page, pixels."""


@dataclass(frozen=True)
class Settings:
    """How to examine the cameras of a recording.

    Args:
        with_pictures: whether to make pictures for a page.
        again: what reads a stored recording again, for fixes; empty for sources.
        assumptions: of a stored recording.
    """

    with_pictures: bool = False
    again: str = ""
    assumptions: dict[str, str] = field(default_factory=dict)


def examine_camera(
    place: str, camera: CameraRecording, settings: Settings, known: tuple[Agreement, Registration] | None = None
) -> ExaminedCamera:
    """All checks of one camera.

    Args:
        place: `recording/camera`.
        known: what depth says about its reading, and whether depth lies on colour, if the reader has told already.
    """
    camera = sharing(camera)
    findings: list[Finding] = []
    right: list[str] = []
    told: list[Agreement] = []

    def check_reading() -> None:
        told.append(known[0] if known else agreement_of_stored(camera, settings.assumptions))
        findings.extend(reading_findings(place, told[0], settings.again))
        if is_sure(told[0]):
            right.append(f"reading: sure; {told[0].text}")

    def check_registration() -> None:
        said = known[1] if known else registration(camera, not (told and told[0].judgement.objections))
        findings.extend(said.findings(place))
        if said.verdict == "fits":
            right.append(said.text)

    def check_sensor() -> None:
        found = sensor_findings(
            place, camera.n_frames, partial(metres, camera), camera.Ks, camera.world_from_cameras, camera.time
        )
        # Poses that are all wrong make frames stand out, and drift: leaving those out, or `refine`, mends nothing.
        is_wrong = bool(told) and is_worse(told[0])
        found = [each for each in found if not (is_wrong and each.code in OF_RIGHT_POSES)]
        # Poses that hang are told by the readings, too.
        said = {each.code for each in findings}
        findings.extend(each for each in found if each.code not in said)
        if not found:
            right.append("images, depth and stamps" if is_wrong else "images, depth, single frames and stamps")

    facts: dict[str, Any] = {}
    for check in (check_reading, check_registration, check_sensor, lambda: facts.update(facts_of(camera))):
        findings += _unreadable(place, check)
    made = ExaminedCamera(place, facts, tuple(findings), tuple(right), bars(told[0]) if told else ())
    return with_pictures(made, camera) if settings.with_pictures else made


def _unreadable(place: str, check: Callable[[], None]) -> list[Finding]:
    """A finding if a check meets an image that cannot be read."""
    try:
        check()
    except BadData as error:
        return [Finding("unreadable", place, error.fault, error.fix)]
    return []


def sharing(camera: CameraRecording) -> CameraRecording:
    """The camera with readers that keep what they have decoded, for the next check."""
    color, depth = KeptFrames(lambda i: camera.read(i)[0]), KeptFrames(camera.read_depth)
    return replace(camera, read=lambda i: (color(i), depth(i)), read_depth=depth)


def of_stored(camera: Camera) -> CameraRecording:
    """A stored camera in the form in which sources are checked."""
    return CameraRecording(
        name=camera.name,
        K=camera.Ks,
        height=camera.height,
        width=camera.width,
        depth_scale=camera.depth_scale,
        world_from_cameras=camera.world_from_cameras,
        time=camera.time,
        read=lambda i: (camera.rgb(i), camera.depth_raw(i)),
        read_depth=camera.depth_raw,
    )


def metres(camera: CameraRecording, i: int) -> tuple[UInt8[ndarray, "h w 3"], Float32[ndarray, "h w"]]:
    """Colour and depth, metres, of a frame."""
    rgb, raw = camera.read(i)
    return rgb, raw.astype(np.float32) * np.float32(camera.depth_scale)


def facts_of(camera: CameraRecording) -> dict[str, Any]:
    """Figures of a camera: what it is, how far it moved, and what depth it has."""
    centres = camera.world_from_cameras[:, :3, 3]
    shares, depths = [], []
    for i in sampled(camera.n_frames, N_SAMPLED):
        depth = metres(camera, i)[1]
        valid = depth[depth > 0]
        shares.append(valid.size / depth.size)
        depths.append(float(np.median(valid)) if valid.size else np.nan)
    median = float(np.nanmedian(depths)) if np.isfinite(depths).any() else None
    return {
        "n_frames": camera.n_frames,
        "width": camera.width,
        "height": camera.height,
        "seconds": float(camera.time[-1] - camera.time[0]),
        "path_m": float(np.linalg.norm(np.diff(centres, axis=0), axis=1).sum()),
        "depth_share": float(np.mean(shares)),
        "depth_m": median,
    }


def sampled(n_frames: int, n: int) -> list[int]:
    """Indices of at most n frames, spread evenly."""
    return [int(i) for i in np.unique(np.linspace(0, n_frames - 1, n).astype(int))]


def with_pictures(examined: ExaminedCamera, camera: CameraRecording) -> ExaminedCamera:
    """The camera with the pictures of a page: some frames with edges of depth, and those that findings are about."""
    named = {i: finding.code for finding in examined.findings for i in frames_of(finding) if i < camera.n_frames}
    try:
        edges = edge_pictures(camera.n_frames, partial(metres, camera))
        odd = [(i, metres(camera, i)[0]) for i in sorted(named)[:N_ODD]]
    except BadData:
        return examined  # It is a finding already.
    return replace(
        examined,
        edges=tuple(Picture(shrunk(rgb), "") for rgb in edges),
        odd_frames=tuple(Picture(shrunk(rgb), f"frame {i}: {named[i]}") for i, rgb in odd),
    )


def shrunk(rgb: UInt8[ndarray, "h w 3"]) -> UInt8[ndarray, "h w 3"]:
    """An image of at most the width of pictures."""
    return resize(rgb, SHOWN_WIDTH) if rgb.shape[1] > SHOWN_WIDTH else rgb
