"""Objects and masks of scans: none, tiny ones, and ones that no frame shows."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from bask_data.dataset import Dataset
from bask_data.doctor.artifact_checks import unless_damaged
from bask_data.evaluation.lookup import find
from bask_data.findings import Finding
from bask_data.kinds import InstanceRow, ObjectInstances, VisibleMasks

SMALLEST_AREA = 4e-4
"""Surface, square metres, below which an object is more likely a splinter of a surface: that of a cube of 8 mm. Chosen
below the least surface of the stage `objects`, 10 cm2 by default; sensitivity not measured."""

SMALLEST_SIDE = 0.012
"""Longest side, metres, below which an object is too small for masks of a depth camera at arm's length, whose pixels
are 1 to 2 mm. Sensitivity not measured."""

VANISHED_SHARE = 0.8
"""Share of the frames with an object in view in which its mask is empty, from which on it counts as vanishing: an
object that others hide from one side of the table is visible in about half of them. Sensitivity not measured."""

LEAST_IN_VIEW = 5
"""Frames with an object in view below which nothing is said of its mask. Sensitivity not measured."""

DIFFERING, LEAST_DIFFERENCE = 3.0, 4
"""Numbers of objects of scans differ hugely if one is so many times the median of all, or the reverse, and by at least
so many objects. Sensitivity not measured."""

LEAST_SCANS = 3
"""Scans below which numbers of objects are not compared: of two, either may be the right one."""


def scene_findings(dataset: Dataset, names: list[str]) -> list[Finding]:
    """What is wrong with the objects and masks of these scenes; scenes without them are passed over."""
    findings: list[Finding] = []
    counts: dict[str, int] = {}
    for name in names:
        objects, masks = find(dataset, ObjectInstances, name), find(dataset, VisibleMasks, name)
        if objects is not None:
            findings += unless_damaged(
                dataset, f"objects of {name}", [objects], partial(_of_objects, name, objects, counts)
            )
        if objects is not None and masks is not None:
            findings += unless_damaged(
                dataset, f"masks of {name}", [objects, masks], partial(_of_masks, name, objects, masks)
            )
    return [*findings, *_differing(counts)]


def _of_objects(name: str, objects: ObjectInstances, counts: dict[str, int]) -> Iterator[Finding]:
    """No object or a tiny one; the number of objects is entered in `counts`."""
    instances = objects.instances
    counts[name] = len(instances)
    if not instances:
        fix = "look at the mesh in the report; set --workspace, or --min-area of `objects`"
        yield Finding("instance-empty", f"objects of {name}", "no object was found in this scan", fix)
    for row in instances:
        longest = max(row.extents)
        if row.n_vertices == 0:
            yield Finding("instance-empty", f"objects of {name}", f"{_called(row)} has no vertex", "make objects again")
        elif row.area_m2 < SMALLEST_AREA or longest < SMALLEST_SIDE:
            evidence = (
                f"{_called(row)} has {row.area_m2 * 1e4:.1f} cm2 of surface, its longest side is {longest * 1e3:.0f} "
                f"mm; expected at least {SMALLEST_AREA * 1e4:.0f} cm2 and {SMALLEST_SIDE * 1e3:.0f} mm"
            )
            yield Finding("instance-tiny", f"objects of {name}", evidence, "raise --min-area of `objects`")


def _of_masks(name: str, objects: ObjectInstances, masks: VisibleMasks) -> Iterator[Finding]:
    """Objects whose masks are empty in all frames, or in most that have them in view."""
    in_view = np.zeros(masks.n_instances, int)
    shown = np.zeros(masks.n_instances, int)
    for camera_name in masks.camera_names:
        camera = masks.camera(camera_name)
        in_view += np.isfinite(camera.visible_fraction).sum(axis=0)
        shown += np.isfinite(camera.measured_fraction).sum(axis=0)
    fix = "look at the masks in the report: the poses, the mesh or --tolerance of `masks` may be wrong"
    place = f"masks of {name}"
    for row, n_in_view, n_shown in zip(objects.instances, in_view.tolist(), shown.tolist(), strict=False):
        if not n_shown:
            evidence = f"the mask of {_called(row)} is empty in all frames, {n_in_view} of which have it in view"
            yield Finding("instance-empty", place, evidence, fix)
        elif n_in_view >= LEAST_IN_VIEW and n_shown <= (1 - VANISHED_SHARE) * n_in_view:
            evidence = (
                f"the mask of {_called(row)} is empty in {n_in_view - n_shown} of {n_in_view} frames with it in view"
            )
            yield Finding("masks-vanish", place, evidence, fix)


def _differing(counts: dict[str, int]) -> Iterator[Finding]:
    if len(counts) < LEAST_SCANS:
        return
    median = float(np.median(list(counts.values())))
    for name, n in counts.items():
        low, high = min(n, median), max(n, median)
        if high - low >= LEAST_DIFFERENCE and high >= DIFFERING * low:
            evidence = f"{n} objects; the median of {len(counts)} scans is {median:g}"
            fix = "look at the objects in the report: the support plane or --workspace may be wrong in this scan"
            yield Finding("objects-differ", f"objects of {name}", evidence, fix)


def _called(row: InstanceRow) -> str:
    return f"object {row.id}" + (f" ({row.name})" if row.name else "")
