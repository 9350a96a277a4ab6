"""The sections on surfaces: the reconstruction and its objects."""

from __future__ import annotations

import numpy as np

from bask_data.core.geometry import scale_pixels
from bask_data.dataset import Dataset
from bask_data.drawing.colours import css, instance_colour, instance_colours
from bask_data.drawing.images import jpeg_uri, resize
from bask_data.drawing.mesh import MeshScene, Viewpoint, draw_path, orbit_views, up_direction
from bask_data.drawing.plots import Curve, line_plot
from bask_data.evaluation.artifact_figures import objects_figures, reconstruction_figures
from bask_data.evaluation.lookup import find
from bask_data.kinds import ObjectInstances, Reconstruction, Scan
from bask_data.report.chosen import N_ROWS, PICTURE, Chosen, Part, per_item
from bask_data.report.turned import surface_text

FIRST, LAST = (80, 220, 120), (240, 70, 90)
"""Colours of the first and last camera on the path."""
BAD = "#e0453a"
"""Colour of suspect frames."""
CAMERA_COLOURS = ("", "#4a90d0", "#3f9f74", "#a07cc0", "#b8923a")
"""Colours of the cameras' curves, none of them near `BAD`; the first is that of the text."""
NO_PICTURES: Part = {"tiles": [], "orbit": []}
"""Of an empty mesh."""


def reconstruction(chosen: Chosen) -> list[Part]:
    """The mesh in its colours, beside a frame from the same viewpoint, and with the path of the cameras."""

    def part(name: str) -> Part | None:
        mesh = find(chosen.dataset, Reconstruction, name)
        if mesh is None:
            return None
        numbers = reconstruction_figures(mesh)
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
            "plots": _frame_plots(mesh),
            **_pictures(chosen.dataset, name, mesh, None),
            "surface": _surface(chosen.dataset, name, mesh),
        }

    return per_item(chosen.scenes, part)


def _frame_plots(reconstruction: Reconstruction) -> list[Part]:
    """How well the mesh explains each frame; suspect frames are red."""
    table = {name: reconstruction.frames[name].to_numpy() for name in reconstruction.frames.column_names}
    if not np.isfinite(table["residual_abs"]).any():
        return []
    cameras = sorted(set(table["camera"].tolist()))
    colours = [CAMERA_COLOURS[i % len(CAMERA_COLOURS)] for i in range(len(cameras))]
    legend = [{"colour": css, "name": name, "last": None} for name, css in zip(cameras, colours, strict=True)]

    def plot(title: str, column: str, factor: float, y_label: str, caption: str, top: float | None) -> Part:
        curves = []
        for name, colour in zip(cameras, colours, strict=True):
            mine = table["camera"] == name
            curves.append(Curve(table["frame"][mine], factor * table[column][mine].astype(np.float64), colour))
        bad = table["suspect"]
        if bad.any():
            curves.append(Curve(table["frame"][bad], factor * table[column][bad].astype(np.float64), BAD, dots=True))
        svg = line_plot(curves, x_label="frame", y_label=y_label, y_range=(0, top) if top else None)
        return {"title": title, "svg": svg, "caption": caption, **({"legend": legend} if len(cameras) > 1 else {})}

    return [
        plot(
            "Distance of each frame from the mesh",
            "residual_abs",
            1000.0,
            "median distance, mm",
            "Median distance between measured depth and mesh."
            + (
                " Red frames fit far worse than the others: their poses are inaccurate, or something moved."
                if table["suspect"].any()
                else ""
            ),
            None,
        ),
        plot(
            "Share of each frame that the mesh explains",
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
        instances = find(chosen.dataset, ObjectInstances, name)
        if instances is None:
            return None
        numbers = objects_figures(instances)
        mesh = find(chosen.dataset, Reconstruction, name)
        rows = [
            {
                "colour": css(instance_colour(row["id"])),
                **row,
                "reasons": instance.reasons,
                "extents_cm": " × ".join(f"{100 * edge:.1f}" for edge in row["extents"]),
            }
            for instance, row in zip(instances.instances, numbers["instances"][:N_ROWS], strict=False)
        ]
        fits = mesh is not None and len(mesh.vertices) == len(instances.vertex_instance)
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
                    "colour_a": css(instance_colour(row["a"])),
                    "colour_b": css(instance_colour(row["b"])),
                }
                for row in numbers["neighbours"][:N_ROWS]
            ],
            **(_pictures(chosen.dataset, name, mesh, instances) if mesh is not None and fits else NO_PICTURES),
            "why_no_picture": ""
            if fits
            else "there is no reconstruction to draw the objects on"
            if mesh is None
            else "the objects were made from another reconstruction; run `bask-data run`",
        }

    return per_item(chosen.scenes, part)


def _surface(dataset: Dataset, name: str, mesh: Reconstruction) -> str:
    """The surface for `surface.js`, with objects if they are those of this mesh."""
    objects, scan = find(dataset, ObjectInstances, name), find(dataset, Scan, name)
    if objects is not None and len(objects.vertex_instance) != len(mesh.vertices):
        objects = None
    return surface_text(mesh, objects, scan.cameras if scan else [], (FIRST, LAST))


def _pictures(dataset: Dataset, name: str, mesh: Reconstruction, objects: ObjectInstances | None) -> Part:
    """`tiles`: a frame and the mesh as it saw it; `orbit`: the mesh from above."""
    if not len(mesh.triangles):
        return NO_PICTURES
    scan = find(dataset, Scan, name)
    cameras = scan.cameras if scan else []
    # A static camera shows one side only.
    camera = max(cameras, key=lambda camera: np.ptp(camera.world_from_cameras[:, :3, 3], axis=0).sum(), default=None)
    path = camera.world_from_cameras if camera else np.eye(4)[None]
    plane = find(dataset, ObjectInstances, name)
    up = up_direction(plane.support_plane if plane else None, path)
    scene = MeshScene(mesh.vertices, mesh.triangles)
    colours = mesh.colors if objects is None else instance_colours(objects.vertex_instance, mesh.colors)
    sharp, ambient = objects is not None, 0.65 if objects is None else 0.35
    tiles, orbit = [], []
    if camera:
        i_frame = camera.n_frames // 2
        height, width = round(camera.height * PICTURE / camera.width), PICTURE
        K = camera.Ks[i_frame].copy()
        K[:2, 2] = scale_pixels(K[:2, 2], (camera.height, camera.width), (height, width))
        K[:2, :2] *= np.array([[width / camera.width], [height / camera.height]])
        view = Viewpoint(K, camera.world_from_cameras[i_frame], height, width)
        if objects is None:
            picture = resize(camera.rgb(i_frame), PICTURE)
            tiles.append({"uri": jpeg_uri(picture), "text": f"frame {i_frame} as recorded"})
        picture = scene.render(colours, view, sharp=sharp, ambient=ambient)
        tiles.append({"uri": jpeg_uri(picture), "text": f"the mesh from the viewpoint of frame {i_frame}"})
    for view, side in zip(
        orbit_views(mesh.vertices, path, up, height=3 * PICTURE // 4, width=PICTURE), ("left", "right"), strict=True
    ):
        picture = scene.render(colours, view, sharp=sharp, ambient=ambient)
        if objects is None and camera:
            picture = draw_path(picture, view, path, FIRST, LAST)
        orbit.append({"uri": jpeg_uri(picture), "text": f"from above, {side}"})
    return {"tiles": tiles, "orbit": orbit}
