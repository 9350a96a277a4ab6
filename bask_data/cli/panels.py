"""Headings under which long commands list their options; options not listed here are under `Parameters`."""

from __future__ import annotations

from collections.abc import Mapping

EVERYDAY = "Options"
"""The first heading: the options that most calls need."""

OTHERS = "Parameters"
ELSEWHERE = "Parameters from elsewhere"
WORKERS = "Workers"
OUTPUT = "Output"

PANELS: Mapping[str, Mapping[str, tuple[str, ...]]] = {
    "reconstruct": {
        EVERYDAY: ("voxel_size", "workspace"),
        "Depth": ("near", "far", "truncation", "min_views"),
        "Frames": ("exclude", "drop_suspects", "min_distance", "min_angle_deg"),
        WORKERS: ("max_memory",),
    },
    "objects": {
        EVERYDAY: ("names", "min_area", "max_extent", "eps"),
        "Support": ("support", "plane", "up", "inlier", "above", "margin"),
        "Clusters": ("core_area", "seed"),
    },
    "correspondences": {
        EVERYDAY: ("n_pairs", "n_matches", "seed"),
        "Pairs of frames": ("min_distance", "min_angle_deg", "min_overlap"),
        "Matches": ("n_attempts", "tolerance", "tolerance_per_metre", "max_cycle", "margin", "use_surface"),
    },
    "train": {
        EVERYDAY: ("steps", "backbone", "descriptor_dim", "weights", "seed"),
        "Images": ("image_height", "crop_share", "precision"),
        "Batches": ("pairs_per_step", "accumulate", "matches", "self_pairs"),
        "Loss": ("loss", "alpha", "match_weight"),
        "Contrastive loss": (
            "margin_foreground",
            "margin_background",
            "hinge",
            "non_match_term",
            "normalised",
            "match_root",
            "background_normalised",
            "non_matches",
            "foreground_share",
            "clearance",
        ),
        "Optimiser": (
            "learning_rate",
            "weight_decay",
            "schedule",
            "decay",
            "decay_every",
            "warmup",
            "frozen_batch_norm",
        ),
        "Augmentation": (
            "zoom",
            "crop",
            "rotation_deg",
            "flip",
            "background",
            "composition",
            "by_identity",
            "colour",
            "hue_deg",
            "noise",
            "blur",
        ),
        "Validation": ("validations", "best_by", "patience", "held_out"),
    },
    "reference": {EVERYDAY: ("auto", "n", "scene", "instances", "picks", "seed")},
    "encode": {
        EVERYDAY: ("filter", "settings", "cameras", "seed"),
        "Observation": ("calibrated", "alpha", "tau", "tau_match", "dropout", "source"),
        "Motion": ("walk", "walk_px", "gripper_probability", "gripper_reach"),
        "Belief": ("n_particles", "grid"),
        "Speed": ("every", "scale"),
    },
    "frames": {
        EVERYDAY: ("camera", "color", "depth", "cloud", "pose", "intrinsics", "fps", "frames", "robot"),
        "Conventions of the files": (
            "depth_scale",
            "invalid_depth",
            "intrinsics_size",
            "pose_by",
            "column_major",
        ),
        "Times": ("timestamps", "time_unit", "max_pose_gap"),
    },
    "lerobot": {
        EVERYDAY: ("episode", "cameras", "intrinsics", "pose_column", "frames"),
        "Depth and intrinsics": ("depth", "depth_scale", "intrinsics_size"),
        "Poses of the cameras and of the gripper": (
            "camera_pose",
            "gripper_from_camera",
            "gripper_pose",
            "gripper_rotation",
            "gripper_width",
            "column_major",
        ),
    },
    "colmap": {
        EVERYDAY: ("camera", "model", "images", "depth", "intrinsics", "align_to", "fps", "frames"),
        "Conventions of the files": ("depth_scale", "invalid_depth", "intrinsics_size"),
    },
    "rosbag": {
        EVERYDAY: ("camera", "frames", "episode", "split"),
        "Topics": ("color_topic", "depth_topic", "camera_info_topic", "depth_info_topic"),
        "Poses": ("world", "camera_frame", "camera_axes", "pose_topic", "pose_frame", "ignore_tf"),
        "Robot": ("gripper_frame", "gripper_joints"),
        "Times": ("stamps", "max_time_difference", "max_pose_gap"),
        "Depth and lens": ("intrinsics", "intrinsics_size", "depth_scale"),
    },
    "sim": {
        EVERYDAY: ("seed", "cameras", "frames", "height", "width"),
        "Scene": ("background_seed", "clutter", "finished", "distance_spread", "gripper_in_view"),
        "Sensor": ("depth_noise", "flying", "holes", "pose_noise", "overhead_height", "overhead_width"),
    },
}


SHARED: Mapping[str, tuple[str, ...]] = {
    "Frames": ("skip_bad", "follow_links", "labels", "local_origin", "trust"),
    "Times": ("time_unit", "max_pose_gap"),
    "Conventions of the poses": ("pose_is", "axes", "pose_unit", "quat", "gripper_from_camera"),
    "Depth and lens": ("confidence", "align", "depth_intrinsics", "color_from_depth", "depth_is", "distortion"),
}
"""Headings of options that all or many formats have, after their own."""


def panels_of(command: str, fields: list[str]) -> dict[str, str]:
    """The heading of each field of a command's parameters, in the order in which they are listed."""
    table = PANELS.get(command, {})
    listed = {field: panel for panel, members in table.items() for field in members}
    shared = {field: panel for panel, members in SHARED.items() for field in members if field not in listed}
    other = OTHERS if table else EVERYDAY
    own = {field: other for field in fields if field not in listed and field not in shared}
    return {**listed, **own, **shared}
