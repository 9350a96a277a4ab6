"""The report's sections: what each picture shows, and the figures that belong beside it.

A section is a list of parts, one per item; no part, no section. A part is a plain dictionary that the template knows
how to lay out: `numbers` are figures, `tiles` pictures, `rows` lines of a table, `plots` curves; `error` stands alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import numpy as np

from bask_data.artifact import Artifact
from bask_data.core.geometry import scale_pixels
from bask_data.dataset import Dataset
from bask_data.drawing import pictures as draw
from bask_data.drawing.marks import N_TRAIL, camera_tracks
from bask_data.evaluation.artifact_figures import (
    matches_figures,
    objects_figures,
    reconstruction_figures,
    recording_figures,
    view_changes,
)
from bask_data.evaluation.figures import Measured
from bask_data.evaluation.lookup import UNREADABLE, find, find_recording, find_truth, spread_frames, what_is_wrong
from bask_data.evaluation.made import made
from bask_data.evaluation.network_figures import descriptor_figures, networks
from bask_data.evaluation.reference_points import frame_of
from bask_data.evaluation.track_figures import TOLERANCE_PX, TrackScores, figures_of_track
from bask_data.kinds import (
    Correspondences,
    DescriptorNet,
    KeypointTrack,
    ObjectInstances,
    Pick,
    Reconstruction,
    ReferenceKeypoints,
    Scan,
    Truth,
    VisibleMasks,
)

N_ITEMS = 3
"""Scenes, demonstrations and variants shown; more would make a page nobody loads."""
N_ROWS = 32
N_CAMERAS = 3
N_MATCHES = 30
TILE, PICTURE, WIDE = 320, 480, 1100
FIRST, LAST = (80, 220, 120), (240, 70, 90)
BAD = "#e0453a"
CAMERA_COLOURS = ("", "#4a90d0", "#3f9f74", "#a07cc0", "#b8923a")
"""Of curves, none of them near `BAD`; the first is that of the text."""
Part = dict[str, Any]
A = TypeVar("A", bound=Artifact)


@dataclass(frozen=True)
class Chosen:
    """The items a page shows: the first few of each sort."""

    dataset: Dataset
    measured: Measured
    scenes: list[str]
    demonstrations: list[str]
    variants: list[str]
    n_frames: int
    """Frames shown of each camera."""

    @cached_property
    def tracks(self) -> list[tuple[str, str, TrackScores]]:
        """(demonstration, variant, scores) of every track shown."""
        return [
            (name, variant, self.measured.track(name, variant))
            for variant in self.variants
            for name in self.demonstrations
            if find(self.dataset, KeypointTrack, name, variant)
        ]

    @cached_property
    def networks(self) -> dict[str, DescriptorNet]:
        """Descriptor networks by variant."""
        return networks(self.dataset)

    @cached_property
    def masks(self) -> dict[str, dict[str, Any]]:
        """Figures of the masks of each scene shown."""
        return {name: value for name in self.scenes if (value := self.measured.masks(name))}


def choose(dataset: Dataset, measured: Measured, n_frames: int) -> Chosen:
    """The first items of each sort."""
    kinds = (DescriptorNet, ReferenceKeypoints, KeypointTrack)
    variants = list(dict.fromkeys(name for kind in kinds for name in dataset.variants(kind)))
    return Chosen(
        dataset=dataset,
        measured=measured,
        scenes=dataset.items("scene")[:N_ITEMS],
        demonstrations=dataset.items("demonstration")[:N_ITEMS],
        variants=variants[:N_ITEMS],
        n_frames=n_frames,
    )


def per_item(names: Sequence[str], part: Callable[[str], Part | None]) -> list[Part]:
    """A part per item that has one; an item that cannot be read says so and spoils no other."""
    parts = []
    for name in names:
        try:
            made = part(name)
        except UNREADABLE as error:
            made = {"title": name, "error": what_is_wrong(error)}
        if made:
            parts.append(made)
    return parts


# Summary -------------------------------------------------------------------------------------------------------------


def overview(chosen: Chosen) -> Part:
    """What was made, the headline figures, what is missing and what is not shown."""
    artifacts = made(chosen.dataset)
    return {
        "headline": _headline(chosen),
        "artifacts": artifacts[: 3 * N_ROWS],
        "n_artifacts_left_out": max(len(artifacts) - 3 * N_ROWS, 0),
        "seconds": sum(one.seconds or 0.0 for one in artifacts),
        "n_without_record": sum(one.seconds is None for one in artifacts),
        "bytes": sum(one.bytes for one in artifacts),
        "missing": _missing(chosen),
        "left_out": _left_out(chosen),
    }


def _left_out(chosen: Chosen) -> list[str]:
    sorts = [
        ("scenes", chosen.dataset.items("scene"), chosen.scenes),
        ("demonstrations", chosen.dataset.items("demonstration"), chosen.demonstrations),
    ]
    return [
        f"{len(everything)} {sort}: the first {len(shown)} are shown, {len(everything) - len(shown)} are left out, "
        "and the figures are of those shown."
        for sort, everything, shown in sorts
        if len(shown) < len(everything)
    ]


def _missing(chosen: Chosen) -> list[str]:
    """What could be there and is not, in sentences."""
    dataset, found = chosen.dataset, []
    for name in [*chosen.scenes, *chosen.demonstrations]:
        if find_recording(dataset, name) is None:
            found.append(f"{name}: its frames are not in the dataset.")
        if find_truth(dataset, name) is None:
            found.append(f"No ground truth for {name}: nothing on this page says how right its results are.")
    of_scenes: list[tuple[type[Artifact], str]] = [
        (Reconstruction, "reconstruction"),
        (ObjectInstances, "objects"),
        (VisibleMasks, "masks"),
        (Correspondences, "correspondences"),
    ]
    of_dataset: list[tuple[type[Artifact], str]] = [
        (DescriptorNet, "descriptor network"),
        (ReferenceKeypoints, "reference keypoints"),
    ]
    for kind, what in of_scenes:
        without = [name for name in chosen.scenes if not find(dataset, kind, name)]
        if without:
            found.append(f"No {what} yet: {', '.join(without)}.")
    if not chosen.scenes:
        found.append("No scan.")
    for kind, what in of_dataset:
        if not any(find(dataset, kind, "", variant) for variant in chosen.variants):
            found.append(f"No {what} yet.")
    without = [
        name
        for name in chosen.demonstrations
        if not any(find(dataset, KeypointTrack, name, variant) for variant in chosen.variants)
    ]
    if without:
        found.append(f"No keypoints yet: {', '.join(without)}.")
    if not chosen.demonstrations:
        found.append("No demonstration, so there is nothing to track keypoints in.")
    return found


def _headline(chosen: Chosen) -> list[tuple[str, str]]:
    """A handful of (value, what it is)."""
    from bask_data.report.page import millimetres, percent

    dataset, rows = chosen.dataset, []
    n_frames = sum(camera.n_frames for name in chosen.scenes for camera in _cameras(dataset, name))
    if n_frames:
        rows.append((f"{n_frames:,}", f"frames scanned in {_count(len(chosen.scenes), 'scene')}"))
    n_objects = [len(o.instances) for name in chosen.scenes if (o := _readable(find(dataset, ObjectInstances, name)))]
    if n_objects:
        rows.append((f"{sum(n_objects)}", "objects found"))
    ious = [label["iou"] for one in chosen.masks.values() for label in one.get("labels") or []]
    if ious:
        rows.append((f"{np.median(ious):.2f}", f"median mask IoU of {_count(len(ious), 'labelled object')}"))
    n_matches = [
        c.metadata.n_matches for name in chosen.scenes if (c := _readable(find(dataset, Correspondences, name)))
    ]
    if n_matches:
        rows.append((f"{sum(n_matches):,}", "matches between views"))
    for variant, told in chosen.measured.descriptors().get("variants", {}).items():
        found = told["all"]["pck_4"]
        if found is not None:
            rows.append((percent(found), f"of true matches found within 4 % of the image's diagonal by {variant}"))
    for name, variant, scored in chosen.tracks:
        if variant != chosen.tracks[0][1]:  # Other variants are compared in their own section.
            continue
        try:
            found = figures_of_track(scored)
        except UNREADABLE:  # Its own section says so.
            continue
        where = name if variant == "main" else f"{name} ({variant})"
        rows.append((str(found["n_keypoints"]), f"keypoints tracked over {found['n_frames']} frames of {where}"))
        if found["error_m"].n:
            rows.append((millimetres(found["error_m"].median), f"median keypoint error in {where}"))
        if found["on_object"].n:
            rows.append((percent(found["on_object"].right), f"of keypoint positions on the right object in {where}"))
    return rows


def _readable(artifact: A | None) -> A | None:
    """The artifact if its metadata can be read: the headline leaves out what its own section will complain about."""
    if artifact is None:
        return None
    try:
        _ = artifact.metadata
    except UNREADABLE:
        return None
    return artifact


def _cameras(dataset: Dataset, name: str) -> list[Any]:
    recording = find_recording(dataset, name)
    return recording.cameras if recording else []


def _count(n: int, what: str) -> str:
    return f"{n:,} {what}" if n == 1 else f"{n:,} {what}s"


# Input frames --------------------------------------------------------------------------------------------------------


def frames(chosen: Chosen) -> list[Part]:
    """Colour above depth, a few frames of each recording."""

    def part(name: str) -> Part | None:
        recording = find_recording(chosen.dataset, name)
        if recording is None:
            return None
        sort = "scan" if isinstance(recording, Scan) else "demonstration"
        cameras = recording_figures(recording)
        n_frames = max(chosen.n_frames // min(len(cameras), N_CAMERAS), 2) if cameras else 0
        return {
            "title": f"{name} ({sort})",
            "cameras": [
                {"name": camera.name, **cameras[camera.name], **_contact_sheet(camera, cameras[camera.name], n_frames)}
                for camera in recording.cameras[:N_CAMERAS]
            ],
            "n_cameras_left_out": max(len(cameras) - N_CAMERAS, 0),
        }

    return per_item([*chosen.scenes, *chosen.demonstrations], part)


def _contact_sheet(camera: Any, found: dict[str, Any], n_frames: int) -> Part:
    near, far = found["depth_range_m"]
    tiles = []
    for i_frame in spread_frames(camera.n_frames, n_frames):
        depth = draw.depth_picture(_shrunk_depth(camera.depth(i_frame)), near, far)
        tiles.append(
            {
                "frame": i_frame,
                "colour": draw.jpeg_uri(draw.resize(camera.rgb(i_frame), TILE)),
                "depth": draw.jpeg_uri(draw.resize(depth, TILE)),
            }
        )
    ticks = [near + (far - near) * share for share in (0, 0.25, 0.5, 0.75, 1)]
    return {"tiles": tiles, "gradient": draw.turbo_gradient(), "ticks": [f"{tick:.2f}" for tick in ticks]}


def _shrunk_depth(depth: np.ndarray) -> np.ndarray:
    """Depth at the size of a tile, by the nearest pixel."""
    if depth.shape[1] <= TILE:
        return depth
    return draw.resize_labels(depth, (max(1, round(depth.shape[0] * TILE / depth.shape[1])), TILE))


# Reconstruction and objects ------------------------------------------------------------------------------------------


def reconstruction(chosen: Chosen) -> list[Part]:
    """The mesh in its own colours, beside a frame seen from the same place and with the cameras' way."""

    def part(name: str) -> Part | None:
        found = find(chosen.dataset, Reconstruction, name)
        if found is None:
            return None
        numbers = reconstruction_figures(found)
        low, high = (np.array(corner) for corner in numbers["bounds_m"])
        return {
            "title": name,
            "numbers": numbers,
            "box": " × ".join(f"{edge:.2f}" for edge in high - low),
            "suspects": numbers["suspect_frames"][:N_ROWS],
            "n_suspects_left_out": max(len(numbers["suspect_frames"]) - N_ROWS, 0),
            "unmeasured": [
                {
                    "centre": ", ".join(f"{x:.2f}" for x in region["centre"]),
                    "size_cm": " × ".join(f"{100 * edge:.1f}" for edge in region["size"]),
                    "volume_l": 1000 * region["volume"],
                }
                for region in numbers["unmeasured"][:N_ROWS]
            ],
            "plots": _frame_plots(found),
            "tiles": _mesh_tiles(chosen.dataset, name, found, None),
        }

    return per_item(chosen.scenes, part)


