"""Track keypoints frame by frame, as a robot's control loop does, here through a recorded demonstration.

Usage: python examples/track.py ROOT --out track.jpg
"""

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import bask_data as bask


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("root", nargs="?", type=Path, default=Path("build/demo/dataset"))
    parser.add_argument("--out", type=Path, default=Path("track.jpg"))
    parser.add_argument("--every", type=int, default=1, help="let the network see every so many-th frame only")
    parser.add_argument("--scale", type=float, default=1.0, help="size of the network's images, as a share")
    arguments = parser.parse_args()

    ds = bask.open(arguments.root)
    network, reference = ds.root / "descriptor" / "main", ds.root / "reference" / "main"
    tracker = bask.KeypointTracker(network, reference, every=arguments.every, scale=arguments.scale)
    demonstration = next(iter(ds.demonstrations.values()))
    cameras = {name: demonstration.camera(name) for name in demonstration.cameras}
    grippers = demonstration.robot.world_from_gripper if demonstration.robot else None
    steps = []
    for i in range(len(demonstration)):
        frames = {name: camera[i] for name, camera in cameras.items()}
        keypoints = tracker.step(
            images={name: frame.rgb for name, frame in frames.items()},
            depths={name: frame.depth for name, frame in frames.items()},
            intrinsics={name: frame.K for name, frame in frames.items()},
            world_from_cameras={name: frame.world_from_camera for name, frame in frames.items()},
            world_from_gripper=None if grippers is None else grippers[i],
        )
        spread = np.sqrt(np.trace(keypoints.covariance, axis1=1, axis2=2))
        print(f"frame {i}: standard deviation of the keypoints {100 * np.nanmedian(spread):.1f} cm (median)")
        steps.append((next(iter(frames.values())), keypoints))

    figure, panels = plt.subplots(1, 4, figsize=(12, 2.6), layout="constrained")
    for axes, i in zip(panels, np.linspace(0, len(steps) - 1, 4).astype(int), strict=True):
        frame, keypoints = steps[i]
        axes.imshow(frame.rgb)
        axes.scatter(*keypoints.pixel[frame.camera].T, c=range(len(tracker.names)), cmap="tab20", s=25, edgecolors="w")
        axes.set(title=f"frame {frame.index}", xlim=(0, frame.rgb.shape[1]), ylim=(frame.rgb.shape[0], 0))
        axes.axis("off")
    figure.savefig(arguments.out, dpi=80)


if __name__ == "__main__":
    bask.errors.run(main)
