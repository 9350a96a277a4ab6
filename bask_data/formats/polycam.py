"""Raw data of Polycam's LiDAR captures: keyframes with images, depth, confidence and a camera file each."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.lens import Lens, one_if_same
from bask_data.errors import BadData
from bask_data.formats.clock import seconds
from bask_data.formats.files import MAX_TEXT_BYTES, first_readable, natural
from bask_data.formats.images import decode_color, decode_depth, decode_labels, image_header
from bask_data.formats.json_values import array, number, parse_json
from bask_data.formats.lenses import scaled_lens
from bask_data.formats.members import Members, ZipMembers, members_of
from bask_data.formats.options.polycam import PolycamOptions
from bask_data.formats.poses import OPENCV_FROM_OPENGL
from bask_data.formats.recording import SourceCamera, SourceRecording

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")


def read(source: Path, options: PolycamOptions) -> SourceRecording:
    """The keyframes of an export, a folder or the zip file as the app writes it; corrected poses go before others."""
    files = _keyframe_files(_members(source, options.follow_links))
    names = sorted({*files.all_cameras, *files.color, *files.depth, *files.cameras}, key=natural)
    cameras, faults, expected = _cameras(files, names, options.least_blur_score)
    usable = [i for i in range(len(names)) if i not in faults]
    if not usable:
        raise faults[0]
    first = names[usable[0]]
    color_size, depth_size = (files.size(group, [names[i] for i in usable]) for group in (files.color, files.depth))
    Ks = np.stack([(cameras.get(name) or cameras[first]).K for name in names])
    lens = Lens(one_if_same(Ks), color_size)
    for i in usable:
        if (stated := cameras[names[i]].size) not in (None, color_size):
            faults[i] = _other_size(files, names[i], stated, color_size)
    unknown = np.full((4, 4), np.nan)
    poses = np.stack([cameras[name].world_from_camera if name in cameras else unknown for name in names])
    camera = SourceCamera(
        name=options.camera,
        frames=tuple(names),
        lens=lens,
        world_from_cameras=poses * np.diag(OPENCV_FROM_OPENGL),
        time=seconds(
            np.array([_stamp(files.members, name) for name in names]), "keyframes' names", unit="us", option=""
        ).time,
        color=lambda i: decode_color(*files.content(files.color, names[i])),
        depth=lambda i: decode_depth(*files.content(files.depth, names[i])),
        depth_scale=0.001,
        depth_lens=None if depth_size == color_size else scaled_lens(lens, depth_size),
        confidence=(lambda i: decode_labels(*files.confidence_of(names[i]))) if files.confidence else None,
        faults=faults,
        expected=expected,
        pose_places=tuple(files.members.place(files.cameras.get(name, name)) for name in names),
    )
    groups = (files.cameras, files.all_cameras, files.color, files.depth, files.confidence)
    used = sorted({file for group in groups for file in group.values()})
    return SourceRecording((camera,), None, {}, _assumptions(files), files.members.files(used))


@dataclass(frozen=True)
class _KeyframeFiles:
    """Files by keyframe; `cameras` are those whose poses are used, `all_cameras` those of all keyframes."""

    members: Members
    cameras: dict[str, str]
    all_cameras: dict[str, str]
    color: dict[str, str]
    depth: dict[str, str]
    confidence: dict[str, str]
    is_corrected: bool

    def content(self, group: dict[str, str], name: str) -> tuple[str, bytes]:
        """Place and content of a keyframe's file."""
        return self.members.place(group[name]), self.members.read(group[name])

    def size(self, group: dict[str, str], names: list[str]) -> tuple[int, int]:
        """(height, width) of the first of the keyframes' images that is not broken, pixels."""
        header = first_readable(lambda name: image_header(*self.content(group, name)), names)
        return header.height, header.width

    def confidence_of(self, name: str) -> tuple[str, bytes]:
        if name not in self.confidence:
            fix = "leave out --confidence, or these keyframes by --frames."
            place = self.members.place(f"keyframes/confidence/{name}.png")
            raise BadData(place, "confidence", expected="a file for every keyframe", got="none", fix=fix)
        return self.content(self.confidence, name)


def _members(source: Path, follow_links: bool) -> Members:
    """The files from the folder on that holds `keyframes`, which may be the only one of its kind in `source`."""
    members = members_of(source, (".zip",), follow_links)
    if isinstance(members, ZipMembers):
        return members.at("keyframes/")
    # A link to a folder elsewhere would become the folder that all files must lie in.
    inside = [path.parent for path in source.glob("*/keyframes") if not path.parent.is_symlink()]
    if len(inside) == 1 and not members.has("keyframes"):
        return members_of(inside[0], (), follow_links)
    return members


