"""Draw the README's picture from the dataset that `make demo` leaves: python docs/picture.py"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from bask_data.dataset import Dataset
from bask_data.drawing.colours import palette
from bask_data.drawing.mask_pictures import mask_picture
from bask_data.drawing.pictures import Mark, marks_picture
from bask_data.kinds import Demonstration, KeypointTrack, ReferenceKeypoints, Scan, VisibleMasks

HERE = Path(__file__).parent
WIDTH = 420
SCAN_FRAME, DEMONSTRATION_FRAME = 2, 8


def main() -> None:
    """A scan, its masks with the picked keypoints beside them, and the keypoints found in the demonstration."""
    dataset = Dataset(HERE.parent / "build" / "demo" / "dataset")
    scan = Scan(dataset.path(Scan, "apc_shelf")).camera("wrist")
    masks = VisibleMasks(dataset.path(VisibleMasks, "apc_shelf")).camera("wrist")
    demonstration = Demonstration(dataset.path(Demonstration, "labelfusion_shelf")).camera("wrist")
    track = KeypointTrack(dataset.path(KeypointTrack, "labelfusion_shelf"))
    picks = ReferenceKeypoints(dataset.path(ReferenceKeypoints)).picks
    colours = palette(len(picks))
    found = [
        Mark(number=i + 1, pixel=pixel, colour=colour)
        for i, (pixel, colour) in enumerate(zip(track.pixel("wrist")[DEMONSTRATION_FRAME], colours, strict=True))
    ]
    panels = [
        cv2.resize(scan.rgb(SCAN_FRAME), (WIDTH, WIDTH * 3 // 4), interpolation=cv2.INTER_AREA),
        mask_picture(scan.rgb(SCAN_FRAME), masks.instance(SCAN_FRAME), None, WIDTH),
        marks_picture(demonstration.rgb(DEMONSTRATION_FRAME), found, WIDTH),
    ]
    gap = np.full((panels[0].shape[0], 6, 3), 255, dtype=np.uint8)
    picture = np.hstack([panels[0], gap, panels[1], gap, panels[2]])
    file = HERE / "picture.jpg"
    if not cv2.imwrite(str(file), picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88]):
        raise OSError(f"{file}: could not be written")


if __name__ == "__main__":
    main()
