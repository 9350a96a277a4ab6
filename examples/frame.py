"""Open a dataset, and show a frame: colour, depth, and the objects that are visible in it.

Usage: python examples/frame.py ROOT --out frame.jpg
"""

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import bask_data as bask


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("root", nargs="?", type=Path, default=Path("build/demo/dataset"))
    parser.add_argument("--out", type=Path, default=Path("frame.jpg"))
    arguments = parser.parse_args()

    ds = bask.open(arguments.root)
    print(ds)
    scan = next(iter(ds.scans.values()))  # or ds.scans["table1"]
    frame = scan[len(scan) // 2]
    print(frame, f"shows objects {np.unique(frame.mask[frame.mask > 0]).tolist()}")

    figure, (colour, depth, mask) = plt.subplots(1, 3, figsize=(10, 2.6), layout="constrained")
    colour.imshow(frame.rgb)
    measured = np.ma.masked_equal(frame.depth, 0)  # 0 means no measurement
    figure.colorbar(depth.imshow(measured, cmap="viridis"), ax=depth, label="metres")
    mask.imshow(frame.rgb)
    mask.imshow(np.ma.masked_equal(frame.mask, 0), alpha=0.6, cmap="Set1", vmin=1, vmax=9, interpolation="nearest")
    for axes, title in ((colour, "frame.rgb"), (depth, "frame.depth"), (mask, "frame.mask")):
        axes.set_title(title)
        axes.axis("off")
    figure.savefig(arguments.out, dpi=80)


if __name__ == "__main__":
    bask.errors.run(main)
