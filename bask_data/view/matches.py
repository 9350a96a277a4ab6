"""Matches between two views, as lines between the images and as points in the scene."""

from __future__ import annotations

from typing import Any

import numpy as np

from bask_data.core.geometry import transform, unproject
from bask_data.dataset import Dataset
from bask_data.drawing.colours import palette
from bask_data.drawing.match_pictures import spread_matches
from bask_data.errors import BadData
from bask_data.evaluation.lookup import find, spread_frames
from bask_data.kinds import Camera, Correspondences, Scan
from bask_data.progress import progress
from bask_data.view.sheet import CORNER, DrawnItem, Sheet, jpeg, reading

N_SHOWN_MATCHES = 60
"""Matches drawn per pair: more than in a report, because the viewer zooms."""
GAP_PX = 8
"""Gap between the two images of a pair, pixels."""


def draw_matches(sheet: Sheet, drawn: DrawnItem, dataset: Dataset, name: str, scan: Scan, n_pairs: int) -> None:
    """Draw pairs of views side by side with lines between matches, and the matched points in the scene."""
    correspondences = find(dataset, Correspondences, name)
    if correspondences is None:
        drawn.shown.missing.append("matches (bask-data correspondences)")
        return
    with reading(correspondences):
        rows = [row for row in correspondences.pairs().to_pylist() if row["n_matches"] > 0]
        rows = sorted(rows, key=lambda row: (row["camera_a"], row["frame_a"], row["pair"]))
        chosen = [rows[i] for i in spread_frames(len(rows), n_pairs)]
        for row in progress(chosen, f"drawing {name}, matches"):
            _draw_pair(sheet, scan, correspondences, row)
    drawn.note(
        bool(chosen), f"matches of {len(chosen)} of {len(rows)} pairs", "--pairs 0" if rows else "no pair has any"
    )
    if chosen:
        drawn.layers.add("matches")


def _draw_pair(sheet: Sheet, scan: Scan, correspondences: Correspondences, row: dict[str, Any]) -> None:
    import rerun as rr

    where = f"pair {row['pair']}"
    cameras = [_frame(scan, correspondences, where, row[f"camera_{x}"], row[f"frame_{x}"]) for x in "ab"]
    table = correspondences.matches([row["pair"]])
    columns = {name: table[name].to_numpy() for name in ("u_a", "v_a", "u_b", "v_b", "instance")}
    some = spread_matches(columns["instance"], N_SHOWN_MATCHES)
    uv_a, uv_b = (np.stack([columns[f"u_{x}"], columns[f"v_{x}"]], axis=1)[some].astype(np.float64) for x in "ab")
    if not np.isfinite([uv_a, uv_b]).all():
        raise BadData(correspondences.path / "matches.parquet", where, expected="finite pixels", got="NaN or infinity")
    images = [camera.rgb(i_frame) for camera, i_frame in cameras]
    shift = images[0].shape[1] + GAP_PX
    picture = np.zeros((max(len(image) for image in images), shift + images[1].shape[1], 3), np.uint8)
    picture[: len(images[0]), : images[0].shape[1]] = images[0]
    picture[: len(images[1]), shift:] = images[1]
    colours = palette(len(some))
    start, end = uv_a + CORNER, uv_b + CORNER + np.array([shift, 0])
    camera, i_frame = cameras[0]
    with sheet.at(frame=i_frame, pair=int(row["pair"])):
        sheet.log(("matches", "images"), rr.EncodedImage(contents=jpeg(picture), media_type="image/jpeg"))
        lines = np.stack([start, end], axis=1)
        sheet.log(("matches", "lines"), rr.LineStrips2D(lines, colors=colours, radii=rr.Radius.ui_points(0.75)))
        ends = np.concatenate([start, end])
        sheet.log(("matches", "points"), rr.Points2D(ends, colors=[*colours, *colours], radii=rr.Radius.ui_points(3)))
        v, u = np.rint(np.clip(uv_a, 0, [camera.width - 1, camera.height - 1])).astype(int).T[::-1]
        depth = camera.depth(i_frame)[v, u].astype(np.float64)
        points = transform(camera.world_from_cameras[i_frame], unproject(uv_a, depth, camera.Ks[i_frame]))
        known = depth > 0
        sheet.log(
            ("world", "matches"),
            rr.Points3D(points[known], colors=np.array(colours)[known], radii=rr.Radius.ui_points(3)),
        )


def _frame(scan: Scan, correspondences: Correspondences, where: str, camera: str, i_frame: int) -> tuple[Camera, int]:
    if camera not in scan.camera_names or not 0 <= i_frame < scan.camera(camera).n_frames:
        raise BadData(
            correspondences.path / "pairs.parquet",
            where,
            expected="frames of the scan",
            got=f"frame {i_frame} of {camera!r}",
        )
    return scan.camera(camera), i_frame
