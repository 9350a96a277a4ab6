"""The sections on views: input frames, visible masks, and matches."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from bask_data.core.geometry import transform, unproject
from bask_data.drawing.colours import N_LABEL_COLOURS, css, instance_colour, turbo_gradient
from bask_data.drawing.images import depth_picture, jpeg_uri, resize, resize_labels
from bask_data.drawing.mask_pictures import mask_picture
from bask_data.drawing.match_pictures import matches_picture, spread_matches
from bask_data.drawing.plots import histogram
from bask_data.evaluation.artifact_figures import is_still, matches_figures, recording_figures, view_changes
from bask_data.evaluation.label_matches import median_apart, merged_labels
from bask_data.evaluation.lookup import find, find_recording, find_truth, spread_frames
from bask_data.evaluation.match_reasons import REASONS, plain_reason
from bask_data.kinds import Camera, Correspondences, ObjectInstances, Reconstruction, Scan, Truth, VisibleMasks
from bask_data.report.chosen import N_CAMERAS, N_ROWS, PICTURE, TILE, WIDE, Chosen, Part, per_item

N_DRAWN_MATCHES = 30
"""Matches drawn per pair, at most: more lines cannot be followed by eye."""
N_RANGED, RANGE_STRIDE, LEAST_RANGED = 5, 8, 50
"""Frames, every so many pixels, whose depths in the workspace give the range of colours, and the least number of them.
Sensitivity not measured."""
FAR_SHARE = 2.0
"""Depths beyond this multiple of the median are background. Sensitivity not measured."""


def frames(chosen: Chosen) -> list[Part]:
    """A few frames of each recording, colour above depth."""

    def part(name: str) -> Part | None:
        recording = find_recording(chosen.dataset, name)
        if recording is None:
            return None
        sort = "scan" if isinstance(recording, Scan) else "demonstration"
        cameras = recording_figures(recording)
        n_frames = max(chosen.n_frames // min(len(cameras), N_CAMERAS), 2) if cameras else 0
        mesh = find(chosen.dataset, Reconstruction, name) if sort == "scan" else None

        def sheet(camera: Camera) -> Part:
            figures = cameras[camera.name]
            # A camera at rest shows a scan's objects the same in every frame.
            shows_one = sort == "scan" and figures["is_still"]
            near, far = _depth_range(camera, figures, mesh)
            return {
                **figures,
                "shows_one": shows_one and camera.n_frames > 1,
                **_contact_sheet(camera, near, far, 1 if shows_one else n_frames),
            }

        return {
            "title": f"{name} ({sort})",
            "cameras": [{"name": camera.name, **sheet(camera)} for camera in recording.cameras[:N_CAMERAS]],
            "n_cameras_left_out": max(len(cameras) - N_CAMERAS, 0),
        }

    return per_item([*chosen.scenes, *chosen.demonstrations], part)


def _depth_range(camera: Camera, figures: dict[str, Any], mesh: Reconstruction | None) -> tuple[float, float]:
    """Depths that the colours spread over, metres: those in the workspace; without one, up to twice the median, as a
    distant wall would leave the objects one colour."""
    near, far = figures["depth_range_m"]
    if mesh is not None:
        corners = np.array(mesh.metadata.bounds, np.float64).reshape(2, 3)
        inside = [_depths_inside(camera, i, corners) for i in spread_frames(camera.n_frames, N_RANGED)]
        depths = np.concatenate(inside) if inside else np.zeros(0)
        if len(depths) >= LEAST_RANGED:
            return float(np.percentile(depths, 2)), float(np.percentile(depths, 98))
    middle = figures["depth_m"].median
    return near, min(far, FAR_SHARE * middle) if np.isfinite(middle) else far


def _depths_inside(camera: Camera, i_frame: int, corners: np.ndarray) -> np.ndarray:
    """Some of a frame's depths (n,) whose points lie in a box, metres."""
    depth = camera.depth(i_frame)[::RANGE_STRIDE, ::RANGE_STRIDE]
    v, u = np.nonzero(depth > 0)
    z = depth[v, u].astype(np.float64)
    uv = RANGE_STRIDE * np.stack([u, v], axis=1).astype(np.float64)
    points = transform(camera.world_from_cameras[i_frame], unproject(uv, z, camera.Ks[i_frame]))
    return z[((points >= corners[0]) & (points <= corners[1])).all(axis=1)]