def _frame_plots(reconstruction: Reconstruction) -> list[Part]:
    """How well the mesh explains each frame; those that stand out are red."""
    from bask_data.drawing.plots import Curve, line_plot

    table = {name: reconstruction.frames[name].to_numpy() for name in reconstruction.frames.column_names}
    if not np.isfinite(table["residual_abs"]).any():
        return []
    cameras = sorted(set(table["camera"].tolist()))
    colours = [CAMERA_COLOURS[i % len(CAMERA_COLOURS)] for i in range(len(cameras))]
    legend = [{"colour": css, "name": name, "last": None} for name, css in zip(cameras, colours, strict=True)]

    def plot(title: str, column: str, factor: float, y_label: str, caption: str, top: float | None) -> Part:
        curves = []
        for name, css in zip(cameras, colours, strict=True):
            mine = table["camera"] == name
            curves.append(Curve(table["frame"][mine], factor * table[column][mine].astype(np.float64), css))
        bad = table["suspect"]
        if bad.any():
            curves.append(Curve(table["frame"][bad], factor * table[column][bad].astype(np.float64), BAD, dots=True))
        svg = line_plot(curves, x_label="frame", y_label=y_label, y_range=(0, top) if top else None)
        return {"title": title, "svg": svg, "caption": caption, **({"legend": legend} if len(cameras) > 1 else {})}

    return [
        plot(
            "How far each frame is from the mesh",
            "residual_abs",
            1000.0,
            "median distance, mm",
            "Measured depth against the mesh."
            + (
                " Red frames are explained far worse than the others: their poses are wrong, or something moved."
                if table["suspect"].any()
                else ""
            ),
            None,
        ),
        plot(
            "How much of each frame the mesh explains",
            "explained",
            1.0,
            "share of the measurements",
            "The share of a frame's measurements in the workspace that lie on the mesh.",
            1.02,
        ),
    ]


