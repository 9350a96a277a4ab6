"""What folders of each format look like: a function per format that knows its layout, by names and first bytes; of APC
also by depth."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping

import numpy as np

from bask_data.core.rotated_bits import BitPairs, bit_pairs
from bask_data.errors import BadData
from bask_data.formats.depth_files import decode_any_depth
from bask_data.formats.file_patterns import words_of
from bask_data.formats.files import MAX_IMAGE_BYTES
from bask_data.formats.guess import Guess
from bask_data.formats.listing import Listing
from bask_data.formats.options.colmap import MODEL_PLACES
from bask_data.formats.recognise.files import guess_of_file
from bask_data.formats.recognise.frames import K_PLACEHOLDER, find_calibration, find_trajectory

INFO_BYTES = 4 * 2**20
"""Bytes read of a LeRobot dataset's `meta/info.json`, which lists all its features."""

N_DECODED = 3
"""Depth images that are decoded at most to see whether a scene may be APC's: the first one that has depth decides."""


def _tum(listing: Listing) -> Guess | None:
    lists = [name for name in ("rgb.txt", "depth.txt") if listing.has(name)]
    pairs = next((name for name in listing.files() if re.match(r"assoc\w*\.txt$", name)), "")
    if len(lists) < 2 and not pairs:
        return None
    options: dict[str, str] = {}
    missing: dict[str, str] = {}
    reasons = [f"{' and '.join(lists)} list images with times" if len(lists) == 2 else f"{pairs} pairs images by time"]
    if len(lists) < 2:
        options["associations"] = pairs
    if not listing.has("groundtruth.txt"):
        trajectory = find_trajectory(listing, without=(*lists, pairs))
        options |= {"trajectory": trajectory} if trajectory else {}
        missing |= {} if trajectory else {"trajectory": "FILE"}
    reasons.append(f"poses in {options.get('trajectory', 'groundtruth.txt')}" if not missing else "no poses")
    benchmark = re.search("freiburg[123]", listing.root.resolve().name)
    calibration = find_calibration(listing)
    if benchmark or calibration:
        options["intrinsics"] = benchmark[0] if benchmark else calibration
    else:
        missing["intrinsics"] = K_PLACEHOLDER
        reasons.append("no file with intrinsics")
    return Guess("tum", listing.root, tuple(reasons), options, missing)


def _scannet(listing: Listing) -> Guess | None:
    for folder in listing.upper_folders:
        prefix = f"{folder}/" if folder else ""
        inner = set(listing.folders(folder))
        has_K = any(
            "intrinsic" in name and name.endswith(".txt")
            for place in (f"{prefix}intrinsic", folder)
            for name in listing.files(place)
        )
        if {"color", "depth", "pose"} <= inner and has_K and ("intrinsic" in inner or _has_stem(listing, folder)):
            reasons = f"{prefix or './'} has color, depth, pose and the intrinsics that SensReader exports"
            return Guess("scannet", listing.root, (reasons,))
    packed = [name for name in listing.files() if name.lower().endswith(".sens")]
    return Guess("scannet", listing.root / packed[0], (f"{packed[0]} is a ScanNet file",)) if len(packed) == 1 else None


def _has_stem(listing: Listing, folder: str) -> bool:
    """Whether calibrations lie beside the folders of images, as in ScanNet's frames_25k."""
    return any(name.startswith(("intrinsics_", "intrinsic_")) for name in listing.files(folder))


def _arkitscenes(listing: Listing) -> Guess | None:
    for prefix in ("", *(f"{name}_frames/" for name in (listing.root.resolve().name,))):
        if listing.has(f"{prefix}lowres_wide.traj") or listing.has_folder(f"{prefix}lowres_wide_intrinsics"):
            seen = [name for name in ("lowres_wide", "lowres_depth", "lowres_wide.traj") if listing.has(prefix + name)]
            return Guess("arkitscenes", listing.root, (f"has {', '.join(seen)}",))
    return None


def _bop(listing: Listing) -> Guess | None:
    def marks(folder: str) -> str:
        names = listing.files(folder)
        return next((n for n in names if re.match(r"scene_camera\w*\.json$", n) or n.endswith("-meta.mat")), "")

    if mark := marks(""):
        return Guess("bop", listing.root, (f"{mark} is a scene's of a BOP data set or of YCB-Video",))
    levels = ([folder for folder in listing.all_folders if folder.count("/") == n and marks(folder)] for n in (0, 1))
    inside = next((folders for folders in levels if folders), [])
    if not inside:
        return None
    return Guess("bop", listing.root, (f"scenes {_listed(inside)}, each with {marks(inside[0])}",))


def _nerfstudio(listing: Listing) -> Guess | None:
    names = [name for name in listing.files() if re.match(r"transforms\w*\.json$", name)]
    names = [name for name in names if b"transform_matrix" in listing.head(name) or b"fl_x" in listing.head(name)]
    if not names:
        return None
    chosen = "transforms.json" if "transforms.json" in names else names[0]
    options = {} if chosen == "transforms.json" else {"transforms": chosen}
    return Guess("nerfstudio", listing.root, (f"{chosen} holds a lens and a transform_matrix per image",), options)


def _polycam(listing: Listing) -> Guess | None:
    cameras = [name for name in ("corrected_cameras", "cameras") if listing.has_folder(f"keyframes/{name}")]
    if not cameras or not listing.has_folder("keyframes/depth"):
        return None
    return Guess("polycam", listing.root, (f"keyframes has images, depth and {cameras[0]}",))


def _stray(listing: Listing) -> Guess | None:
    if not listing.has("odometry.csv") or not (listing.has("rgb.mp4") or listing.has("camera_matrix.csv")):
        return None
    return Guess("stray", listing.root, ("has rgb.mp4, odometry.csv and depth",))


