"""The table with a task's objects: built once, with a new layout for each recording."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any
from xml.etree.ElementTree import Element, SubElement, tostring

import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray

from bask_data.errors import UsageError
from bask_data.sim import gripper, textures
from bask_data.sim.engine import import_mujoco
from bask_data.sim.inventory import THINGS
from bask_data.sim.objects import Thing, add_geom, clutter, numbers
from bask_data.sim.options import TASKS, SimOptions

GAP = 0.04
"""Least distance between objects, metres, unless one stands on the other: above DBSCAN's default radius of 3 cm."""

TOUCHING = 0.003
"""Distance below which two objects count as touching in ground truth, metres. Chosen."""

TABLE = (0.52, 0.42)
"""Half sizes of the table top, metres; its centre is the origin of the world frame, z up."""

NEAR, FAR = 0.02, 8.0
"""Near and far plane of the renderer, metres. Chosen."""

STEP = 0.002
"""Physics time step, seconds: MuJoCo's default."""

SETTLE, MAX_SETTLE = 0.2, 3.0
"""Seconds between checks whether all objects are at rest, and the longest time to come to rest."""

STILL = 0.003
"""Metres and radians per second below which objects count as at rest: 0.6 mm in `SETTLE` seconds. Chosen."""

OVERHEAD_AT, OVERHEAD_TO, OVERHEAD_FOV_DEG = (0.0, -0.42, 0.88), (0.0, 0.03, 0.03), 46.0
"""Position and target of the overhead camera, metres, and its vertical field of view, degrees. Chosen."""


@dataclass(frozen=True)
class Layout:
    """Initial poses and lighting; restoring them restores the scene exactly."""

    body_pos: Float[ndarray, "b 3"]
    body_quat_wxyz: Float[ndarray, "b 4"]
    light_pos: Float[ndarray, "l 3"]
    light_diffuse: Float[ndarray, "l 3"]
    qpos: Float[ndarray, " q"]


