"""One camera of a bag: its images joined by time, its lens, and its pose at their time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from bask_data.core.lens import Lens
from bask_data.core.time_pairs import mutual_nearest
from bask_data.errors import BadData
from bask_data.formats.clock import seconds
from bask_data.formats.files import Folder, first_readable, folder_of, listed
from bask_data.formats.intrinsics import read_calibration
from bask_data.formats.options.rosbag import RosbagOptions
from bask_data.formats.poses import other_readings, to_world_from_camera
from bask_data.formats.recording import SourceCamera
from bask_data.formats.rosbag.bag import Bag, frame_name
from bask_data.formats.rosbag.contents import Contents, ImageStream
from bask_data.formats.rosbag.edges import since
from bask_data.formats.rosbag.images import color_of, depth_of
from bask_data.formats.rosbag.lenses import has_lens, same_camera, stated_lens
from bask_data.formats.rosbag.motion import FrameMotion, camera_motion
from bask_data.formats.rosbag.topics import CameraTopics, ImageTopic

BODY_FROM_OPTICAL = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""REP 103: a body's x is forward, y left and z up; a camera's optical frame has x right, y down and z forward."""

AXES = {
    "optical": "optical, as REP 103 has it: x right, y down, z forward",
    "body": "a body's (--camera-axes): x forward, y left, z up",
}
"""Axes of the camera's frame in words, by the option's value."""

SAME_EXTRINSICS = 1e-6
"""Difference of the entries of the transforms between colour and depth, metres, within which they are one."""


