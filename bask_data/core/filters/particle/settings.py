"""Settings of the particle filter: our own, the paper's and those of its authors' code."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

from bask_data.core.filters.table import FilterSettings, PerKeypoint


@dataclass(frozen=True)
class ParticleSettings(FilterSettings):
    """Settings of the particle filter."""

    n_particles: int = 2000
    alpha: PerKeypoint = 2.0
    """Temperature: a pixel at descriptor distance z has likelihood exp(-alpha z). Half of the paper's and of the
    training's, because errors of successive frames are correlated. Mean errors of three networks on `lid`: 59, 59 and
    57 mm; with alpha 4, 70, 74 and 63."""
    tau: PerKeypoint | None = None
    """Likelihood of any observation if the camera does not see the particle; None: `unseen_likelihood` of each
    frame."""
    tau_ratio: PerKeypoint = 2.0
    """Without `tau`: likelihood of a frame if the keypoint is not visible, over that at its average pixel ..."""
    tau_match: float = 0.03
    """... and at least this share of the track's average match while seen: the best match in an image that does not
    show the keypoint is far better than at the average pixel. Chosen on `lid` and `rubbish` with trained networks;
    where distances end at 1, 0.1 to 0.25 is better."""
    walk: float = 0.002
    """Standard deviation of the random walk in one frame and along each axis, metres. The authors' is 0.01. Assumes a
    tabletop. Chosen, sensitivity not measured."""
    gripper_probability: float = 0.2
    """Probability that a particle near the gripper takes part in the gripper's motion. The authors' is 0.25."""
    gripper_memory: float = 0.9
    """Probability that a particle keeps, from the last frame, whether it moves with the gripper. Zero for the paper's
    model, in which every frame is redrawn. With 0.9, the 90th percentile of the error of moving keypoints fell from 2.0
    to 0.2 cm (two simulated demonstrations, wrist camera)."""
    gripper_reach: float = 0.15
    """Metres around the gripper's frame within which particles may move with it. Infinity for the paper's model.
    Assumes a tabletop. Chosen, sensitivity not measured."""
    gripper_turns: bool = True
    """Whether particles follow the gripper's rotation, too. The authors' follow its translation only."""
    depth_noise: float = 0.02
    """Standard deviation of depth, as a share of depth; the authors' ..."""
    depth_noise_floor: float = 0.001
    """... and a constant added to it, metres; the authors'."""
    hidden_without_depth: float = 0.5
    """p_o at a pixel without depth. The authors' is 1: such a pixel is no evidence at all."""
    occlusion_margin: float = 0.05
    """Metres by which an occluder must be in front of a particle. The paper's; its code has 0.10. Assumes a
    tabletop."""
    resample_below: float = 0.1
    """Resample when the effective sample size is below this share of the particles; 1: in every frame. The share in
    the authors' configurations, which their code does not use: it resamples in every frame."""
    resampling: Literal["stratified", "systematic"] = "stratified"
    """One random number for each new particle, or one for all of them."""
    draw_sharpness: float = 6.0
    """Factor on alpha for the heat maps that particles are drawn from: alpha is chosen for many frames together, and in
    a single one leaves most of the weight to the background. One for the paper's filter. On 7-Scenes `redkitchen` it
    reduced the error of the first estimate from 86 to 17 cm."""
    redraw_sharpness: float | None = None
    """The same factor for redrawn particles; None: `draw_sharpness`. The authors' is 64."""
    redraw_share: float = 0.01
    """Share of the particles redrawn from each frame's heat maps. The authors' is 0.05."""
    draw_block: int = 4
    """Edge, pixels of the distance map, of the blocks in which one random pixel each is considered for redrawing: the
    cost falls with its square. Chosen, sensitivity not measured."""
    redraw_mass: float = 1e-3
    """Total weight of redrawn particles where the track is not seen to match: the probability that it was lost, in each
    frame. On `redkitchen`, ten times as much raised the error of the mean out of view from 1.8 to 3.9 cm."""
    unfound_mass: float = 20.0
    """Factor on that weight while a track has never been found. Chosen, sensitivity not measured."""
    found: float = 2.0
    """A track is found where a camera sees it match this many times better than tau. Chosen, sensitivity not
    measured."""
    usual_rate: float = 0.1
    """Weight of a frame in the running average of the track's match while it is found. Chosen, sensitivity not
    measured."""
    n_lookalikes: int = 64
    """Number of distractors to remember: positions that matched while the keypoint was seen elsewhere. Zero for the
    paper's filter, whose track moves to a distractor once the keypoint is not visible. With it, 31 of 32 keypoints on
    one of two identical boxes were kept (simulated), without it none."""
    lookalike_radius: float = 0.06
    """Metres around a distractor, or around the track, that count as the same position: about the size of a small
    object on a table. A track is certain enough to find distractors if its spread is below half of it. Assumes a
    tabletop. Chosen, sensitivity not measured."""
    lookalike_better: float = 1.5
    """A point that matches better than a distractor by this factor is something else that moved there. Chosen,
    sensitivity not measured."""
    mode_radius: float = 0.03
    """Metres around the mode within which particles count as one hypothesis: half of `lookalike_radius`. Assumes a
    tabletop. Chosen, sensitivity not measured."""

    residual_sigma: float = 0.87
    """Factor on the displacement that explains how poorly the mean matches, for the reported covariance: see
    `with_certainty`. Zero reports the spread of the particles alone, as in the paper. Chosen with the next three for
    the least calibration error on three simulated demonstrations each of `microwave`, `phone`, `lid` and `rubbish`
    (seeds 101 to 112, perfect descriptors): 0.01 by the wrist camera and, on half of them, 0.04 by both. Sensitivities
    are those of that half, with values some percent smaller: half or twice as much raised it from 0.03 to 0.28."""
    residual_noise: float = 0.03
    """Part of the residual, as a descriptor distance, that is noise of depth and pixels and needs no displacement. Half
    or twice as much raises the calibration error from 0.03 to 0.07 and 0.15."""
    spread_seen: float = 0.07
    """Share of the particles' standard deviation that is reported beside the displacement while a camera sees the
    keypoint. Half or twice as much changes the calibration error by 0.01."""
    spread_unseen: float = 0.25
    """The same while no camera does. Below one, as most objects then stand still. Half or twice as much raises the
    calibration error by 0.02 and 0.01."""


