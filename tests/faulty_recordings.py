"""Recordings as folders of files, clean or with one fault injected, and the codes that are to be found for each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8, UInt16
from numpy import ndarray
from scipy.spatial.transform import Rotation

from bask_data.core.geometry import invert_rigid
from tests.random_recordings import MOTIONS, Errors, tracked
from tests.scenes import intrinsics, noisy, tabletop

SIZE = (180, 240)
"""Height and width."""

FRAME_RATE = 10.0


@dataclass(frozen=True)
class Frames:
    """What is written to a folder.

    Args:
        rgb: (t, h, w, 3); depth_mm: 0 = none.
        poses: as the files state them.
        time: seconds.
        options: for `ingest frames`, besides those of a clean recording.
        quaternions: whether poses are written w x y z behind the position, one file for all.
    """

    rgb: UInt8[ndarray, "t h w 3"]
    depth_mm: UInt16[ndarray, "t h w"]
    poses: Float[ndarray, "t 4 4"]
    K: Float[ndarray, "3 3"]
    time: Float[ndarray, " t"]
    options: tuple[str, ...] = ()
    quaternions: bool = False

    @property
    def n_frames(self) -> int:
        return len(self.rgb)

    @property
    def read_as(self) -> list[str]:
        """The options of `ingest frames` for the folder."""
        intrinsics = f"{self.K[0, 0]:.6f},{self.K[1, 1]:.6f},{self.K[0, 2]:.6f},{self.K[1, 2]:.6f}"
        pose = "poses.txt" if self.quaternions else "poses/*.txt"
        options = ["--color", "rgb/*.png", "--depth", "depth/*.png", "--pose", pose, "--intrinsics", intrinsics]
        return [*options, "--timestamps", "times.txt", *self.options]

    def write(self, folder: Path) -> Path:
        """Write the files that `read_as` reads."""
        for name in ("rgb", "depth", "poses"):
            (folder / name).mkdir(parents=True, exist_ok=True)
        lines = []
        for i in range(self.n_frames):
            cv2.imwrite(str(folder / f"rgb/{i:04}.png"), self.rgb[i][..., ::-1])
            cv2.imwrite(str(folder / f"depth/{i:04}.png"), self.depth_mm[i])
            np.savetxt(folder / f"poses/{i:04}.txt", self.poses[i], fmt="%.9f")
            quat_wxyz = np.roll(Rotation.from_matrix(invertible(self.poses[i])).as_quat(), 1)
            lines.append(f"{i:04} " + " ".join(f"{x:.9f}" for x in (*self.poses[i, :3, 3], *quat_wxyz)))
        (folder / "poses.txt").write_text("\n".join(lines) + "\n")
        (folder / "times.txt").write_text("".join(f"{t:.4f}\n" for t in self.time))
        return folder


def invertible(matrix: Float[ndarray, "4 4"]) -> Float[ndarray, "3 3"]:
    """The rotation of a pose, or none if a fault left no rotation."""
    rotation = matrix[:3, :3]
    return rotation if np.linalg.det(rotation) > 0.5 else np.eye(3)


def clean_frames(seed: int, n_frames: int = 36) -> Frames:
    """A hand-held recording of boxes and balls on a table: depth noise of 2 mm + 0.3 %, poses off by 1 mm and 0.1
    degrees, colour noise of 2."""
    rng = np.random.default_rng([seed, 21])
    scene, K = tabletop(4, seed=seed), intrinsics(*SIZE)
    exact = MOTIONS["hand"](rng, n_frames, np.array([0, 0, 0.03]), 0.6)
    views = [scene.render(K, pose, *SIZE) for pose in exact]
    rgb = np.stack([_grainy(view.rgb, rng) for view in views])
    metres = np.stack([_in_reach(noisy(view.depth, 0.002 + 0.003 * 0.6, rng, 0.03)) for view in views])
    poses = tracked(exact, Errors(position=0.001, angle_deg=0.1), rng)
    return Frames(rgb, (metres * 1000).round().astype(np.uint16), poses, K, np.arange(n_frames) / FRAME_RATE)


def _grainy(rgb: UInt8[ndarray, "h w 3"], rng: np.random.Generator) -> UInt8[ndarray, "h w 3"]:
    return np.clip(rgb + rng.normal(scale=2, size=rgb.shape), 0, 255).astype(np.uint8)


def _in_reach(depth: ndarray) -> ndarray:
    """Depth without what lies beyond 4 metres."""
    return np.where(depth < 4.0, depth, 0)


# Faults ---------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Fault:
    """One thing that is wrong.

    Args:
        codes: any of these findings tells it.
        inject: the frames with the fault.
    """

    name: str
    codes: tuple[str, ...]
    inject: Callable[[Frames], Frames] = field(repr=False)


def _with_poses(change: Callable[[Float[ndarray, "t 4 4"]], Float[ndarray, "t 4 4"]]) -> Callable[[Frames], Frames]:
    return lambda frames: replace(frames, poses=change(frames.poses.copy()))


def _with_depth(change: Callable[[Float[ndarray, "t h w"]], ndarray]) -> Callable[[Frames], Frames]:
    """A change of depth in millimetres; 0 stays 0."""

    def inject(frames: Frames) -> Frames:
        depth = frames.depth_mm.astype(np.float64)
        changed = np.where(depth > 0, change(depth), 0)
        return replace(frames, depth_mm=np.clip(changed, 0, 65535).round().astype(np.uint16))

    return inject


def _flipped(poses: ndarray) -> ndarray:
    return poses @ np.diag([1.0, -1, -1, 1])


def _mirrored(poses: ndarray) -> ndarray:
    mirror = np.diag([1.0, -1, 1, 1])
    return mirror @ poses @ mirror


def _in_mm(poses: ndarray) -> ndarray:
    poses[:, :3, 3] *= 1000
    return poses


def _transposed(poses: ndarray) -> ndarray:
    return np.swapaxes(poses, 1, 2)


def _frozen(poses: ndarray) -> ndarray:
    last = 2 * len(poses) // 3
    poses[last:] = poses[last]
    return poses


def _drifting(poses: ndarray) -> ndarray:
    """Away by 60 mm and 4 degrees until the end."""
    share = np.linspace(0, 1, len(poses))
    off = np.tile(np.eye(4), (len(poses), 1, 1))
    off[:, :3, :3] = Rotation.from_rotvec(share[:, None] * np.radians(4) * np.array([0.6, 0.8, 0])).as_matrix()
    off[:, :3, 3] = share[:, None] * [0.04, 0.03, 0.03]
    return off @ poses


def _one_off(poses: ndarray) -> ndarray:
    poses[len(poses) // 2, :3, 3] += [0.05, -0.04, 0.03]
    return poses


def _of_others(poses: ndarray) -> ndarray:
    """Those of another hand around another place."""
    return MOTIONS["hand"](np.random.default_rng(77), len(poses), np.array([0.3, 0.2, 0.1]), 0.8)


def _late(frames: Frames) -> Frames:
    """Each frame with the pose of two frames later."""
    kept = slice(0, frames.n_frames - 2)
    return Frames(frames.rgb[kept], frames.depth_mm[kept], frames.poses[2:], frames.K, frames.time[kept])


def _rays(frames: Frames) -> Frames:
    v, u = np.mgrid[: SIZE[0], : SIZE[1]]
    K = frames.K
    length = np.sqrt(1 + ((u - K[0, 2]) / K[0, 0]) ** 2 + ((v - K[1, 2]) / K[1, 1]) ** 2)
    return _with_depth(lambda depth: depth * length)(frames)


def _with_K(factor: float) -> Callable[[Frames], Frames]:
    def inject(frames: Frames) -> Frames:
        K = frames.K * factor
        K[:2, 2] += 0.5 * factor - 0.5
        K[2, 2] = 1
        return replace(frames, K=K)

    return inject


def _full_of_holes(depth: ndarray) -> ndarray:
    rng = np.random.default_rng(5)
    coarse = rng.random((len(depth), SIZE[0] // 12, SIZE[1] // 12)).astype(np.float32)
    fine = np.stack([cv2.resize(each, SIZE[::-1], interpolation=cv2.INTER_NEAREST) for each in coarse])
    return np.where(fine < 0.85, 0, depth)


def _middle(frames: Frames) -> slice:
    return slice(frames.n_frames // 3, 2 * frames.n_frames // 3)


def _stuck(frames: Frames) -> Frames:
    depth = frames.depth_mm.copy()
    depth[_middle(frames)] = depth[_middle(frames).start]
    return replace(frames, depth_mm=depth)


def _repeated(frames: Frames) -> Frames:
    first = _middle(frames).start
    rgb, depth = frames.rgb.copy(), frames.depth_mm.copy()
    rgb[first : first + 4], depth[first : first + 4] = rgb[first], depth[first]
    return replace(frames, rgb=rgb, depth_mm=depth)


def _black(frames: Frames) -> Frames:
    rgb = frames.rgb.copy()
    rgb[_middle(frames).start : _middle(frames).start + 3] = 0
    return replace(frames, rgb=rgb)


def _exposed(frames: Frames) -> Frames:
    rgb = frames.rgb.copy()
    rgb[_middle(frames)] = (rgb[_middle(frames)] * 0.35).astype(np.uint8)
    return replace(frames, rgb=rgb)


def _bowl(depth: ndarray) -> ndarray:
    """25 mm too near at the image's corners, as of a wrong lens of depth."""
    v, u = np.mgrid[: SIZE[0], : SIZE[1]]
    radius = np.hypot(u - SIZE[1] / 2, v - SIZE[0] / 2) / np.hypot(SIZE[1] / 2, SIZE[0] / 2)
    return depth - 25 * radius**2


