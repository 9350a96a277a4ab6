"""The same views in the layouts and conventions of other tools, written by the libraries that these use."""

from __future__ import annotations

import json
import pickle
import sys
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import h5py
import lzfse
import numpy as np
import OpenEXR
from numpy import ndarray
from scipy.spatial.transform import Rotation

from bask_data.core.geometry import invert_rigid
from tests.formats.bags import COLOR_TOPIC, DEPTH_TOPIC, INFO_TOPIC, OPTICAL, BagWriter
from tests.formats.folders import write_image
from tests.formats.videos import write_video
from tests.formats.views import OPENGL, Views

TRACK = 6
"""Images that may see a point of COLMAP's model: real tracks are as short."""


@dataclass(frozen=True)
class Written:
    """A source as a user has it.

    Args:
        path: what is passed as SOURCE.
        options: what no file states, as a user adds it to the command.
        is_lossy: whether colour is compressed with losses.
        tolerance: of poses, metres; of files in single precision or few digits.
        depth_tolerance: metres.
    """

    path: Path
    options: list[str] = field(default_factory=list)
    is_lossy: bool = False
    tolerance: float = 1e-6
    depth_tolerance: float = 1e-6


def quat_xyzw(pose: ndarray) -> ndarray:
    return Rotation.from_matrix(pose[:3, :3]).as_quat()


def names(views: Views) -> list[str]:
    return [f"{i:04d}" for i in range(views.n)]


def write_images(folder: Path, views: Views, color: str = "rgb/{}.png", depth: str = "depth/{}.png") -> None:
    for name, rgb, z in zip(names(views), views.color, views.depth_mm, strict=True):
        write_image(folder / color.format(name), rgb)
        write_image(folder / depth.format(name), z)


def matrices(folder: Path, views: Views) -> Written:
    """4x4 matrices as text, OpenCV axes, world from camera; K as a matrix."""
    write_images(folder, views)
    (folder / "poses").mkdir()
    for name, pose in zip(names(views), views.poses, strict=True):
        np.savetxt(folder / f"poses/{name}.txt", pose)
    np.savetxt(folder / "intrinsics.txt", views.K)
    return Written(folder)


def opengl_millimetres(folder: Path, views: Views) -> Written:
    """Camera from world in OpenGL axes and millimetres, beside the images."""
    write_images(folder, views, "frame-{}.color.png", "frame-{}.depth.png")
    for name, pose in zip(names(views), views.poses, strict=True):
        camera_from_world = invert_rigid(pose @ OPENGL)
        camera_from_world[:3, 3] *= 1000
        np.savetxt(folder / f"frame-{name}.pose.txt", camera_from_world)
    np.savetxt(folder / "camera-intrinsics.txt", views.K)
    return Written(folder, ["--pose-is", "camera_from_world", "--axes", "opengl", "--pose-unit", "mm"])


def quaternions_wxyz(folder: Path, views: Views) -> Written:
    """One file of `number tx ty tz qw qx qy qz`, and depth in units of 0.2 mm."""
    write_images(folder, views, "images/{}.png", "depths/{}.png")
    for name, z in zip(names(views), views.depth_mm, strict=True):
        write_image(folder / f"depths/{name}.png", 5 * z)
    rows = [[i, *pose[:3, 3], *np.roll(quat_xyzw(pose), 1)] for i, pose in enumerate(views.poses)]
    np.savetxt(folder / "trajectory.txt", rows, fmt=["%d", *["%.12f"] * 7])
    (folder / "camera_info.yaml").write_text(
        f"image_width: {views.size[1]}\nimage_height: {views.size[0]}\n"
        f"camera_matrix:\n  rows: 3\n  cols: 3\n  data: {views.K.ravel().tolist()}\n"
    )
    return Written(folder, ["--quat", "wxyz", "--depth-scale", "0.0002"])


