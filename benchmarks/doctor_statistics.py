"""Whether the judge of readings is ever sure and wrong: `python benchmarks/doctor_statistics.py --seed 1000`.

Random analytic recordings (tests/random_recordings.py) are told in wrong readings, and what `core/readings.py` answers
is compared with what was done to them. A run is *sure and wrong* if anything it is sure of is not so: the reading
(direction, axes, handedness, order of quaternions), the unit (12 %), the clock or the intrinsics; where poses belong to
other frames, all that it is sure of is wrong. `--suites`:

- `standard`: hand, wrist and approach; random direction and axes, in three of four runs also a wrong unit.
- `errors`: clock, intrinsics, both, quaternions, rays, handedness, millimetres, and nothing wrong, each in turn.
- `clean`: clock or intrinsics wrong, or nothing, with 0.5 % depth noise, 10 % holes and exact poses.
- `degenerate`: motions and scenes that do not tell, few frames, repeated poses, poses of others; random direction and
  axes; in half of the runs poses are exact.

With `--recordings TABLE`, real recordings are told in all readings instead: lines of a folder, a format and its
options, as `ingest` takes them: `data/scan frames --color 'rgb/*.png' ...`.

Published figures are of seeds from 1000; thresholds were chosen on seeds below 1000.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # The scenes are among the tests.

from bask_data.core.readings import Judgement, judge
from bask_data.findings import CODES
from benchmarks.told_readings import (
    Told,
    Wrong,
    clock_is_right,
    intrinsics_are_right,
    reading_is_right,
    told,
    unit_is_right,
)
from benchmarks.told_recordings import read_table, told_recordings
from tests.random_recordings import Errors, RandomRecording, random_recording

FACTORS = (10, 0.1, 1000, 0.001, 1 / 256, 1 / 1024, 1 / 4000, 1 / 5000, 1 / 10000)
"""Told depth per true depth: units that are mixed up."""
SIZES = (0.25, 1 / 3, 0.5, 2 / 3, 0.75, 4 / 3, 1.5, 2, 3, 4)
"""Told intrinsics per true ones: images of another size."""
LAGS = (-3, -2, -1, 1, 2, 3)

EXPECTED = {
    "rotation": ("unit-unknown",),
    "sideways": ("axes-unknown", "reading-unknown"),
    "upward": ("axes-unknown", "reading-unknown"),
    "forward": ("axes-unknown", "reading-unknown"),
    "resting": ("hardly-moves", "reading-unknown"),
    "tiny": ("hardly-moves", "reading-unknown", "unit-unknown"),
    "plane": ("reading-unknown", "axes-unknown", "unit-unknown"),
    "ball": ("reading-unknown", "axes-unknown", "unit-unknown"),
    "slats": ("reading-unknown", "axes-unknown", "unit-unknown"),
    "one frame": ("few-views",),
    "two frames": ("few-views",),
    "three frames": ("few-views",),
    "frozen tail": ("poses-repeated",),
    "same poses": ("camera-moved",),
    "other poses": ("poses-unrelated", "reading-unknown"),
}
"""Codes that answer a degenerate case: one of them is to come, unless reading and unit are right and sure."""


@dataclass(frozen=True)
class Run:
    """One recording, judged.

    Args:
        right: whether the best hypothesis is right, by what it is about.
        sure: what the judge is sure of.
        wrong: what it is sure of, but wrong about.
        codes: of its findings.
    """

    kind: str
    seed: int
    name: str
    told: str
    right: dict[str, bool]
    sure: dict[str, bool]
    wrong: list[str]
    codes: list[str]
    best: str
    shares: tuple[float, float]
    seconds: float

    @property
    def line(self) -> str:
        shares = "{:.2f} as told, {:.2f} best".format(*self.shares)
        return f"{self.kind}, seed {self.seed} ({self.name}; {self.told}): {self.best} ({shares}); {self.codes}"


# Cases ----------------------------------------------------------------------------------------------------------------


def direction(rng: np.random.Generator) -> Wrong:
    """One of the four readings."""
    return Wrong(inverted=bool(rng.integers(2)), opengl=bool(rng.integers(2)))


def standard(seed: int) -> tuple[str, RandomRecording, Told]:
    rng = np.random.default_rng([seed, 1])
    wrong = direction(rng)
    if rng.random() < 0.75:
        wrong = replace(wrong, depth_factor=float(rng.choice(FACTORS)))
    recording = random_recording(seed)
    return "standard", recording, told(recording, wrong)


def errors(seed: int) -> tuple[str, RandomRecording, Told]:
    rng = np.random.default_rng([seed, 2])
    size = float(rng.choice(SIZES))
    lag = int(rng.choice(LAGS))
    kinds = {
        "nothing wrong": Wrong(),
        "clock": Wrong(lag=lag),
        "intrinsics": Wrong(K_factor=(size, size)),
        "wide intrinsics": Wrong(K_factor=(2.0, 1.5) if rng.random() < 0.5 else (0.5, 2 / 3)),
        "clock and reading": replace(direction(rng), lag=lag),
        "intrinsics and reading": replace(direction(rng), K_factor=(size, size)),
        "clock and intrinsics": Wrong(lag=lag, K_factor=(size, size)),
        "quaternions": Wrong(reordered=True),
        "rays": Wrong(is_ray=True),
        "handedness": Wrong(mirrored=True),
        "millimetres": replace(direction(rng), pose_factor=1000.0),
        "unit and intrinsics": Wrong(depth_factor=float(rng.choice(FACTORS)), K_factor=(size, size)),
    }
    kind = list(kinds)[seed % len(kinds)]
    recording = random_recording(seed)
    return kind, recording, told(recording, kinds[kind])


def clean(seed: int) -> tuple[str, RandomRecording, Told]:
    rng = np.random.default_rng([seed, 2])
    size, lag = float(rng.choice(SIZES)), int(rng.choice(LAGS))
    kinds = {"clock": Wrong(lag=lag), "intrinsics": Wrong(K_factor=(size, size)), "nothing wrong": Wrong()}
    kind = list(kinds)[seed % len(kinds)]
    recording = random_recording(seed, errors=Errors(depth=0.005, position=0.0, angle_deg=0.0, holes=0.1))
    return kind, recording, told(recording, kinds[kind])


def degenerate(seed: int) -> tuple[str, RandomRecording, Told]:
    rng = np.random.default_rng([seed, 3])
    kind = list(EXPECTED)[seed % len(EXPECTED)]
    wrong = direction(rng)
    off = Errors() if rng.random() < 0.5 else Errors(position=0.0, angle_deg=0.0)
    frames = {"one frame": 1, "two frames": 2, "three frames": 3}
    scenes = {
        "plane": ("hand", "plane"),
        "ball": ("turntable", "ball"),
        "slats": (str(rng.choice(["hand", "sideways"])), "slats"),
    }
    if kind in frames:
        recording = random_recording(seed, errors=off, n_frames=frames[kind])
    elif kind in scenes:
        recording = random_recording(seed, *scenes[kind], errors=off)
    elif kind in ("frozen tail", "same poses", "other poses"):
        recording = random_recording(seed, errors=off)
    else:
        recording = random_recording(seed, kind, errors=off)
    as_told = told(recording, wrong)
    if kind == "frozen tail":
        last = np.minimum(np.arange(recording.n_frames), 2 * recording.n_frames // 3)
        as_told = replace(as_told, poses=as_told.poses[last], true_poses=as_told.true_poses[last])
    if kind == "same poses":
        as_told = replace(as_told, poses=np.tile(as_told.poses[:1], (recording.n_frames, 1, 1)))
    if kind == "other poses":
        other = random_recording(seed + 500_000, errors=off, n_frames=recording.n_frames)
        as_told = replace(as_told, poses=told(other, wrong).poses)
    return kind, recording, as_told


SUITES = {"standard": standard, "errors": errors, "clean": clean, "degenerate": degenerate}


# Judging --------------------------------------------------------------------------------------------------------------


def judged(kind: str, seed: int, name: str, as_told: Told) -> Run:
    """What the judge says, compared with the truth."""
    begun = time.perf_counter()
    made = judge(as_told.n_frames, as_told.read_depth, as_told.Ks, as_told.poses, otherwise=as_told.otherwise)
    seconds = time.perf_counter() - begun
    codes = [finding.code for finding in made.findings(name)]
    sure = sure_of(made, codes)
    right = {
        "reading": reading_is_right(as_told, made.best),
        "unit": unit_is_right(as_told, made.best),
        "clock": clock_is_right(as_told, made.best),
        "intrinsics": intrinsics_are_right(as_told, made.best),
        "ray": (made.best.ray == "ray") == as_told.wrong.is_ray,
    }
    wrong = [what for what in sure if sure[what] and not right[what]]
    if kind in ("other poses", "same poses"):
        right = dict.fromkeys(right, False)
        wrong = [what for what in sure if sure[what]]
    return Run(
        kind,
        seed,
        name,
        str(as_told.wrong),
        right,
        sure,
        wrong,
        codes,
        made.best.words,
        (round(made.told, 3), round(made.share, 3)),
        round(seconds, 3),
    )


def sure_of(made: Judgement, codes: list[str]) -> dict[str, bool]:
    """What the judge claims. Clock, intrinsics and rays count as claimed if it says that they are others."""
    return {
        "reading": made.sure_of_reading or "other-reading" in codes,
        "unit": made.sure_of_unit or "other-unit" in codes,
        "clock": "other-clock" in codes or (made.sure_of_clock and made.best.lag != 0),
        "intrinsics": "other-intrinsics" in codes or (made.sure_of_intrinsics and made.best.K_factor != (1, 1)),
        "ray": "other-depth" in codes,
    }


def runs_of_table(table: Path) -> Iterator[Run]:
    """Judged runs of real recordings, in all readings; recordings are kinds."""
    for line in read_table(table):
        for camera, case, as_told in told_recordings(line):
            yield judged(camera, 0, case, as_told)


def runs_of(suite: str, n_runs: int, seed: int) -> Iterator[Run]:
    """Judged runs of seeds in turn."""
    for each in range(seed, seed + n_runs):
        kind, recording, as_told = SUITES[suite](each)
        yield judged(kind, each, recording.name, as_told)


# What is printed ------------------------------------------------------------------------------------------------------


def share(n: int, of: int) -> str:
    return f"{n} of {of} ({n / of:.0%})" if of else "none"


def summary(runs: list[Run]) -> Iterator[str]:
    """Figures of some runs of one kind."""
    n = len(runs)
    yield f"  reading right as best guess {share(sum(run.right['reading'] for run in runs), n)}"
    yield f"  unit right as best guess    {share(sum(run.right['unit'] for run in runs), n)}"
    yield f"  sure of the reading         {share(sum(run.sure['reading'] for run in runs), n)}"
    yield f"  sure of the unit            {share(sum(run.sure['unit'] for run in runs), n)}"
    yield f"  sure and wrong              {sum(bool(run.wrong) for run in runs)}"
    yield f"  seconds of the judge, median {np.median([run.seconds for run in runs]):.2f}"


def by_kind(runs: list[Run]) -> Iterator[str]:
    """A line per kind: what was right, what was claimed."""
    kinds: dict[str, list[Run]] = defaultdict(list)
    for run in runs:
        kinds[run.kind].append(run)
    yield f"  {'':24}runs  reading  unit  sure of: reading  unit  claimed: clock  K  ray (of them right)  wrong"
    for kind, of in kinds.items():
        cells = [f"{sum(run.right[what] for run in of):6}" for what in ("reading", "unit")]
        cells += [f"{sum(run.sure[what] for run in of):9}" for what in ("reading", "unit")]
        for what in ("clock", "intrinsics", "ray"):
            claimed = [run for run in of if run.sure[what]]
            cells.append(f"{len(claimed):4} ({sum(run.right[what] for run in claimed)})")
        yield f"  {kind:24}{len(of):4} {' '.join(cells)}  {sum(bool(run.wrong) for run in of):5}"


def answers(runs: list[Run]) -> Iterator[str]:
    """A line per degenerate kind: the codes it got, and runs that none answers."""
    kinds: dict[str, list[Run]] = defaultdict(list)
    for run in runs:
        kinds[run.kind].append(run)
    for kind, of in kinds.items():
        counted = Counter(code for run in of for code in run.codes)
        silent = [run for run in of if not is_answered(run)]
        yield f"  {kind:14}{len(of):4} runs: " + ", ".join(f"{code} {n}" for code, n in counted.most_common())
        for run in silent:
            yield f"      not answered: seed {run.seed}: {run.codes}, sure {[k for k in run.sure if run.sure[k]]}"


def is_answered(run: Run) -> bool:
    """Whether a degenerate case got its code, or is told rightly after all."""
    if set(run.codes) & set(EXPECTED[run.kind]):
        return True
    rightly = all(run.sure[what] and run.right[what] for what in ("reading", "unit"))
    return rightly and run.kind not in ("one frame", "frozen tail", "same poses", "other poses")


def is_false_alarm(run: Run) -> bool:
    """Whether nothing is wrong, but an error is found."""
    return run.told == "nothing wrong" and any(CODES[code].severity == "error" for code in run.codes)


def main() -> int:
    parser = argparse.ArgumentParser(description="How often the judge of readings is right, sure, and sure and wrong.")
    parser.add_argument("--runs", type=int, default=200, help="of each suite")
    parser.add_argument("--seed", type=int, default=0, help="of the first run")
    parser.add_argument("--suites", nargs="+", choices=list(SUITES), default=list(SUITES))
    parser.add_argument("--json", type=Path, help="write all runs to this file, too")
    parser.add_argument("--recordings", type=Path, help="a table of real recordings to judge instead")
    parser.add_argument("--verbose", action="store_true", help="a line per run")
    options = parser.parse_args()
    suites = {suite: runs_of(suite, options.runs, options.seed) for suite in options.suites}
    if options.recordings:
        suites = {"recordings": runs_of_table(options.recordings)}
    everything: list[Run] = []
    for suite, made in suites.items():
        runs = []
        for run in made:
            runs.append(run)
            if options.verbose or run.wrong:
                print(f"{'SURE AND WRONG of ' + ', '.join(run.wrong) if run.wrong else '-'}: {run.line}", flush=True)
        seeds = "" if options.recordings else f", seeds {options.seed} to {options.seed + len(runs) - 1}"
        print(f"\n{suite}: {len(runs)} runs{seeds}")
        plain = [run for run in runs if run.kind not in EXPECTED]
        print("\n".join([*(summary(plain) if plain else ()), *by_kind(runs)]))
        if suite == "degenerate":
            print("\n".join(answers(runs)))
        everything += runs
    alarms = [run for run in everything if is_false_alarm(run) and run.kind not in EXPECTED]
    print(f"\nerrors found where nothing is wrong: {len(alarms)}", *(run.line for run in alarms), sep="\n  ")
    bad = [run for run in everything if run.wrong]
    print(f"sure and wrong: {len(bad)} of {len(everything)} runs", *(run.line for run in bad), sep="\n  ")
    if options.json:
        options.json.write_text(json.dumps([asdict(run) for run in everything], indent=1) + "\n")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
