"""The descriptor network."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import Field

from bask_data.errors import BadData, UsageError
from bask_data.kinds import Correspondences, DescriptorNet, Scan, VisibleMasks
from bask_data.stage import Params, Splits, progress, stage

if TYPE_CHECKING:
    import numpy as np

    from bask_data.nn.network import DescriptorNetwork
    from bask_data.nn.sampling import Pair

MATCHES_KEPT = 1000
"""Matches of a pair held in memory; a step uses a tenth of them."""

CACHE_BYTES = 1 << 30
"""Memory for shrunk frames."""


class TrainParams(Params):
    """The network and how it is trained. The defaults learn from scratch in minutes on a laptop's CPU."""

    backbone: Literal["resnet18", "resnet34", "resnet50", "resnet101"] = Field("resnet18", description="The network.")
    descriptor_dim: int = Field(16, ge=1, description="Numbers in a descriptor.")
    weights: str | None = Field(
        None,
        description="File of pretrained weights under torchvision's names (.pth or .safetensors). Default: random.",
        json_schema_extra={"file": True},
    )
    image_height: int = Field(
        120, ge=16, multiple_of=8, description="Height images are resized to for the network, pixels."
    )
    steps: int = Field(1000, ge=1, description="Optimiser steps.")
    seed: int = Field(0, ge=0, description="Seed of the weights and of all batches.")
    loss: Literal["infonce", "contrastive"] = Field(
        "infonce",
        description="infonce: cross-entropy of heat maps, learns fast. contrastive: margins, as in the paper.",
    )
    alpha: float = Field(4.0, gt=0, description="infonce: temperature of the heat maps, that of `encode`.")
    match_weight: float = Field(0.1, ge=0, description="infonce: weight of the squared distance of matches.")
    margin_foreground: float = Field(0.25, ge=0, description="contrastive: margin to other pixels of the object.")
    margin_background: float = Field(0.75, ge=0, description="contrastive: margin to pixels off the object.")
    hinge: Literal["squared", "plain"] = Field(
        "squared", description="contrastive: max(0, M - z^2), as in the paper, or max(0, M - z)^2."
    )
    hard_negatives: bool = Field(False, description="contrastive: mean over the non-matches inside the margin only.")
    pairs_per_step: int = Field(2, ge=1, description="Image pairs in a batch.")
    matches: int = Field(128, ge=1, description="Matches of a pair.")
    non_matches: int = Field(150, ge=1, description="contrastive: non-matches of each match.")
    foreground_share: float | None = Field(
        None,
        ge=0,
        le=1,
        description="contrastive: share of non-matches on the object. Default: the share of the image it covers.",
    )
    clearance: float = Field(
        5.0, ge=0, description="contrastive: no non-match is as close to the true match, pixels of the network's input."
    )
    learning_rate: float = Field(1e-3, gt=0, description="Adam's rate.")
    weight_decay: float = Field(1e-4, ge=0, description="Adam's weight decay.")
    schedule: Literal["cosine", "step"] = Field("cosine", description="How the rate falls.")
    decay: float = Field(0.9, gt=0, le=1, description="step: factor on the rate.")
    decay_every: int = Field(1000, ge=1, description="step: steps between two factors.")
    warmup: int = Field(20, ge=0, description="Steps over which the rate rises from zero.")
    frozen_batch_norm: bool = Field(False, description="Keep the batch statistics of the pretrained weights.")
    zoom: tuple[float, float] = Field(
        (0.7, 2.0), description="Smallest and largest magnification; 2 shows a crop of half the image."
    )
    rotation_deg: float = Field(20.0, ge=0, le=180, description="Largest rotation of an image, degrees.")
    flip: float = Field(0.0, ge=0, le=1, description="Probability that a pair is mirrored.")
    background: float = Field(
        0.3, ge=0, le=1, description="Probability that everything off the objects is painted over."
    )
    colour: float = Field(
        0.5, ge=0, description="Largest change of brightness, contrast and saturation, as a logarithm."
    )
    hue_deg: float = Field(11.0, ge=0, le=180, description="Largest turn of the colours, degrees.")
    noise: float = Field(6.0, ge=0, description="Largest standard deviation of pixel noise, grey levels.")
    held_out: float = Field(
        0.15,
        ge=0,
        lt=1,
        description="Without scenes for validation: share of each camera's frames, the last, kept from training.",
    )
    precision: Literal["auto", "float32", "bfloat16"] = Field(
        "auto", description="Of the convolutions in training. auto: bfloat16 where the hardware has it."
    )