class World:
    """MuJoCo's model and state, and the labels of bodies."""

    def __init__(self, options: SimOptions) -> None:
        """Build the world of a task, with sizes and textures from the seed."""
        mujoco = import_mujoco()
        self.options = options
        seed = [options.seed, TASKS.index(options.task)]
        things, self.dimensions = THINGS[options.task](np.random.default_rng([*seed, 0]))
        things += [clutter(np.random.default_rng([*seed, 1, i]), i) for i in range(options.clutter)]
        self.things = {thing.name: thing for thing in things}
        colours = {name: hsv for thing in things for name, hsv in thing.labelled.items()}
        self.labels = {name: i + 1 for i, name in enumerate(colours)}
        self.model = mujoco.MjModel.from_xml_string(_mjcf(things, options))
        _paint(self.model, things, seed, options.background_seed)
        self.data = mujoco.MjData(self.model)

    # Labels and poses -------------------------------------------------------------------------------------------------

    @property
    def label_names(self) -> dict[int, str]:
        """Names by label, including the gripper's."""
        return {**{label: name for name, label in self.labels.items()}, gripper.LABEL: "gripper"}

    @cached_property
    def geom_labels(self) -> UInt8[ndarray, " g"]:
        """Label of each geom; 0 for table and floor."""
        of_body = np.zeros(self.model.nbody, dtype=np.uint8)
        for i_body in range(1, self.model.nbody):
            name = self.model.body(i_body).name
            # Parents precede their children.
            of_body[i_body] = self.labels.get(name, of_body[self.model.body_parentid[i_body]])
            if name == "hand":
                of_body[i_body] = gripper.LABEL
        return of_body[self.model.geom_bodyid]

    @cached_property
    def geom_is_glass(self) -> Bool[ndarray, " g"]:
        """Whether each geom is transparent."""
        return self.model.geom_rgba[:, 3] < 1

    def world_from_objects(self) -> Float[ndarray, "k 4 4"]:
        """Poses of the labelled bodies, metres, in the order of labels."""
        return np.stack([self.world_from_body(name) for name in self.labels])

    def world_from_body(self, name: str) -> Float[ndarray, "4 4"]:
        """Pose of a body, metres."""
        body = self.data.body(name)
        transform = np.eye(4)
        transform[:3, :3] = body.xmat.reshape(3, 3)
        transform[:3, 3] = body.xpos
        return transform

    def address(self, joint: str) -> int:
        """Index in `qpos` of a joint's first position."""
        return int(self.model.jnt_qposadr[self.model.joint(joint).id])

    def is_object_geom(self) -> Bool[ndarray, " g"]:
        """Whether each geom belongs to an object, not to table, floor or gripper."""
        return (self.geom_labels > 0) & (self.geom_labels != gripper.LABEL)

    def touching(self) -> list[tuple[int, int]]:
        """Pairs of labels whose bodies are closer than `TOUCHING`."""
        labels = sorted(self.labels.values())
        return [
            (a, b)
            for i, a in enumerate(labels)
            for b in labels[i + 1 :]
            if self.distance(self._geoms_of_label(a), self._geoms_of_label(b), TOUCHING) < TOUCHING
        ]

    def _geoms_of_label(self, label: int) -> ndarray:
        return np.flatnonzero(self.geom_labels == label)

    def geoms_of(self, name: str) -> ndarray:
        """Indices of the geoms of an object and its parts."""
        return np.flatnonzero(np.isin(self.geom_labels, [self.labels[part] for part in self.things[name].labelled]))

    def distance(self, geoms_a: ndarray, geoms_b: ndarray, most: float) -> float:
        """Metres between two sets of geoms, but at most `most`; negative if they overlap."""
        mujoco = import_mujoco()
        least = most
        at, reach = self.data.geom_xpos, self.model.geom_rbound
        for a in geoms_a:
            for b in geoms_b:
                if np.linalg.norm(at[a] - at[b]) - reach[a] - reach[b] < least:
                    least = min(least, mujoco.mj_geomDistance(self.model, self.data, int(a), int(b), least, None))
        return float(least)

    # Laying out -------------------------------------------------------------------------------------------------------

    def lay_out(self, rng: np.random.Generator) -> Layout:
        """Place all objects at random, `GAP` apart, and let them come to rest.

        Raises:
            UsageError: there is not enough room.
        """
        for _ in range(60):
            self._reset()
            if self._place_all(rng) and self._settle() and self._stands_apart():
                self._light(rng)
                return self._layout()
        raise UsageError(
            "simulator",
            "--clutter",
            expected=f"objects that fit on the table {GAP * 100:g} cm apart",
            got=f"{len(self.things)} objects",
            fix="use less --clutter.",
        )

    def restore(self, layout: Layout) -> None:
        """Restore a layout."""
        import_mujoco().mj_resetData(self.model, self.data)
        self.model.body_pos[:], self.model.body_quat[:] = layout.body_pos, layout.body_quat_wxyz
        self.model.light_pos[:], self.model.light_diffuse[:] = layout.light_pos, layout.light_diffuse
        self.data.ctrl[:] = gripper.MAX_WIDTH / 2
        self.show(layout.qpos)

    def show(self, qpos: Float[ndarray, " q"]) -> None:
        """Set the joint positions, for rendering."""
        mujoco = import_mujoco()
        self.data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)

    def _layout(self) -> Layout:
        model = self.model
        return Layout(
            model.body_pos.copy(),
            model.body_quat.copy(),
            model.light_pos.copy(),
            model.light_diffuse.copy(),
            self.data.qpos.copy(),
        )

    def _reset(self) -> None:
        import_mujoco().mj_resetData(self.model, self.data)
        self.data.ctrl[:] = gripper.MAX_WIDTH / 2
        self.data.joint("left").qpos[:] = self.data.joint("right").qpos[:] = gripper.MAX_WIDTH / 2

    def _place_all(self, rng: np.random.Generator) -> bool:
        placed: list[str] = []
        for thing in self.things.values():
            for _ in range(60):
                self._place(thing, rng)
                others = [name for name in placed if name != thing.on]
                if all(self.distance(self.geoms_of(thing.name), self.geoms_of(name), GAP) >= GAP for name in others):
                    break
            else:
                return False
            placed.append(thing.name)
        return True

    def _place(self, thing: Thing, rng: np.random.Generator) -> None:
        mujoco = import_mujoco()
        x, y, yaw = rng.uniform(*thing.x), rng.uniform(*thing.y), rng.uniform(*thing.yaw)
        at, quat = np.array([x, y, thing.z]), np.array([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)])
        if thing.on:
            below = self.world_from_body(thing.on)
            at = below[:3, :3] @ at + below[:3, 3]
        if thing.free:
            self.data.joint(thing.name).qpos[:] = [*at, *quat]
        else:
            self.model.body(thing.name).pos[:], self.model.body(thing.name).quat[:] = at, quat
        for joint, positions in thing.joints.items():
            self.data.joint(joint).qpos[:] = rng.uniform(*positions)
        mujoco.mj_kinematics(self.model, self.data)

    def _settle(self) -> bool:
        """Simulate until all objects are at rest; False if they take longer than `MAX_SETTLE`."""
        mujoco = import_mujoco()
        mujoco.mj_forward(self.model, self.data)
        still = False
        while not still and self.data.time < MAX_SETTLE:
            mujoco.mj_step(self.model, self.data, nstep=round(SETTLE / STEP))
            still = bool(np.abs(self.data.qvel).max() < STILL)
        self.data.qvel[:] = 0
        mujoco.mj_forward(self.model, self.data)
        return still

    def _stands_apart(self) -> bool:
        """Whether the objects at rest are on the table and `GAP` apart."""
        things = list(self.things.values())
        for i, a in enumerate(things):
            if self.world_from_body(a.name)[2, 3] < -0.01:
                return False
            for b in things[i + 1 :]:
                if b.on != a.name and self.distance(self.geoms_of(a.name), self.geoms_of(b.name), GAP) < GAP - 5e-4:
                    return False
        return True

    def _light(self, rng: np.random.Generator) -> None:
        angle, strength = rng.uniform(0, 2 * np.pi), rng.uniform(0.40, 0.60)
        self.model.light_pos[0] = [0.9 * np.cos(angle), 0.9 * np.sin(angle), 1.8]
        self.model.light_diffuse[0] = strength * np.array([1.0, rng.uniform(0.93, 1.0), rng.uniform(0.86, 1.0)])


