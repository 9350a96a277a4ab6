"""Draw the matches of the two views of a scan that are farthest apart.

Usage: python examples/matches.py ROOT --out matches.jpg
"""

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import bask_data as bask


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("root", nargs="?", type=Path, default=Path("build/demo/dataset"))
    parser.add_argument("--out", type=Path, default=Path("matches.jpg"))
    arguments = parser.parse_args()

    ds = bask.open(arguments.root)
    scan = next(iter(ds.scans.values()))
    matches = ds.matches(scan.name)
    print(matches)

    def views(pair: int) -> tuple:
        """The two frames of a pair."""
        a = scan.camera(matches.camera_a[pair])[matches.frame_a[pair]]
        return a, scan.camera(matches.camera_b[pair])[matches.frame_b[pair]]

    def baseline(pair: int) -> float:
        """Metres between the cameras of a pair."""
        a, b = views(pair)
        return float(np.linalg.norm(a.world_from_camera[:3, 3] - b.world_from_camera[:3, 3]))

    widest = max(matches.pairs, key=baseline)
    a, b = views(widest)
    some = np.random.default_rng(0).permutation(np.flatnonzero(matches.pair == widest))[:40]

    figure, axes = plt.subplots(figsize=(9, 3.5), layout="constrained")
    gap = np.full((a.rgb.shape[0], 10, 3), 255, dtype=np.uint8)
    axes.imshow(np.hstack([a.rgb, gap, b.rgb]))
    right = a.rgb.shape[1] + gap.shape[1]
    for uv_a, uv_b, instance in zip(matches.uv_a[some], matches.uv_b[some], matches.instance[some], strict=True):
        (u_a, v_a), (u_b, v_b) = uv_a, uv_b
        axes.plot([u_a, u_b + right], [v_a, v_b], ".-", color=f"C{instance}", linewidth=0.8, markersize=4)
    axes.set_title(f"frames {a.index} and {b.index}, {100 * baseline(widest):.0f} cm apart; a colour for each object")
    axes.axis("off")
    figure.savefig(arguments.out, dpi=80)


if __name__ == "__main__":
    bask.errors.run(main)
