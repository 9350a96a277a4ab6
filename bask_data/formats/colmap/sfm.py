"""Structure from motion: camera poses, up to scale, from images alone, by pycolmap."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pycolmap

from bask_data.core.image_pairs import pairs_to_match
from bask_data.core.lens import Lens
from bask_data.errors import BadData, UsageError
from bask_data.formats.colmap.lens import colmap_camera
from bask_data.formats.colmap.model import SparseModel, quiet, sparse_model
from bask_data.progress import progress, report

MOST_IMAGES = 1000
"""Most images that are matched: beyond, it takes hours. On two cores, 25 images of 640 x 480 take 20 s, 50 take 60 s,
and each further one about 2 s."""

MOST_PIXELS_PER_SIDE = 1600
"""Longer side to which larger images are reduced to find features. COLMAP's is 3200, for no gain in pose that matters
beside the noise of depth, at four times the time. Sensitivity not measured."""

SEED = 0
"""Of COLMAP's random numbers: the same images give the same poses."""

N_THREADS = min(8, os.cpu_count() or 1)
"""Threads that find and match features; their number changes nothing in the result."""

FIX = "move the camera sideways between images, by views that overlap by 80 % or so, or ingest known poses."
"""What to do where images do not register."""


def structure_from_motion(images: dict[str, Path], lens: Lens | None) -> tuple[SparseModel, int]:
    """A model of the images, all of one camera and size.

    Args:
        images: files by name, in the order they were taken; checked before, as COLMAP decodes them.
        lens: kept as it is; None: estimated, as a radial lens with the principal point in the middle.

    Returns:
        The model, its images by the names given, and the number of models that the images broke into; it is the
        largest.

    Raises:
        BadData: no two images match, or none register.
        UsageError: there are too few or too many images, or COLMAP lacks the lens's model.
    """
    if not 2 < len(images) <= MOST_IMAGES:
        raise UsageError(
            "ingest colmap",
            "images",
            expected=f"3 to {MOST_IMAGES} to find poses from",
            got=str(len(images)),
            fix="choose fewer by --frames ::STEP." if len(images) > 2 else "check --images.",
        )
    with tempfile.TemporaryDirectory(prefix="bask-data-sfm-") as scratch, quiet():
        folder = Path(scratch)
        (folder / "images").mkdir()
        # Names of our own: COLMAP's lists of pairs are separated by spaces.
        own = [f"{i:06d}{path.suffix.lower()}" for i, path in enumerate(images.values())]
        for name, path in zip(own, images.values(), strict=True):
            (folder / "images" / name).symlink_to(path.resolve())
        pycolmap.set_random_seed(SEED)
        _find_features(folder, own, lens)
        _match(folder, own)
        parts = _map(folder, len(own), lens is not None)
        if not parts:
            raise BadData(
                next(iter(images.values())).parent,
                "images",
                expected="images that register",
                got=f"none of {len(images)}: no two share enough features seen from places far enough apart",
                fix=FIX,
            )
        largest = max(parts, key=lambda part: part.num_reg_images())
        model, names = sparse_model("images", largest), dict(zip(own, images, strict=True))
        return replace(model, images={names[name]: image for name, image in model.images.items()}), len(parts)


def _find_features(folder: Path, names: Sequence[str], lens: Lens | None) -> None:
    reader = pycolmap.ImageReaderOptions()
    if lens is not None:
        camera = colmap_camera(lens)
        reader.camera_model, reader.camera_params = camera.model.name, camera.params_to_string()
    database, images = folder / "database.db", folder / "images"
    pycolmap.Database.open(database).close()
    # All are entered first, so that their numbers do not depend on which thread is done first.
    pycolmap.import_images(database, images, pycolmap.CameraMode.SINGLE, list(names), reader)
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu, options.num_threads, options.max_image_size = False, N_THREADS, MOST_PIXELS_PER_SIDE
    for part in progress(_parts(names, N_THREADS), "finding features"):
        pycolmap.extract_features(
            database, images, part, pycolmap.CameraMode.SINGLE, reader, options, device=pycolmap.Device.cpu
        )


def _match(folder: Path, names: Sequence[str]) -> None:
    options = pycolmap.FeatureMatchingOptions()
    options.use_gpu, options.num_threads = False, N_THREADS
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    # A gripper in view of a camera on the wrist stays where it is in every image, and outvotes the scene.
    verification.filter_stationary_matches = True
    listing = pycolmap.ImportedPairingOptions()
    listing.match_list_path = folder / "pairs.txt"
    for part in progress(_parts(pairs_to_match(len(names)), 8 * N_THREADS), "matching images"):
        Path(listing.match_list_path).write_text("".join(f"{names[i]} {names[j]}\n" for i, j in part))
        pycolmap.match_image_pairs(folder / "database.db", options, listing, verification, device=pycolmap.Device.cpu)


def _map(folder: Path, n: int, is_lens_known: bool) -> list[Any]:
    options = pycolmap.IncrementalPipelineOptions()
    # Sums of many threads differ in their last digits from run to run.
    options.num_threads, options.random_seed, options.extract_colors = 1, SEED, False
    options.mapper.random_seed = options.triangulation.random_seed = SEED
    options.min_model_size = 3
    if is_lens_known:
        options.ba_refine_focal_length = options.ba_refine_principal_point = options.ba_refine_extra_params = False
        options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    done = 0

    def registered() -> None:
        nonlocal done
        done = min(done + 1, n)
        report("registering images", done, n)

    report("registering images", 0, n)
    (folder / "models").mkdir()
    parts = pycolmap.incremental_mapping(
        folder / "database.db", folder / "images", folder / "models", options, next_image_callback=registered
    )
    report("registering images", n, n)
    return list(parts.values())


def _parts(items: Sequence[Any], size: int) -> list[list[Any]]:
    return [list(items[i : i + size]) for i in range(0, len(items), size)]
