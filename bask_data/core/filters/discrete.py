"""The discrete Bayes filter: for each camera, a belief over its pixels and one more state, *outside of the image*.

The belief is warped from the previous image into the current one by depth and camera motion, a part of it by the
gripper's motion, spread by a random walk, and multiplied by the observation likelihood. Every step is linear in the
belief and keeps its mass: mass that leaves the image is outside, and returns where the camera uncovers something it did
not see before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from numpy.random import Generator
from scipy.sparse import csr_array

from bask_data.core.filters.heatmap import Lifted, fuse, keep_last, lift, unseen_likelihood
from bask_data.core.filters.observation import Estimate, Motion, Observation, PixelMaps, n_keypoints
from bask_data.core.filters.per_keypoint import per_keypoint
from bask_data.core.filters.table import Filter, FilterSettings, PerKeypoint
from bask_data.core.geometry import in_image, invert_rigid, pixel_grid, project, scale_intrinsics, transform, unproject
from bask_data.core.nearest_depth import fill_depth, shrink_depth

LEAST_EVIDENCE = 1e-300
"""Evidence below which an image is ignored: what is left has lost its digits."""

ASSUMED_DEPTH = 1e6
"""Depth, metres, assumed in an image without any: the camera's rotation still moves its pixels."""


@dataclass(frozen=True)
class DiscreteSettings(FilterSettings):
    """Settings of the discrete filter. In the paper's, `tau`, `restart` and `gripper_probability` are zero."""

    alpha: PerKeypoint = 4.0
    """Temperature: a pixel at descriptor distance z has likelihood exp(-alpha z). The paper's."""
    walk_px: float = 1.0
    """Standard deviation of the random walk in one frame, pixels of the distance map. The authors' is 2."""
    grid: tuple[int, int] | None = None
    """Rows and columns of the belief; None: those of the distance map."""
    tau: PerKeypoint | None = None
    """Likelihood of any image if the keypoint is outside of it; None: `unseen_likelihood` of each image."""
    tau_ratio: PerKeypoint = 2.0
    """Without `tau`: likelihood of an image if the keypoint is outside, over that at its average pixel."""
    outside_area: float = 1.0
    """Area around the image that a keypoint may be in, in images: the larger, the less mass returns as the view moves.
    Chosen, sensitivity not measured."""
    restart: float = 0.03
    """Share of the belief that is redistributed over the image in each frame, so that the filter can recover. With it,
    100 % of returning keypoints are found within five frames instead of 88 % (perfect descriptors, simulated)."""
    gripper_probability: float = 0.35
    """Share of the belief near the gripper that moves with it, in each frame. Chosen on the simulated `lid` and
    `rubbish`, where the error with 0.2 is within 1 mm; zero costs 18 to 33 mm on moving keypoints."""
    gripper_reach: float = 0.15
    """Metres around the gripper's frame that count as near: a hand's breadth and the object in it. Assumes a tabletop.
    Chosen, sensitivity not measured."""


@dataclass(frozen=True)
class CameraBelief:
    """Belief over one camera's pixels, and the view it belongs to. `inside` and `outside` sum to one.

    Attributes:
        depth: z-depth, metres, of each cell; 0 means no measurement.
        cell: width and height of a cell, pixels of the distance map.
        world_from_gripper: when that view was taken, if the camera has given no frame since; else None.
    """

    inside: Float[ndarray, "k h w"]
    outside: Float[ndarray, "k"]
    depth: Float[ndarray, "h w"]
    K: Float[ndarray, "3 3"]
    world_from_camera: Float[ndarray, "4 4"]
    cell: Float[ndarray, "2"] = field(default_factory=lambda: np.ones(2))
    world_from_gripper: Float[ndarray, "4 4"] | None = None


@dataclass(frozen=True)
class DiscreteBelief:
    """One belief per camera, None before its first frame, and the last estimate, which is kept while a keypoint is
    outside of all images."""

    cameras: tuple[CameraBelief | None, ...]
    estimate: Estimate


