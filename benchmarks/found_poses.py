"""Accuracy of poses that `ingest colmap` finds from images, on scans whose poses are known.

    python benchmarks/found_poses.py                        the two shipped recordings of shelves
    python benchmarks/found_poses.py data/demo table ::2    a scan of a dataset, every second frame

Images and depth of each scan are written to `build/found_poses` without their poses, and ingested with its intrinsics.
Printed are the frames that registered, the scale compared with the known poses', and what differs after the best rigid
motion of the world. The known poses have errors, too.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import cv2
import numpy as np

from bask_data.core.geometry import rotation_angle
from bask_data.core.similarity import similarity
from bask_data.errors import run
from bask_data.formats import FORMATS
from bask_data.formats.options.colmap import ColmapOptions
from bask_data.kinds import Camera, Scan
from bask_data.sources.ingest import ingest

REPOSITORY = Path(__file__).resolve().parent.parent
BUILD = REPOSITORY / "build" / "found_poses"
FORMAT = {format.name: format for format in FORMATS}
MILLIMETRES = 1000


def main() -> None:
    given = (*sys.argv[1:], "", "", "")
    print("scan                 registered   scale   median             largest")
    if given[0]:
        compare(given[1], Scan(Path(given[0]) / "scan" / given[1]), given[2])
        return
    for name in ("apc_shelf", "labelfusion_shelf"):
        apc = FORMAT["apc"]
        source = REPOSITORY / "datasets" / name
        ingest(BUILD / "known", name, format=apc, source=source, options=apc.options(), force=True)
        compare(name, Scan(BUILD / "known" / "scan" / name), "")


def compare(name: str, scan: Scan, frames: str) -> None:
    """Print a row for a scan."""
    camera = scan.cameras[0]
    source = BUILD / name
    shutil.rmtree(source, ignore_errors=True)
    write(camera, source)
    K = camera.Ks[0].tolist()
    intrinsics = f"{K[0][0]},{K[1][1]},{K[0][2]},{K[1][2]}"
    options = ColmapOptions(intrinsics=intrinsics, frames=frames, fps=1)
    ingest(BUILD / "found", name, format=FORMAT["colmap"], source=source, options=options, force=True)
    found = Scan(BUILD / "found" / "scan" / name).camera("camera")
    numbers = np.rint(np.array(found.time)).astype(int)
    known, ours = np.array(camera.world_from_cameras)[numbers], np.array(found.world_from_cameras)
    scale = 1 / similarity(ours, known).scale - 1
    moved = similarity(ours, known, scale=1.0).moved(ours)
    distance_mm = MILLIMETRES * np.linalg.norm(moved[:, :3, 3] - known[:, :3, 3], axis=1)
    angle_deg = np.degrees(rotation_angle(np.swapaxes(moved[:, :3, :3], 1, 2) @ known[:, :3, :3]))
    n_frames = len(np.arange(camera.n_frames)[slice(*(int(part) if part else None for part in frames.split(":")))])
    median = f"{np.median(distance_mm):5.1f} mm {np.median(angle_deg):5.2f} deg"
    largest = f"{distance_mm.max():5.1f} mm {angle_deg.max():5.2f} deg"
    print(f"{name:20} {len(ours):4} of {n_frames:3} {scale:+7.1%}  {median}  {largest}")


def write(camera: Camera, folder: Path) -> None:
    """Images, and depth in millimetres, by the number of the frame."""
    for i in range(camera.n_frames):
        for kind, image in (
            ("images", camera.rgb(i)[..., ::-1]),
            ("depth", np.rint(camera.depth(i) * MILLIMETRES).astype(np.uint16)),
        ):
            (folder / kind).mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(folder / kind / f"{i:06d}.png"), image)


if __name__ == "__main__":
    run(main)