@stage(makes=DescriptorNet, version=1, resumable=True)
def train(
    scans: list[Scan],
    masks: list[VisibleMasks],
    correspondences: list[Correspondences],
    splits: Splits,
    params: TrainParams,
    out: Path,
) -> None:
    """Train a Dense Object Net on the matches of all scans.

    It is validated on the scenes that `bask-data split` sets aside, or without any, on frames that are kept from
    training. Interrupted, it goes on from the last saved step. A GPU is used where there is one.
    """
    from bask_data.nn import training
    from bask_data.nn.augment import AugmentSettings
    from bask_data.nn.loss import ContrastiveSettings
    from bask_data.nn.network import best_device
    from bask_data.nn.sampling import SampleSettings

    if not 0 < params.zoom[0] <= params.zoom[1]:
        raise UsageError("train", "zoom", expected="0 < smallest <= largest", got=f"{params.zoom[0]},{params.zoom[1]}")
    training.remove_all_but_state(out)
    network = _network(params).to(best_device())
    everything = [ScanPairs(*inputs) for inputs in zip(scans, masks, correspondences, strict=True)]
    learned, held_out, validated_on = _divided(everything, splits, params.held_out)
    size = network.input_size(learned.image_size)
    learned.shrink_to((2 * size[0], 2 * size[1]))
    settings = training.TrainingSettings(
        steps=params.steps,
        seed=params.seed,
        loss=params.loss,
        contrastive=ContrastiveSettings(
            params.margin_foreground, params.margin_background, params.hinge, params.hard_negatives
        ),
        alpha=params.alpha,
        match_weight=params.match_weight,
        learning_rate=params.learning_rate,
        weight_decay=params.weight_decay,
        schedule=params.schedule,
        decay=params.decay,
        decay_every=params.decay_every,
        warmup=params.warmup,
        frozen_batch_norm=params.frozen_batch_norm,
        precision=params.precision,
        validate_every=max(params.steps // 5, 1),
    )
    sample = SampleSettings(
        size=size,
        n_pairs=params.pairs_per_step,
        n_matches=params.matches,
        n_non_matches=params.non_matches if params.loss == "contrastive" else 0,
        foreground_share="auto" if params.foreground_share is None else params.foreground_share,
        clearance=params.clearance,
    )
    augment = AugmentSettings(
        zoom=params.zoom,
        rotation=params.rotation_deg * 3.141592653589793 / 180,
        flip=params.flip,
        background=params.background,
        brightness=params.colour,
        contrast=params.colour,
        saturation=params.colour,
        hue=params.hue_deg * 3.141592653589793 / 180,
        noise=params.noise,
    )

    def validate(network: DescriptorNetwork) -> dict[str, float]:
        return training.validation_metrics(network, held_out) if held_out.n_pairs else {}

    try:
        curve = training.train_network(
            network,
            learned,
            sample,
            augment,
            settings,
            validate=validate,
            state_folder=out,
            steps=lambda numbers: progress(numbers, "training"),
        )
    except FloatingPointError as error:
        training.remove_state(out)
        raise UsageError("train", "learning_rate", got=str(error), fix="try a smaller one.") from error
    network.save(out)
    last = {name: value for step, name, value in curve if step == params.steps and name != "learning_rate"}
    DescriptorNet.write(out, validated_on=validated_on, metrics=last, curve=curve)
    training.remove_state(out)


def _network(params: TrainParams) -> DescriptorNetwork:
    from bask_data.nn.network import NetworkSettings, create

    settings = NetworkSettings(params.backbone, params.descriptor_dim, params.image_height)
    if params.weights is None:
        return create(settings, params.seed)
    file = Path(params.weights)
    if not file.is_file():
        raise UsageError("train", "weights", expected="a file", got=file, fix="give its path, or leave it out.")
    try:
        return create(settings, params.seed, file)
    except ValueError as error:
        fix = "choose the --backbone the file was made for."
        raise BadData(file, "", expected=f"weights of a {params.backbone}", got=str(error), fix=fix) from error


class ScanPairs:
    """The pairs of one scan, frames read as they are needed."""

    def __init__(self, scan: Scan, masks: VisibleMasks, correspondences: Correspondences) -> None:
        self.name = scan.path.name
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
            # Matches were drawn at random, so any part of them is a fair one; evenly spaced, it needs no chance.
            rows = np.unique(np.linspace(first, end - 1, min(end - first, MATCHES_KEPT)).round().astype(int))
            a = np.stack([columns["u_a"][rows], columns["v_a"][rows]], axis=-1)
            b = np.stack([columns["u_b"][rows], columns["v_b"][rows]], axis=-1)
            self.frames.append((pair["camera_a"], pair["frame_a"], pair["camera_b"], pair["frame_b"]))
            self.matches.append((columns["instance"][rows].astype(np.uint8), a, b))
        self.n_instances = len(np.unique(columns["instance"]))

    def frame(self, camera: str, i_frame: int, limit: tuple[int, int] | None) -> tuple[np.ndarray, np.ndarray]:
        """Colour and instances of a frame, shrunk to `limit` (height, width) or as they are."""
        import cv2
        import numpy as np

        rgb, instance = self._cameras[camera].rgb(i_frame), self._masks[camera].instance(i_frame)
        size = self.shrunk_size(camera, limit)
        if size != rgb.shape[:2]:
            rgb = cv2.resize(rgb, size[::-1], interpolation=cv2.INTER_AREA)
            instance = cv2.resize(instance, size[::-1], interpolation=cv2.INTER_NEAREST_EXACT)
        return np.ascontiguousarray(rgb), np.ascontiguousarray(instance)

    def shrunk_size(self, camera: str, limit: tuple[int, int] | None) -> tuple[int, int]:
        """Size of a camera's frames at most as large as `limit` in height or width, the shape kept."""
        height, width = self.sizes[camera]
        factor = 1.0 if limit is None else min(max(limit[0] / height, limit[1] / width), 1.0)
        return round(height * factor), round(width * factor)


class Pairs:
    """Some pairs of some scans: a `PairSource`."""

    def __init__(self, chosen: list[tuple[ScanPairs, int]]) -> None:
        import numpy as np

        self._chosen = chosen
        self.scans = np.unique([scan.name for scan, _ in chosen], return_inverse=True)[1]
        self.n_instances = np.array([scan.n_instances for scan, _ in chosen], int)
        self._limit: tuple[int, int] | None = None
        self._frames: dict[tuple[str, str, int], tuple[np.ndarray, np.ndarray]] = {}
        self._bytes = 0

    @property
    def n_pairs(self) -> int:
        return len(self._chosen)

    @property
    def image_size(self) -> tuple[int, int]:
        """(height, width) of the first image."""
        scan, i = self._chosen[0]
        return scan.sizes[scan.frames[i][0]]

    def shrink_to(self, limit: tuple[int, int]) -> None:
        """Give frames no larger than `limit`, and keep as many in memory as fit."""
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
        # What is full stays as it is: to drop frames for others that are as likely to be needed gains nothing.
        if self._limit is not None and self._bytes < CACHE_BYTES:
            self._frames[key] = found
            self._bytes += sum(image.nbytes for image in found)
        return found


def _divided(everything: list[ScanPairs], splits: Splits, share: float) -> tuple[Pairs, Pairs, str]:
    """Pairs to learn from, pairs to validate on, and what the latter are, in words."""
    aside = {*splits.validation, *splits.test}
    learning = [scan for scan in everything if (scan.name in splits.train if splits.train else scan.name not in aside)]
    validating = [scan for scan in everything if scan.name in splits.validation]
    if not learning:
        raise UsageError("train", "splits", expected="a scene to train on", got="none", fix="see `bask-data split`.")
    if validating:
        learned, held_out = _all_pairs(learning), _all_pairs(validating)
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
    return Pairs(learned), Pairs(held_out), words


def _all_pairs(scans: list[ScanPairs]) -> list[tuple[ScanPairs, int]]:
    return [(scan, i) for scan in scans for i in range(len(scan.frames))]


def _split_by_frame(
    scans: list[ScanPairs], share: float
) -> tuple[list[tuple[ScanPairs, int]], list[tuple[ScanPairs, int]], str]:
    """The last frames of each camera are kept from training: neighbours in time look alike, so they go together."""
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
