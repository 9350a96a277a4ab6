"""Options of `ingest rosbag`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, FiniteFloat

from bask_data.formats.options.common import EpisodeOptions, PoseOptions, Text
from bask_data.params import NAMES, SIZE


class RosbagOptions(PoseOptions, EpisodeOptions):
    """A bag of ROS 1 or ROS 2."""

    camera: str = Field(
        "camera",
        pattern=NAMES,
        description="Name of the camera in the dataset, or of several: wrist,overhead. Topics, frames and "
        "calibrations of several are given as NAME=VALUE;NAME=VALUE, or with {camera} for the name.",
    )
    color_topic: str = Field(
        "",
        description="Topic of the colour images, Image or CompressedImage; found by itself if only one can be meant.",
    )
    depth_topic: str = Field(
        "", description="Topic of the depth images; found by itself, and best one that is registered to colour."
    )
    camera_info_topic: str = Field(
        "", description="Topic of colour's CameraInfo; by default the one beside its images."
    )
    depth_info_topic: str = Field("", description="Topic of depth's CameraInfo; by default the one beside its images.")
    intrinsics: Text = Field(
        "", description="Intrinsics of colour instead of CameraInfo: fx,fy,cx,cy in pixels, or a calibration file."
    )
    intrinsics_size: str = Field(
        "", pattern=SIZE, description="WIDTHxHEIGHT of the images of the intrinsics; checked against the images."
    )
    depth_scale: FiniteFloat | None = Field(
        None, gt=0, description="Metres per unit of depth; by default 0.001 for 16UC1 and 1 for 32FC1, as ROS has it."
    )
    world: str = Field("", description="World frame of tf; by default the root of the tree that holds the camera.")
    camera_frame: str = Field(
        "", description="Optical frame of the camera in tf; by default the frame_id of the colour images."
    )
    camera_axes: Literal["optical", "body"] = Field(
        "optical", description="Axes of that frame: z forward (optical), or x forward and z up (body)."
    )
    ignore_tf: str = Field("", description="Transforms of tf to ignore: PARENT:CHILD,PARENT:CHILD.")
    pose_topic: str = Field(
        "",
        description="Instead of tf: a topic of poses, PoseStamped, PoseWithCovarianceStamped, Odometry, "
        "TransformStamped or Path.",
    )
    pose_frame: str = Field(
        "",
        description="Frame whose pose --pose-topic gives; by default its messages' child_frame_id, or the camera.",
    )
    gripper_frame: str = Field("", description="Frame of the gripper in tf: tool0; common names are found.")
    gripper_joints: str = Field(
        "", description="Joints whose positions in JointState add up to the gripper's width, separated by commas."
    )
    stamps: Literal["header", "arrival"] = Field(
        "header", description="Times of images: those in their headers, or those of their arrival in the bag."
    )
    max_time_difference: FiniteFloat = Field(
        0.02, gt=0, description="Largest difference in seconds between a colour image and its depth."
    )
    max_pose_gap: FiniteFloat | None = Field(
        None,
        gt=0,
        description="Longest time in seconds between two transforms that one is interpolated between; by default 1.5 "
        "times the usual one, and at least 0.1.",
    )
    split: bool = Field(
        False, description="The bags in the folder SOURCE are parts of one recording, in the order of their names."
    )
