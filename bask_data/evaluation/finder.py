"""Search for reference keypoints in an image with a descriptor network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bask_data.core.filters.heatmap import softmax_map
from bask_data.core.filters.table import alpha_of_one_frame
from bask_data.core.geometry import in_image, scale_pixels
from bask_data.dataset import Dataset
from bask_data.errors import BadData
from bask_data.evaluation.lookup import find, input_variant
from bask_data.evaluation.reference_points import frame_of
from bask_data.evaluation.search import ALPHA
from bask_data.kinds import DescriptorNet, KeypointTrack, Pick, ReferenceKeypoints


@dataclass(frozen=True)
class Sight:
    """Heat maps and best matches of k keypoints in one frame.

    Args:
        heat: (k, h, w) probabilities, at the network's own resolution.
        nearest: (k,) smallest descriptor distance in the frame.
        best: (k, 2) the pixel of the frame at that distance.
    """

    heat: np.ndarray
    nearest: np.ndarray
    best: np.ndarray


class Finder:
    """A descriptor network with the descriptors of keypoints to look for."""

    def __init__(self, dataset: Dataset, variant: str, descriptor: DescriptorNet, picks: Sequence[Pick]) -> None:
        """Describe the keypoints where they were picked.

        Raises:
            BadData: the network does not load, or has another dimension than the reference keypoints.
        """
        self._network = descriptor.network()
        self.descriptors = self._described(dataset, variant, descriptor, picks)
        """Descriptors (k, d); NaN for picks in frames that are not in the dataset."""
        self.alpha = temperature(dataset, variant, descriptor)

    def _described(
        self, dataset: Dataset, variant: str, descriptor: DescriptorNet, picks: Sequence[Pick]
    ) -> np.ndarray:
        kept = find(dataset, ReferenceKeypoints, "", variant)
        if kept is not None and kept.picks == list(picks):
            made_with = input_variant(dataset, kept, DescriptorNet, variant)
            if made_with is not None and made_with.path == descriptor.path:
                return self._fitting(descriptor, kept.descriptors)
        descriptors = np.full((len(picks), self._network.settings.descriptor_dim), np.nan, np.float32)
        by_frame: dict[tuple[str, str, int], list[int]] = {}
        for i, pick in enumerate(picks):
            by_frame.setdefault((pick.recording, pick.camera, pick.frame), []).append(i)
        for indices in by_frame.values():
            image = frame_of(dataset, picks[indices[0]])
            uv = np.array([[picks[i].u, picks[i].v] for i in indices], np.float32)
            inside = in_image(uv, *image.shape[:2]) if image is not None else np.zeros(len(uv), bool)
            if image is not None and inside.any():
                rows = np.array(indices)[inside]
                descriptors[rows] = self._network.descriptors_at(image, uv[inside]).cpu().numpy()
        return descriptors

    def _fitting(self, descriptor: DescriptorNet, references: np.ndarray) -> np.ndarray:
        dimension = self._network.settings.descriptor_dim
        if references.shape[1] != dimension:
            raise BadData(
                descriptor.path,
                "descriptor_dim",
                expected=f"{references.shape[1]} as the reference keypoints",
                got=dimension,
            )
        return references

    @property
    def described(self) -> np.ndarray:
        """(k,) bool: keypoints that have a descriptor."""
        return np.isfinite(self.descriptors).all(axis=1)

    def look(self, rgb: np.ndarray, chosen: Sequence[int]) -> Sight:
        """Look for some of the keypoints, which must be `described`, in an image."""
        distance = self._network.distance_maps(rgb, self.descriptors[list(chosen)])
        k, height, width = distance.shape
        heat, _ = softmax_map(distance, self.alpha)
        flat = distance.reshape(k, -1)
        row, column = np.divmod(flat.argmin(axis=1), width)
        best = scale_pixels(np.stack([column, row], axis=1).astype(np.float64), (height, width), rgb.shape[:2])
        return Sight(heat, flat.min(axis=1), best)


def network_of(dataset: Dataset, variant: str) -> DescriptorNet | None:
    """The descriptor network of a variant, or the one that its reference keypoints or tracks were made with."""
    own = find(dataset, DescriptorNet, "", variant) if variant in dataset.variants(DescriptorNet) else None
    if own is not None:
        return own
    for artifact in (find(dataset, ReferenceKeypoints, "", variant), *_tracks(dataset, variant)):
        if artifact is not None:
            return input_variant(dataset, artifact, DescriptorNet, "main")
    return None


def _tracks(dataset: Dataset, variant: str) -> list[KeypointTrack]:
    tracks = [find(dataset, KeypointTrack, name, variant) for name in dataset.items("demonstration")]
    return [track for track in tracks if track is not None]


def temperature(dataset: Dataset, variant: str, descriptor: DescriptorNet) -> float:
    """alpha of the heat maps softmax(-alpha z): that of the variant's tracks, or else of its training.

    The default of a filter over many frames does not count, only a value that was set.
    """
    for track in _tracks(dataset, variant):
        params = track.manifest.params
        alpha = alpha_of_one_frame(track.metadata.filter, params.get("settings", "default"), params.get("alpha"))
        if alpha is not None:
            return alpha
    params = descriptor.manifest.params
    # Only training on heat maps has a temperature.
    return float(params.get("alpha") or ALPHA) if params.get("loss") == "infonce" else ALPHA