def _keyframe_files(members: Members) -> _KeyframeFiles:
    def group(folder: str, suffixes: tuple[str, ...] = (".png",)) -> dict[str, str]:
        return members.named(f"keyframes/{folder}", suffixes)

    all_cameras, corrected = group("cameras", (".json",)), group("corrected_cameras", (".json",))
    color = group("images", IMAGE_SUFFIXES)
    if corrected:
        color = group("corrected_images", IMAGE_SUFFIXES) or color
    files = _KeyframeFiles(
        members, corrected or all_cameras, all_cameras, color, group("depth"), group("confidence"), bool(corrected)
    )
    wants = {
        "cameras": (files.cameras, "check SOURCE: it holds the folder keyframes, or is the exported zip file."),
        "images": (files.color, "check SOURCE."),
        "depth": (files.depth, "capture with LiDAR (not photo mode), and export raw data in developer mode."),
    }
    for folder, (found, fix) in wants.items():
        if not found:
            raise BadData(members.place(f"keyframes/{folder}"), folder, expected="its files", got="none", fix=fix)
    return files


@dataclass(frozen=True)
class _Camera:
    """A keyframe's camera file.

    Args:
        world_from_camera: in ARKit's axes, metres.
        size: (height, width) of the image that K is for, pixels; None if the file does not say.
        blur_score: the app's measure, larger is sharper; None if the file does not say.
    """

    world_from_camera: Float[ndarray, "4 4"]
    K: Float[ndarray, "3 3"]
    size: tuple[int, int] | None
    blur_score: float | None


def _camera(members: Members, file: str) -> _Camera:
    place = members.place(file)
    table = parse_json(place, members.read(file, MAX_TEXT_BYTES))
    keys = [f"t_{row}{column}" for row in range(3) for column in range(4)]
    # NaN is left for `prepare`, which takes it for lost tracking; a number that is missing is an error.
    rows = array(place, "t_00 to t_23", [table[key] for key in keys if table.get(key) is not None], ((12,),))
    fx, fy, cx, cy = (number(place, table, key) for key in ("fx", "fy", "cx", "cy"))
    has_size = "width" in table or "height" in table
    size = (int(number(place, table, "height")), int(number(place, table, "width"))) if has_size else None
    score = number(place, table, "blur_score") if "blur_score" in table else None
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return _Camera(np.vstack([rows.reshape(3, 4), [0, 0, 0, 1]]), K, size, score)


def _cameras(
    files: _KeyframeFiles, names: list[str], least: float | None
) -> tuple[dict[str, _Camera], dict[int, BadData], dict[int, str]]:
    """Cameras by keyframe; why keyframes cannot be used; kinds of those that the app itself or the user left out."""
    cameras: dict[str, _Camera] = {}
    faults: dict[int, BadData] = {}
    expected: dict[int, str] = {}
    groups = {"camera": files.cameras, "image": files.color, "depth": files.depth}
    for i, name in enumerate(names):
        place = files.members.place(f"keyframes/*/{name}")
        if files.is_corrected and name not in files.cameras:
            got = "none: the app rejected the keyframe"
            faults[i] = BadData(place, "corrected_cameras", expected="a corrected pose", got=got)
            expected[i] = "no corrected pose"
        elif missing := [kind for kind, group in groups.items() if name not in group]:
            fix = "pass --skip-bad to leave out the keyframes that lack a file."
            got = f"no {' and no '.join(missing)}"
            faults[i] = BadData(place, "files", expected="camera, image and depth", got=got, fix=fix)
        else:
            try:
                cameras[name] = _camera(files.members, files.cameras[name])
                score = _blur_score(files, cameras[name], name) if least is not None else None
            except BadData as error:
                faults[i] = error
                continue
            if least is not None and score is not None and score < least:
                want = f"at least {least:g} (--least-blur-score)"
                faults[i] = BadData(place, "blur_score", expected=want, got=f"{score:g}")
                expected[i] = "blurred"
    return cameras, faults, expected


def _blur_score(files: _KeyframeFiles, camera: _Camera, name: str) -> float | None:
    """Corrected cameras leave it out."""
    if camera.blur_score is None and files.is_corrected and name in files.all_cameras:
        return _camera(files.members, files.all_cameras[name]).blur_score
    return camera.blur_score


def _other_size(files: _KeyframeFiles, name: str, stated: object, size: tuple[int, int]) -> BadData:
    return BadData(
        files.members.place(files.cameras[name]),
        "height, width",
        expected=f"{size}, the size of the images",
        got=str(stated),
        fix="export the raw data again, without resizing the images.",
    )


def _stamp(members: Members, name: str) -> int:
    if not (name.isascii() and name.isdecimal() and len(name) < 19):
        place = members.place("keyframes")
        raise BadData(place, "names", expected="files named by their time in microseconds", got=name)
    return int(name)


def _assumptions(files: _KeyframeFiles) -> dict[str, str]:
    which = "corrected_cameras, which the app optimised" if files.is_corrected else "cameras; none are corrected"
    assumptions = {
        "pose": f"world_from_camera in metres, from {which}",
        "camera axes": "ARKit's: x right, y up, z backward; turned to OpenCV's",
        "depth": "z-depth in millimetres, 0 = no measurement",
        "intrinsics": "pinhole, each keyframe's own, for the colour image, pixel (0, 0) a centre; for depth scaled by "
        "the ratio of the sizes",
        "time": "microseconds since the phone started, from the files' names",
    }
    if files.confidence:
        assumptions["confidence levels"] = "0 low, 54 medium, 255 high: --confidence 54 keeps medium and high"
    return assumptions