def _contact_sheet(camera: Camera, near: float, far: float, n_frames: int) -> Part:
    tiles = []
    chosen = spread_frames(camera.n_frames, n_frames) if n_frames > 1 else [camera.n_frames // 2][: camera.n_frames]
    for i_frame in chosen:
        depth = depth_picture(_shrunk_depth(camera.depth(i_frame)), near, far)
        tiles.append(
            {
                "frame": i_frame,
                "colour": jpeg_uri(resize(camera.rgb(i_frame), TILE)),
                "depth": jpeg_uri(resize(depth, TILE)),
            }
        )
    ticks = [near + (far - near) * share for share in (0, 0.25, 0.5, 0.75, 1)]
    return {"tiles": tiles, "gradient": turbo_gradient(), "ticks": [f"{tick:.2f}" for tick in ticks]}


def _shrunk_depth(depth: np.ndarray) -> np.ndarray:
    """Depth shrunk to a tile's width by nearest neighbour."""
    if depth.shape[1] <= TILE:
        return depth
    return resize_labels(depth, (max(1, round(depth.shape[0] * TILE / depth.shape[1])), TILE))


def masks(chosen: Chosen) -> list[Part]:
    """Masks over frames, the visible share of each instance, and the IoU with ground-truth labels."""

    def part(name: str) -> Part | None:
        visible_masks = find(chosen.dataset, VisibleMasks, name)
        if visible_masks is None:
            return None
        numbers = chosen.masks[name]
        if "error" in numbers:
            return {"title": name, "error": numbers["error"]}
        truth, scan = find_truth(chosen.dataset, name), find(chosen.dataset, Scan, name)
        colours = [css(instance_colour(i)) for i in range(1, N_LABEL_COLOURS + 1)]
        objects = find(chosen.dataset, ObjectInstances, name)
        names = {row.id: row.name for row in objects.instances} if objects else {}
        tiles = [
            tile
            for camera in (scan.camera_names[:N_CAMERAS] if scan else [])
            if camera in visible_masks.camera_names
            for tile in _mask_tiles(
                scan, visible_masks, truth, camera, max(chosen.n_frames // min(len(visible_masks.camera_names), 2), 2)
            )
        ]
        return {
            "title": name,
            "numbers": numbers,
            "tiles": tiles,
            "n_cameras_left_out": max(len(visible_masks.camera_names) - N_CAMERAS, 0),
            "rows": [
                {**row, "colour": css(instance_colour(row["id"])), "name": names.get(row["id"], "")}
                for row in numbers["instances"][:N_ROWS]
            ],
            "n_rows_left_out": max(len(numbers["instances"]) - N_ROWS, 0),
            "labels": numbers["labels"],
            "colours": ["", *colours],
            "median_iou": median_apart(numbers["labels"] or []),
            "merged": merged_labels(numbers["labels"] or []),
        }

    return per_item(chosen.scenes, part)


def _mask_tiles(scan: Any, masks: VisibleMasks, truth: Truth | None, camera: str, n_frames: int) -> list[Part]:
    frames, instances = scan.camera(camera), masks.camera(camera)
    labelled = truth is not None and camera in truth.camera_names
    tiles = []
    for i_frame in spread_frames(min(frames.n_frames, instances.n_frames), 1 if is_still(frames) else n_frames):
        labels = truth.instance(camera, i_frame) if labelled and truth is not None else None
        instance, measured = instances.instance(i_frame), instances.measured(i_frame)
        picture = mask_picture(frames.rgb(i_frame), instance, labels, PICTURE, measured)
        tiles.append({"uri": jpeg_uri(picture), "text": f"{camera}, frame {i_frame}"})
    return tiles


def matches(chosen: Chosen) -> list[Part]:
    """Pairs of frames with lines between matching pixels, and why candidates were rejected."""

    def part(name: str) -> Part | None:
        correspondences = find(chosen.dataset, Correspondences, name)
        if correspondences is None:
            return None
        numbers = matches_figures(correspondences)
        scan = find(chosen.dataset, Scan, name)
        most = max([numbers["n_matches"], *numbers["rejections"].values()], default=1) or 1
        reasons = sorted(numbers["rejections"], key=lambda why: -numbers["rejections"][why])
        bars = [("accepted", numbers["n_matches"]), *((REASONS[why], numbers["rejections"][why]) for why in reasons)]
        return {
            "title": name,
            "numbers": numbers,
            "bars": [{"name": why, "n": n, "width": round(100 * n / most, 1)} for why, n in bars[:N_ROWS]],
            "tiles": _pair_tiles(scan, correspondences) if scan else [],
            "reasons": [REASONS[why] for why in reasons],
            "notes": [plain_reason(text) for text in numbers["warnings"]],
            "table": _tried_per_object(numbers, reasons)[:N_ROWS],
            "plots": _change_plots(correspondences),
        }

    return per_item(chosen.scenes, part)


def _tried_per_object(numbers: dict[str, Any], reasons: Sequence[str]) -> list[Part]:
    """By object: number of pixels sampled, number of matches, and shares of the reasons for rejection."""
    matches, rejected = numbers["matches_per_instance"], numbers["rejections_per_instance"]
    rows = []
    for i in sorted({*matches, *rejected}):
        counts = [rejected.get(i, {}).get(why, 0) for why in reasons]
        tried = matches.get(i, 0) + sum(counts)
        rows.append(
            {
                "id": i,
                "colour": css(instance_colour(i)),
                "n_matches": matches.get(i, 0),
                "tried": tried,
                "share": matches.get(i, 0) / tried if tried else None,
                "shares": [n / tried if tried else None for n in counts],
            }
        )
    return rows


def _change_plots(correspondences: Correspondences) -> list[Part]:
    """Histograms of the differences between the two views of a pair."""
    pairs = correspondences.pairs()
    if not pairs.num_rows:
        return []
    change = view_changes(correspondences.matches())
    distance, angle = (pairs[name].to_numpy().astype(np.float64) for name in ("distance", "angle"))
    drawn = [
        ("Distance between the cameras", 100 * distance, "centimetres", False),
        ("Angle between the cameras", np.rad2deg(angle), "degrees", False),
    ]
    if len(change.scale):
        drawn += [
            ("Change of scale", change.scale, "scale of the second view relative to the first", True),
            ("Rotation in the image", np.rad2deg(change.rotation), "degrees", False),
        ]
    return [
        {"title": title, "svg": histogram(values, x_label=x_label, y_label="pairs", logarithmic=logarithmic)}
        for title, values, x_label, logarithmic in drawn
    ]


def _pair_tiles(scan: Scan, correspondences: Correspondences) -> list[Part]:
    """The pair with the most matches and, if different, the pair with the widest angle and enough matches."""
    pairs = correspondences.pairs().to_pylist()
    if not pairs:
        return []
    fullest = max(pairs, key=lambda row: row["n_matches"])
    enough = [row for row in pairs if row["n_matches"] >= max(N_DRAWN_MATCHES, 0.1 * fullest["n_matches"])]
    widest = max(enough, key=lambda row: row["angle"], default=fullest)
    tiles = []
    for row, why in ((fullest, "most matches"), (widest, "widest angle")):
        known = row["camera_a"] in scan.camera_names and row["camera_b"] in scan.camera_names
        if not known or (why == "widest angle" and widest is fullest):
            continue
        table = correspondences.matches([row["pair"]])
        columns = {name: table[name].to_numpy() for name in ("u_a", "v_a", "u_b", "v_b", "instance")}
        some = spread_matches(columns["instance"], N_DRAWN_MATCHES)
        picture = matches_picture(
            scan.camera(row["camera_a"]).rgb(row["frame_a"]),
            scan.camera(row["camera_b"]).rgb(row["frame_b"]),
            np.stack([columns["u_a"], columns["v_a"]], axis=1)[some],
            np.stack([columns["u_b"], columns["v_b"]], axis=1)[some],
            WIDE,
        )
        text = (
            f"{why}: {row['camera_a']} frame {row['frame_a']} and {row['camera_b']} frame {row['frame_b']}, "
            f"{100 * row['distance']:.1f} cm and {np.rad2deg(row['angle']):.0f}° apart; "
            f"{len(some)} of {row['n_matches']:,} matches drawn"
        )
        tiles.append({"uri": jpeg_uri(picture), "text": text})
    return tiles
