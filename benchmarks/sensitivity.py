"""How much results change when a tuned number is halved or doubled: a Markdown table, each row a number.

    python -m benchmarks.sensitivity               all numbers
    python -m benchmarks.sensitivity eps inlier    some of them

Measured on ray-cast tables (boxes and spheres, depth noise of 1 mm + 0.5 % of z), and for what concerns objects and
masks also on the real recording `datasets/apc_shelf` and its labels. The settings of the recording are those of
shelves.yaml. Five to twenty minutes.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bask_data.core import local_warp, scores
from bask_data.core.correspondences import refinement
from bask_data.core.geometry import unproject
from bask_data.core.visibility import decision, labelled, sensor
from bask_data.dataset import Dataset
from bask_data.engine import make, plan
from bask_data.evaluation.correspondences import evaluated_correspondences
from bask_data.evaluation.masks import evaluated_masks
from bask_data.kinds import Truth
from bask_data.kinds.truth import TruthMetadata
from bask_data.stages import correspondences as matching
from bask_data.stages.correspondences import correspondences
from bask_data.stages.masks import masks
from bask_data.stages.objects import objects
from bask_data.stages.reconstruct import reconstruct
from tests.datasets import publish_artifact, publish_recording
from tests.scenes import Scene, View, intrinsics, orbit, tabletop

REPOSITORY = Path(__file__).resolve().parent.parent
HEIGHT, WIDTH, N_VIEWS, N_SCENES = 240, 320, 24, 3
DEPTH_SCALE = 1e-4
K = intrinsics(HEIGHT, WIDTH)
STAGES = (reconstruct, objects, masks, correspondences)
SHELF: dict[str, dict[str, Any]] = {
    "reconstruct": {"voxel_size": 0.003, "workspace": (0.03, -0.14, -0.012, 0.4, 0.14, 0.2)},
    "objects": {"support": "none", "eps": 0.011, "min_area": 0.005},
    "masks": {},
}
FACTORS = (0.5, 1.0, 2.0)

Figures = dict[str, float]


@dataclass(frozen=True)
class Number:
    """A tuned number.

    Args:
        first: name of the first stage whose result depends on it; empty for a number of the evaluation alone.
        option: whether it is a parameter of that stage, as the name says, and no constant.
        on_shelf: whether the recording depends on it.
        scaled: sets the constants that follow from it to a multiple of their values, and puts them back.
    """

    name: str
    first: str
    option: bool = False
    on_shelf: bool = False
    scaled: Callable[[float], Any] | None = None
    measured: Callable[[], Figures] | None = None


@contextmanager
def replaced(*constants: tuple[Any, str, Any]) -> Iterator[None]:
    """Module constants with other values."""
    before = [(module, name, getattr(module, name)) for module, name, _ in constants]
    for module, name, value in constants:
        setattr(module, name, value)
    try:
        yield
    finally:
        for module, name, value in before:
            setattr(module, name, value)


def multiplied(module: Any, name: str, factor: float) -> Any:
    """A constant times a factor."""
    return replaced((module, name, getattr(module, name) * factor))


def edge_reach(factor: float) -> Any:
    """`EDGE_REACH`, and the steps and the margin that follow from it."""
    reach = round(decision.EDGE_REACH * factor)
    steps = range(-reach, reach + 1)
    nearby = sorted(((dv, du) for dv in steps for du in steps), key=lambda step: step[0] ** 2 + step[1] ** 2)[1:]
    return replaced((decision, "STEPS_NEARBY", np.array(nearby)), (labelled, "MARGIN", 1 + reach))


# Data -----------------------------------------------------------------------------------------------------------------


def tables(root: Path) -> Dataset:
    """Ray-cast scenes with noise, and their ground truth."""
    dataset, cameras = Dataset.create(root), orbit(N_VIEWS, radius=0.6)
    for seed in range(N_SCENES):
        scene, rng = tabletop(4 + seed, seed=seed), np.random.default_rng(seed)
        views = [scene.render(K, camera, HEIGHT, WIDTH) for camera in cameras]
        publish_artifact(dataset, Truth, f"table{seed}", partial(_write_truth, views=views, cameras=cameras))
        depth = [
            view.depth + (view.depth > 0) * rng.normal(size=view.depth.shape) * (0.001 + 0.005 * view.depth)
            for view in views
        ]
        publish_recording(
            dataset, f"table{seed}", rgb=[view.rgb for view in views], depth=depth, K=K, world_from_cameras=cameras
        )
    return dataset


def _write_truth(out: Path, views: Sequence[View], cameras: np.ndarray) -> None:
    names = {label: f"body{label}" for label in range(1, 1 + int(max(view.instance.max() for view in views)))}
    with Truth.writer(out, TruthMetadata(label_names=names), np.zeros((len(views), 0, 4, 4))) as writer:
        camera = writer.camera("wrist", len(views), (HEIGHT, WIDTH), DEPTH_SCALE)
        for view, world_from_camera in zip(views, cameras, strict=True):
            camera.append(view.instance, np.round(view.depth / DEPTH_SCALE).astype(np.uint16), world_from_camera)


def shelf(root: Path) -> Dataset:
    """The recording that ships."""
    command = [
        Path(sys.executable).with_name("bask-data"),
        "ingest",
        "apc",
        REPOSITORY / "datasets" / "apc_shelf",
        root,
    ]
    subprocess.run([*map(str, command), "--scene", "apc_shelf"], check=True, stderr=subprocess.DEVNULL)
    return Dataset(root)


def run(dataset: Dataset, options: dict[str, dict[str, Any]], first: str = "reconstruct") -> None:
    """The stages from one on, those alone that have options."""
    names = [stage.name for stage in STAGES]
    for stage in STAGES[names.index(first) :]:
        if stage.name in options:
            for task in plan(dataset, stage, options=options[stage.name]):
                outcome = make(task, force=True)
                if outcome.status != "made":
                    raise RuntimeError(f"{stage.name} of {task.item}: {outcome.why}")


# Figures --------------------------------------------------------------------------------------------------------------


def figures_of(dataset: Dataset, with_matches: bool) -> Figures:
    """Accuracy of masks and matches over all scenes."""
    found = evaluated_masks(dataset)
    figures = {name: found["all"][name] for name in ("counted", "iou", "worst")}
    if with_matches:
        everything = evaluated_correspondences(dataset)["all"]
        figures |= {
            name: everything[name] for name in ("n", "within_1px", "within_2px", "hidden") if name in everything
        }
    return figures


def subpixel_samples(scene: Scene, camera: np.ndarray, n: int = 4000) -> tuple[View, np.ndarray]:
    """An exact view, and positions between pixels on its objects."""
    view, rng = scene.render(K, camera, HEIGHT, WIDTH), np.random.default_rng(0)
    v, u = np.nonzero(view.instance)
    chosen = rng.integers(len(u), size=n)
    uv = np.stack([u[chosen], v[chosen]], axis=1) + rng.uniform(-0.5, 0.5, (n, 2))
    return view, uv


def exact_depth(scene: Scene, camera: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """z-depth by ray casting, metres."""
    directions = unproject(uv, np.ones(len(uv)), K) @ camera[:3, :3].T
    return np.min([body.cast(camera[:3, 3], directions) for body in scene.background + scene.objects], axis=0)


def interpolation_figures() -> Figures:
    """How far `true_depth` is off the ray-cast depth, millimetres."""
    errors = []
    for seed in range(N_SCENES):
        scene = tabletop(4 + seed, seed=seed)
        for camera in orbit(8, radius=0.6):
            view, uv = subpixel_samples(scene, camera)
            errors.append(np.abs(scores.true_depth(view.depth, view.instance, uv) - exact_depth(scene, camera, uv)))
    error = 1000 * np.concatenate(errors)
    return {
        "median mm": float(np.median(error)),
        "p99 mm": float(np.percentile(error, 99)),
        "over 2 mm": float((error > 2).mean()),
    }


def tangent_figures() -> Figures:
    """How far the depth's change per pixel is off that of ray casting, relative to the size of a pixel there."""
    errors, step = [], 0.05
    for seed in range(N_SCENES):
        scene = tabletop(4 + seed, seed=seed)
        for camera in orbit(8, radius=0.6):
            view, uv = subpixel_samples(scene, camera, 1000)
            _, tangents = local_warp.surface_tangents(uv, view.depth, view.instance, K)
            z = exact_depth(scene, camera, uv)
            along = [
                (exact_depth(scene, camera, uv + one) - exact_depth(scene, camera, uv - one)) / (2 * step)
                for one in ([step, 0], [0, step])
            ]
            errors.append(np.linalg.norm(tangents[:, 2] - np.stack(along, axis=1), axis=1) * K[0, 0] / z)
    error = np.concatenate(errors)
    error = error[np.isfinite(error)]
    return {"median": float(np.median(error)), "p90": float(np.percentile(error, 90))}


