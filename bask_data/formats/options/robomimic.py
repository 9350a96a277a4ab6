"""Options of `ingest robomimic`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, FiniteFloat

from bask_data.formats.options.common import EpisodeOptions, Text


class RobomimicOptions(EpisodeOptions):
    """A demonstration in a robomimic HDF5 file with images and depth."""

    cameras: tuple[str, ...] = Field(
        (), description="Cameras to read: agentview,wrist. All with colour, depth and calibration by default."
    )
    fps: FiniteFloat = Field(
        20.0, gt=0, description="Frames per second, where the file states none: time is frame number / fps."
    )
    hand_extrinsics: Literal["robomimic", "gripper_from_camera"] = Field(
        "robomimic",
        description="What camera_info holds for a camera in the hand: robomimic's product of the first frame's poses, "
        "or gripper_from_camera.",
    )
    site_turn: FiniteFloat | None = Field(
        None,
        description="Turn about z, degrees, from the hand of robot0_eef_quat to the controller's site, for files "
        "without robot0_eef_quat_site: 90 or -90 for a Panda; it is stated which of them depth agrees with.",
    )
    depth_unit: Literal["auto", "metres", "normalised"] = Field(
        "auto", description="Depth in metres (robomimic's), or MuJoCo's normalised depth (needs --planes)."
    )
    planes: Text = Field("", description="Near and far plane of normalised depth, NEAR,FAR, metres.")
    far_plane: FiniteFloat = Field(
        50.0, gt=0, description="Far plane of depth in metres: values of 99 % of it and above are no measurement."
    )
