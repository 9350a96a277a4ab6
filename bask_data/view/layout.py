"""The viewer's layout: the scene on the left, images and plots on the right, time below; a tab for each item.

With heat maps, these are on the right, and images and plots below the scene.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from bask_data.view.sheet import DrawnItem

BACKGROUND = [24, 26, 30]
"""Background of 3D views: light surfaces and coloured lines stand out from it in any theme of the viewer."""


def layout(items: Sequence[DrawnItem]) -> Any:
    """The blueprint: the main views visible at once, the others in tabs."""
    import rerun.blueprint as rrb

    return rrb.Blueprint(
        rrb.Tabs(*[_item(item) for item in items]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="frame", loop_mode="all"),
    )


def _item(item: DrawnItem) -> Any:
    import rerun.blueprint as rrb

    beside, heat = _beside(item), _heat(item)
    if heat is not None:
        tabs = [view for group in beside for view in group]
        left = rrb.Vertical(_scene(item), rrb.Tabs(*tabs, active_tab=0))
        return rrb.Horizontal(left, heat, column_shares=[4, 5], name=item.name)
    groups = [rrb.Tabs(*group, active_tab=0) if len(group) > 1 else group[0] for group in beside]
    parts = [_scene(item), *([rrb.Vertical(*groups)] if groups else [])]
    return rrb.Horizontal(*parts, column_shares=[5, 4][: len(parts)], name=item.name)


def _heat(item: DrawnItem) -> Any:
    """Heat maps of all keypoints beside the image they were picked in, and beliefs, in a tab per camera; None without
    any."""
    import rerun.blueprint as rrb

    cameras = [
        rrb.Grid(
            rrb.Spatial2DView(origin=f"/{item.name}/heat/reference", name="picked here"),
            *[
                rrb.Spatial2DView(origin=f"/{item.name}/heat/{_escaped(camera)}/{_escaped(point)}", name=point)
                for point in points
            ],
            name=f"Heat maps, {camera}",
        )
        for camera, points in item.heated.items()
    ]
    cameras += [
        rrb.Grid(
            *[
                rrb.Spatial2DView(origin=f"/{item.name}/belief/{_escaped(camera)}/{_escaped(point)}", name=point)
                for point in points
            ],
            name=f"Belief, {camera}",
        )
        for camera, points in item.believed.items()
    ]
    return rrb.Tabs(*cameras, active_tab=0) if cameras else None


def _scene(item: DrawnItem) -> Any:
    """Tabs of the surface, of its instances, and of the measured depth as points."""
    import rerun.blueprint as rrb

    tabs = []
    if "surface" in item.layers:
        tabs.append(_space(item, "Surface", hidden=("instances",), depth=False))
    if "instances" in item.layers:
        tabs.append(_space(item, "Instances", hidden=("surface", "matches"), depth=False))
    if "frames" in item.layers:
        tabs.append(_space(item, "Measured depth", hidden=("surface", "instances", "matches", "boxes"), depth=True))
    return rrb.Tabs(*tabs, active_tab=0)


def _space(item: DrawnItem, name: str, *, hidden: Sequence[str], depth: bool) -> Any:
    import rerun.blueprint as rrb

    root = f"/{item.name}/world"
    overrides: dict[Any, Any] = {f"{root}/{layer}": rrb.EntityBehavior(visible=False) for layer in hidden}
    for camera in item.cameras:
        place = f"{root}/cameras/{_escaped(camera)}"
        for layer in ("truth", "inferred", "keypoints", "particles", *(() if depth else ("depth",))):
            overrides[f"{place}/{layer}"] = rrb.EntityBehavior(visible=False)
    eye = None
    if item.eye is not None:
        eye = rrb.EyeControls3D(position=item.eye.position, look_target=item.eye.target, eye_up=item.eye.up)
    return rrb.Spatial3DView(
        origin=root, name=name, overrides=overrides, eye_controls=eye, line_grid=False, background=BACKGROUND
    )


def _beside(item: DrawnItem) -> list[list[Any]]:
    """Groups of images, matches and plots, each of which shows one of its views at a time."""
    import rerun.blueprint as rrb

    images = [_images(item, camera) for camera in item.cameras]
    matches = [rrb.Spatial2DView(origin=f"/{item.name}/matches", name="Matches")] if "matches" in item.layers else []
    plots = [
        rrb.TimeSeriesView(origin=f"/{item.name}/plots/{layer}", name=title)
        for layer, title in (("gripper_width", "Gripper"), ("spread", "Spread of the keypoints"), ("action", "Action"))
        if layer in item.layers
    ]
    return [group for group in (images, matches, plots) if group]


def _images(item: DrawnItem, camera: str) -> Any:
    import rerun.blueprint as rrb

    origin = f"/{item.name}/world/cameras/{_escaped(camera)}"
    hidden: dict[Any, Any] = {f"{origin}/{layer}": rrb.EntityBehavior(visible=False) for layer in ("truth", "inferred")}
    colour = [f"$origin/{layer}" for layer in ("rgb", "masks", "inferred", "truth", "particles", "keypoints")]
    return rrb.Horizontal(
        rrb.Spatial2DView(origin=origin, contents=colour, name=camera, overrides=hidden),
        rrb.Spatial2DView(origin=origin, contents=["$origin/depth"], name=f"{camera}, depth"),
        name=camera,
    )


def _escaped(name: str) -> str:
    import rerun as rr

    return rr.escape_entity_path_part(name)