def objects(chosen: Chosen) -> list[Part]:
    """The mesh by instance, and the table of instances."""

    def part(name: str) -> Part | None:
        found = find(chosen.dataset, ObjectInstances, name)
        if found is None:
            return None
        numbers = objects_figures(found)
        mesh = find(chosen.dataset, Reconstruction, name)
        rows = [
            {
                "colour": draw.css(draw.instance_colour(row["id"])),
                **row,
                "extents_cm": " × ".join(f"{100 * edge:.1f}" for edge in row["extents"]),
            }
            for row in numbers["instances"][:N_ROWS]
        ]
        fits = mesh is not None and len(mesh.vertices) == len(found.vertex_instance)
        return {
            "title": name,
            "numbers": numbers,
            "rows": rows,
            "n_rows_left_out": max(len(numbers["instances"]) - N_ROWS, 0),
            "planes": [
                {**row, "normal": ", ".join(f"{x:.2f}" for x in row["plane"][:3])} for row in numbers["planes"][:N_ROWS]
            ],
            "neighbours": [
                {
                    "a": row["a"],
                    "b": row["b"],
                    "gap_m": row["gap_m"],
                    "colour_a": draw.css(draw.instance_colour(row["a"])),
                    "colour_b": draw.css(draw.instance_colour(row["b"])),
                }
                for row in numbers["neighbours"][:N_ROWS]
            ],
            "tiles": _mesh_tiles(chosen.dataset, name, mesh, found) if mesh is not None and fits else [],
            "why_no_picture": ""
            if fits
            else "there is no reconstruction to draw them on"
            if mesh is None
            else "the reconstruction is not the one they were found on; run `bask-data run`",
        }

    return per_item(chosen.scenes, part)