def _noise(depth: ndarray) -> ndarray:
    return depth * (1 + np.random.default_rng(6).normal(scale=0.06, size=depth.shape))


def _saturated(depth: ndarray) -> ndarray:
    return np.minimum(depth, np.quantile(depth[depth > 0], 0.7))


def _beside(frames: Frames) -> Frames:
    """Depth as a camera 4 cm beside the colour camera sees it, not registered: some 14 pixels off at 60 cm."""
    depth = np.zeros_like(frames.depth_mm)
    for i, before in enumerate(frames.depth_mm):
        v, u = np.nonzero(before)
        z = before[v, u]
        far_first = np.argsort(-z.astype(int), kind="stable")
        shifted = np.round(u + frames.K[0, 0] * 40 / z).astype(int)
        kept = far_first[(shifted < SIZE[1])[far_first]]
        depth[i, v[kept], shifted[kept]] = z[kept]
    return replace(frames, depth_mm=depth)


def _gap(frames: Frames) -> Frames:
    """Twenty frames' time without any."""
    time = frames.time.copy()
    time[_middle(frames).stop :] += 20 / FRAME_RATE
    return replace(frames, time=time)


def _read_with(**changes: object) -> Callable[[Frames], Frames]:
    return lambda frames: replace(frames, **changes)