# The model ------------------------------------------------------------------------------------------------------------


def _mjcf(things: list[Thing], options: SimOptions) -> str:
    mujoco = Element("mujoco", {"model": options.task})
    SubElement(mujoco, "compiler", {"angle": "radian", "autolimits": "false"})
    SubElement(
        mujoco,
        "option",
        {
            "timestep": f"{STEP}",
            "integrator": "implicitfast",
            "cone": "elliptic",
            "impratio": "10",
            "noslip_iterations": "3",
        },
    )
    # The near and far plane are in units of the extent.
    SubElement(mujoco, "statistic", {"extent": "1", "center": "0 0 0"})
    visual = SubElement(mujoco, "visual")
    height, width = (max(values) for values in zip(*(options.size(name) for name in options.cameras), strict=True))
    SubElement(visual, "global", {"offwidth": f"{width}", "offheight": f"{height}"})
    # Without a GPU, shadows, multisampling and reflections take ten times as long as the rest.
    SubElement(
        visual, "quality", {"offsamples": "0", "shadowsize": "0", "numslices": "48", "numstacks": "8", "numquads": "2"}
    )
    SubElement(visual, "map", {"znear": f"{NEAR}", "zfar": f"{FAR}"})
    SubElement(visual, "headlight", {"ambient": "0.38 0.38 0.40", "diffuse": "0.25 0.25 0.25", "specular": "0 0 0"})
    assets = SubElement(mujoco, "asset")
    for name, size in (("table", 512), ("floor", 256)):
        size_ = {"width": f"{size}", "height": f"{size}"}
        SubElement(assets, "texture", {"name": name, "type": "2d", "builtin": "flat", **size_})
        SubElement(assets, "material", {"name": name, "texture": name, "specular": "0.1"})
    for name in (*(material for thing in things for material in thing.materials), "gripper"):
        size_ = {"width": f"{textures.FACE}", "height": f"{6 * textures.FACE}"}
        SubElement(assets, "texture", {"name": name, "type": "cube", "builtin": "flat", **size_})
        SubElement(assets, "material", {"name": name, "texture": name, "specular": "0.15", "shininess": "0.3"})
    sky = {"type": "skybox", "builtin": "gradient", "rgb1": "0.75 0.8 0.85", "rgb2": "0.55 0.58 0.62"}
    SubElement(assets, "texture", {"name": "sky", **sky, "width": "64", "height": "384"})
    world = SubElement(mujoco, "worldbody")
    lamp = {"cutoff": "120", "exponent": "0", "castshadow": "false", "specular": "0.2 0.2 0.2"}
    SubElement(world, "light", {"name": "lamp", "pos": "0.6 -0.6 1.8", "dir": "0 0 -1", **lamp})
    add_geom(world, "box", (*TABLE, 0.02), (0, 0, -0.02), material="table")
    add_geom(world, "box", (2.5, 2.5, 0.02), (0, 0, -0.77), material="floor", contype="0", conaffinity="0")
    for x in (-1, 1):
        for y in (-1, 1):
            leg = (x * (TABLE[0] - 0.04), y * (TABLE[1] - 0.04), -0.395)
            add_geom(world, "box", (0.025, 0.025, 0.355), leg, material="table", tint=(0.6, 0.6, 0.6, 1))
    SubElement(world, "camera", {"name": "overhead", **_overhead()})
    for thing in things:
        world.append(thing.body)
    gripper.add_gripper(mujoco, world)
    contact = SubElement(mujoco, "contact")
    for thing in things:
        for part in thing.parts:
            SubElement(contact, "exclude", {"body1": thing.name, "body2": part})
    return tostring(mujoco, encoding="unicode")


