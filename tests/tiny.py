"""A recording small enough that the whole pipeline runs in seconds, as files that `ingest frames` reads."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from tests.scenes import intrinsics, orbit, tabletop

HEIGHT, WIDTH = 72, 96

PARAMS = {
    "reconstruct": {"voxel_size": 0.008},
    "correspondences": {"n_pairs": 6, "n_matches": 40},
    "train": {"descriptor_dim": 4, "image_height": 48, "steps": 2, "matches": 16, "pairs_per_step": 1},
    "reference": {"n": 3},
    "encode": {"n_particles": 50},
}


def write_recording(folder: Path, *, n_objects: int = 2, seed: int = 0, n_frames: int = 8) -> list[str]:
    """Write colour, depth and pose files and return the options of `ingest frames` for them."""
    folder.mkdir(parents=True)
    scene, K = tabletop(n_objects, seed=seed, spread=0.12), intrinsics(HEIGHT, WIDTH)
    for i, world_from_camera in enumerate(orbit(n_frames, radius=0.5, n_turns=0.6)):
        view = scene.render(K, world_from_camera, HEIGHT, WIDTH)
        cv2.imwrite(str(folder / f"frame-{i:03d}.color.png"), view.rgb[..., ::-1])
        cv2.imwrite(str(folder / f"frame-{i:03d}.depth.png"), np.round(view.depth * 1e4).astype(np.uint16))
        np.savetxt(folder / f"frame-{i:03d}.pose.txt", world_from_camera)
    K_text = ",".join(f"{value:.9g}" for value in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    return ["--camera", "wrist", "--depth-scale", "0.0001", "--intrinsics", K_text]
