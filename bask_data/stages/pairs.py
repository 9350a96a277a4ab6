"""Pairs of frames that a network is trained on, and those that it is validated on."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

from bask_data.dataset import Splits
from bask_data.errors import BadData, UsageError
from bask_data.kinds import Correspondences, Scan, VisibleMasks

if TYPE_CHECKING:
    import numpy as np

    from bask_data.nn.sampling import Pair

MATCHES_KEPT = 1000
"""Matches of a pair kept in memory; by default a step uses about a tenth of them. Chosen, sensitivity not measured."""

CACHE_BYTES = 1 << 30
"""Memory for shrunk frames. Chosen."""


class ScanPairs:
    """The pairs of one scan; frames are read when needed.

    Args:
        identities: by instance, as far as they are known.
    """

    def __init__(
        self,
        scan: Scan,
        masks: VisibleMasks,
        correspondences: Correspondences,
        identities: Mapping[int, int] = MappingProxyType({}),
    ) -> None:
        self.name = scan.path.name
        self.identities = identities
        self.scan, self.masks = scan, masks
        self.n_frames = {camera.name: camera.n_frames for camera in scan.cameras}
        self.sizes = {camera.name: (camera.height, camera.width) for camera in scan.cameras}
        self._cameras = {camera.name: camera for camera in scan.cameras}
        self._masks = {name: masks.camera(name) for name in self._cameras}
        self._read(correspondences)

    def _read(self, correspondences: Correspondences) -> None:
        import numpy as np

        self.frames: list[tuple[str, int, str, int]] = []
        self.matches: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        pairs, matches = correspondences.pairs().to_pylist(), correspondences.matches()
        columns = {name: matches[name].to_numpy() for name in matches.column_names}
        for pair in pairs:
            first, end = np.searchsorted(columns["pair"], [pair["pair"], pair["pair"] + 1])
            if first == end:
                continue
            # Matches are in random order, so any part of them is a fair sample; evenly spaced, it needs no seed.
            rows = np.unique(np.linspace(first, end - 1, min(end - first, MATCHES_KEPT)).round().astype(int))
            a = np.stack([columns["u_a"][rows], columns["v_a"][rows]], axis=-1)
            b = np.stack([columns["u_b"][rows], columns["v_b"][rows]], axis=-1)
            self.frames.append((pair["camera_a"], pair["frame_a"], pair["camera_b"], pair["frame_b"]))
            self.matches.append((columns["instance"][rows].astype(np.uint8), a, b))
        self.n_instances = len(np.unique(columns["instance"]))

    def frame(self, camera: str, i_frame: int, limit: tuple[int, int] | None) -> tuple[np.ndarray, np.ndarray]:
        """Colour and instances of a frame, shrunk to `limit` (height, width) or unchanged."""
        import cv2
        import numpy as np

        rgb, instance = self._cameras[camera].rgb(i_frame), self._masks[camera].instance(i_frame)
        size = self.shrunk_size(camera, limit)
        if size != rgb.shape[:2]:
            rgb = cv2.resize(rgb, size[::-1], interpolation=cv2.INTER_AREA)
            instance = cv2.resize(instance, size[::-1], interpolation=cv2.INTER_NEAREST_EXACT)
        return np.ascontiguousarray(rgb), np.ascontiguousarray(instance)

    def shrunk_size(self, camera: str, limit: tuple[int, int] | None) -> tuple[int, int]:
        """(height, width) of a camera's frames, shrunk until one side fits `limit`, the aspect ratio kept."""
        height, width = self.sizes[camera]
        factor = 1.0 if limit is None else min(max(limit[0] / height, limit[1] / width), 1.0)
        return round(height * factor), round(width * factor)