NUMBERS = (
    Number("inlier", "objects", option=True),
    Number("eps", "objects", option=True, on_shelf=True),
    Number("N_SIGMA", "masks", on_shelf=True, scaled=partial(multiplied, sensor, "N_SIGMA")),
    Number("EDGE_REACH", "masks", on_shelf=True, scaled=edge_reach),
    Number("MATCH_NOISE_SIGMAS", "correspondences", scaled=partial(multiplied, matching, "MATCH_NOISE_SIGMAS")),
    Number("SIGNIFICANT", "correspondences", scaled=partial(multiplied, refinement, "SIGNIFICANT")),
    Number("INTERPOLABLE", "", scaled=partial(multiplied, scores, "INTERPOLABLE"), measured=interpolation_figures),
    Number("SAME_SLOPE", "", scaled=partial(multiplied, local_warp, "SAME_SLOPE"), measured=tangent_figures),
)


def options_with(options: dict[str, dict[str, Any]], number: Number, factor: float) -> dict[str, dict[str, Any]]:
    """The options, with a parameter times a factor."""
    if not number.option:
        return options
    [stage] = [stage for stage in STAGES if stage.name == number.first]
    value = options[number.first].get(number.name, getattr(stage.params(), number.name))
    return options | {number.first: options[number.first] | {number.name: value * factor}}


