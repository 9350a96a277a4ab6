"""A camera of a recording, examined: geometry, sensor, and depth on colour. Frames are decoded once for all checks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from numpy import ndarray

from bask_data.core.edge_offset import depth_edges
from bask_data.doctor.examination import ExaminedCamera, Picture, frames_of
from bask_data.doctor.reading import evidence_of, reading_findings
from bask_data.errors import BadData
from bask_data.findings import Finding
from bask_data.formats.agreement import agreement
from bask_data.formats.kept_frames import KeptFrames
from bask_data.formats.recording import CameraRecording
from bask_data.formats.registration import registration
from bask_data.formats.verdict import Agreement
from bask_data.kinds import Camera

N_SAMPLED = 8
"""Frames that figures of depth are computed from, and of which some are shown. Sensitivity not measured."""

N_EDGES, N_ODD = 4, 8
"""Most frames shown with edges of depth, and most that stand out, of a camera."""

SHOWN_WIDTH = 480
"""Width of pictures on the page, pixels."""


@dataclass(frozen=True)
class Settings:
    """How to examine a camera.

    Args:
        with_pictures: whether to make pictures for a page.
        again: what reads the recording again, for fixes of stored ones; empty for sources.
    """

    with_pictures: bool = False
    again: str = ""


def examine_camera(
    place: str, camera: CameraRecording, settings: Settings, judged: Agreement | None = None
) -> ExaminedCamera:
    """All checks of one camera.

    Args:
        place: `recording/camera`.
        judged: what depth says about its reading, if that is known already.
    """
    camera = sharing(camera)
    findings: list[Finding] = []
    right: list[str] = []
    told: list[Agreement] = []

    def check_reading() -> None:
        told.append(judged or agreement(camera, {}))
        found = reading_findings(place, told[0])
        findings.extend(found)
        if not found:
            right.append(f"reading: sure; {told[0].text}")

    def check_registration() -> None:
        said = registration(camera)
        if said.verdict == "shifted":
            fix = "register depth to colour: --color-from-depth and --depth-intrinsics, or the driver's aligned depth"
            findings.append(Finding("depth-shifted", place, said.text, fix))
        elif said.verdict == "fits":
            right.append(said.text)
        else:
            evidence = "edges of depth fit those of colour nowhere clearly, or in few frames"
            fix = "look at the red edges in the page: --report FILE"
            findings.append(Finding("registration-unknown", place, evidence, fix))

    facts: dict[str, Any] = {}
    for check in (check_reading, check_registration, lambda: facts.update(facts_of(camera))):
        findings += _unreadable(place, check)
    if settings.again:
        findings = [_with_command(each, settings.again) for each in findings]
    made = ExaminedCamera(place, facts, tuple(findings), tuple(right), evidence_of(told[0]) if told else ())
    return with_pictures(made, camera) if settings.with_pictures else made


def _unreadable(place: str, check: Callable[[], None]) -> list[Finding]:
    """A finding if a check meets an image that cannot be read."""
    try:
        check()
    except BadData as error:
        return [Finding("unreadable", place, error.fault, error.fix)]
    return []


def _with_command(finding: Finding, again: str) -> Finding:
    """The finding of a stored recording, whose mending begins with reading the source again."""
    is_option = "--" in finding.fix and "bask-data" not in finding.fix
    return replace(finding, fix=f"{finding.fix}; the recording was made by `{again}`") if is_option else finding


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
    edges = [_picture(camera, i, edges_over) for i in sampled(camera.n_frames, N_EDGES)]
    named = {i: finding.code for finding in examined.findings for i in frames_of(finding) if i < camera.n_frames}
    odd = [_picture(camera, i, lambda rgb, _: rgb, named[i]) for i in sorted(named)[:N_ODD]]
    return replace(
        examined, edges=tuple(each for each in edges if each), odd_frames=tuple(each for each in odd if each)
    )


def _picture(
    camera: CameraRecording, i: int, draw: Callable[[ndarray, ndarray], ndarray], why: str = ""
) -> Picture | None:
    try:
        rgb, depth = metres(camera, i)
    except BadData:
        return None
    drawn = draw(rgb, depth)
    if drawn.shape[1] > SHOWN_WIDTH:
        size = (SHOWN_WIDTH, max(1, round(drawn.shape[0] * SHOWN_WIDTH / drawn.shape[1])))
        drawn = cv2.resize(drawn, size, interpolation=cv2.INTER_AREA)
    return Picture(drawn, f"frame {i}" + (f": {why}" if why else ""))


def edges_over(rgb: UInt8[ndarray, "h w 3"], depth: Float32[ndarray, "h w"]) -> UInt8[ndarray, "h w 3"]:
    """Colour with the edges of depth in red."""
    edges = depth_edges(depth).astype(np.uint8)
    width = max(2, round(rgb.shape[1] / SHOWN_WIDTH) + 1)
    drawn = rgb.copy()
    drawn[cv2.dilate(edges, np.ones((width, width), np.uint8)) > 0] = (255, 0, 0)
    return drawn
