"""The objects of the task `mug`: a mug, and a stand with a hook."""

from __future__ import annotations

from itertools import pairwise
from xml.etree.ElementTree import Element, SubElement

import cv2
import numpy as np

from bask_data.sim import textures
from bask_data.sim.objects import DARK, Colour, Dimensions, Thing, add_geom, new_body, size_factor

N_WALLS = 16
"""Boxes that make up the mug's wall, 22.5 degrees each: MuJoCo has no hollow primitives."""

THICKNESS = 0.005
"""Thickness of the mug's wall, metres. Chosen."""

HANDLE, REACH = 0.004, 0.034
"""Half the thickness of the mug's handle, and how far its outer bar's axis is from the wall, metres. Chosen."""

PEG = 0.005
"""Radius of the hook, metres. Chosen."""

SLOPE = np.radians(8.0)
"""Rise of the hook towards its tip, radians, so that a mug does not slide off. Chosen."""

POST = 0.012
"""Half the thickness of the stand's post, metres. Chosen."""


def mug(rng: np.random.Generator) -> tuple[list[Thing], Dimensions]:
    """A stand with a hook towards -y, and a mug with a handle towards +x."""
    height, length = 0.20 * size_factor(rng, 0.04), 0.085 * size_factor(rng, 0.04)
    stand = new_body("stand")
    add_geom(stand, "box", (0.055, 0.055, 0.007), (0, 0, 0.007))
    top = height + 0.025
    add_geom(stand, "box", (POST, POST, top / 2 - 0.007), (0, 0, top / 2 + 0.007), material="stand/post")
    along = np.array([0, -np.cos(SLOPE), np.sin(SLOPE)])
    middle = along * length / 2 + [0, 0, height]
    upright = {"euler": (np.pi / 2 - SLOPE, 0, 0)}
    add_geom(stand, "cylinder", (PEG, length / 2), middle, tint=DARK, material="stand/hook", **upright)
    tip = along * (length - 0.003) + [0, 0, height + 0.002]
    add_geom(stand, "box", (PEG, 0.003, 0.007), tip, tint=DARK, material="stand/hook", euler=(-SLOPE, 0, 0))
    radius, tall = 0.037 * size_factor(rng), 0.080 * size_factor(rng)
    upper, lower = 0.82 * tall, 0.28 * tall
    things = [
        Thing("stand", stand, False, (-0.14, 0.14), (0.06, 0.14), (-0.6, 0.6), (0.80, 0.45, 0.85)),
        Thing(
            "mug",
            mug_body(radius, tall, upper, lower),
            True,
            (-0.20, 0.20),
            (-0.18, -0.02),
            (-np.pi, np.pi),
            (0.55, 0.65, 0.90),
            paint_walls=wrapped,
        ),
    ]
    # Where the hook is in the mug's frame when the mug hangs: in the outer upper corner of its handle.
    seat = {"seat_x": radius + REACH - HANDLE - PEG, "seat_z": upper - HANDLE - PEG}
    hole = {"hole_x": radius + (REACH - HANDLE) / 2, "hole_z": (upper + lower) / 2}
    return things, Dimensions({"hook": height, "length": length, "rim": tall, "radius": radius, **seat, **hole})


def mug_body(radius: float, tall: float, upper: float, lower: float) -> Element:
    """A mug whose handle's bars are at the heights `upper` and `lower`; metres."""
    body = new_body("mug")
    # Damping ends the swinging of a mug on a hook within a second.
    SubElement(body, "joint", {"name": "mug", "type": "free", "damping": "0.003"})
    add_geom(body, "cylinder", (radius - 0.001, 0.003), (0, 0, 0.003), mass=0.03)
    for i in range(N_WALLS):
        angle = 2 * np.pi * i / N_WALLS
        # Boxes as wide as the ring's outer edge leave no gaps.
        size = (THICKNESS / 2, radius * np.tan(np.pi / N_WALLS), tall / 2 - 0.001)
        at = radius - THICKNESS / 2
        pos = (at * np.cos(angle), at * np.sin(angle), tall / 2 + 0.001)
        add_geom(body, "box", size, pos, euler=(0, 0, angle), material=f"mug/wall{i:02}", mass=0.06 / N_WALLS)
    for z in (lower, upper):
        bar = (REACH / 2, 0.006, HANDLE)
        add_geom(body, "box", bar, (radius - 0.001 + REACH / 2, 0, z), mass=0.005)
    size = (HANDLE, 0.006, (upper - lower) / 2 + HANDLE)
    add_geom(body, "box", size, (radius + REACH, 0, (lower + upper) / 2), material="mug/handle", mass=0.005)
    return body


def wrapped(rng: np.random.Generator, colour: Colour, n_walls: int) -> list[textures.Faces]:
    """A print around the mug, and one inside, cut into the faces of its walls; the handle's comes first."""
    handle = textures.object_faces(rng, *colour)
    faces = textures.object_faces(rng, *colour)
    outside, inside = (np.hstack(list(part)) for part in (faces[:3], faces[3:]))
    cuts = np.linspace(0, outside.shape[1], n_walls).astype(int)
    walls = [handle]
    for begin, end in pairwise(cuts):
        out, into = (cv2.resize(part[:, begin:end], (textures.FACE, textures.FACE)) for part in (outside, inside))
        # Columns of an x face run along z and its rows along y.
        walls.append(np.stack([np.rot90(out), np.rot90(into)[:, ::-1], out, out, out, out]))
    return walls