def discrete_step(
    belief: DiscreteBelief | None,
    observations: Sequence[Observation | None],
    motion: Motion | None = None,
    rng: Generator | None = None,
    settings: DiscreteSettings = DiscreteSettings(),
) -> tuple[DiscreteBelief, Estimate]:
    """Belief and estimate after one more frame. Without a belief, the prior is uniform over the pixels.

    Cameras are filtered separately and their estimates fused. A keypoint that is more likely outside of an image than
    inside is not estimated from that camera; outside of all of them, it keeps its last estimate. A camera without a
    frame keeps its last view, and its belief only spreads; the gripper's motion since then is applied with the next
    frame. `rng` is unused.

    Source: von Hartz et al. 2023, Sec. III-B.
    """
    known = belief.cameras if belief else ()
    before = (*known, *[None] * (len(observations) - len(known)))  # Cameras may join.
    filtered = [_camera_step(last, seen, motion, settings) for last, seen in zip(before, observations, strict=True)]
    k = len(belief.estimate.mean) if belief else n_keypoints(observations)
    now = fuse([lifted for _, lifted in filtered], k)
    given = np.array([seen is not None for seen in observations])
    now = replace(now, pixel=np.where(given[:, None, None], now.pixel, np.nan), observed=now.observed & given[:, None])
    estimate = keep_last(now, belief.estimate if belief else None, observations)
    return DiscreteBelief(tuple(camera for camera, _ in filtered), estimate), estimate


def _camera_step(
    before: CameraBelief | None, seen: Observation | None, motion: Motion | None, settings: DiscreteSettings
) -> tuple[CameraBelief | None, Lifted | None]:
    """One camera's belief after a frame, and its estimate in 3D; None before its first frame."""
    since = motion_since(before.world_from_gripper if before else None, motion)
    if seen is None:
        if before is None:
            return None, None
        still = Observation(before.inside, before.depth, before.K, before.world_from_camera)
        posterior = replace(
            predict(before, still, replace(settings, restart=0.0)),
            world_from_gripper=before.world_from_gripper if since is None else since.world_from_gripper_before,
        )
        return posterior, _lifted(posterior, np.zeros(len(posterior.outside)), before.depth.shape)
    grid, likelihood = _on_grid(seen, settings)
    if before is None:
        prior = _uniform(grid, likelihood.shape)
    else:
        prior = predict(before, grid, settings, since)
    tau = unseen_likelihood(seen.distance, settings.alpha, settings.tau, settings.tau_ratio)
    posterior, log_evidence = update(prior, likelihood, tau)
    return posterior, _lifted(posterior, log_evidence, seen.depth.shape)


def motion_since(world_from_gripper: Float[ndarray, "4 4"] | None, motion: Motion | None) -> Motion | None:
    """The gripper's motion since a camera's view was taken.

    Args:
        world_from_gripper: at that view; None if it was the last frame.
        motion: in the last frame.
    """
    if motion is None or world_from_gripper is None:
        return motion
    return replace(motion, world_from_gripper_before=world_from_gripper)


def _lifted(belief: CameraBelief, log_evidence: Float[ndarray, "k"], image: tuple[int, ...]) -> Lifted:
    """A camera's belief in 3D, with pixels of an image of the given (height, width); NaN for a keypoint that is more
    likely outside."""
    inside = belief.inside.sum(axis=(1, 2))
    is_empty = (inside <= 0)[:, None, None]
    heat = np.where(is_empty, 1.0, belief.inside) / np.where(is_empty, belief.depth.size, inside[:, None, None])
    lifted = lift(heat, Observation(heat, belief.depth, belief.K, belief.world_from_camera), log_evidence)
    is_outside = (belief.outside > 0.5)[:, None]
    return replace(
        lifted,
        mean=np.where(is_outside, np.nan, lifted.mean),
        mode=np.where(is_outside, np.nan, lifted.mode),
        pixel=_pixels_of_image(lifted.pixel, belief.depth.shape, image),
    )