def _overhead() -> dict[str, str]:
    forward = np.subtract(OVERHEAD_TO, OVERHEAD_AT)
    forward = forward / np.linalg.norm(forward)
    right = np.array([1.0, 0.0, 0.0])
    up = np.cross(right, forward)
    return {"pos": numbers(OVERHEAD_AT), "xyaxes": numbers([*right, *up]), "fovy": f"{OVERHEAD_FOV_DEG}"}


def _paint(model: Any, things: list[Thing], seed: list[int], background_seed: int | None) -> None:
    """Fill in the textures, for which the model only reserves memory."""
    images = {
        "table": textures.wood(np.random.default_rng([*seed, 2]), 512),
        "floor": textures.tiles(np.random.default_rng([*seed, 3]), 256),
        "gripper": textures.object_faces(np.random.default_rng([*seed, 4]), 0.6, 0.08, 0.55),
    }
    if background_seed is not None:
        for i, name in enumerate(("table", "floor")):
            images[name] = textures.covering(np.random.default_rng([background_seed, i]), len(images[name]))
    colours = [(name, hsv, thing) for thing in things for name, hsv in thing.labelled.items()]
    materials = [material for thing in things for material in thing.materials]
    for i, (name, (hue, saturation, value), thing) in enumerate(colours):
        rng = np.random.default_rng([*seed, 5, i])
        hue += rng.uniform(-0.02, 0.02)
        draw = textures.symmetric_faces if thing.is_symmetric else textures.object_faces
        images[name] = draw(rng, hue, saturation, value)
        walls = [material for material in materials if material.startswith(f"{name}/")]
        if thing.paint_walls and walls:
            images |= zip(walls, thing.paint_walls(rng, (hue, saturation, value), len(walls)), strict=True)
        else:
            images |= {wall: draw(rng, hue, saturation, value) for wall in walls}
    for name, image in images.items():
        begin = int(model.tex_adr[model.texture(name).id])
        model.tex_data[begin : begin + image.size] = image.reshape(-1)