FAULTS = (
    Fault("poses inverted", ("other-reading",), _with_poses(invert_rigid)),
    Fault("OpenGL axes", ("other-reading",), _with_poses(_flipped)),
    Fault("mirrored", ("other-reading", "unreadable"), _with_poses(_mirrored)),
    Fault("quaternions w x y z", ("other-reading",), _read_with(quaternions=True)),
    Fault("transposed", ("unreadable",), _with_poses(_transposed)),
    Fault("depth ten times", ("other-unit",), _with_depth(lambda depth: depth * 10)),
    Fault("depth a thousandth", ("other-unit", "unreadable"), _read_with(options=("--depth-scale", "0.000001"))),
    Fault("poses in millimetres", ("other-unit",), _with_poses(_in_mm)),
    Fault("depth along rays", ("other-depth",), _rays),
    Fault("intrinsics of half the size", ("other-intrinsics", "unreadable"), _with_K(0.5)),
    Fault("intrinsics of double the size", ("other-intrinsics", "unreadable"), _with_K(2.0)),
    Fault("clock off by two frames", ("other-clock",), _late),
    Fault("poses of another recording", ("poses-unrelated", "reading-unknown"), _with_poses(_of_others)),
    Fault("poses frozen at the end", ("poses-repeated", "frame-off"), _with_poses(_frozen)),
    Fault("one pose wrong", ("pose-jump", "frame-off"), _with_poses(_one_off)),
    Fault("drift", ("drift",), _with_poses(_drifting)),
    Fault("holes", ("depth-sparse",), _with_depth(_full_of_holes)),
    Fault("stuck depth", ("depth-stuck",), _stuck),
    Fault("frames twice", ("frames-duplicate",), _repeated),
    Fault("black frames", ("frames-black",), _black),
    Fault("exposure jump", ("exposure-jump",), _exposed),
    Fault("depth bowl", ("depth-bowl",), _with_depth(_bowl)),
    Fault("depth noise", ("depth-noise",), _with_depth(_noise)),
    Fault("depth saturated", ("depth-saturated",), _with_depth(_saturated)),
    Fault("depth beside colour", ("depth-shifted",), _beside),
    Fault("missing stamps", ("time-gap",), _gap),
)
"""Of a recording's files."""