def tum(folder: Path, views: Views) -> Written:
    """Colour and depth with clocks of their own, and poses between the images' times: along a straight line here."""
    write_images(folder, views)
    stamps = {"rgb": views.time, "depth": views.time + 0.004}
    for kind, times in stamps.items():
        lines = [f"{time:.6f} {kind}/{name}.png" for time, name in zip(times, names(views), strict=True)]
        (folder / f"{kind}.txt").write_text("# time file\n" + "\n".join(lines) + "\n")
    rows = [[t, *pose[:3, 3], *quat_xyzw(pose)] for t, pose in zip(views.time, views.poses, strict=True)]
    np.savetxt(folder / "groundtruth.txt", rows, fmt=["%.6f", *["%.12f"] * 7])
    return Written(folder, ["--intrinsics", views.K_text, "--depth-scale", "0.001"])


def open3d(folder: Path, views: Views) -> Written:
    """Open3D's `.log`, its camera intrinsics as JSON, and depth as arrays of metres."""
    write_images(folder, views, "color/{}.png", "16bit/{}.png")
    (folder / "depth").mkdir()
    for name, metres in zip(names(views), views.metres, strict=True):
        (folder / f"16bit/{name}.png").unlink()
        np.save(folder / f"depth/{name}.npy", metres)
    (folder / "16bit").rmdir()
    blocks = []
    for i, pose in enumerate(views.poses):
        blocks += [f"{i} {i} {i + 1}", *(" ".join(map(repr, row)) for row in pose.tolist())]
    (folder / "trajectory.log").write_text("\n".join(blocks) + "\n")
    document = {"width": views.size[1], "height": views.size[0], "intrinsic_matrix": views.K.T.ravel().tolist()}
    (folder / "camera_intrinsic.json").write_text(json.dumps(document))
    return Written(folder, depth_tolerance=5e-4)


def nerfstudio(folder: Path, views: Views) -> Written:
    """transforms.json with OpenGL axes and K from the corner of the image, and depth in EXR, metres."""
    frames = []
    (folder / "depth").mkdir()
    for name, rgb, metres, pose in zip(names(views), views.color, views.metres, views.poses, strict=True):
        write_image(folder / f"images/{name}.png", rgb)
        OpenEXR.File({"type": OpenEXR.scanlineimage}, {"Z": metres}).write(str(folder / f"depth/{name}.exr"))
        frame = {"file_path": f"images/{name}.png", "depth_file_path": f"depth/{name}.exr"}
        frames.append({**frame, "transform_matrix": (pose @ OPENGL).tolist()})
    K, (height, width) = views.K, views.size
    lens = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2] + 0.5, "cy": K[1, 2] + 0.5, "w": width, "h": height}
    (folder / "transforms.json").write_text(json.dumps({**lens, "camera_model": "OPENCV", "frames": frames}))
    return Written(folder, ["--depth-scale", "1"], depth_tolerance=5e-4)


def polycam(folder: Path, views: Views) -> Written:
    """Keyframes named by microseconds, a JSON file of ARKit's pose each."""
    K, (height, width) = views.K, views.size
    lens = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "width": width, "height": height}
    (folder / "keyframes/cameras").mkdir(parents=True)
    for i, pose in enumerate(views.poses @ OPENGL):
        stamp = 900_000 + 400_000 * i
        write_image(folder / f"keyframes/images/{stamp}.png", views.color[i])
        write_image(folder / f"keyframes/depth/{stamp}.png", views.depth_mm[i])
        table = {f"t_{row}{column}": pose[row, column] for row in range(3) for column in range(4)}
        (folder / f"keyframes/cameras/{stamp}.json").write_text(json.dumps({**table, **lens, "blur_score": 99.0}))
    return Written(folder)


def record3d(folder: Path, views: Views) -> Written:
    """A zip file of JPEG, LZFSE-compressed depth and a table of ARKit poses."""
    height, width = views.size
    poses = views.poses @ OPENGL
    table = {
        "w": width,
        "h": height,
        "dw": width,
        "dh": height,
        "fps": 10,
        "K": views.K.T.ravel().tolist(),
        "poses": [[*quat_xyzw(pose), *pose[:3, 3]] for pose in poses],
        "frameTimestamps": (views.time - 1.7e9).tolist(),
    }
    path = folder / "scan.r3d"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("metadata", json.dumps(table))
        for i in range(views.n):
            jpeg = cv2.imencode(".jpg", views.color[i][..., ::-1])[1]
            archive.writestr(f"rgbd/{i}.jpg", jpeg.tobytes())
            archive.writestr(f"rgbd/{i}.depth", lzfse.compress(views.metres[i].tobytes()))
    return Written(path, is_lossy=True, depth_tolerance=5e-4)


