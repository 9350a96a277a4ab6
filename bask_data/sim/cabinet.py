"""The objects of the task `drawer`: a cabinet, and its drawer with a handle."""

from __future__ import annotations

from xml.etree.ElementTree import Element, SubElement

import numpy as np

from bask_data.sim.objects import DARK, Dimensions, Thing, Vector, add_geom, new_body, numbers, size_factor

WALL = 0.010
"""Thickness of the walls of cabinet and drawer, metres. Chosen."""

SLACK = 0.002
"""Gap between drawer and cabinet, metres: below `TOUCHING`, as the drawer runs in the cabinet. Chosen."""

STANDOFF, BAR = 0.034, 0.005
"""Distance of the handle's axis from the front, with room for a finger, and half its thickness, metres. Chosen."""

ALMOST_SHUT = 0.015
"""Largest opening of the drawer before the task, metres. Chosen."""


def cabinet(rng: np.random.Generator) -> tuple[list[Thing], Dimensions]:
    """A cabinet open to -y above a plinth, and a drawer that fills the opening; position 0 is shut, positive open."""
    w, d, h = 0.22 * size_factor(rng), 0.16 * size_factor(rng), 0.15 * size_factor(rng)
    plinth = 0.42 * h
    body = new_body("cabinet")
    # A texture extends through a body: with one texture, the inside of a wall would look like another's outside.
    add_geom(body, "box", (w / 2, d / 2, plinth / 2), (0, 0, plinth / 2))
    add_geom(body, "box", (w / 2, d / 2, WALL / 2), (0, 0, h - WALL / 2), material="cabinet/top")
    half, middle = (h - WALL - plinth) / 2, (h - WALL + plinth) / 2
    add_geom(body, "box", (w / 2, WALL / 2, half), (0, d / 2 - WALL / 2, middle), material="cabinet/back")
    for side, sign in (("left", -1), ("right", 1)):
        at = (sign * (w / 2 - WALL / 2), -WALL / 2, middle)
        add_geom(body, "box", (WALL / 2, (d - WALL) / 2, half), at, material=f"cabinet/{side}")
    for x in (-0.3, 0.3):
        add_geom(
            body, "cylinder", (0.012, 0.002), (x * w, -d / 2 - 0.002, plinth / 2), euler=(np.pi / 2, 0, 0), tint=DARK
        )
    height = 2 * (half - SLACK)
    add_drawer(body, (w - 2 * WALL - 2 * SLACK, d - WALL - SLACK, height), (0, -d / 2, plinth + SLACK))
    things = [
        Thing(
            "cabinet",
            body,
            False,
            (-0.08, 0.08),
            (0.09, 0.15),
            (-0.35, 0.35),
            (0.36, 0.45, 0.80),
            parts={"drawer": (0.95, 0.45, 0.95)},
            joints={"drawer": (0.0, ALMOST_SHUT)},
        )
    ]
    handle = plinth + SLACK + height / 2
    return things, Dimensions({"front": d / 2, "handle": handle, "travel": 0.75 * d, "width": w, "height": h})


def add_drawer(body: Element, size: Vector, at: Vector) -> None:
    """Add a drawer, open above, that slides along -y, with a bar across its front.

    Args:
        size: width, depth and height, metres.
        at: the origin in the cabinet's frame, metres: below the middle of the front.
    """
    w, d, h = size
    drawer = SubElement(body, "body", {"name": "drawer", "pos": numbers(at)})
    slide = {"name": "drawer", "type": "slide", "axis": "0 -1 0", "range": numbers((0, 0.85 * d)), "limited": "true"}
    SubElement(drawer, "joint", {**slide, "damping": "2", "frictionloss": "0.6"})
    tall = 0.75 * h
    add_geom(drawer, "box", (w / 2, WALL / 2, h / 2), (0, WALL / 2, h / 2), mass=0.15)
    add_geom(drawer, "box", (w / 2, d / 2 - WALL, WALL / 4), (0, d / 2, WALL / 4), material="drawer/floor", mass=0.1)
    back = (0, d - WALL / 2, tall / 2)
    add_geom(drawer, "box", (w / 2, WALL / 2, tall / 2), back, material="drawer/back", mass=0.05)
    for side, sign in (("left", -1), ("right", 1)):
        beside = (sign * (w / 2 - WALL / 4), d / 2, tall / 2)
        add_geom(drawer, "box", (WALL / 4, d / 2 - WALL, tall / 2), beside, material=f"drawer/{side}", mass=0.05)
    reach = 0.24 * w
    add_geom(drawer, "box", (reach, BAR, BAR), (0, -STANDOFF, h / 2), material="drawer/bar", mass=0.02)
    post = (STANDOFF - BAR) / 2
    for sign in (-1, 1):
        foot = (sign * (reach - BAR), -post, h / 2)
        add_geom(drawer, "box", (BAR, post, BAR), foot, tint=DARK, mass=0.01)
