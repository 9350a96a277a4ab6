"""Draw the keypoints of a demonstration: in its last frame, and as trajectories in 3D with their uncertainty.

Usage: python examples/keypoints.py ROOT --out keypoints.jpg
"""

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import bask_data as bask


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("root", nargs="?", type=Path, default=Path("build/demo/dataset"))
    parser.add_argument("--out", type=Path, default=Path("keypoints.jpg"))
    arguments = parser.parse_args()

    ds = bask.open(arguments.root)
    demonstration = next(iter(ds.demonstrations.values()))
    track = ds.keypoints(demonstration.name)
    print(track)
    camera = demonstration.cameras[0]
    frame = demonstration.camera(camera)[-1]

    figure = plt.figure(figsize=(10, 3.8))
    picture, space = figure.add_axes((0, 0, 0.48, 0.9)), figure.add_axes((0.5, 0.02, 0.48, 0.9), projection="3d")
    picture.imshow(frame.rgb)
    picture.set(title=f"frame {frame.index}", xlim=(0, frame.rgb.shape[1]), ylim=(frame.rgb.shape[0], 0))
    picture.axis("off")
    sphere = np.stack(np.meshgrid(np.linspace(0, 2 * np.pi, 16), np.linspace(0, np.pi, 9)))
    unit = np.stack([np.cos(sphere[0]) * np.sin(sphere[1]), np.sin(sphere[0]) * np.sin(sphere[1]), np.cos(sphere[1])])
    for k in range(len(track.names)):
        colour = plt.get_cmap("tab20")(k % 20)
        u, v = track.pixel[camera][-1, k]
        picture.plot(u, v, "o", color=colour, markeredgecolor="white" if track.observed[camera][-1, k] else "black")
        space.plot(*track.mean[:, k].T, ".-", color=colour, linewidth=1, markersize=4)
        # One standard deviation around the last position.
        values, axes = np.linalg.eigh(track.covariance[-1, k])
        ellipsoid = np.einsum("ij,jab->iab", axes * np.sqrt(values.clip(0)), unit) + track.mean[-1, k, :, None, None]
        space.plot_wireframe(*ellipsoid, color=colour, linewidth=0.4)
    space.locator_params(nbins=4)
    space.set(
        xlabel="x (m)",
        ylabel="y (m)",
        zlabel="z (m)",
        aspect="equal",
        title="all frames; ellipsoids: 1 standard deviation",
    )
    figure.savefig(arguments.out, dpi=80)


if __name__ == "__main__":
    bask.errors.run(main)