def stray(folder: Path, views: Views) -> Written:
    """A video, depth images, and a table of poses in OpenCV axes."""
    write_video(folder / "rgb.mp4", views.color, rate=10)
    rows = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    for i, pose in enumerate(views.poses):
        write_image(folder / f"depth/{i:06d}.png", views.depth_mm[i])
        values = ", ".join(f"{value:.12f}" for value in (*pose[:3, 3], *quat_xyzw(pose)))
        rows.append(f"{100 + i / 10:.6f}, {i:06d}, {values}")
    (folder / "odometry.csv").write_text("\n".join(rows) + "\n")
    np.savetxt(folder / "camera_matrix.csv", views.K, delimiter=", ")
    return Written(folder, is_lossy=True)


def scannet(folder: Path, views: Views) -> Written:
    """What SensReader exports: names without zeros, six decimals."""
    for i, pose in enumerate(views.poses):
        write_image(folder / f"color/{i}.jpg", views.color[i])
        write_image(folder / f"depth/{i}.png", views.depth_mm[i])
        (folder / "pose").mkdir(exist_ok=True)
        np.savetxt(folder / f"pose/{i}.txt", pose, fmt="%f")
    (folder / "intrinsic").mkdir()
    K = np.eye(4)
    K[:3, :3] = views.K
    for kind in ("color", "depth"):
        np.savetxt(folder / f"intrinsic/intrinsic_{kind}.txt", K)
        np.savetxt(folder / f"intrinsic/extrinsic_{kind}.txt", np.eye(4), fmt="%f")
    return Written(folder, is_lossy=True, tolerance=2e-6)


def bop(folder: Path, views: Views) -> Written:
    """scene_camera.json: camera from world in millimetres, depth_scale to millimetres."""
    cameras = {}
    for i, camera_from_world in enumerate(views.camera_from_world):
        write_image(folder / f"rgb/{5 * i:06d}.png", views.color[i])
        write_image(folder / f"depth/{5 * i:06d}.png", 10 * views.depth_mm[i])
        rotation, translation = camera_from_world[:3, :3], 1000 * camera_from_world[:3, 3]
        pose = {"cam_R_w2c": rotation.ravel().tolist(), "cam_t_w2c": translation.tolist()}
        cameras[5 * i] = {"cam_K": views.K.ravel().tolist(), "depth_scale": 0.1, **pose}
    (folder / "scene_camera.json").write_text(json.dumps(cameras))
    return Written(folder)


def arkitscenes(folder: Path, views: Views) -> Written:
    """Names with times, camera from world as axis-angle, intrinsics of every image."""
    lines, video = [], "47333462"
    K, (height, width) = views.K, views.size
    (folder / "lowres_wide_intrinsics").mkdir(parents=True)
    for i, camera_from_world in enumerate(views.camera_from_world):
        name = f"{video}_{100 + i / 10:.3f}"
        write_image(folder / f"lowres_wide/{name}.png", views.color[i])
        write_image(folder / f"lowres_depth/{name}.png", views.depth_mm[i])
        pincam = f"{width} {height} {K[0, 0]} {K[1, 1]} {K[0, 2]} {K[1, 2]}"
        (folder / f"lowres_wide_intrinsics/{name}.pincam").write_text(pincam)
        vector = Rotation.from_matrix(camera_from_world[:3, :3]).as_rotvec()
        lines.append(" ".join(f"{value:.12f}" for value in (100 + i / 10, *vector, *camera_from_world[:3, 3])))
    (folder / "lowres_wide.traj").write_text("\n".join(lines) + "\n")
    return Written(folder)