def _record3d(listing: Listing) -> Guess | None:
    if listing.has("metadata") and listing.has_folder("rgbd"):
        return Guess("record3d", listing.root, ("metadata and rgbd: an unpacked .r3d file",))
    return None


def _apc(listing: Listing) -> Guess | None:
    reasons = {folder: reason for folder in listing.upper_folders if (reason := _of_apc(listing, folder))}
    if len(reasons) != 1:
        return None
    [(folder, reason)] = reasons.items()
    inside = (f"SOURCE holds it: {folder}",) if folder else ()
    return Guess("apc", listing.root / folder, (reason, *inside))


def _of_apc(listing: Listing, folder: str) -> str:
    """Why a folder is an APC scene; empty if it is none. Others name files so, too: depth must have steps of 8."""
    files = listing.files(folder)
    depths = [name for name in files if re.match(r"frame-\d+\.depth\.png$", name)]
    mark = next((name for name in ("cam.info.txt", "camera-intrinsics.color.txt") if name in files), "")
    if not depths or not mark:
        return ""
    reason = f"frame-*.depth.png and {mark}, as APC scenes have"
    for name in depths[:N_DECODED]:
        try:
            raw = decode_any_depth(name, listing.head(f"{folder}/{name}".lstrip("/"), MAX_IMAGE_BYTES))
        except BadData:
            continue
        pairs = bit_pairs(raw) if raw.dtype == np.uint16 else BitPairs()
        if pairs.n_changed:
            return f"{reason}, and depth in steps of 8, as rotated bits have" if pairs.may_be_rotated else ""
    return reason


def _rlbench(listing: Listing) -> Guess | None:
    inside = [folder for folder in listing.all_folders if "low_dim_obs.pkl" in listing.files(folder)]
    if not inside:
        return None
    reason = f"low_dim_obs.pkl in {_listed([folder or './' for folder in inside])}"
    return Guess("rlbench", listing.root, (reason,), has_robot=True)


def _lerobot(listing: Listing) -> Guess | None:
    try:
        info = json.loads(listing.head("meta/info.json", INFO_BYTES))
        version, features = info["codebase_version"], dict(info["features"])
    except (ValueError, KeyError, TypeError, RecursionError):
        return None
    reasons = [f"meta/info.json of a LeRobot dataset, {str(version)[:20]}"]
    words = {word for name in features for word in words_of(str(name))}
    has_K = bool({"intrinsic", "intrinsics"} & words) or any("intrinsic" in str(value) for value in features.values())
    calibration = "" if has_K else find_calibration(listing)
    options = {"intrinsics": calibration} if calibration else {}
    missing = {} if has_K or calibration else {"intrinsics": K_PLACEHOLDER}
    if missing:
        reasons.append("no feature with intrinsics")
    return Guess("lerobot", listing.root, tuple(reasons), options, missing, has_robot=True)


def _rosbag(listing: Listing) -> Guess | None:
    is_bag = b"rosbag2_bagfile_information" in listing.head("metadata.yaml")
    if is_bag:
        return Guess("rosbag", listing.root, ("metadata.yaml of a ROS 2 bag",))
    bags = [name for name in listing.files() if name.lower().endswith((".bag", ".mcap", ".db3"))]
    bags += [name for name in listing.upper_folders if name and listing.has(f"{name}/metadata.yaml")]
    if len(bags) > 1 and _is_bag(listing, bags[0]):
        return Guess("rosbag", listing.root, (f"bags {_listed(bags)}",))
    return _only_file(listing, "rosbag")


def _is_bag(listing: Listing, name: str) -> bool:
    guess = guess_of_file(listing.root / name)
    return guess is not None or b"rosbag2_bagfile_information" in listing.head(f"{name}/metadata.yaml")


def _maniskill(listing: Listing) -> Guess | None:
    return _only_file(listing, "maniskill")


def _robomimic(listing: Listing) -> Guess | None:
    return _only_file(listing, "robomimic")


def _colmap(listing: Listing) -> Guess | None:
    folders = [folder for place in MODEL_PLACES for folder in (place, f"{place}/0")]
    places = [folder for folder in folders if _is_model(listing, folder)]
    if not places:
        return None
    return Guess("colmap", listing.root, (f"COLMAP's model in {places[0]}: cameras and images",))


def _is_model(listing: Listing, place: str) -> bool:
    names = set(listing.files(place))
    return any({f"cameras.{ending}", f"images.{ending}"} <= names for ending in ("bin", "txt"))


def _only_file(listing: Listing, format: str) -> Guess | None:
    """The one file of a format in a folder."""
    endings = (".bag", ".mcap", ".db3", ".h5", ".hdf5", ".r3d")
    files = [name for name in listing.files() if name.lower().endswith(endings)]
    found = [guess for name in files[:20] if (guess := guess_of_file(listing.root / name)) and guess.format == format]
    return found[0] if len(found) == 1 else None


def _listed(names: list[str]) -> str:
    more = len(names) - 3
    return ", ".join(names[:3]) + (f" and {more} more" if more > 0 else "")


RECOGNISERS: Mapping[str, Callable[[Listing], Guess | None]] = {
    "tum": _tum,
    "scannet": _scannet,
    "arkitscenes": _arkitscenes,
    "bop": _bop,
    "nerfstudio": _nerfstudio,
    "polycam": _polycam,
    "record3d": lambda listing: _record3d(listing) or _only_file(listing, "record3d"),
    "stray": _stray,
    "colmap": _colmap,
    "apc": _apc,
    "rlbench": _rlbench,
    "maniskill": _maniskill,
    "robomimic": _robomimic,
    "lerobot": _lerobot,
    "rosbag": _rosbag,
}
"""By format. `frames` is what remains, in `recognise_frames`."""