@dataclass
class BagCamera:
    """A camera of a bag.

    Args:
        options: those of this camera.
        statements: for the assumptions of a recording, once it was read.
    """

    bag: Bag
    contents: Contents
    topics: CameraTopics
    options: RosbagOptions
    statements: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Where poses come from is known before any image is looked at."""
        self.images = self.contents.images[self.topics.color.name]
        self.depths = self.contents.images[self.topics.depth.name]
        self.frame = frame_name(self.options.camera_frame) or self.topics.color.frame
        self.motion: FrameMotion = camera_motion(self.bag, self.contents, self.frame, self.options)

    def read(
        self, name: str, source: Path, partners: ImageStream | None
    ) -> tuple[SourceCamera, tuple[Path, ...], Float[ndarray, "t 4 4"] | None]:
        """The camera; the files of its hand-eye calibration; and world_from_gripper if its poses come from there.

        Args:
            partners: images of another camera, each of which gets the nearest one of this.
        """
        color, depth, options = self.topics.color, self.topics.depth, self.options
        folder = folder_of(source, options.follow_links)
        limit = options.max_time_difference
        color_of_frame, stamps = self._frames(partners)
        depth_of_frame = np.where(color_of_frame < 0, -1, _paired(stamps, self.depths.stamps, limit))
        poses = self.motion.at(stamps)
        faults, expected = self._faults(color_of_frame, depth_of_frame, stamps, poses.is_known)
        if len(faults) == len(stamps):
            raise self._nothing(faults[0], stamps)
        lens, stated_size, about_lens, lens_files = self._lens(folder, stamps)
        depth_lens, color_from_depth, about_depth = self._depth(lens, stamps)
        written = self._optical(poses.matrices, options.camera_axes)
        world_from_cameras, world_from_gripper, hand_eye = to_world_from_camera(written, options, folder=folder)
        camera = SourceCamera(
            name=name,
            frames=tuple(f"{i:06d}" for i in range(len(stamps))),
            lens=lens,
            world_from_cameras=world_from_cameras,
            time=self._time(stamps),
            color=lambda i: self._color(int(color_of_frame[i])),
            depth=lambda i: self._depth_image(int(depth_of_frame[i])),
            depth_scale=options.depth_scale or depth.kind.depth_scale,
            depth_lens=depth_lens,
            color_from_depth=color_from_depth,
            faults=faults,
            expected=expected,
            pose_places=tuple(f"{self.bag.paths[0]}: pose of {color.name} {i:06d}" for i in range(len(stamps))),
            intrinsics_size=stated_size,
            otherwise=other_readings(written, options, folder=folder) | self._of_other_frames(poses.matrices, stamps),
        )
        self.statements |= {
            "pose": self.motion.statement,
            "camera axes": f"{AXES[options.camera_axes]} of {self.motion.target}",
            "depth": f"{depth.name}, {camera.depth_scale:g} m per unit, {about_depth}; the image nearest in time, at "
            f"most {limit:g} s away",
            "intrinsics": about_lens,
            "time": f"{color.name}: "
            + ("arrival in the bag" if options.stamps == "arrival" else "header stamps")
            + (f"; {self.images.n_moved} arrived late and were sorted" if self.images.n_moved else ""),
        }
        return camera, (*lens_files, *hand_eye), world_from_gripper

    def _optical(self, world_from_frame: Float[ndarray, "t 4 4"], axes: str) -> Float[ndarray, "t 4 4"]:
        """Poses with optical axes; those of a gripper stay as they are."""
        is_gripper = self.motion.target != self.frame
        return world_from_frame if axes == "optical" or is_gripper else world_from_frame @ BODY_FROM_OPTICAL

    def _of_other_frames(
        self, world_from_frame: Float[ndarray, "t 4 4"], stamps: list[int]
    ) -> dict[str, Float[ndarray, "t 4 4"]]:
        """Poses by options for other frames and axes, if the frame's name does not say that it is an optical one."""
        options, tree, frame = self.options, self.motion.tree, self.motion.target
        if "optical" in frame or frame != self.frame:
            return {}
        other = "optical" if options.camera_axes == "body" else "body"
        readings = {f"--camera-axes {other}": self._optical(world_from_frame, other)}
        if options.camera_frame or options.pose_topic:
            return readings
        near = [name for name in sorted(tree.frames) if "optical" in name and frame in tree.chain(name)]
        found = {f"--camera-frame {name}": replace(self.motion, target=name).at(stamps).matrices for name in near[:4]}
        return readings | found

    def _frames(self, partners: ImageStream | None) -> tuple[Int[ndarray, " t"], list[int]]:
        """Index of the colour image of each frame, -1 if it has none, and stamps."""
        if partners is None or partners is self.images:
            return np.arange(len(self.images.stamps)), self.images.stamps
        which = _paired(partners.stamps, self.images.stamps, self.options.max_time_difference)
        return which, [self.images.stamps[k] if k >= 0 else partners.stamps[i] for i, k in enumerate(which)]

    def _time(self, stamps: list[int]) -> Float[ndarray, " t"]:
        """Seconds of all frames; the clock is checked on those that count."""
        where = f"{self.bag.paths[0]}: {self.topics.color.name}"
        values = np.array(stamps, np.int64)
        seconds(np.unique(values), where, unit="ns", instead="pass --stamps arrival", option="")
        whole, rest = np.divmod(values, 10**9)
        return whole + rest / 1e9

    def _color(self, k: int) -> ndarray:
        topic = self.topics.color
        return color_of(*self._message(topic, self.images, k))

    def _depth_image(self, k: int) -> ndarray:
        return depth_of(*self._message(self.topics.depth, self.depths, k))

    def _message(self, topic: ImageTopic, images: ImageStream, k: int) -> tuple[str, object]:
        where = f"{self.bag.paths[images.places[k].part]}: {topic.name} {k:06d}"
        return where, self.bag.decoded(topic.name, self.bag.raw(topic.name, images.places[k]))

    def _faults(
        self,
        color_of_frame: Int[ndarray, " t"],
        depth_of_frame: Int[ndarray, " t"],
        stamps: list[int],
        has_pose: Bool[ndarray, " t"],
    ) -> tuple[dict[int, BadData], dict[int, str]]:
        """Why frames cannot be used, and in one or two words; by index."""
        limit = self.options.max_time_difference
        again = np.diff(np.array(stamps, np.int64), prepend=-1) == 0
        checks = {
            "no colour": (color_of_frame < 0, f"an image within {limit:g} s of the first camera's"),
            "repeated stamp": ((color_of_frame >= 0) & again, "a header stamp of its own"),
            "no depth": (depth_of_frame < 0, f"a depth image of its own within {limit:g} s"),
            "no pose": (~has_pose, f"transforms of {self.motion.target} around it"),
        }
        faults: dict[int, BadData] = {}
        kinds: dict[int, str] = {}
        for kind, (lacks, expected) in checks.items():
            remedy = {"no pose": "a larger --max-pose-gap", "repeated stamp": "--stamps arrival"}
            fix = f"pass {remedy.get(kind, 'a larger --max-time-difference')}, or --skip-bad to leave such frames out."
            for i in np.flatnonzero(lacks).tolist():
                if i not in faults:
                    place = f"{self.bag.paths[0]}: {self.topics.color.name}"
                    faults[i] = BadData(place, f"image {i:06d}", expected=expected, got="none", fix=fix)
                    kinds[i] = kind
        return faults, kinds

    def _nothing(self, fault: BadData, stamps: list[int]) -> BadData:
        """The error for no frame that can be used."""
        spans = {self.topics.depth.name: self.depths.stamps} | {
            f"tf {parent} -> {child}": list(edge.stamps)
            for child in self.motion.tree.chain(self.motion.target)
            for parent, edge in self.motion.tree.edges.get(child, {}).items()
            if not edge.is_static
        }
        text = [f"{name} {min(span) / 1e9:.3f} to {max(span) / 1e9:.3f} s" for name, span in spans.items() if span]
        error = BadData(
            self.bag.paths[0],
            "time stamps",
            expected=f"depth within {self.options.max_time_difference:g} s of colour, and transforms around it",
            got=f"none for {len(stamps)} images from {stamps[0] / 1e9:.3f} to {stamps[-1] / 1e9:.3f} s; {listed(text)}",
            fix="check that the clocks agree, or pass a larger --max-time-difference or --max-pose-gap.",
        )
        error.add_note(f"the first: {fault.fault}")
        return error

    def _lens(self, folder: Folder, stamps: list[int]) -> tuple[Lens, str, str, tuple[Path, ...]]:
        """Colour's lens, the size of the images that it is for, a statement, and files."""
        size = _size(self._color, self.images)
        if self.options.intrinsics:
            stated = read_calibration(folder, self.options.intrinsics)
            stated_size = self.options.intrinsics_size or stated.size
            lens = Lens(stated.K, size, stated.distortion)
            return lens, stated_size, f"{self.options.intrinsics}: {stated.statement}", stated.files
        found = stated_lens(
            self.bag,
            self.contents,
            self.topics.color,
            size,
            stamps,
            "--camera-info-topic",
            self.options.camera_info_topic,
        )
        return found.lens, self.options.intrinsics_size or found.stated_size, found.statement, ()

    def _depth(self, lens: Lens, stamps: list[int]) -> tuple[Lens | None, Float[ndarray, "4 4"] | None, str]:
        """Depth's lens and pose in the colour camera, None where they are colour's, and a statement."""
        depth, topics = self.topics.depth, self.topics
        size = _size(self._depth_image, self.depths)
        is_aligned = topics.is_aligned and size == lens.size
        wants_lens = not is_aligned or has_lens(self.contents, depth, self.options.depth_info_topic)
        if self.options.depth_intrinsics or not wants_lens:
            return None, self._extrinsics(stamps), "on colour's pixels" if is_aligned else "with --depth-intrinsics"
        found = stated_lens(
            self.bag, self.contents, depth, size, stamps, "--depth-info-topic", self.options.depth_info_topic
        )
        if is_aligned and same_camera(found.lens, lens):
            return None, None, "on colour's pixels"
        extrinsics = self._extrinsics(stamps)
        about = "of the same camera" if extrinsics is None else f"of another camera, {depth.frame} by tf"
        return found.lens, extrinsics, f"{about}, {found.statement}"

    def _extrinsics(self, stamps: list[int]) -> Float[ndarray, "4 4"] | None:
        """Pose of the depth camera in the colour camera; None if they are one."""
        depth = self.topics.depth
        if self.topics.is_aligned or depth.frame == self.topics.color.frame or self.options.color_from_depth:
            return None
        tree = self.contents.tree
        for frame in (self.frame, depth.frame):
            if frame not in tree.frames:
                raise BadData(
                    self.bag.paths[0],
                    "tf",
                    expected=f"the pose of the depth camera, {depth.frame}, in colour's, {self.frame}",
                    got=f"no frame {frame}",
                    fix="pass --color-from-depth FILE, or --depth-topic with depth that is registered to colour.",
                )
        poses = tree.a_from_b(self.frame, depth.frame, stamps)
        known = poses.matrices[poses.is_known]
        if not len(known) or np.abs(known - known[0]).max() > SAME_EXTRINSICS:
            got = "one that changes" if len(known) else "none at the times of the images"
            raise BadData(
                self.bag.paths[0],
                f"tf: {depth.frame} in {self.frame}",
                expected="one transform",
                got=got,
                fix="pass --color-from-depth FILE.",
            )
        return known[0]


def _size(decode: Callable[[int], ndarray], images: ImageStream) -> tuple[int, int]:
    """(height, width) of the first image that can be decoded, pixels."""
    shape = first_readable(decode, range(len(images.places))).shape
    return int(shape[0]), int(shape[1])


def _paired(stamps: Sequence[int], others: Sequence[int], limit: float) -> Int[ndarray, " n"]:
    """Index of the other stamp that is each other's nearest, at most `limit` seconds away; -1 if there is none."""
    start = int(stamps[0])
    return mutual_nearest(since(stamps, start), since(others, start), limit)
