"""Commands that look at a whole dataset, over the number of its scenes: cost per scene must not grow with the dataset.

`ours` is a command on many scenes and `plain` one on a quarter of them, run four times: cost linear in the number of
scenes gives a ratio of 1 (or more, since a command has a fixed cost), quadratic cost 0.25. Target: a time at 1,600
scenes of at most 4.4 times that at 400, a ratio of 0.91. Ingesting into 2,000 scenes is compared with ingesting into
one; target: 0.83, 20 % more.

    python benchmarks/bench_scale.py         seconds of every command at 400, 1,600 and 2,000 scenes, as processes

Targets there: `status` 8 s, `run --dry-run` 10 s, `info` 4 s at 2,000 scenes. The scenes are hard links of a tiny one
whose scene stages are all up to date; only the manifests, which name the inputs of their scene, are files of their own.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from bask_data.artifact import MANIFEST, digest_of
from bask_data.dataset import DATASET, Dataset
from bask_data.engine import RunRequest, key_parts, plan, run_pipeline, status
from bask_data.formats import FORMATS
from bask_data.pipeline import STAGES
from bask_data.sources.ingest import ingest
from bask_data.validate import validate

FEW, MANY, MOST = 400, 1600, 2000
SIZE = 32
KINDS = ("scan", "reconstruction", "objects", "masks", "correspondences")
Work = Callable[[], object]
COMMANDS = {"status": ["status"], "run --dry-run": ["run", "--dry-run"], "info": ["info"]}


def cases() -> Iterator[tuple[str, Work, Work]]:
    """Each look at a dataset, and ingesting one more scene."""
    with tempfile.TemporaryDirectory(prefix="bask-scale-") as folder:
        tiny = tiny_dataset(Path(folder))
        few, many = (enlarged(tiny, Path(folder) / str(n), n) for n in (FEW, MANY))
        looks: dict[str, Callable[[Path], object]] = {
            "status": lambda root: list(status(Dataset(root), STAGES)),
            "run --dry-run": lambda root: list(run_pipeline(Dataset(root), STAGES, dry_run=True)),
            "validate": lambda root: validate(Dataset(root)),
        }
        for name, look in looks.items():
            yield f"{name}, {MANY} scenes", lambda look=look: look(many), lambda look=look: four_times(look, few)
        most = enlarged(tiny, Path(folder) / "most", MOST - 1)
        yield f"ingest of scene {MOST}", ingesting(Path(folder), most), ingesting(Path(folder), tiny)


def four_times(look: Callable[[Path], object], root: Path) -> None:
    """The work of a quarter, as often as the whole has it."""
    for _ in range(MANY // FEW):
        look(root)


def ingesting(folder: Path, root: Path) -> Work:
    """Enter the same recording again under a new name."""
    count = iter(range(10**6))

    def work() -> None:
        [format] = [format for format in FORMATS if format.name == "frames"]
        ingest(
            root, f"new{os.getpid()}-{next(count)}", format=format, source=folder / "source", options=options(format)
        )

    return work


def options(format: object) -> object:
    """Of the frames that `write_frames` writes."""
    return format.options(camera="wrist", depth_scale=0.001, intrinsics="30,30,15.5,15.5")  # type: ignore[attr-defined]


def write_frames(folder: Path) -> None:
    """A box on a table, seen from straight above by a camera that moves sideways."""
    folder.mkdir()
    for i in range(3):
        depth = np.full((SIZE, SIZE), 500, np.uint16)
        depth[10:20, 10 - i : 20 - i] = 400
        world_from_camera = np.diag([1.0, -1.0, -1.0, 1.0])
        world_from_camera[:3, 3] = 0.016 * i, 0, 0.5
        cv2.imwrite(str(folder / f"frame-{i:03d}.color.png"), np.full((SIZE, SIZE, 3), 50 * i, np.uint8))
        cv2.imwrite(str(folder / f"frame-{i:03d}.depth.png"), depth)
        np.savetxt(folder / f"frame-{i:03d}.pose.txt", world_from_camera)


def tiny_dataset(folder: Path) -> Path:
    """One scene, and what the stages of a scene make of it."""
    write_frames(folder / "source")
    root = folder / "tiny"
    [format] = [format for format in FORMATS if format.name == "frames"]
    ingest(root, "s0", format=format, source=folder / "source", options=options(format))  # type: ignore[arg-type]
    given = {"reconstruct": {"voxel_size": 0.02}, "correspondences": {"n_pairs": 1, "n_matches": 4}}
    stages = tuple(stage.name for stage in STAGES if stage.makes.scope == "scene")
    for outcome in run_pipeline(Dataset(root), STAGES, RunRequest(stages=stages, given=given)):
        assert outcome.status == "made", outcome.why
    return root


def enlarged(tiny: Path, root: Path, n_scenes: int) -> Path:
    """The same scene many times, up to date: hard links, but for manifests of their own inputs."""
    names = [f"s{i}" for i in range(n_scenes)]
    root.mkdir()
    for file in ("zarr.json", "requested.json", *(f"{kind}/zarr.json" for kind in KINDS)):
        (root / file).parent.mkdir(exist_ok=True)
        os.link(tiny / file, root / file)
    content = json.loads((tiny / DATASET).read_text())
    content["scenes"] = dict.fromkeys(names, content["scenes"]["s0"])
    (root / DATASET).write_text(json.dumps(content))
    for kind in KINDS:
        for folder, _, files in os.walk(tiny / kind / "s0"):
            for name in names:
                there = root / kind / name / Path(folder).relative_to(tiny / kind / "s0")
                there.mkdir(parents=True)
                for file in files:
                    if file != MANIFEST:
                        os.link(Path(folder) / file, there / file)
        text = (tiny / kind / "s0" / MANIFEST).read_text()
        for name in names:
            (root / kind / name / MANIFEST).write_text(text.replace('/s0"', f'/{name}"'))
    for stage in STAGES:
        if stage.makes.scope == "scene":
            for task in plan(Dataset(root), stage):
                file = task.target / MANIFEST
                manifest = json.loads(file.read_text()) | {"key": digest_of(key_parts(task))}
                file.write_text(json.dumps(manifest, indent=2))
    return root


def seconds(command: Sequence[str], root: Path) -> float:
    """Wall time of a whole command."""
    begun = time.perf_counter()
    subprocess.run([sys.executable, "-m", "bask_data.cli", *command, str(root)], capture_output=True, check=False)
    return time.perf_counter() - begun


def main(n_rounds: int = 3) -> None:
    """The table of commands by number of scenes: medians over rounds in which all sizes take turns."""
    with tempfile.TemporaryDirectory(prefix="bask-scale-") as folder:
        tiny = tiny_dataset(Path(folder))
        roots = {n: enlarged(tiny, Path(folder) / str(n), n) for n in (FEW, MANY, MOST)}
        print(f"{'command':<16}" + "".join(f"{n:>8} s" for n in roots) + f"{MANY:>8}/{FEW}")
        for name, command in COMMANDS.items():
            rounds = [{n: seconds(command, root) for n, root in roots.items()} for _ in range(n_rounds)]
            median = {n: statistics.median(found[n] for found in rounds) for n in roots}
            ratio = statistics.median(found[MANY] / found[FEW] for found in rounds)
            print(f"{name:<16}" + "".join(f"{median[n]:>10.1f}" for n in roots) + f"{ratio:>12.2f}", flush=True)


if __name__ == "__main__":
    main()