def rlbench(folder: Path, views: Views) -> Written:
    """Pickled observations, CoppeliaSim axes, and depth as 24-bit colour between two planes."""
    near, far, inside = 0.1, 3.0, folder / "variation0/episodes/episode0"
    modules = {"rlbench": "", "rlbench.backend": "", "rlbench.demo": "Demo"}
    modules["rlbench.backend.observation"] = "Observation"
    before = {name: sys.modules.get(name) for name in modules}
    classes: dict[str, Any] = {}
    for name, of_class in modules.items():
        sys.modules[name] = ModuleType(name)
        if of_class:
            classes[of_class] = type(of_class, (), {"__module__": name})
            setattr(sys.modules[name], of_class, classes[of_class])
    demo = classes["Demo"]()
    demo._observations = []
    for i, pose in enumerate(views.poses):
        write_image(inside / f"wrist_rgb/{i}.png", views.color[i])
        share = np.where(views.depth_mm[i] > 0, (views.depth_mm[i] / 1000 - near) / (far - near), 1)
        code = np.rint(share * (2**24 - 1)).astype(np.int64)
        coded = np.stack([code >> 16, code >> 8 & 255, code & 255], axis=-1).astype(np.uint8)
        write_image(inside / f"wrist_depth/{i}.png", coded)
        observation = classes["Observation"]()
        observation.gripper_pose = np.concatenate([pose[:3, 3], quat_xyzw(pose)])
        observation.gripper_open = 1.0
        observation.misc = {
            "wrist_camera_extrinsics": pose @ np.diag([-1.0, -1.0, 1.0, 1.0]),
            "wrist_camera_intrinsics": views.K @ np.diag([-1.0, -1.0, 1.0]),
            "wrist_camera_near": near,
            "wrist_camera_far": far,
        }
        demo._observations.append(observation)
    (inside / "low_dim_obs.pkl").write_bytes(pickle.dumps(demo))
    for name, module in before.items():
        if module is None:
            del sys.modules[name]
        else:
            sys.modules[name] = module
    return Written(folder)


def maniskill(folder: Path, views: Views) -> Written:
    """HDF5 with calibrations in single precision."""
    path = folder / "trajectory.rgbd.h5"
    with h5py.File(path, "w") as file:
        observations = file.create_group("traj_0/obs")
        shown = observations.create_group("sensor_data/hand_camera")
        shown.create_dataset("rgb", data=views.color, compression="gzip", compression_opts=5)
        depth = views.depth_mm[..., None].astype(np.int16)
        shown.create_dataset("depth", data=depth, compression="gzip", compression_opts=5)
        known = observations.create_group("sensor_param/hand_camera")
        known["extrinsic_cv"] = views.camera_from_world[:, :3].astype(np.float32)
        known["cam2world_gl"] = (views.poses @ OPENGL).astype(np.float32)
        known["intrinsic_cv"] = np.tile(views.K, (views.n, 1, 1)).astype(np.float32)
    return Written(path, tolerance=1e-5)


def robomimic(folder: Path, views: Views) -> Written:
    """HDF5 with a camera in the hand: extrinsics are robomimic's product of the first frame's poses."""
    path, hand = folder / "image_depth.hdf5", "robot0_eye_in_hand"
    gripper_from_camera = np.eye(4)
    gripper_from_camera[:3, 3] = [0.05, 0.0, -0.1]
    grippers = views.poses @ invert_rigid(gripper_from_camera)
    extrinsics = views.poses[0] @ invert_rigid(grippers[0])
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["env_args"] = json.dumps({"env_name": "Lift", "type": 1, "env_kwargs": {}})
        demo = data.create_group("demo_0")
        info = {hand: {"intrinsics": views.K.tolist(), "extrinsics": extrinsics.tolist()}}
        demo.attrs["camera_info"] = json.dumps(info)
        demo["actions"] = np.zeros((views.n, 7))
        obs = demo.create_group("obs")
        obs.create_dataset(f"{hand}_image", data=views.color, compression="gzip")
        depth = np.nan_to_num(views.metres, nan=50.0)[..., None]
        obs.create_dataset(f"{hand}_depth", data=depth, compression="gzip")
        obs["robot0_eef_pos"] = grippers[:, :3, 3]
        obs["robot0_eef_quat_site"] = Rotation.from_matrix(grippers[:, :3, :3]).as_quat()
    return Written(path, depth_tolerance=5e-4)


