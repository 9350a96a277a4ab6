"""A floating parallel gripper with a wrist camera.

The gripper's frame has its origin between the finger tips, z in the direction of approach, x from finger to finger. A
weld to a moving target replaces a robot's arm; the fingers are position-controlled with a limited force.
"""

from __future__ import annotations

from typing import Any
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.sim.objects import Vector, add_geom, numbers

LABEL = 255
"""Label of the gripper in label images: the largest of 8 bits, which no object has."""

GROUP = 1
"""MuJoCo's group of the gripper's geoms, 0 to 5, by which they can be hidden; objects are in group 0."""

MAX_WIDTH = 0.08
"""Metres between the fingers of the open gripper, as of a Franka hand."""

FOV_DEG = 56.0
"""Vertical field of view of the wrist camera, degrees: between RealSense's colour cameras (42) and depth cameras
(58)."""

TILT = np.radians(15.0)
"""Rotation of the wrist camera towards the finger tips, radians; they appear at the lower edge of the image."""

CAMERA_AT = (0.0, -0.078, -0.135)
"""Position of the wrist camera in the gripper's frame, metres: beside the hand and behind the finger tips. Chosen."""


def gripper_from_camera() -> Float[ndarray, "4 4"]:
    """Transform (4, 4) of the wrist camera, metres; camera x right, y down, z forward."""
    transform = np.eye(4)
    sine, cosine = np.sin(TILT), np.cos(TILT)
    transform[:3, :3] = np.array([[1, 0, 0], [0, cosine, sine], [0, -sine, cosine]])
    transform[:3, 3] = CAMERA_AT
    return transform


def add_gripper(mujoco: Element, world: Element) -> None:
    """Add the hand, fingers, camera, mocap target and motors to the model."""
    SubElement(world, "body", {"name": "target", "mocap": "true", "pos": "0 0 0.5", "quat": "0 1 0 0"})
    hand = SubElement(world, "body", {"name": "hand", "gravcomp": "1", "pos": "0 0 0.5", "quat": "0 1 0 0"})
    SubElement(hand, "freejoint", {"name": "hand"})
    _add_part(hand, "box", (0.052, 0.020, 0.018), (0, 0, -0.108), mass=0.4)
    _add_part(hand, "cylinder", (0.026, 0.035), (0, 0, -0.160), mass=0.2, tint=(0.5, 0.5, 0.55, 1))
    behind = (0, CAMERA_AT[1] + 0.012, CAMERA_AT[2] - 0.030)
    _add_part(hand, "box", (0.022, 0.012, 0.012), behind, mass=0.05, tint=(0.25, 0.25, 0.25, 1))
    for side, sign in (("left", -1), ("right", 1)):
        finger = SubElement(hand, "body", {"name": f"{side}_finger", "gravcomp": "1"})
        joint = {"name": side, "type": "slide", "axis": f"{sign} 0 0", "range": f"0.0005 {MAX_WIDTH / 2}"}
        SubElement(finger, "joint", {**joint, "limited": "true", "damping": "15", "armature": "0.05"})
        pad: dict[str, Any] = {"friction": (1.4, 0.03, 0.001), "condim": "4", "solref": (0.008, 1), "mass": 0.04}
        _add_part(finger, "box", (0.006, 0.010, 0.052), (sign * 0.006, 0, -0.040), **pad)
    camera = gripper_from_camera()
    axes = [*camera[:3, 0], *-camera[:3, 1]]
    attributes = {"name": "wrist", "pos": numbers(CAMERA_AT), "xyaxes": numbers(axes), "fovy": f"{FOV_DEG}"}
    SubElement(hand, "camera", attributes)
    equality = SubElement(mujoco, "equality")
    SubElement(equality, "weld", {"body1": "target", "body2": "hand", "solref": "0.02 1", "solimp": "0.95 0.99 0.001"})
    SubElement(equality, "joint", {"joint1": "left", "joint2": "right", "solref": "0.01 1"})
    motors = SubElement(mujoco, "actuator")
    for side in ("left", "right"):
        SubElement(
            motors,
            "position",
            {"name": side, "joint": side, "kp": "500", "forcelimited": "true", "forcerange": "-12 12"},
        )


def _add_part(parent: Element, kind: str, size: Vector, pos: Vector, **attributes: Any) -> None:
    add_geom(parent, kind, size, pos, material="gripper", group=str(GROUP), **attributes)
