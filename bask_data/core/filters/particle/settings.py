"""Settings of the particle filter: our own, the paper's and those of its authors' code."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

from bask_data.core.filters.table import FilterSettings


@dataclass(frozen=True)
class ParticleSettings(FilterSettings):
    """Settings of the particle filter."""

    n_particles: int = 2000
    alpha: float = 2.0
    """Temperature: a pixel at distance z has correspondence likelihood exp(-alpha z). Half of what networks are trained
    with, and the paper's: frames of one motion err together, and what they say must not count in full each time.
    Three networks on `lid`: mean error 59, 59 and 57 mm, with alpha 4 it was 70, 74 and 63."""
    tau: float | None = None
    """Likelihood of any observation if the camera does not see the particle; None: `unseen_likelihood` says it of each
    frame."""
    tau_ratio: float = 2.0
    """Without `tau`: how much likelier the keypoint is out of sight than at the average pixel ..."""
    tau_match: float = 0.03
    """... and at least: this share of how well the track has matched, on average, while seen. The best match of an
    image that does not show the keypoint is far above the average pixel. Chosen on `lid` and `rubbish` with trained
    networks; where distances end at 1, 0.1 to 0.25 is better."""
    walk: float = 0.002
    """Standard deviation of the random walk in one frame and along each axis, metres. The authors' is 0.01."""
    gripper_probability: float = 0.2
    """Probability that a particle near the gripper takes part in the gripper's motion. The authors' is 0.25."""
    gripper_memory: float = 0.9
    """Probability that it does in a frame what it did in the last: what is held stays held. Zero for the paper's model,
    in which every frame is drawn anew. With 0.9, the 90th percentile of the error of moving keypoints fell from 2.0 to
    0.2 cm (two simulated demonstrations, wrist camera)."""
    gripper_reach: float = 0.15
    """Metres around the gripper's frame within which particles may move with it. Infinity for the paper's model."""
    gripper_turns: bool = True
    """Whether particles take part in the gripper's rotation, too. The authors' take part in its translation only."""
    depth_noise: float = 0.02
    """Standard deviation of depth, as a share of depth; as in the authors' code ..."""
    depth_noise_floor: float = 0.001
    """... and what is added to it, metres."""
    hidden_without_depth: float = 0.5
    """p_o at a pixel without depth. The authors' is 1: such a pixel says nothing at all."""
    occlusion_margin: float = 0.05
    """Metres by which something must lie in front of a particle to hide it. The paper's; its code has 0.10."""
    resample_below: float = 0.1
    """Resample when the effective number of particles is below this share of all. The authors'."""
    resampling: Literal["stratified", "systematic"] = "stratified"
    """One random number for each new particle, or one for all of them."""
    draw_sharpness: float = 6.0
    """How much higher than alpha the temperature is of the heat maps that particles are drawn from, first and later:
    alpha is made for many frames together, and in a single one leaves most of the weight to the background. One for the
    paper's filter. On 7-Scenes `redkitchen` it took the error of the first estimate from 86 to 17 cm."""
    redraw_share: float = 0.01
    """Share of the particles drawn anew from each frame's heat maps. The authors' is 0.05."""
    draw_block: int = 4
    """Edge, pixels of the distance map, of the blocks of which one pixel each is looked at when these are drawn: the
    cost falls with its square, and a network of stride 8 resolves nothing finer."""
    redraw_mass: float = 1e-3
    """Weight these get together where the track is not seen to match: the probability that it has been lost, in each
    frame. On `redkitchen`, ten times as much pulled the mean of points out of view from 1.8 to 3.9 cm."""
    unfound_mass: float = 20.0
    """How much more weight is drawn anew while a track has never been found. Its sensitivity has not been measured."""
    found: float = 2.0
    """A track is found where a camera sees it match this many times better than tau. Its sensitivity has not been
    measured."""
    usual_rate: float = 0.1
    """Share of a frame's match in the running average of how well the track matches while it is found: an average over
    about ten frames. Its sensitivity has not been measured."""
    n_lookalikes: int = 64
    """How many places to remember that matched while the keypoint was seen elsewhere: none of them is it. Zero for the
    paper's filter: whatever looks alike takes the keypoint over, then, once that is out of sight. With the memory, 31
    of 32 keypoints with a twin were kept (two equal boxes, simulated), without it none."""
    lookalike_radius: float = 0.06
    """Metres around a look-alike, or around the track, that count as the same place: about the size of a small object
    on a table. A track must be twice as sure to tell the one from the other."""
    lookalike_better: float = 1.5
    """What matches better than a look-alike by this factor is another thing that came to its place."""
    mode_radius: float = 0.03
    """Metres around the mode within which particles count as one hypothesis: half of `lookalike_radius`."""


_OUT_OF_SIGHT = 0.25 * math.exp(-4.0)
"""tau of the authors' code: a match at descriptor distance 1 whose depth fits with 0.25."""

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
    "resample_below": 0.1,
    "resampling": "stratified",
    "draw_sharpness": 1.0,
    "redraw_share": 0.05,
    "redraw_mass": 0.05,
    "n_lookalikes": 0,
}
PRESETS: dict[str, dict[str, Any]] = {
    "paper": {**_CODE, "occlusion_margin": 0.05, "hidden_without_depth": 0.5},
    "code": _CODE,
}
