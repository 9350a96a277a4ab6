"""Draw the pictures of docs/parameters.md, one parameter at a time too small, right and too large.

    python docs/parameters_picture.py

Simulates one scan and makes it again for each value, by the commands that a user would type: about five minutes on
two cores.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np

from bask_data.dataset import Dataset
from bask_data.drawing.mask_pictures import mask_picture
from bask_data.kinds import Scan, VisibleMasks

HERE = Path(__file__).parent
OUT = HERE / "pictures"
WORK = HERE.parent / "build" / "parameters"
SCENE = "rubbish_scan0"
PANEL_PX = 300

PARAMETERS = {
    "voxel_size": ("reconstruct.voxel_size", ("0.002", "0.004", "0.02"), 10),
    "truncation": ("reconstruct.truncation", ("1", "5", "30"), 10),
    "above": ("objects.above", ("[0.0,0.3]", "", "[0.04,0.3]"), 10),
    "eps": ("objects.eps", ("0.004", "0.02", "0.1"), 10),
    "tolerance": ("masks.tolerance", ("0.0005", "", "0.5"), 10),
}
"""By name of the picture: the setting, its values from too small to too large (empty: the default), and the frame."""

WITHOUT = ("masks.find_fixed=false", "masks.use_colour=false")
"""What else keeps masks off the gripper; without it, the pictures show what the tolerance does."""


def main() -> None:
    """A picture for each parameter: the masks of one frame with each of its values, side by side."""
    OUT.mkdir(exist_ok=True)
    data = WORK / "data"
    if not data.exists():
        scan = ("--task", "rubbish", "--scans", "1", "--demonstrations", "0", "--only", SCENE, "--seed", "0")
        bask_data(
            *("ingest", "sim", str(data), *scan, "--frames", "30", "--cameras", "wrist"),
            *("--depth-noise", "0.005", "--flying", "0.2", "--clutter", "2", "--gripper-in-view"),
        )
    make(data, "")  # what a changed setting leaves up to date is not made again
    for name, (setting, values, frame) in PARAMETERS.items():
        panels = [panel(data, setting, value, frame) for value in values]
        gap = np.full((panels[0].shape[0], 6, 3), 255, dtype=np.uint8)
        picture = np.hstack([panels[0], gap, panels[1], gap, panels[2]])
        file = OUT / f"{name}.jpg"
        if not cv2.imwrite(str(file), picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85]):
            raise OSError(f"{file}: could not be written")


def panel(data: Path, setting: str, value: str, i_frame: int) -> np.ndarray:
    """The masks of a frame, made with one setting changed."""
    copy = WORK / "copy"
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(data, copy)
    make(copy, f"{setting}={value}" if value else "")
    dataset = Dataset(copy)
    image = Scan(dataset.path(Scan, SCENE)).camera("wrist").rgb(i_frame)
    labels = VisibleMasks(dataset.path(VisibleMasks, SCENE)).camera("wrist").instance(i_frame)
    return mask_picture(image, labels, None, PANEL_PX)


def make(data: Path, assignment: str) -> None:
    """Mesh, objects and masks of a dataset, with one setting of one of them changed."""
    for stage in ("reconstruct", "objects", "masks"):
        changed = [each for each in (*WITHOUT, assignment) if each.startswith(stage)]
        bask_data(stage, str(data), *(f"--set={each}" for each in changed))


def bask_data(*arguments: str) -> None:
    """One command of the command line."""
    subprocess.run([str(Path(sys.executable).with_name("bask-data")), *arguments], check=True)


if __name__ == "__main__":
    main()