_OUT_OF_SIGHT = 0.25 * math.exp(-4.0)
"""tau of the authors' code: the likelihood of a match at descriptor distance 1 (alpha 4) and p_d = 0.25."""

_CODE: dict[str, Any] = {
    "n_particles": 250,
    "alpha": 4.0,
    "tau": _OUT_OF_SIGHT,
    "walk": 0.01,
    "gripper_probability": 0.25,
    "gripper_memory": 0.0,
    "gripper_reach": math.inf,
    "gripper_turns": False,
    "depth_noise": 0.02,
    "depth_noise_floor": 0.001,
    "hidden_without_depth": 1.0,
    "occlusion_margin": 0.10,
    "resample_below": 1.0,
    "resampling": "systematic",
    "draw_sharpness": 1.0,
    "redraw_sharpness": 64.0,
    "redraw_share": 0.05,
    "redraw_mass": 0.05,
    "n_lookalikes": 0,
    "residual_sigma": 0.0,
}
IF_CALIBRATED: dict[str, Any] = {"found": 1.0}
"""Where tau was measured, every better match is more likely the keypoint than a rival. Twice as good is never reached
by descriptors that hardly differ. Chosen on 7-Scenes `redkitchen`, half of the points."""

PRESETS: dict[str, dict[str, Any]] = {
    # Stratified resampling below a threshold; nothing is said of sharper heat maps.
    "paper": {
        **_CODE,
        "occlusion_margin": 0.05,
        "hidden_without_depth": 0.5,
        "resample_below": 0.1,
        "resampling": "stratified",
        "redraw_sharpness": None,
    },
    "code": _CODE,
}
