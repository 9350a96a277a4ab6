"""Options of `ingest colmap`."""

from __future__ import annotations

from pydantic import Field

from bask_data.formats.options.common import (
    DepthScale,
    IntrinsicsSize,
    InvalidDepth,
    OneCameraOptions,
    PoseOptions,
    Text,
    TimeOptions,
)

MODEL_PLACES = ("sparse", "colmap/sparse", "distorted/sparse", "dslr/colmap", "model", "colmap", ".", "sparse_txt")
"""Folders in which models are looked for, and in their folders 0, 1 and so on."""


class ColmapOptions(OneCameraOptions, TimeOptions, PoseOptions):
    """Images with depth, and COLMAP's model of them, or none: then their poses are found first."""

    model: str = Field(
        "auto",
        description="Folder of the model in SOURCE. auto: sparse/0 or wherever one is, and if there is none, poses are "
        "found from the images; none: they are found from the images in any case.",
    )
    images: str = Field(
        "",
        description="Folder of the images in SOURCE, or a pattern: 'frame-*.color.png'. By default images, color, rgb "
        "or SOURCE itself.",
    )
    depth: str = Field(
        "depth/*.png",
        description="Depth files; * stands for an image's name without its ending, or for the text matched by the * "
        "of --images.",
    )
    depth_scale: DepthScale = None
    invalid_depth: InvalidDepth = ""
    intrinsics: Text = Field(
        "",
        description="To find poses with, instead of an estimate: fx,fy,cx,cy in pixels (pixel (0, 0) is a centre), or "
        "a text file. A model states its own.",
    )
    intrinsics_size: IntrinsicsSize = ""
    align_to: str = Field(
        "",
        description="Known poses of some of the images, whose world is taken: lines `image-or-time tx ty tz qx qy qz "
        "qw` (TUM), JSON {image: 4x4}, or a pattern of pose files. The conventions below are those of these poses.",
        json_schema_extra={"file": True},
    )
