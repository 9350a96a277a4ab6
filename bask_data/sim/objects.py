"""The objects of the tasks, as MuJoCo bodies made of primitives. Metres; an object's frame has z up, origin below.

MuJoCo's sizes are half sizes: a box of `size` (x, y, z) is twice as long along each axis.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from bask_data.sim.textures import Faces

Range = tuple[float, float]
Vector = Sequence[float | int] | np.ndarray
Colour = tuple[float, float, float]
WallPainter = Callable[[np.random.Generator, Colour, int], list[Faces]]


@dataclass(frozen=True)
class Dimensions:
    """Sizes used by experts and tests, metres; they vary a little with the seed."""

    values: dict[str, float] = field(default_factory=dict)

    def __getitem__(self, name: str) -> float:
        return self.values[name]


@dataclass(frozen=True)
class Thing:
    """An object and its range of poses.

    Args:
        body: MJCF element; its position is set for each scene.
        free: whether the object can move; otherwise it is fixed to the table.
        x, y: ranges of the origin on the table, metres.
        yaw: range of the rotation about z, radians.
        z: height of the origin, metres.
        on: name of the object that it stands on, with `x`, `y` and `z` in that object's frame; empty for the table.
        hsv: main colour of the texture.
        is_symmetric: whether its appearance is invariant to rotation about z.
        parts: main colours by name of bodies inside `body` with their own labels.
        joints: ranges of the initial positions of the parts' joints, by name; radians or metres.
        paint_walls: draws the textures of all walls together; without it, each wall is drawn on its own.
    """

    name: str
    body: Element
    free: bool
    x: Range
    y: Range
    yaw: Range
    hsv: tuple[float, float, float]
    z: float = 0.0
    on: str = ""
    is_symmetric: bool = False
    parts: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    joints: dict[str, Range] = field(default_factory=dict)
    paint_walls: WallPainter | None = None

    @property
    def materials(self) -> list[str]:
        """Names of the textures: one per labelled body, and `name/wall` for walls with their own."""
        used = {geom.get("material", "") for geom in self.body.iter("geom")}
        return [*self.labelled, *sorted(name for name in used if "/" in name)]

    @property
    def labelled(self) -> dict[str, tuple[float, float, float]]:
        """Main colours by name of the object and its parts."""
        return {self.name: self.hsv, **self.parts}


def numbers(values: object) -> str:
    """Numbers in MJCF's format, separated by spaces."""
    return " ".join(f"{float(value):.9g}" for value in np.ravel(np.asarray(values)))


def add_geom(
    parent: Element,
    kind: str,
    size: Vector,
    pos: Vector = (0, 0, 0),
    *,
    material: str = "",
    tint: Vector = (1, 1, 1, 1),
    **attributes: object,
) -> Element:
    """Add a primitive. `tint` is RGBA and multiplies the texture; an opacity below 1 makes it transparent."""
    text = {name: value if isinstance(value, str) else numbers(value) for name, value in attributes.items()}
    # The material's colour overrides a colour equal to MuJoCo's default; both are white.
    return SubElement(
        parent,
        "geom",
        {
            "type": kind,
            "size": numbers(size),
            "pos": numbers(pos),
            "material": material or parent.get("name", ""),
            "rgba": numbers(tint),
            **text,
        },
    )


def new_body(name: str) -> Element:
    """An MJCF body without geoms."""
    return Element("body", {"name": name})


def size_factor(rng: np.random.Generator, share: float = 0.06) -> float:
    """A random factor of a size, at most `share` from 1."""
    return float(1 + rng.uniform(-share, share))


DARK = (0.35, 0.35, 0.38, 1.0)
"""RGBA in [0, 1] of dark plastic: handles, dials, windows."""


