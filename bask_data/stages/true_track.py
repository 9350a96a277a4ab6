"""Tracks from ground truth, instead of a network's."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from bask_data.engine import progress
from bask_data.errors import BadData
from bask_data.kinds import Camera, Demonstration, KeypointTrack, ReferenceKeypoints, Truth


def write_truth(
    demonstration: Demonstration,
    cameras: list[Camera],
    reference: ReferenceKeypoints,
    truths: Mapping[str, Truth],
    out: Path,
) -> None:
    """Write the true positions of the keypoints as a track.

    Raises:
        BadData: the demonstration has no ground truth, or none of an object with a keypoint.
    """
    import numpy as np

    from bask_data.kinds.places import Known, true_pixels, true_places

    name = demonstration.path.name
    if name not in truths:
        fix = "--source network, or --only demonstrations with truth."
        raise BadData(demonstration.path, "truth", expected="objects' transforms", got="none", fix=fix)
    recordings = {one: Known(None, truth) for one, truth in truths.items()}
    places = true_places(reference.picks, {**recordings, name: Known(demonstration, truths[name])}, name)
    if np.isnan(places).all():
        expected = f"a keypoint on an object whose transform is known in {name}"
        raise BadData(reference.path, "picks", expected=expected, got="none", fix="see `bask-data reference --help`.")
    names, k = [camera.name for camera in cameras], places.shape[1]
    with KeypointTrack.writer(out, names=reference.names, filter="truth", cameras=names) as writer:
        for i_frame in progress(range(cameras[0].n_frames), "writing keypoints"):
            points = places[i_frame]
            seen = {camera.name: true_pixels(points, camera, truths[name], i_frame) for camera in cameras}
            known = np.isfinite(points).all(axis=1)
            writer.append(
                mean=points,
                covariance=np.where(known[:, None, None], 0.0, np.full((k, 3, 3), np.nan)),
                mode=points,
                n_eff=known.astype(np.float64),
                log_evidence=np.zeros(k),
                cameras={one: (found.uv, found.inside & ~found.hidden) for one, found in seen.items()},
            )
