"""What a verdict about a recording's readings means to its user: codes, numbers, and the options that fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.geometry import view_change
from bask_data.core.readings_evidence import AT_REST, NO_TRANSLATION, PairedViews, Trial
from bask_data.core.readings_hypotheses import Hypothesis, Readings, hypothesis_of
from bask_data.core.readings_unusual import conversion
from bask_data.core.readings_verdict import LEAST_JUDGED_PAIRS, POOR_EVIDENCE, Verdict
from bask_data.findings import CODES, Finding

CERTAIN_PAIRS = 12
"""Pairs below which it is not said that nothing fits: few frames may hardly overlap."""

HARDLY = 0.03
"""Share of the scene's distance, or angle in radians, up to which a camera hardly moves: pixels of a depth camera of
640x480 move by some fifteen then, and noise of depth and poses is as large. Sensitivity not measured."""


NAMED_READINGS = 3
"""Readings that are named where several fit as well."""


@dataclass(frozen=True)
class Offers:
    """Options of a format that read it otherwise; none for a recording that is stored.

    Args:
        depth_scale: of depth's unit, as `--depth-scale`, empty if there is none; metres per unit as read.
        rays: `--depth-is`.
        intrinsics: `--intrinsics`.
    """

    depth_scale: tuple[str, float] = ("", 1.0)
    rays: str = ""
    intrinsics: str = ""


@dataclass(frozen=True)
class JudgedCamera:
    """What a judgement needs besides the verdict.

    Args:
        world_from_cameras: as read.
        K: of the first frame, pixels.
        frozen: first and last frame of runs with the same pose but other depth, and evidence for a camera at rest.
    """

    world_from_cameras: Float[ndarray, "t 4 4"]
    readings: Readings
    views: PairedViews
    K: Float[ndarray, "3 3"]
    frozen: list[tuple[int, int, float]]


@dataclass(frozen=True)
class Judgement:
    """What depth says about the way a camera's recording was read.

    Args:
        told, share: mean evidence, in [0, 1], of the recording as read and of the best hypothesis.
        best: the hypothesis that fits best; the default one is "as read".
        n_pairs: pairs of frames that overlap under it.
        sure_of_reading, sure_of_unit, sure_of_clock, sure_of_intrinsics: whether `best` beats all that differ in it.
        rivals: what cannot be told from the best one, in words.
        option: the format's options for the best reading of poses, if it needs any, and whether they state the unit of
            positions, too.
        K: intrinsics of the first frame under the best hypothesis, pixels.
        reasons: why, by code, in words and numbers.
    """

    told: float
    share: float
    best: Hypothesis
    n_pairs: int
    sure_of_reading: bool
    sure_of_unit: bool
    sure_of_clock: bool
    sure_of_intrinsics: bool
    rivals: tuple[str, ...]
    option: tuple[str, bool]
    K: Float[ndarray, "3 3"]
    reasons: dict[str, str]

    @property
    def codes(self) -> tuple[str, ...]:
        """Those of `bask_data.findings.CODES` that apply."""
        return tuple(self.reasons)

    @property
    def objections(self) -> tuple[str, ...]:
        """The codes that say that the recording was read wrongly."""
        return tuple(code for code in self.reasons if CODES[code].severity == "error")

    @property
    def evidence(self) -> str:
        """The numbers: how well the recording as read fits, and what fits better."""
        told = f"{self.told:.0%} of the depth of a frame, warped into another, meets what was measured there"
        if self.best.departures:
            return f"{told}; with {self.best.words} it would be {self.share:.0%} ({self.n_pairs} pairs)"
        return f"{told} ({self.n_pairs} pairs)"

    def findings(self, place: str, offers: Offers = Offers()) -> list[Finding]:
        """What is wrong, or cannot be told, with evidence and fix.

        Args:
            place: the camera: `table/wrist`.
        """
        fix = self.fix(offers)
        return [
            Finding(code, place, reason, fix if code in self.objections else ADVICE.get(code, ""))
            for code, reason in self.reasons.items()
        ]

    def fix(self, offers: Offers = Offers()) -> str:
        """What to do about all objections together."""
        if {"poses-unrelated", "camera-moved"} & set(self.objections):
            return ADVICE[self.objections[0]]
        options = list(filter(None, self._options(offers).values()))
        mended = [text for code, text in self._mended().items() if not self._options(offers).get(code)]
        return "; ".join([*([f"pass {' '.join(options)}"] if options else []), *mended])

    def _options(self, offers: Offers) -> dict[str, str]:
        """Options by the objection that they answer; empty where there are none."""
        best, (option, is_unit) = self.best, self.option
        scale_option, depth_scale = offers.depth_scale
        found = {}
        if "other-reading" in self.objections:
            found["other-reading"] = option
        if "other-unit" in self.objections and best.depth_factor != 1 and scale_option:
            found["other-unit"] = f"{scale_option} {depth_scale * best.depth_factor:.6g}"
        if "other-unit" in self.objections and best.pose_factor != 1 and is_unit:
            found["other-unit"] = "" if "other-reading" in self.objections else option
        if "other-depth" in self.objections and offers.rays:
            found["other-depth"] = f"{offers.rays} {best.ray}"
        if "other-intrinsics" in self.objections and offers.intrinsics:
            found["other-intrinsics"] = f"{offers.intrinsics} {self._intrinsics}"
        return found

    def _mended(self) -> dict[str, str]:
        """What to change in the files, by the objection that it answers."""
        best = self.best
        unit = f"correct the unit of depth in the files: depth {best.depth_factor:.4g} times as large"
        if best.pose_factor != 1:
            unit = f"scale the positions of the poses to metres, by about {best.pose_factor:.3g}"
            unit += ", or correct the unit of depth"
        frames = f"{abs(best.lag)} {'frame' if abs(best.lag) == 1 else 'frames'}"
        every = {
            "other-reading": conversion(best) or f"convert the poses, which are of {self.option[0] or best.words}",
            "other-unit": unit,
            "other-depth": f"convert depth, which is {'the length of the ray' if best.ray == 'ray' else 'z'}",
            "other-intrinsics": f"give the intrinsics of these images, about {self._intrinsics}",
            "other-clock": f"give each frame the pose that stands {frames} {'later' if best.lag > 0 else 'earlier'}",
        }
        if self.option[1] and "other-reading" in self.objections and best.pose_factor != 1:
            del every["other-unit"]
        return {code: text for code, text in every.items() if code in self.objections}

    @property
    def _intrinsics(self) -> str:
        """Intrinsics under the best hypothesis, as fx,fy,cx,cy."""
        return ",".join(f"{value:.6g}" for value in (self.K[0, 0], self.K[1, 1], self.K[0, 2], self.K[1, 2]))


ADVICE = {
    "poses-unrelated": "check that poses, depth and intrinsics belong together, and depth's unit",
    "camera-moved": "pass the poses of this recording, one for each frame",
    "clock-unknown": "check that each frame has the pose of its own time",
    "intrinsics-unknown": "check that the intrinsics are those of images of this size",
    "poses-repeated": "leave out the frames whose poses were not updated, with --frames",
    "reading-unknown": "check the conventions of the poses yourself: their direction, axes and order",
    "axes-unknown": "check axes and direction of the poses yourself; turn the camera, too, when recording again",
    "unit-unknown": "check the units of depth and poses; move the camera sideways when recording again",
    "hardly-moves": "check the conventions yourself; move the camera around the scene when recording again",
    "few-views": "check the conventions yourself; record more frames that see the same things",
}
"""What to do about what cannot be told, or has no other reading."""


def without_views(K: Float[ndarray, "3 3"]) -> Judgement:
    """The judgement of a camera with a single frame."""
    reasons = {"few-views": "a single frame has nothing to compare its pose with, and shows objects from one side"}
    return Judgement(0.0, 0.0, Hypothesis(), 0, False, False, False, False, (), ("", False), K, reasons)


def judgement(camera: JudgedCamera, found: Verdict) -> Judgement:
    """What a verdict means."""
    best = hypothesis_of(found.trial, camera.readings, camera.views.median_depth(), found.fine)
    reasons = _Reasons(camera, found, best).all()
    kx, ky = best.K_factor
    K = camera.K * np.array([[kx], [ky], [1.0]])
    K[:2, 2] += np.array([kx, ky]) / 2 - 0.5
    return Judgement(
        told=float(found.mean[found.trials.index(Trial(0))]),
        share=found.share,
        best=best,
        n_pairs=found.overlapping,
        sure_of_reading=found.sure_of_reading,
        sure_of_unit=found.sure_of_unit,
        sure_of_clock=found.sure_of_clock,
        sure_of_intrinsics=found.sure_of_intrinsics,
        rivals=tuple(dict.fromkeys(_words(trial, camera) for trial in found.unbeaten)),
        option=camera.readings.option(found.trial.reading, best.pose_factor),
        K=K,
        reasons=reasons,
    )


def _words(trial: Trial, camera: JudgedCamera) -> str:
    if trial.scale == NO_TRANSLATION:
        return "a camera that only turns"
    return hypothesis_of(trial, camera.readings, camera.views.median_depth()).words


@dataclass(frozen=True)
class _Reasons:
    """Codes for a verdict, with the numbers behind them."""

    camera: JudgedCamera
    found: Verdict
    best: Hypothesis

    def all(self) -> dict[str, str]:
        """By code, in the order of importance."""
        return self._poses() | self._repeated()

    def _repeated(self) -> dict[str, str]:
        if not self.camera.frozen:
            return {}
        runs = ", ".join(f"{a} to {b} ({share:.0%})" for a, b, share in self.camera.frozen)
        text = f"frames of the same pose, of whose depth little stays where it is: {runs}; neighbours have"
        return {"poses-repeated": f"{text} {self.found.near:.0%}"}

    def _poses(self) -> dict[str, str]:
        n, told = len(self.camera.views.pairs), float(self.found.mean[self.found.trials.index(Trial(0))])
        if n < LEAST_JUDGED_PAIRS:
            return {"few-views": f"{n} pairs of frames; {LEAST_JUDGED_PAIRS} are needed"}
        distance, angle = self._motion()
        if distance.max() < 1e-9 and angle.max() < 1e-6:
            return self._resting()
        if self.found.overlapping < LEAST_JUDGED_PAIRS:
            return {"few-views": f"{self.found.overlapping} of {n} pairs of frames see the same things"}
        if self.found.share < self.found.poor and n >= CERTAIN_PAIRS:
            share = f"{told:.0%} of the depth of a frame, warped into another, meets what was measured there"
            return {
                "poses-unrelated": f"{share}; no reading, unit, clock or size of intrinsics gives more than "
                f"{self.found.share:.0%}; 30 to 90 % are usual"
            }
        if not self.found.moved:
            return self._unmoved(distance, angle)
        return self._reading() | self._unit() | self._rest()

    def _motion(self) -> tuple[Float[ndarray, " p"], Float[ndarray, " p"]]:
        """Distance, as a share of the scene's, and angle between the cameras of each pair by the poses as read."""
        a, b = np.array(self.camera.views.pairs).T
        poses = self.camera.world_from_cameras
        distance, angle = view_change(poses[a], poses[b])
        return distance / max(self.camera.views.median_depth(), 1e-9), angle

    def _resting(self) -> dict[str, str]:
        share = float(self.found.mean[self.found.trials.index(Trial(AT_REST))])
        n = self.found.overlapping
        if share < POOR_EVIDENCE and n >= CERTAIN_PAIRS:
            text = f"all poses are the same, but only {share:.0%} of depth stays where it is ({n} pairs)"
            return {"camera-moved": text}
        return {"hardly-moves": "the camera does not move, so nothing shows how its pose is meant"}

    def _unmoved(self, distance: Float[ndarray, " p"], angle: Float[ndarray, " p"]) -> dict[str, str]:
        far, turned = float(np.quantile(distance, 0.8)), float(np.quantile(angle, 0.8))
        moved = f"{far:.1%} of the scene's distance and {np.degrees(turned):.1f} degrees"
        if far < HARDLY and turned < HARDLY:
            return {"hardly-moves": f"the camera moves by {moved}, too little to tell how poses are meant"}
        share = f"a camera that does not move explains depth as well as the best reading ({self.found.share:.0%})"
        return {"reading-unknown": f"{share}, though the poses move by {moved}"}

    def _reading(self) -> dict[str, str]:
        found = self.found
        if found.sure_of_reading:
            return {"other-reading": self._better()} if found.trial.reading != 0 else {}
        if not found.is_distinct:
            text = f"no reading fits clearly better than others ({found.share:.0%} and {found.other:.0%}), and frames"
            return {
                "reading-unknown": f"{text} far apart fit badly ({found.near:.0%} of near ones): are these its poses?"
            }
        names = self.camera.readings.names
        other = [trial for trial in found.unbeaten if trial.reading != found.trial.reading]
        rivals = [names[trial.reading] for trial in other]
        alike = list(dict.fromkeys(each.words for each in [names[found.trial.reading], *rivals]))
        more = f" and {len(alike) - NAMED_READINGS} more" if len(alike) > NAMED_READINGS else ""
        named = " or with ".join(alike[:NAMED_READINGS])
        text = f"depth fits as well with {named}{more} ({found.share:.0%}, {self._pairs})"
        if "as read" not in alike:
            told = float(found.mean[found.trials.index(Trial(0))])
            text = f"as read, depth fits worse than otherwise ({told:.0%}): {text}"
        is_axes = all((each.inverted, each.otherwise) == (self.best.inverted, self.best.otherwise) for each in rivals)
        # Motions that leave only the axes open tell the unit roughly; otherwise nothing is supported.
        is_axes = is_axes and all(0.5 <= trial.scale / found.trial.scale <= 2 for trial in other)
        return {"axes-unknown" if is_axes else "reading-unknown": text}

    @property
    def _pairs(self) -> str:
        return f"{self.found.overlapping} pairs"

    def _unit(self) -> dict[str, str]:
        found = self.found
        if found.sure_of_unit:
            return {} if found.trial.scale == 1 else {"other-unit": self._better()}
        if not found.sure_of_reading:
            return {}
        if not found.translates:
            return {"unit-unknown": "a camera that only turns explains depth as well"}
        if found.is_off_scale:
            return {
                "unit-unknown": f"depth fits best if the poses are {1 / found.fine:.2g} times as large, no usual unit"
            }
        return {"unit-unknown": "another unit explains depth as well"}

    def _rest(self) -> dict[str, str]:
        """Clock, intrinsics, and what depth measures."""
        found = self.found
        if not found.sure_of_reading:
            return {}
        trial = found.trial
        said = {
            "other-depth": trial.ray != 0 and found.sure_of_ray,
            "other-clock": trial.lag != 0 and found.sure_of_clock,
            "clock-unknown": trial.lag != 0 and not found.sure_of_clock,
            "other-intrinsics": trial.K_factor != (1.0, 1.0) and found.sure_of_intrinsics,
            "intrinsics-unknown": trial.K_factor != (1.0, 1.0) and not found.sure_of_intrinsics,
        }
        return {code: self._better() for code, is_so in said.items() if is_so}

    def _better(self) -> str:
        told = float(self.found.mean[self.found.trials.index(Trial(0))])
        share = f"{told:.0%} of the depth of a frame, warped into another, meets what was measured there"
        return f"{share}; with {self.best.words} it would be {self.found.share:.0%} ({self.found.overlapping} pairs)"