def _mesh_tiles(dataset: Dataset, name: str, mesh: Reconstruction, objects: ObjectInstances | None) -> list[Part]:
    from bask_data.drawing.mesh import MeshScene, Viewpoint, draw_path, orbit_views, up_direction

    if not len(mesh.triangles):
        return []
    scan = find(dataset, Scan, name)
    cameras = scan.cameras if scan else []
    # A camera that stands still shows one side only.
    camera = max(cameras, key=lambda one: np.ptp(one.world_from_cameras[:, :3, 3], axis=0).sum(), default=None)
    path = camera.world_from_cameras if camera else np.eye(4)[None]
    plane = find(dataset, ObjectInstances, name)
    up = up_direction(plane.support_plane if plane else None, path)
    scene = MeshScene(mesh.vertices, mesh.triangles)
    colours = mesh.colors if objects is None else draw.instance_colours(objects.vertex_instance, mesh.colors)
    sharp, ambient = objects is not None, 0.65 if objects is None else 0.35
    tiles = []
    if camera:
        i_frame = camera.n_frames // 2
        height, width = round(camera.height * PICTURE / camera.width), PICTURE
        K = camera.K.copy()
        K[:2, 2] = scale_pixels(camera.K[:2, 2], (camera.height, camera.width), (height, width))
        K[:2, :2] *= np.array([[width / camera.width], [height / camera.height]])
        view = Viewpoint(K, camera.world_from_cameras[i_frame], height, width)
        if objects is None:
            picture = draw.resize(camera.rgb(i_frame), PICTURE)
            tiles.append({"uri": draw.jpeg_uri(picture), "text": f"frame {i_frame} as recorded"})
        picture = scene.render(colours, view, sharp=sharp, ambient=ambient)
        tiles.append({"uri": draw.jpeg_uri(picture), "text": f"the mesh from where frame {i_frame} was taken"})
    for view, side in zip(
        orbit_views(mesh.vertices, path, up, height=3 * PICTURE // 4, width=PICTURE), ("left", "right"), strict=True
    ):
        picture = scene.render(colours, view, sharp=sharp, ambient=ambient)
        if objects is None and camera:
            picture = draw_path(picture, view, path, FIRST, LAST)
        tiles.append({"uri": draw.jpeg_uri(picture), "text": f"from above, {side}"})
    return tiles


# Masks ---------------------------------------------------------------------------------------------------------------


def masks(chosen: Chosen) -> list[Part]:
    """Tinted masks over frames, how visible each instance is, and the IoU with labels."""

    def part(name: str) -> Part | None:
        found = find(chosen.dataset, VisibleMasks, name)
        if found is None:
            return None
        numbers = chosen.masks[name]
        if "error" in numbers:
            return {"title": name, "error": numbers["error"]}
        truth, scan = find_truth(chosen.dataset, name), find(chosen.dataset, Scan, name)
        colours = [draw.css(draw.instance_colour(i)) for i in range(1, draw.N_COLOURS + 1)]
        objects = find(chosen.dataset, ObjectInstances, name)
        names = {row.id: row.name for row in objects.instances} if objects else {}
        tiles = [
            tile
            for camera in (scan.camera_names[:N_CAMERAS] if scan else [])
            if camera in found.camera_names
            for tile in _mask_tiles(
                scan, found, truth, camera, max(chosen.n_frames // min(len(found.camera_names), 2), 2)
            )
        ]
        return {
            "title": name,
            "numbers": numbers,
            "tiles": tiles,
            "n_cameras_left_out": max(len(found.camera_names) - N_CAMERAS, 0),
            "rows": [
                {**row, "colour": draw.css(draw.instance_colour(row["id"])), "name": names.get(row["id"], "")}
                for row in numbers["instances"][:N_ROWS]
            ],
            "n_rows_left_out": max(len(numbers["instances"]) - N_ROWS, 0),
            "labels": numbers["labels"],
            "colours": ["", *colours],
            "median_iou": float(np.median([row["iou"] for row in numbers["labels"]])) if numbers["labels"] else None,
        }

    return per_item(chosen.scenes, part)


def _mask_tiles(scan: Any, masks: VisibleMasks, truth: Truth | None, camera: str, n_frames: int) -> list[Part]:
    frames, instances = scan.camera(camera), masks.camera(camera)
    labelled = truth is not None and camera in truth.camera_names
    tiles = []
    for i_frame in spread_frames(min(frames.n_frames, instances.n_frames), n_frames):
        labels = truth.instance(camera, i_frame) if labelled and truth is not None else None
        instance, measured = instances.instance(i_frame), instances.measured(i_frame)
        picture = draw.mask_picture(frames.rgb(i_frame), instance, labels, PICTURE, measured)
        tiles.append({"uri": draw.jpeg_uri(picture), "text": f"{camera}, frame {i_frame}"})
    return tiles


# Matches -------------------------------------------------------------------------------------------------------------


def matches(chosen: Chosen) -> list[Part]:
    """Pairs of frames with lines between matching pixels, and why candidates were rejected."""

    def part(name: str) -> Part | None:
        found = find(chosen.dataset, Correspondences, name)
        if found is None:
            return None
        numbers = matches_figures(found)
        scan = find(chosen.dataset, Scan, name)
        most = max([numbers["n_matches"], *numbers["rejections"].values()], default=1) or 1
        reasons = sorted(numbers["rejections"], key=lambda why: -numbers["rejections"][why])
        bars = [("accepted", numbers["n_matches"]), *sorted(numbers["rejections"].items(), key=lambda row: -row[1])]
        return {
            "title": name,
            "numbers": numbers,
            "bars": [{"name": why, "n": n, "width": round(100 * n / most, 1)} for why, n in bars[:N_ROWS]],
            "tiles": _pair_tiles(scan, found) if scan else [],
            "reasons": reasons,
            "table": _tried_per_object(numbers, reasons)[:N_ROWS],
            "plots": _change_plots(found),
        }

    return per_item(chosen.scenes, part)


def _tried_per_object(numbers: dict[str, Any], reasons: Sequence[str]) -> list[Part]:
    """By object: how many of its pixels that were tried became matches, and why the others did not."""
    matches, rejected = numbers["matches_per_instance"], numbers["rejections_per_instance"]
    rows = []
    for i in sorted({*matches, *rejected}):
        counts = [rejected.get(i, {}).get(why, 0) for why in reasons]
        tried = matches.get(i, 0) + sum(counts)
        rows.append(
            {
                "id": i,
                "colour": draw.css(draw.instance_colour(i)),
                "n_matches": matches.get(i, 0),
                "tried": tried,
                "share": matches.get(i, 0) / tried if tried else None,
                "shares": [n / tried if tried else None for n in counts],
            }
        )
    return rows


def _change_plots(correspondences: Correspondences) -> list[Part]:
    """How different the two views of a pair are."""
    from bask_data.drawing.plots import histogram

    pairs = correspondences.pairs()
    if not pairs.num_rows:
        return []
    change = view_changes(correspondences.matches())
    distance, angle = (pairs[name].to_numpy().astype(np.float64) for name in ("distance", "angle"))
    drawn = [
        ("Distance of the cameras", 100 * distance, "centimetres", False),
        ("Angle between them", np.rad2deg(angle), "degrees", False),
    ]
    if len(change.scale):
        drawn += [
            ("Change of scale", change.scale, "times larger in the second view", True),
            ("Rotation in the image", np.rad2deg(change.rotation), "degrees", False),
        ]
    return [
        {"title": title, "svg": histogram(values, x_label=x_label, y_label="pairs", logarithmic=logarithmic)}
        for title, values, x_label, logarithmic in drawn
    ]


def _pair_tiles(scan: Scan, correspondences: Correspondences) -> list[Part]:
    """The pair with most matches and, if another, the one seen from most different directions with enough of them."""
    pairs = correspondences.pairs().to_pylist()
    if not pairs:
        return []
    fullest = max(pairs, key=lambda row: row["n_matches"])
    enough = [row for row in pairs if row["n_matches"] >= max(N_MATCHES, 0.1 * fullest["n_matches"])]
    widest = max(enough, key=lambda row: row["angle"], default=fullest)
    tiles = []
    for row, why in ((fullest, "most matches"), (widest, "widest angle")):
        known = row["camera_a"] in scan.camera_names and row["camera_b"] in scan.camera_names
        if not known or (why == "widest angle" and widest is fullest):
            continue
        table = correspondences.matches([row["pair"]])
        columns = {name: table[name].to_numpy() for name in ("u_a", "v_a", "u_b", "v_b", "instance")}
        some = draw.spread_matches(columns["instance"], N_MATCHES)
        picture = draw.matches_picture(
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
        tiles.append({"uri": draw.jpeg_uri(picture), "text": text})
    return tiles


# Training ------------------------------------------------------------------------------------------------------------


def training(chosen: Chosen) -> list[Part]:
    """Loss terms and validation metrics over the steps."""

    def part(variant: str) -> Part:
        found = chosen.networks[variant]
        numbers = descriptor_figures(found)
        marked = numbers["step"] if numbers["chosen_by"] is not None else None
        return {
            "title": variant,
            "numbers": numbers,
            "metrics": numbers["metrics"],
            "plots": _curve_plots(found, marked),
        }

    return _untitled_if_alone(per_item(list(chosen.networks), part))


def _curve_plots(descriptor: DescriptorNet, marked_step: int | None) -> list[Part]:
    """A plot per family of terms that share a scale, with a line where the weights are from."""
    table = descriptor.curve()
    step, names, value = table["step"].to_numpy(), np.array(table["name"].to_pylist(), dtype=object), table["value"]
    values = value.to_numpy()
    families: dict[str, list[str]] = {}
    for name in dict.fromkeys(names.tolist()):
        families.setdefault(_family(name), []).append(name)
    plots = []
    for family, members in families.items():
        colours = [draw.css(colour) for colour in draw.palette(len(members))]
        curves, legend = [], []
        for name, colour in list(zip(members, colours, strict=True))[: N_ITEMS * 4]:
            chosen = names == name
            curves.append(_curve(step[chosen], values[chosen], colour))
            legend.append({"name": name, "colour": colour, "last": float(values[chosen][-1])})
        plots.append({"title": family, "svg": _training_plot(curves, family, marked_step), "legend": legend})
    return plots


def _family(name: str) -> str:
    lowered = name.lower()
    for word, family in (
        ("loss", "loss"),
        ("pck", "share of matches within 1, 2, 4, 8 % of the diagonal"),
        ("px", "error in pixels"),
        ("pixel", "error in pixels"),
        ("rate", "learning rate"),
        ("accuracy", "shares"),
        ("share", "shares"),
        ("fraction", "shares"),
    ):
        if word in lowered:
            return family
    return name if len(name) < 40 else "other"


def _curve(x: np.ndarray, y: np.ndarray, colour: str) -> Any:
    from bask_data.drawing.plots import Curve

    # A long curve is noise upon a trend: what is drawn are means of short stretches.
    stride = max(len(x) // 400, 1)
    n = len(x) // stride * stride
    return Curve(
        x[:n].reshape(-1, stride).mean(axis=1), y[:n].reshape(-1, stride).mean(axis=1), colour, thick=len(x) < 50
    )


def _training_plot(curves: list[Any], family: str, marked_step: int | None) -> str:
    from bask_data.drawing.plots import line_plot

    share = family.startswith("share")
    return line_plot(
        curves,
        x_label="optimiser steps",
        y_label="share" if share else "pixels" if "pixel" in family else "value",
        logarithmic=family == "loss",
        marked_x=marked_step,
        y_range=(0, 1.02) if share else None,
    )


# Reference keypoints -------------------------------------------------------------------------------------------------


def reference(chosen: Chosen) -> list[Part]:
    """Where each keypoint was picked."""

    def part(variant: str) -> Part | None:
        found = find(chosen.dataset, ReferenceKeypoints, "", variant)
        if found is None:
            return None
        colours = draw.palette(len(found.picks))
        by_frame: dict[tuple[str, str, int], list[int]] = {}
        for i, pick in enumerate(found.picks):
            by_frame.setdefault((pick.recording, pick.camera, pick.frame), []).append(i)
        tiles: list[Part] = []
        unseen = []
        for (recording, camera, i_frame), indices in by_frame.items():
            image = frame_of(chosen.dataset, found.picks[indices[0]])
            if image is None:
                unseen.append(f"{recording}, {camera}, frame {i_frame}")
            elif len(tiles) < 2 * chosen.n_frames:
                marks = [_pick_mark(found.picks[i], i, colours[i]) for i in indices]
                uri = draw.jpeg_uri(draw.marks_picture(image, marks, 640 if len(by_frame) < 3 else PICTURE))
                tiles.append({"uri": uri, "text": f"{recording}, {camera}, frame {i_frame}"})
        return {
            "title": variant,
            "tiles": tiles,
            "n_frames_left_out": max(len(by_frame) - len(unseen) - len(tiles), 0),
            "unseen": unseen,
            "rows": [
                {"number": i + 1, "colour": draw.css(colours[i]), **pick.model_dump()}
                for i, pick in enumerate(found.picks[: 2 * N_ROWS])
            ],
            "n_rows_left_out": max(len(found.picks) - 2 * N_ROWS, 0),
        }

    return _untitled_if_alone(per_item(chosen.variants, part))


def _untitled_if_alone(parts: list[Part]) -> list[Part]:
    """A variant's name says something only where there are several."""
    return [{**part, "title": ""} for part in parts] if len(parts) == 1 else parts


def _pick_mark(pick: Pick, i: int, colour: draw.Colour) -> draw.Mark:
    return draw.Mark(number=i + 1, pixel=np.array([pick.u, pick.v]), colour=colour)


# Tracks --------------------------------------------------------------------------------------------------------------


def tracks(chosen: Chosen) -> list[Part]:
    """Keypoints in the frames of a demonstration, how certain and how right they are."""
    labels = {f"{name}/{variant}": (name, variant, scored) for name, variant, scored in chosen.tracks}

    def part(label: str) -> Part:
        name, variant, scored = labels[label]
        numbers = figures_of_track(scored)
        colours = draw.palette(len(scored.track.names))
        return {
            "title": name + (f" ({variant})" if len(chosen.variants) > 1 else ""),
            "numbers": numbers,
            "strips": _strips(
                scored, colours, chosen.n_frames if variant == chosen.variants[0] else chosen.n_frames // 2
            ),
            "n_cameras_left_out": max(len(scored.track.camera_names) - N_CAMERAS, 0),
            "plots": _track_plots(scored, colours),
            "rows": [
                {"number": i + 1, "colour": draw.css(colours[i]), **row}
                for i, row in enumerate(numbers["keypoints"][: 2 * N_ROWS])
            ],
            "n_rows_left_out": max(len(numbers["keypoints"]) - 2 * N_ROWS, 0),
            "n_trail": N_TRAIL,
        }

    parts = per_item(list(labels), part)
    compared = [{"title": one["title"], **one["numbers"]} for one in parts if "numbers" in one]
    return [{"title": "", "compared": compared}, *parts] if len(compared) > 1 else parts


def _strips(scored: TrackScores, colours: list[draw.Colour], n_frames: int) -> list[Part]:
    """A strip of frames per camera, with keypoints, trails, one-sigma ellipses and true places."""
    recording = scored.recording
    if recording is None:
        return []
    first = scored.track.camera_names[:N_CAMERAS]
    strips = []
    for seen in camera_tracks(scored.track, recording.cameras, scored.places):
        camera = seen.camera
        if camera.name not in first:
            continue
        tiles = []
        for i_frame in spread_frames(min(camera.n_frames, len(seen.pixel)), n_frames):
            uri = draw.jpeg_uri(draw.marks_picture(camera.rgb(i_frame), seen.marks(i_frame, colours), PICTURE))
            tiles.append({"uri": uri, "text": f"frame {i_frame}"})
        strips.append({"camera": camera.name, "tiles": tiles})
    return strips


def _track_plots(scored: TrackScores, colours: list[draw.Colour]) -> list[Part]:
    plots = []
    if not scored.why_no_error():
        plots.append(
            {
                "title": "Error against the truth",
                "svg": _over_time(scored.error * 1000, colours, "error, mm"),
                "caption": "Distance between each keypoint's mean and its true place; the thick line is their median.",
            }
        )
    plots.append(
        {
            "title": "Spread",
            "svg": _over_time(scored.spread * 1000, colours, "spread, mm"),
            "caption": "Root of the covariance's trace: how unsure the filter is; the thick line is the median.",
        }
    )
    if not scored.why_no_share():
        plots.append(
            {
                "title": "On the right object",
                "svg": _share_plot(scored),
                "caption": "Share of the keypoints whose object is in view that lie on it (solid) or within "
                f"{TOLERANCE_PX:g} px of it (dashed), by the labels. "
                "Orange: what pixels drawn blindly would reach.",
            }
        )
    return plots


def _over_time(values: np.ndarray, colours: list[draw.Colour], y_label: str) -> str:
    from bask_data.drawing.plots import Curve, line_plot

    t = np.arange(len(values))
    curves = [
        Curve(t, values[:, i], draw.css(colour)) for i, colour in enumerate(colours) if np.isfinite(values[:, i]).any()
    ]
    known = np.isfinite(values).any(axis=1)
    middle = np.full(len(values), np.nan)
    middle[known] = np.nanmedian(values[known], axis=1)
    return line_plot([*curves, Curve(t, middle, "", thick=True)], x_label="frame", y_label=y_label)


def _share_plot(scored: TrackScores) -> str:
    from bask_data.core.scores import object_shares
    from bask_data.drawing.plots import Curve, line_plot

    per_frame = [object_shares(list(frame)) for frame in zip(*scored.landings.values(), strict=True)]
    t = np.arange(len(per_frame))
    return line_plot(
        [
            Curve(t, np.array([one.chance for one in per_frame]), "#d08020", dashed=True),
            Curve(t, np.array([one.near for one in per_frame]), "", dashed=True),
            Curve(t, np.array([one.right for one in per_frame]), "", thick=True),
        ],
        x_label="frame",
        y_label="share",
        y_range=(0, 1.02),
    )