class Pairs:
    """Some pairs of some scans: a `PairSource`."""

    def __init__(self, chosen: list[tuple[ScanPairs, int]]) -> None:
        import numpy as np

        from bask_data.nn.occluders import N_INSTANCES

        self._chosen = chosen
        self.scans = np.unique([scan.name for scan, _ in chosen], return_inverse=True)[1]
        self.n_instances = np.array([scan.n_instances for scan, _ in chosen], int)
        self.identities = np.zeros((self.scans.max(initial=-1) + 1, N_INSTANCES), int)
        for i_scan, scan in {int(i): scan for i, (scan, _) in zip(self.scans, chosen, strict=True)}.items():
            for instance, identity in scan.identities.items():
                self.identities[i_scan, instance] = identity
        self._limit: tuple[int, int] | None = None
        self._frames: dict[tuple[str, str, int], tuple[np.ndarray, np.ndarray]] = {}
        self._bytes = 0

    @property
    def scenes(self) -> tuple[str, ...]:
        """Names of their scans, sorted."""
        return tuple(sorted({scan.name for scan, _ in self._chosen}))

    @property
    def n_pairs(self) -> int:
        return len(self._chosen)

    @property
    def image_size(self) -> tuple[int, int]:
        """(height, width) of the first image."""
        scan, i = self._chosen[0]
        return scan.sizes[scan.frames[i][0]]

    def shrink_to(self, limit: tuple[int, int]) -> None:
        """Shrink frames to `limit` (height, width), and keep as many in memory as fit."""
        self._limit = limit

    def pair(self, i_pair: int) -> Pair:
        """One pair, coordinates in the pixels of the shrunk images."""
        from bask_data.core.geometry import scale_pixels
        from bask_data.nn.sampling import Pair

        scan, i = self._chosen[i_pair]
        camera_a, frame_a, camera_b, frame_b = scan.frames[i]
        instance, uv_a, uv_b = scan.matches[i]
        rgb_a, instance_a = self._frame(scan, camera_a, frame_a)
        rgb_b, instance_b = self._frame(scan, camera_b, frame_b)
        return Pair(
            rgb_a=rgb_a,
            rgb_b=rgb_b,
            instance_a=instance_a,
            instance_b=instance_b,
            instance=instance,
            uv_a=scale_pixels(uv_a, scan.sizes[camera_a], rgb_a.shape[:2]).astype("float32"),
            uv_b=scale_pixels(uv_b, scan.sizes[camera_b], rgb_b.shape[:2]).astype("float32"),
        )

    def _frame(self, scan: ScanPairs, camera: str, i_frame: int) -> tuple[np.ndarray, np.ndarray]:
        key = (scan.name, camera, i_frame)
        if key in self._frames:
            return self._frames[key]
        found = scan.frame(camera, i_frame, self._limit)
        # A full cache stays unchanged: replacing frames by others that are as likely to be needed gains nothing.
        if self._limit is not None and self._bytes < CACHE_BYTES:
            self._frames[key] = found
            self._bytes += sum(image.nbytes for image in found)
        return found


class Division(NamedTuple):
    """Pairs for training and for validation.

    Args:
        words: description of the latter for users.
        share: of each camera's frames in the training scenes, the last ones, that are kept for validation.
    """

    learned: Pairs
    held_out: Pairs
    words: str
    share: float


def divided(everything: list[ScanPairs], splits: Splits, share: float) -> Division:
    """Validation on the scenes set aside for it or, without any, on a share of each camera's frames.

    Raises:
        UsageError: there is no scene to train on.
        BadData: there are no matches to train on.
    """
    aside = {*splits.validation, *splits.test}
    learning = [scan for scan in everything if (scan.name in splits.train if splits.train else scan.name not in aside)]
    validating = [scan for scan in everything if scan.name in splits.validation]
    if not learning:
        raise UsageError("train", "splits", expected="a scene to train on", got="none", fix="see `bask-data split`.")
    if validating:
        learned, held_out, share = _all_pairs(learning), _all_pairs(validating), 0.0
        names = ", ".join(scan.name for scan in validating)
        words = f"held-out scenes: {names} ({len(held_out)} pairs)"
    else:
        learned, held_out, words = _split_by_frame(learning, share)
    if not learned:
        raise BadData(
            learning[0].scan.path,
            "correspondences",
            expected="pairs with matches to train on",
            got=f"none in {', '.join(scan.name for scan in learning)}",
            fix="look at the rejections that `bask-data correspondences` counted, or lower --held-out.",
        )
    return Division(Pairs(learned), Pairs(held_out), words, share)


def _all_pairs(scans: list[ScanPairs]) -> list[tuple[ScanPairs, int]]:
    return [(scan, i) for scan in scans for i in range(len(scan.frames))]


def _split_by_frame(
    scans: list[ScanPairs], share: float
) -> tuple[list[tuple[ScanPairs, int]], list[tuple[ScanPairs, int]], str]:
    """Keep the last frames of each camera for validation: consecutive frames are similar, so they stay together."""
    learned: list[tuple[ScanPairs, int]] = []
    held_out: list[tuple[ScanPairs, int]] = []
    n_held, n_all = 0, 0
    for scan in scans:
        kept = {name: n - round(share * n) for name, n in scan.n_frames.items()}
        n_held += sum(n - kept[name] for name, n in scan.n_frames.items())
        n_all += sum(scan.n_frames.values())
        for i, (camera_a, frame_a, camera_b, frame_b) in enumerate(scan.frames):
            is_known = frame_a < kept[camera_a] and frame_b < kept[camera_b]
            (learned if is_known else held_out).append((scan, i))
    words = f"held-out frames: the last {n_held} of {n_all} ({len(held_out)} pairs), of scenes that were trained on"
    return learned, held_out, words if held_out else "nothing: no scene and no frame with matches was held out"
