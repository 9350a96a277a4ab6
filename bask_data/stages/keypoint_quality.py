"""How well keypoints are recognised, in other scans and in other frames of their own."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from bask_data.core.agreement import NEAR, Sightings, joined
from bask_data.kinds import Camera, Pick, Recognition, Scan, VisibleMasks

if TYPE_CHECKING:
    import numpy as np
    import torch

    from bask_data.nn.network import DescriptorNetwork
    from bask_data.nn.selection import SelectionView

MOST_SCANS = 8
"""Most scans that keypoints are searched in, as some may not show their objects. Each costs `N_FRAMES` forward passes.
Chosen, sensitivity not measured."""

ENOUGH_SCANS = 3
"""Scans that show an object, after which the search for its keypoints ends. Chosen, sensitivity not measured."""

N_FRAMES = 6
"""Frames of such a scan, evenly spaced among those that show objects. Chosen, sensitivity not measured."""

LEAST_ALIGNED = 5
"""Fewest keypoints that a rigid motion must take to where they are found again: three always fit. Chosen, sensitivity
not measured."""

LEAST_SEEN = 3
"""Fewest frames of a candidate whose mean error is compared with others: a single frame may be right by luck. Chosen on
the five objects of decision 54: the chosen points' mean error is 50 mm with 1 or 2, 44 with 3, 43 with 4."""

FAMILIAR = 0.9
"""An object is in another scan only if half of its candidates match there, in their best frame, at least as well as
this share of all best matches in its own scan. Chosen on ten pairs of an object and a scan that shows it and ten that
do not (decision 54): the latter are all refused, also at a distance larger by 8 %, and eight of the former accepted."""

LEAST_SHARE_ALIGNED = 0.25
"""Smallest share of an object's keypoints, likewise. Chosen, sensitivity not measured."""


@dataclass
class Pool:
    """Candidates of one object, and what frames say about them.

    Args:
        points_world: (k, 3) metres, in the scan they are picked in.
        own: sightings in other frames of that scan, where the true places are known.
        familiar: largest descriptor distance, see `FAMILIAR`, at which the object is recognised.
        scans: other scans in which the object was recognised.
        others: sightings in them.
    """

    points_world: np.ndarray
    descriptors: torch.Tensor
    own: Sightings
    familiar: float = float("inf")
    scans: list[str] = field(default_factory=list)
    others: list[Sightings] = field(default_factory=list)

    @property
    def sightings(self) -> Sightings:
        """Sightings in the other scans, or, if the object was recognised in none, in its own."""
        return joined(self.others, len(self.points_world)) if self.others else self.own

    @property
    def ranks(self) -> np.ndarray:
        """(k,) ranks of the candidates by their errors in their own scan plus those by their errors in others.

        Ranks, as errors in two places differ in size. In its own scan, true places are known exactly; other scans
        show what was not learned. Together they choose better than either alone.
        """
        import numpy as np

        k = len(self.points_world)
        sightings = (self.own, joined(self.others, k))
        errors = [np.where(seen.n_views >= LEAST_SEEN, seen.expected_error, np.inf) for seen in sightings]
        # Equal errors share a rank.
        return sum((np.unique(error, return_inverse=True)[1] for error in errors), np.zeros(k, int))

    def recognition(self, row: int, scene: str) -> Recognition | None:
        """What is stored of a candidate; None if it was searched in no frame that shows it.

        Args:
            scene: the scan that it is picked in.
        """
        everywhere = joined([self.own, *self.others], len(self.points_world))
        return recognition_of(self.sightings, everywhere, row, self.scans or [scene])


def recognition_of(measured: Sightings, everywhere: Sightings, row: int, scans: Sequence[str]) -> Recognition | None:
    """What is stored of the keypoint in a row: errors of some frames, ambiguity in all; None without any frame."""
    n_views = int(measured.n_views[row])
    if n_views == 0:
        return None
    return Recognition(
        error=float(measured.expected_error[row]),
        share_found=int(measured.n_found[row]) / n_views,
        n_frames=n_views,
        scans=tuple(scans),
        is_ambiguous=bool(everywhere.is_ambiguous[row]),
    )


def other_scans(scene: str, names: Sequence[str], learned: Sequence[str] | None) -> list[str]:
    """At most `MOST_SCANS` scans beside `scene`: first those that the network has not learned from."""
    others = [name for name in names if name != scene]
    return sorted(others, key=lambda name: name in (learned or ()))[:MOST_SCANS]


def search(
    pools: Sequence[Pool], scans: Mapping[str, tuple[Scan, VisibleMasks]], network: DescriptorNetwork, seed: int
) -> Iterator[None]:
    """Search for the candidates of all objects in some scans, one scan a step."""
    for name, (scan, masks) in scans.items():
        if all(len(pool.scans) >= ENOUGH_SCANS for pool in pools):
            return
        views = [view_of(camera, i_frame, network, masks) for camera, i_frame in searched_frames(scan, masks)]
        for pool in pools:
            found = elsewhere(pool, views, seed) if len(views) > 1 else None
            if found is not None:
                pool.scans.append(name)
                pool.others.append(found)
        yield