def predict(
    belief: CameraBelief, seen: Observation, settings: DiscreteSettings, motion: Motion | None = None
) -> CameraBelief:
    """The belief before the observation: warped into its pixels, and spread.

    Source: von Hartz et al. 2023, Sec. III-B.3; the gripper's part is Eq. 4.
    """
    k, height, width = belief.inside.shape
    inside, outside = belief.inside, belief.outside
    if _moves(belief, seen, motion, settings):
        inside = (carry(belief, seen, settings, motion) @ inside.reshape(k, -1).T).T.reshape(k, height, width)
        outside = outside + np.maximum(belief.inside.sum(axis=(1, 2)) - inside.sum(axis=(1, 2)), 0.0)
        uncovered = _uncovered(belief, seen)
        back = uncovered.sum() / (uncovered.sum() + settings.outside_area * height * width)
        inside = inside + (outside * back / max(uncovered.sum(), 1))[:, None, None] * uncovered
        outside = outside * (1 - back)
    if settings.walk_px > 0:
        before = inside.sum(axis=(1, 2))
        u, v = (settings.walk_px / belief.cell).tolist()
        inside = np.stack(
            [cv2.GaussianBlur(cells, (0, 0), u, sigmaY=v, borderType=cv2.BORDER_CONSTANT) for cells in inside]
        )
        outside = outside + np.maximum(before - inside.sum(axis=(1, 2)), 0.0)
    inside = (1 - settings.restart) * inside + settings.restart / (height * width)
    outside = (1 - settings.restart) * outside
    return CameraBelief(inside, outside, seen.depth, seen.K, seen.world_from_camera, belief.cell)


def _moves(belief: CameraBelief, seen: Observation, motion: Motion | None, settings: DiscreteSettings) -> bool:
    """Whether the camera moved, or a gripper that the filter follows."""
    camera_rests = np.array_equal(belief.world_from_camera, seen.world_from_camera) and np.array_equal(belief.K, seen.K)
    if motion is None or settings.gripper_probability == 0:
        return not camera_rests
    return not (camera_rests and np.array_equal(motion.world_from_gripper_before, motion.world_from_gripper))


def carry(
    belief: CameraBelief,
    seen: Observation,
    settings: DiscreteSettings = DiscreteSettings(),
    motion: Motion | None = None,
) -> csr_array:
    """The matrix (cells now, cells before) that moves mass with the camera, and a part of that near the gripper with
    the gripper; columns of cells that leave the image sum to less than one.

    A cell's mass is divided over the four cells around the position that its centre moves to, so that slow motions add
    up over frames. A cell without depth takes that of the nearest cell with a measurement.
    """
    height, width = belief.depth.shape
    depth = np.nan_to_num(fill_depth(belief.depth), nan=ASSUMED_DEPTH).astype(np.float64)
    points_camera = unproject(pixel_grid(height, width), depth, belief.K).reshape(-1, 3)
    points_world = transform(belief.world_from_camera, points_camera)
    held = np.zeros(len(points_world))
    if motion is not None:
        apart = np.linalg.norm(points_world - motion.world_from_gripper_before[:3, 3], axis=-1)
        held = settings.gripper_probability * (apart < settings.gripper_reach)
    carried = _to_cells(points_world, 1 - held, seen, (height, width))
    if motion is not None and held.any():
        now_from_before = motion.world_from_gripper @ invert_rigid(motion.world_from_gripper_before)
        carried += _to_cells(transform(now_from_before, points_world), held, seen, (height, width))
    return carried


def _to_cells(
    points_world: Float[ndarray, "n 3"], share: Float[ndarray, "n"], seen: Observation, size: tuple[int, int]
) -> csr_array:
    """The matrix that moves the given share of each cell's mass to the four cells around its point's image."""
    height, width = size
    uv = project(transform(invert_rigid(seen.world_from_camera), points_world), seen.K)[0]
    uv = np.round(uv, 9)  # so that a camera that moves by whole pixels does not blur
    uv = np.clip(np.nan_to_num(uv, nan=-9.0), -9.0, max(height, width) + 9.0)
    corner = np.floor(uv).astype(int)
    part = uv - corner
    rows, columns, values = [], [], []
    for du, dv in ((0, 0), (1, 0), (0, 1), (1, 1)):
        u, v = corner[:, 0] + du, corner[:, 1] + dv
        weight = share * (part[:, 0] if du else 1 - part[:, 0]) * (part[:, 1] if dv else 1 - part[:, 1])
        (kept,) = np.nonzero((u >= 0) & (u < width) & (v >= 0) & (v < height) & (weight > 0))
        rows.append(v[kept] * width + u[kept])
        columns.append(kept)
        values.append(weight[kept])
    indices = (np.concatenate(rows), np.concatenate(columns))
    return csr_array((np.concatenate(values), indices), shape=(height * width, height * width))


