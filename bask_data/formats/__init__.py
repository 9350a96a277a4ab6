"""Readers of recordings in other formats: units, frames and conventions are converted here and nowhere else.

To add a format, touch three files, and a fourth if it has a layout that can be told:

1. `formats/options/<name>.py`, new, with a model of its options, derived from `SourceOptions`, whose descriptions are
   the help of `bask-data ingest <name>`. It must not load NumPy or OpenCV, so that `--help` stays fast.
2. `formats/<name>.py`, new, or `formats/<name>/__init__.py` if it takes several modules, with
   `read(source: Path, options) -> SourceRecording`. It returns the recording in our units and frames, states in
   `assumptions` what the files do not, and reads frames on demand. What `SourceOptions` asks for is done by `prepare`,
   for all formats alike. A source of many recordings also has `episodes(source: Path, options) -> tuple[str, ...]`,
   their names.
3. `formats/__init__.py`: the import of the model, and a line in `FORMATS`.
4. So that `ingest auto` knows it, `formats/recognise/folders.py`: a function in `RECOGNISERS` that tells its layout by
   names and first bytes; or `formats/recognise/files.py` for a single file. They load no library, so that a source is
   looked at in a moment.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bask_data.formats.options.apc import ApcOptions
from bask_data.formats.options.arkitscenes import ArkitscenesOptions
from bask_data.formats.options.bop import BopOptions
from bask_data.formats.options.colmap import ColmapOptions
from bask_data.formats.options.common import SourceOptions
from bask_data.formats.options.frames import FramesOptions
from bask_data.formats.options.lerobot import LerobotOptions
from bask_data.formats.options.maniskill import ManiskillOptions
from bask_data.formats.options.nerfstudio import NerfstudioOptions
from bask_data.formats.options.polycam import PolycamOptions
from bask_data.formats.options.record3d import Record3dOptions
from bask_data.formats.options.rlbench import RlbenchOptions
from bask_data.formats.options.robomimic import RobomimicOptions
from bask_data.formats.options.rosbag import RosbagOptions
from bask_data.formats.options.scannet import ScannetOptions
from bask_data.formats.options.stray import StrayOptions
from bask_data.formats.options.tum import TumOptions

if TYPE_CHECKING:
    from bask_data.formats.recording import PreparedRecording, SourceRecording


@dataclass(frozen=True)
class Format:
    """A source format: `bask-data ingest <name>`, with the options of the model `options`.

    Args:
        wants: what SOURCE is, for the help.
    """

    name: str
    help: str
    options: type[SourceOptions]
    wants: str = "The recording's folder."

    def opened(self, source: Path, options: SourceOptions) -> SourceRecording:
        """The recording at `source` with its labels: which files it has, before anything that takes long.

        Raises:
            BadData: a file is missing, corrupted, or contradicts the options.
            UsageError: `source` is not what the format needs, or an option is missing or invalid.
            MissingDependency: a library that decodes the format is not installed.
        """
        from bask_data.formats.alignment import option_files
        from bask_data.formats.label_files import with_labels

        recording = with_labels(source, self._reader.read(source, options), options)
        return replace(recording, files=(*recording.files, *option_files(source, recording.cameras, options)))

    def read(self, source: Path, options: SourceOptions) -> PreparedRecording:
        """The recording at `source`, ready to be written; raises as `opened` does."""
        from bask_data.formats.prepare import prepared

        return prepared(source, self.opened(source, options), options)

    def episodes(self, source: Path, options: SourceOptions) -> tuple[str, ...]:
        """Names of the recordings at `source`; empty for a format that holds one."""
        find = getattr(self._reader, "episodes", None)
        return find(source, options) if find else ()

    @property
    def _reader(self) -> Any:
        return import_module(f"bask_data.formats.{self.name}")


FORMATS = (
    Format(
        "frames", "A folder of colour, depth and pose files by pattern: 7-Scenes, 3DMatch, own dumps.", FramesOptions
    ),
    Format("tum", "A TUM RGB-D sequence: rgb.txt, depth.txt and groundtruth.txt with timestamps.", TumOptions),
    Format(
        "scannet",
        "A scan of ScanNet: what SensReader exports, or the .sens file; and 3RScan and 12-Scenes.",
        ScannetOptions,
        "The exported folder, the scan's folder, or its .sens file.",
    ),
    Format(
        "arkitscenes",
        "A video of ARKitScenes: lowres_wide, lowres_depth, intrinsics and trajectory.",
        ArkitscenesOptions,
        "The video's folder.",
    ),
    Format(
        "bop",
        "A scene of a BOP data set (scene_camera.json), or of YCB-Video (.mat files).",
        BopOptions,
        "The scene's folder, or with --episode the folder of a split.",
    ),
    Format(
        "nerfstudio",
        "transforms.json of nerfstudio or Instant-NGP, with depth: lens, poses and images.",
        NerfstudioOptions,
    ),
    Format(
        "polycam",
        "Raw data of a Polycam LiDAR capture: keyframes with images, depth, confidence, cameras.",
        PolycamOptions,
        "The exported folder, which holds keyframes, or the zip file.",
    ),
    Format(
        "record3d",
        "A recording of the iPhone app Record3D: .r3d, or an export of EXR and JPG images.",
        Record3dOptions,
        "The .r3d file, or the folder of its content or of the export.",
    ),
    Format(
        "stray",
        "A recording of the iPhone app Stray Scanner: rgb.mp4, depth, confidence, odometry.csv.",
        StrayOptions,
    ),
    Format(
        "colmap",
        "Images with depth and a COLMAP model; or without poses, which COLMAP then finds. Depth gives the scale.",
        ColmapOptions,
        "The folder with images, depth, and the model if there is one.",
    ),
    Format(
        "rosbag",
        "A bag of ROS 1 or ROS 2: images, CameraInfo and tf, by RealSense's and others' topics.",
        RosbagOptions,
        "The .bag file, the folder of a ROS 2 bag, its .mcap or .db3 file, or a folder of bags.",
    ),
    Format("apc", "A MIT-Princeton APC scene: bit-rotated depth, poses, labels where there are any.", ApcOptions),
    Format(
        "rlbench",
        "Demonstrations saved by RLBench: low_dim_obs.pkl, read without running it, and images.",
        RlbenchOptions,
        "The folder of an episode, a variation or a task.",
    ),
    Format(
        "maniskill",
        "Trajectories of ManiSkill 3 and 2 with images: an HDF5 file, and its JSON file if there is one.",
        ManiskillOptions,
        "The .h5 file, replayed with observations (trajectory.rgbd.*.h5), or its folder.",
    ),
    Format(
        "lerobot",
        "A LeRobot dataset, v3.0 or v2.1, with depth: an episode of it.",
        LerobotOptions,
        "The dataset's folder, with meta/info.json.",
    ),
    Format(
        "robomimic",
        "Demonstrations in robomimic's HDF5 files with images and depth, or exported with --cameras.",
        RobomimicOptions,
        "The .hdf5 file, or its folder.",
    ),
)