def elsewhere(pool: Pool, views: Sequence[SelectionView], seed: int) -> Sightings | None:
    """Sightings of an object's candidates in another scan; None if the object is not recognised there.

    Views that agree can agree on the wrong place. The object is rigid: its true places follow from the motion that
    takes most candidates to where they are found. (Of an object that can be turned without a change, it is one of
    several.)
    """
    import numpy as np

    from bask_data.core.geometry import transform
    from bask_data.core.rigid_fit import robust_rigid_fit
    from bask_data.nn.recognition import Search

    found = Search.of(pool.descriptors, views)
    if np.median(found.nearest.min(axis=1)) > pool.familiar:
        return None
    places, votes = found.agreed()
    reliable = np.flatnonzero(votes >= 2)
    if len(reliable) < LEAST_ALIGNED:
        return None
    rng = np.random.default_rng(seed)
    here_from_there, inliers = robust_rigid_fit(pool.points_world[reliable], places[reliable], NEAR, rng)
    if inliers.sum() < max(LEAST_ALIGNED, LEAST_SHARE_ALIGNED * len(pool.points_world)):
        return None
    return found.sightings(transform(here_from_there, pool.points_world))


def in_own_scan(
    points_world: np.ndarray, descriptors: torch.Tensor, i_view: np.ndarray, views: Sequence[SelectionView]
) -> tuple[Sightings, float]:
    """Sightings of points (k, 3) in views of the scan they are picked in, each in all views but its own.

    Also the descriptor distance up to which matches count as familiar: infinite if there is no other view.

    Args:
        i_view: (k,) the view that each descriptor is from.
    """
    import numpy as np

    from bask_data.nn.recognition import Search

    error, tied, nearest = (np.full((len(points_world), len(views)), np.nan) for _ in range(3))
    for i, view in enumerate(views):
        rows = np.flatnonzero(i_view != i)
        if len(rows):
            found = Search.of(descriptors[rows], [view])
            seen = found.sightings(points_world[rows])
            error[rows, i], tied[rows, i], nearest[rows, i] = seen.error[:, 0], seen.tied[:, 0], found.nearest[:, 0]
    known = nearest[np.isfinite(nearest)]
    return Sightings(error, tied), float(np.quantile(known, FAMILIAR)) if len(known) else float("inf")


def of_picks(
    picks: Sequence[Pick],
    descriptors: np.ndarray,
    scans: Mapping[str, Scan],
    masks: Mapping[str, VisibleMasks],
    network: DescriptorNetwork,
) -> list[Pick]:
    """The picks with how well they are recognised in other frames of their scans; in demonstrations things move."""
    import numpy as np
    import torch

    completed = list(picks)
    for name in dict.fromkeys(pick.recording for pick in picks if pick.recording in scans):
        mine = [i for i, pick in enumerate(picks) if pick.recording == name and pick.point_world is not None]
        frames = searched_frames(scans[name], masks.get(name))
        views = [view_of(camera, i_frame, network, masks.get(name)) for camera, i_frame in frames]
        numbers = {(camera.name, i_frame): i for i, (camera, i_frame) in enumerate(frames)}
        own_view = np.array([numbers.get((picks[i].camera, picks[i].frame), -1) for i in mine])
        if mine and views:
            points = np.array([picks[i].point_world for i in mine])
            own, _ = in_own_scan(points, torch.from_numpy(descriptors[mine]).to(network.device), own_view, views)
            for row, i in enumerate(mine):
                completed[i] = picks[i].model_copy(update={"recognition": recognition_of(own, own, row, [name])})
    return completed


def searched_frames(scan: Scan, masks: VisibleMasks | None) -> list[tuple[Camera, int]]:
    """At most `N_FRAMES` frames of a scan, evenly spaced among those that show objects, or all without masks."""
    import numpy as np

    frames: list[tuple[Camera, int]] = []
    for camera in scan.cameras:
        shown = np.ones(camera.n_frames, bool)
        if masks is not None:
            shown = np.nan_to_num(masks.camera(camera.name).visible_fraction).max(axis=1, initial=0.0) > 0
        frames += [(camera, int(i_frame)) for i_frame in np.flatnonzero(shown)]
    return [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, N_FRAMES).astype(int))] if frames else []


def view_of(camera: Camera, i_frame: int, network: DescriptorNetwork, masks: VisibleMasks | None) -> SelectionView:
    """A frame with its descriptors and, if there are masks, its objects."""
    from bask_data.nn.selection import SelectionView

    return SelectionView(
        descriptors=network.describe(camera.rgb(i_frame)),
        depth=camera.depth(i_frame),
        K=camera.Ks[i_frame],
        world_from_camera=camera.world_from_cameras[i_frame],
        instance=None if masks is None else masks.camera(camera.name).instance(i_frame),
    )