def _uncovered(belief: CameraBelief, seen: Observation) -> Bool[ndarray, "h w"]:
    """Cells that show points outside of the previous view."""
    height, width = seen.depth.shape
    depth = np.nan_to_num(fill_depth(seen.depth), nan=ASSUMED_DEPTH).astype(np.float64)
    before_from_now = invert_rigid(belief.world_from_camera) @ seen.world_from_camera
    points = transform(before_from_now, unproject(pixel_grid(height, width), depth, seen.K))
    return ~in_image(np.round(project(points, belief.K)[0], 9), height, width)


def update(
    prior: CameraBelief, likelihood: Float[ndarray, "k h w"], tau: Float[ndarray, "k"]
) -> tuple[CameraBelief, Float[ndarray, "k"]]:
    """Belief after an observation, and the log evidence.

    The likelihood exp(-alpha z) is not normalised over the image as in the paper, where the factor cancels: here it is
    compared with `tau`, the likelihood of the state outside.

    Source: von Hartz et al. 2023, Sec. III-B.4.
    """
    inside, outside = prior.inside * likelihood, prior.outside * tau
    evidence = np.maximum(inside.sum(axis=(1, 2)) + outside, LEAST_EVIDENCE)
    is_informative = evidence > LEAST_EVIDENCE
    inside = np.where(is_informative[:, None, None], inside / evidence[:, None, None], prior.inside)
    outside = np.where(is_informative, outside / evidence, prior.outside)
    return replace(prior, inside=inside, outside=outside), np.log(evidence)


def _uniform(seen: Observation, shape: tuple[int, ...]) -> CameraBelief:
    k, height, width = shape
    uniform = np.full((k, height, width), 1.0 / (height * width))
    cell = np.array([seen.distance.shape[2] / width, seen.distance.shape[1] / height])
    return CameraBelief(uniform, np.zeros(k), seen.depth, seen.K, seen.world_from_camera, cell)


def _on_grid(seen: Observation, settings: DiscreteSettings) -> tuple[Observation, Float[ndarray, "k h w"]]:
    """Depth and intrinsics at the resolution of the belief, and the mean likelihood exp(-alpha z) of each cell."""
    alpha = per_keypoint(settings.alpha, len(seen.distance), "alpha").astype(seen.distance.dtype)
    likelihood = np.exp(-alpha[:, None, None] * seen.distance, dtype=np.float64)
    if settings.grid is not None and settings.grid != likelihood.shape[1:]:
        height, width = settings.grid
        shrinks = height <= likelihood.shape[1] and width <= likelihood.shape[2]
        how = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
        likelihood = np.stack([cv2.resize(image, (width, height), interpolation=how) for image in likelihood])
    size, grid = seen.depth.shape, likelihood.shape[1:]
    if size != grid:
        seen = replace(seen, depth=shrink_depth(seen.depth, grid), K=scale_intrinsics(seen.K, size, grid))
    return seen, likelihood


def _pixels_of_image(
    cells: Float[ndarray, "k 2"], grid: tuple[int, ...], image: tuple[int, ...]
) -> Float[ndarray, "k 2"]:
    factor = np.array([image[1] / grid[1], image[0] / grid[0]])
    return (cells + 0.5) * factor - 0.5


def pixel_beliefs(
    belief: DiscreteBelief | None, observations: Sequence[Observation | None], settings: DiscreteSettings
) -> PixelMaps:
    """The part of the belief inside each camera's image."""
    cameras = belief.cameras if belief else ()
    return PixelMaps(tuple(None if camera is None else camera.inside for camera in cameras))


_PAPER = {"alpha": 4.0, "walk_px": 2.0, "tau": 0.0, "restart": 0.0, "gripper_probability": 0.0}
FILTER = Filter(
    settings=DiscreteSettings,
    belief=DiscreteBelief,
    step=discrete_step,
    hypotheses=pixel_beliefs,
    presets={"paper": _PAPER, "code": _PAPER},
)