def rows(number: Number, datasets: dict[str, tuple[Dataset, dict[str, dict[str, Any]]]]) -> Iterator[str]:
    """Table rows of a number, one for each data set it was measured on."""
    if number.measured is not None and number.scaled is not None:
        found = []
        for factor in FACTORS:
            with number.scaled(factor):
                found.append(number.measured())
        yield row(number, "tables, exact depth", found)
        return
    for name, (dataset, options) in datasets.items():
        if name == "apc_shelf" and not number.on_shelf:
            continue
        found = []
        for factor in FACTORS:
            # A copy, so that every number starts from the same artifacts.
            with tempfile.TemporaryDirectory() as folder:
                copy = Dataset(shutil.copytree(dataset.root, Path(folder) / "copy"))
                if number.scaled is None:
                    run(copy, options_with(options, number, factor), number.first)
                else:
                    with number.scaled(factor):
                        run(copy, options, number.first)
                found.append(figures_of(copy, with_matches="correspondences" in options))
        yield row(number, name, found)


def row(number: Number, data: str, found: Sequence[Figures]) -> str:
    cells = [", ".join(f"{name} {value:.3g}" for name, value in figures.items()) for figures in found]
    return f"| `{number.name}` | {data} | " + " | ".join(cells) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="numbers to measure; default: all")
    wanted = parser.parse_args().names
    chosen = [number for number in NUMBERS if not wanted or number.name in wanted]
    print("| number | data | x 0.5 | as it is | x 2 |\n|---|---|---|---|---|", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        datasets: dict[str, tuple[Dataset, dict[str, dict[str, Any]]]] = {}
        if any(number.measured is None for number in chosen):
            datasets["tables"] = tables(Path(folder) / "tables"), {stage.name: {} for stage in STAGES}
        if any(number.on_shelf for number in chosen):
            datasets["apc_shelf"] = shelf(Path(folder) / "shelf"), SHELF
        for dataset, options in datasets.values():
            run(dataset, options)
        for number in chosen:
            for line in rows(number, datasets):
                print(line, flush=True)


if __name__ == "__main__":
    main()