def microwave(rng: np.random.Generator) -> tuple[list[Thing], Dimensions]:
    """A box open to -y, and a door hinged at its left edge; angle 0 is shut, negative open."""
    w, d, h = 0.27 * size_factor(rng), 0.19 * size_factor(rng), 0.165 * size_factor(rng)
    wall, panel, door = 0.010, 0.055, 0.014
    body = new_body("microwave")
    add_geom(body, "box", (w / 2, d / 2, wall / 2), (0, 0, wall / 2))
    # A texture extends through a body: with one texture, the inside of a wall would look like another's outside.
    add_geom(body, "box", (w / 2, d / 2, wall / 2), (0, 0, h - wall / 2), material="microwave/top")
    inner = (h - 2 * wall) / 2
    add_geom(body, "box", (w / 2, wall / 2, inner), (0, d / 2 - wall / 2, h / 2), material="microwave/back")
    depth = (d - wall) / 2
    left, right = (-w / 2 + wall / 2, -wall / 2, h / 2), (w / 2 - panel / 2, -wall / 2, h / 2)
    add_geom(body, "box", (wall / 2, depth, inner), left, material="microwave/left")
    add_geom(body, "box", (panel / 2, depth, inner), right, material="microwave/right", tint=(0.5, 0.55, 0.6, 1))
    dial: dict[str, Any] = {"euler": (np.pi / 2, 0, 0), "tint": DARK}
    for z in (0.35, 0.65):
        add_geom(body, "cylinder", (0.014, 0.004), (w / 2 - panel / 2, -d / 2 - 0.003, z * h), **dial)
    width = w - panel - 0.004
    hinge = SubElement(body, "body", {"name": "door", "pos": numbers((-w / 2, -d / 2 - 0.001, 0))})
    SubElement(
        hinge,
        "joint",
        {
            "name": "door",
            "type": "hinge",
            "axis": "0 0 1",
            "range": "-1.9 0",
            "limited": "true",
            "damping": "0.05",
            "frictionloss": "0.03",
        },
    )
    middle = (h + 0.004) / 2
    add_geom(hinge, "box", (width / 2, door / 2, (h - 0.004) / 2), (width / 2, -door / 2, middle), mass=0.4)
    window = (width * 0.33, 0.001, h * 0.3)
    add_geom(hinge, "box", window, (width * 0.47, -door - 0.0005, middle), tint=DARK, contype="0", conaffinity="0")
    add_geom(hinge, "box", (0.006, 0.009, h * 0.33), (width - 0.012, -door - 0.009, middle), tint=(0.6, 0.6, 0.65, 1))
    thing = Thing(
        "microwave",
        body,
        False,
        (-0.05, 0.06),
        (0.07, 0.13),
        (-0.35, 0.35),
        (0.58, 0.22, 0.95),
        parts={"door": (0.02, 0.55, 0.85)},
        joints={"door": (-1.75, -0.9)},
    )
    return [thing], Dimensions({"height": h, "width": w, "depth": d, "door_width": width, "door": door})


N_RIM = 24
"""Boxes that make up a pan's round rim, 15 degrees each: MuJoCo has no hollow primitives."""


def lid(rng: np.random.Generator) -> tuple[list[Thing], Dimensions]:
    """A saucepan with a handle, and a lid of glass with a knob."""
    radius, height, rim, wall = 0.088 * size_factor(rng), 0.075 * size_factor(rng), 0.012, 0.005
    pan = new_body("saucepan")
    add_geom(pan, "cylinder", (radius, height / 2), (0, 0, height / 2))
    for angle in 2 * np.pi * np.arange(N_RIM) / N_RIM:
        # Boxes as wide as the ring's outer edge leave no gaps.
        size = (wall / 2, radius * np.tan(np.pi / N_RIM), rim / 2)
        at = radius - wall / 2
        pos = (at * np.cos(angle), at * np.sin(angle), height + rim / 2)
        add_geom(pan, "box", size, pos, euler=(0, 0, angle), tint=(0.8, 0.8, 0.85, 1))
    add_geom(pan, "box", (0.065, 0.011, 0.007), (radius + 0.06, 0, height - 0.012), tint=DARK)
    top = height + rim
    cover = new_body("lid")
    SubElement(cover, "freejoint", {"name": "lid"})
    add_geom(cover, "cylinder", (radius + 0.004, 0.004), (0, 0, 0.004), tint=(1, 1, 1, 0.4), mass=0.10)
    add_geom(cover, "cylinder", (0.012, 0.006), (0, 0, 0.014), tint=DARK, mass=0.02)
    add_geom(cover, "cylinder", (0.017, 0.010), (0, 0, 0.030), mass=0.03)
    things = [
        Thing("saucepan", pan, False, (-0.12, 0.12), (-0.06, 0.12), (-np.pi, np.pi), (0.60, 0.45, 0.75)),
        Thing(
            "lid",
            cover,
            True,
            (-0.001, 0.001),
            (-0.001, 0.001),
            (-np.pi, np.pi),
            (0.12, 0.85, 0.95),
            z=top,
            on="saucepan",
            is_symmetric=True,
        ),
    ]
    return things, Dimensions({"radius": radius, "top": top, "handle": radius + 0.125, "knob": 0.030, "grip": 0.034})


def phone(rng: np.random.Generator) -> tuple[list[Thing], Dimensions]:
    """A handset, and a base with a cradle at either end."""
    length = 0.17 * size_factor(rng, 0.03)
    end = length / 2 - 0.022
    base = new_body("base")
    top = 0.034
    add_geom(base, "box", (0.052, length / 2 + 0.012, top / 2), (0, 0, top / 2))
    add_geom(base, "cylinder", (0.026, 0.003), (0, 0, top + 0.003), tint=(1.0, 1.0, 0.9, 1))
    for y in (-end, end):
        for x in (-0.030, 0.030):
            add_geom(base, "box", (0.005, 0.016, 0.007), (x, y, top + 0.007), tint=DARK)
    handset = new_body("phone")
    SubElement(handset, "freejoint", {"name": "phone"})
    add_geom(handset, "box", (0.017, length / 2, 0.009), (0, 0, 0.029), mass=0.06)
    for y in (-end, end):
        add_geom(handset, "box", (0.020, 0.021, 0.010), (0, y, 0.010), tint=(0.7, 0.7, 0.7, 1), mass=0.03)
    things = [
        Thing("base", base, False, (-0.16, 0.16), (-0.10, 0.14), (-0.8, 0.8), (0.93, 0.70, 0.85)),
        Thing("phone", handset, True, (-0.22, 0.22), (-0.14, 0.18), (-np.pi, np.pi), (0.47, 0.75, 0.75)),
    ]
    return things, Dimensions({"length": length, "top": top, "bar": 0.029, "grip": 0.034})