def rosbag(folder: Path, views: Views) -> Written:
    """A ROS 2 bag: header stamps, depth 2 ms later than colour, and the camera in tf below a robot's tool."""
    bag = BagWriter(folder / "scan", "mcap")
    tool_from_camera = np.eye(4)
    tool_from_camera[:3, 3] = [0.05, 0.0, -0.1]
    bag.write("/tf_static", 0, bag.transforms((0, "tool0", OPTICAL, tool_from_camera)))
    K = views.K
    for time, pose, rgb, z in zip(views.time, views.poses, views.color, views.depth_mm, strict=True):
        stamp = round(time * 10) * 100_000_000
        bag.write("/tf", stamp, bag.transforms((stamp, "base", "tool0", pose @ invert_rigid(tool_from_camera))))
        height, width = views.size
        bag.write(INFO_TOPIC, stamp, bag.info(stamp, matrix=K, height=height, width=width))
        bag.write(COLOR_TOPIC, stamp + 3_000_000, bag.image(stamp, OPTICAL, "rgb8", rgb))
        bag.write(DEPTH_TOPIC, stamp + 4_000_000, bag.image(stamp + 2_000_000, OPTICAL, "16UC1", z))
    return Written(bag.close())


def colmap(folder: Path, views: Views) -> Written:
    """A model of COLMAP in its own unit: camera from world, K from the image's corner, points that images saw."""
    write_images(folder, views, "images/{}.png", "depth/{}.png")
    unit, (height, width), K = 0.4, views.size, views.K
    model = folder / "sparse/0"
    model.mkdir(parents=True)
    lens = f"{K[0, 0]} {K[1, 1]} {K[0, 2] + 0.5} {K[1, 2] + 0.5}"
    (model / "cameras.txt").write_text(f"1 PINHOLE {width} {height} {lens}\n")
    points, seen = [], [[] for _ in range(views.n)]
    rng, inverse = np.random.default_rng(0), views.camera_from_world
    for i in range(views.n):
        v, u = np.nonzero(views.depth_mm[i])
        for k in rng.choice(len(v), 40, replace=False):
            z = views.depth_mm[i, v[k], u[k]] / 1000
            point = views.poses[i] @ [*(z * np.linalg.solve(K, [u[k], v[k], 1.0])), 1.0]
            track = []
            for j in range(i, min(i + TRACK, views.n)):
                camera_from_world = inverse[j]
                x, y, depth = K @ (camera_from_world @ point)[:3]
                uv = np.array([x, y]) / depth
                column, row = np.rint(uv).astype(int)
                inside = 0 <= row < height and 0 <= column < width and depth > 0
                if inside and abs(views.depth_mm[j, row, column] / 1000 - depth) < 0.003:
                    track += [j + 1, len(seen[j])]
                    seen[j].append((*(uv + 0.5), len(points) + 1))
            place = " ".join(map(str, point[:3] / unit))
            points.append(f"{len(points) + 1} {place} 9 9 9 0.1 {' '.join(map(str, track))}")
    lines = []
    for i, (name, pose) in enumerate(zip(names(views), views.camera_from_world, strict=True)):
        numbers = [*np.roll(quat_xyzw(pose), 1), *(pose[:3, 3] / unit)]
        lines.append(f"{i + 1} {' '.join(map(str, numbers))} 1 {name}.png")
        lines.append(" ".join(f"{x} {y} {k}" for x, y, k in seen[i]))
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    (model / "points3D.txt").write_text("\n".join(points) + "\n")
    return Written(folder, tolerance=2e-3)


SOURCES: dict[str, Callable[[Path, Views], Written]] = {
    "matrices": matrices,
    "opengl_millimetres": opengl_millimetres,
    "quaternions_wxyz": quaternions_wxyz,
    "open3d": open3d,
    "tum": tum,
    "scannet": scannet,
    "arkitscenes": arkitscenes,
    "bop": bop,
    "nerfstudio": nerfstudio,
    "polycam": polycam,
    "record3d": record3d,
    "stray": stray,
    "colmap": colmap,
    "rosbag": rosbag,
    "rlbench": rlbench,
    "maniskill": maniskill,
    "robomimic": robomimic,
}
"""By convention; of formats, by the format's name."""