def rubbish(rng: np.random.Generator) -> tuple[list[Thing], Dimensions]:
    """A bin, crumpled paper, and a tomato and a can that stay on the table."""
    half, height, wall = 0.068 * size_factor(rng), 0.13 * size_factor(rng), 0.005
    container = new_body("bin")
    add_geom(container, "box", (half, half, wall / 2), (0, 0, wall / 2))
    tall, up = (height - wall) / 2, (height + wall) / 2
    # A texture extends through a body: with one texture, the inside of a wall would look like another's outside.
    tint = (0.85, 0.85, 0.85, 1)
    for side, sign in (("near", -1), ("far", 1)):
        across = sign * (half - wall / 2)
        add_geom(container, "box", (wall / 2, half, tall), (across, 0, up), material=f"bin/{side}_x")
        add_geom(container, "box", (half - wall, wall / 2, tall), (0, across, up), material=f"bin/{side}_y", tint=tint)
    paper = new_body("rubbish")
    SubElement(paper, "freejoint", {"name": "rubbish"})
    for _ in range(4):
        size = rng.uniform((0.010, 0.010, 0.012), (0.021, 0.021, 0.018))
        at = (*rng.uniform(-0.007, 0.007, 2), 0.018 + float(rng.uniform(-0.003, 0.003)))
        shade = float(rng.uniform(0.8, 1.0))
        add_geom(paper, "box", size, at, euler=rng.uniform(-0.5, 0.5, 3), tint=(shade, shade, shade, 1), mass=0.008)
    tomato = new_body("tomato")
    rolls_little: dict[str, Any] = {"condim": "6", "friction": (0.9, 0.01, 0.002)}
    SubElement(tomato, "freejoint", {"name": "tomato"})
    round_ = 0.032 * size_factor(rng)
    add_geom(tomato, "ellipsoid", (round_, round_, 0.026), (0, 0, 0.026), mass=0.09, **rolls_little)
    add_geom(tomato, "cylinder", (0.004, 0.006), (0, 0, 0.055), tint=(0.3, 0.9, 0.2, 1), mass=0.001)
    can = new_body("can")
    SubElement(can, "freejoint", {"name": "can"})
    add_geom(can, "cylinder", (0.031, 0.050 * size_factor(rng)), (0, 0, 0.050), mass=0.2)
    everywhere: dict[str, Any] = {"x": (-0.24, 0.24), "y": (-0.16, 0.18), "yaw": (-np.pi, np.pi)}
    things = [
        Thing("bin", container, False, (-0.18, 0.18), (-0.04, 0.16), (-np.pi, np.pi), (0.33, 0.60, 0.60)),
        Thing("rubbish", paper, True, hsv=(0.14, 0.12, 0.98), z=0.006, **everywhere),
        Thing("tomato", tomato, True, hsv=(0.99, 0.85, 0.85), **everywhere),
        Thing("can", can, True, hsv=(0.72, 0.55, 0.80), **everywhere),
    ]
    return things, Dimensions({"half": half, "height": height, "wall": wall, "grip": 0.030})


def clutter(rng: np.random.Generator, i: int) -> Thing:
    """A further object: a box, a can, a stepped box or a mug."""
    name = f"clutter{i + 1}"
    body = new_body(name)
    SubElement(body, "freejoint", {"name": name})
    a, b, c = (float(value) for value in rng.uniform((0.020, 0.020, 0.020), (0.040, 0.040, 0.055)))
    kind = int(rng.integers(0, 4))
    if kind == 0:
        add_geom(body, "box", (a, b, c), (0, 0, c), mass=0.2)
    elif kind == 1:
        add_geom(body, "cylinder", (a, c), (0, 0, c), mass=0.2)
    elif kind == 2:
        add_geom(body, "box", (a, b, 0.012), (0, 0, 0.012), mass=0.1)
        add_geom(body, "box", (a * 0.7, b * 0.7, c / 2), (0, 0, 0.024 + c / 2), mass=0.1)
    else:
        add_geom(body, "cylinder", (a, c), (0, 0, c), mass=0.2)
        add_geom(body, "box", (0.014, 0.005, c * 0.6), (a + 0.010, 0, c), mass=0.02)
    hsv = (0.27 + 0.618034 * i, float(rng.uniform(0.4, 0.9)), float(rng.uniform(0.6, 0.95)))
    return Thing(name, body, True, (-0.34, 0.34), (-0.24, 0.28), (-np.pi, np.pi), hsv)
