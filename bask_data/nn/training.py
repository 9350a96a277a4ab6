"""The training loop: deterministic, resumable, with batches prefetched."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor, nn

from bask_data.nn import loss as losses
from bask_data.nn.loading import Waited, ahead
from bask_data.nn.network import DescriptorNetwork
from bask_data.nn.processes import ALONE, Group
from bask_data.nn.resnet import sampled
from bask_data.nn.sampling import Batch, Examples, Plan, SampleSettings, batch_of_step, plan_of_step, rendered
from bask_data.nn.state import CurveRow, Progress, copied, load_state, save_state

MEDIAN = "validation_median_error_px"
"""The only validation metric for which lower is better."""


@dataclass(frozen=True)
class TrainingSettings:
    """Settings of the training loop.

    Args:
        contrastive: margins and form of the `contrastive` loss.
        loss: `contrastive` is the paper's; `infonce` is the cross-entropy of heat maps, which learns faster.
        alpha: temperature of the heat maps that `infonce` trains; the same as for keypoints.
        match_weight: weight of the matches' z^2 in `infonce`.
        accumulate: parts in which a batch is computed in sequence, with gradients accumulated, to save memory.
        schedule: `step` multiplies the learning rate by `decay` every `decay_every` steps; `cosine` anneals it to zero.
        warmup: steps over which the learning rate rises from zero.
        frozen_batch_norm: keep the batch statistics of pretrained weights; those of small batches are poor.
        precision: `auto` is bfloat16 if the hardware supports it natively, else float32.
        validate_every: steps between validations; the last step is always validated.
        best_by: validation metric by which the weights are selected; None keeps the last.
        patience: validations without improvement after which training stops early; None: never.
        log_every: steps between two rows of the curve.
        save_share: largest share of the time spent on saving states; for a large network one takes seconds.
    """

    steps: int
    seed: int = 0
    loss: Literal["contrastive", "infonce"] = "contrastive"
    contrastive: losses.ContrastiveSettings = field(default_factory=losses.ContrastiveSettings)
    alpha: float = 4.0
    match_weight: float = 0.1
    accumulate: int = 1
    learning_rate: float = 1e-4
    weight_decay: float = 1e-4
    schedule: Literal["step", "cosine"] = "step"
    decay: float = 0.9
    decay_every: int = 1000
    warmup: int = 0
    frozen_batch_norm: bool = False
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    validate_every: int = 500
    best_by: str | None = "validation_pck_4"
    patience: int | None = None
    log_every: int = 20
    save_share: float = 0.05


Validate = Callable[[DescriptorNetwork], dict[str, float]]
Watch = Callable[[int, dict[str, float]], None]


@dataclass(frozen=True)
class Trained:
    """Result of a training.

    Args:
        curve: loss terms, learning rate and validation metrics as (step, name, value).
        step: step of the selected weights; earlier than the last if validation was better then.
        n_steps: steps done; fewer than requested if training stopped early.
    """

    curve: list[CurveRow]
    step: int
    n_steps: int


def train_network(
    network: DescriptorNetwork,
    examples: Examples,
    settings: TrainingSettings,
    *,
    validate: Validate | None = None,
    state_folder: Path | None = None,
    steps: Callable[[range], Iterator[int]] = iter,
    watch: Watch = lambda step, values: None,
    group: Group = ALONE,
) -> Trained:
    """Train a network in place; of several processes the first ends with the selected weights, others with the last.

    If interrupted and called again with the same arguments and an untrained network, training resumes from the last
    saved state and ends with the same weights: bit-identical on a CPU with the same number of threads, nearly so on a
    GPU, whose order of summation varies.

    Args:
        validate: computes the validation metrics, in the first process; None: no validation.
        state_folder: folder of the saved state, read at the start; delete the state with `remove_state` when the result
            is stored.
        steps: wraps the range of steps, to show progress.
        watch: called with the step and each row of the curve, to which it adds speed and the share of the time spent
            waiting for batches; these depend on the machine and are not part of the curve.

    Raises:
        FloatingPointError: the loss is not finite.
        TooManyProcesses: there are more processes than pairs in a batch.
    """
    run = _Run(network, examples.sample, settings, group, state_folder)

    # Images for a GPU are rendered there from a plan: a CPU would be too slow.
    batch_or_plan = plan_of_step if network.device.type == "cuda" else batch_of_step

    def make(step: int) -> list[Batch | Plan]:
        source, sample, augment = examples.source, examples.sample, examples.augment
        return [batch_or_plan(source, settings.seed, step, sample, augment, part) for part in run.parts]

    numbers = steps(range(run.progress.step, run.last_step))
    with closing(ahead(make, numbers, settings.steps, run.clock.waited)) as prefetched:
        for step, batches in prefetched:
            run.train_step(step, batches)
            validates = validate is not None and run.is_at(settings.validate_every)
            if validates or run.is_at(settings.log_every):
                run.record(validate if validates else None, watch)
            if run.progress.step >= run.last_step:
                break
    if run.progress.best:
        network.load_state_dict(run.progress.best)
    network.eval()
    return Trained(run.progress.curve, run.progress.best_step or run.progress.step, run.progress.step)


class _Run:
    """State of a running training."""

    def __init__(
        self,
        network: DescriptorNetwork,
        sample: SampleSettings,
        settings: TrainingSettings,
        group: Group,
        folder: Path | None,
    ) -> None:
        self.network, self.settings, self.group, self.folder = network, settings, group, folder
        self.parts = group.share_of(sample.n_pairs, settings.accumulate)
        # Weights of the parts' means in the mean over the batch's pairs; gradients are averaged over processes.
        self.weights = [len(part) * group.size / sample.n_pairs for part in self.parts]
        network.channels_last()
        # Fused, the optimiser takes a third of the time; on a CPU it is a tenth of a training step.
        self.optimiser = torch.optim.Adam(
            network.trainable_parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay, fused=True
        )
        self.progress = Progress() if folder is None else load_state(folder, network, self.optimiser)
        self.model = group.wrapped(network)
        self.sums: dict[str, Tensor] = {}
        self.clock = _Clock(2 * sample.n_pairs, self.progress.step)
        self.saved, self.save_took = time.monotonic(), 0.0
        self._set_modes()

    def _set_modes(self) -> None:
        self.network.train()
        if self.settings.frozen_batch_norm:
            for module in self.network.modules():
                if isinstance(module, torch.nn.BatchNorm2d):
                    module.eval()

    @property
    def last_step(self) -> int:
        """Step at which training ends: the current one if patience is exhausted."""
        if self.settings.patience is not None:
            validated = {step for step, name, _ in self.progress.curve if name == self.settings.best_by}
            if sum(step > self.progress.best_step for step in validated) >= self.settings.patience:
                return self.progress.step
        return self.settings.steps

    def is_at(self, every: int) -> bool:
        """Whether the number of steps done is a multiple of `every`, or the last."""
        return self.progress.step % every == 0 or self.progress.step == self.settings.steps

    def train_step(self, step: int, batches: list[Batch | Plan]) -> None:
        """One optimiser step on a batch, given in parts."""
        for parameters in self.optimiser.param_groups:
            parameters["lr"] = learning_rate(step, self.settings)
        self.optimiser.zero_grad(set_to_none=True)
        for i, (batch, weight) in enumerate(zip(batches, self.weights, strict=True), start=1):
            with self.group.exchanging(self.model, i == len(batches)):
                terms = _terms(self.model, _on_device(batch, self.network.device), self.settings)
                (terms.loss * weight).backward()
            # Sums stay on the device: reading a number would synchronise with it.
            for name, value in terms.logged.items():
                self.sums[name] = self.sums[name] + value if name in self.sums else value
        self.optimiser.step()
        self.progress.step = step + 1

    def record(self, validate: Validate | None, watch: Watch) -> None:
        """Add a row to the curve for the steps since the last one, validate, keep the best weights, and save."""
        values = self._means() | {"learning_rate": self.optimiser.param_groups[0]["lr"]}
        step, speed = self.progress.step, self.clock.read(self.progress.step)
        if not math.isfinite(values["loss"]):
            raise FloatingPointError(f"loss is {values['loss']} at step {step}; a smaller learning rate may help")
        if validate is not None:
            values |= self.group.broadcast(validate(self.network) if self.group.is_first else {})
            self._set_modes()
        self.progress.curve += [(step, name, value) for name, value in values.items()]
        if best_step(self.progress.curve, self.settings.best_by) == step:
            self.progress.best_step = step
            self.progress.best = copied(self.network) if self.group.is_first else {}
        watch(step, values | speed)
        self._save()
        self.clock.start(step)

    def _means(self) -> dict[str, float]:
        summed = self.group.summed(torch.stack(list(self.sums.values()))).tolist()
        means = {name: value / max(count, 1) for name, (value, count) in zip(self.sums, summed, strict=True)}
        self.sums = {}
        return means

    def _save(self) -> None:
        """Save the state, if due. Always right after a row of the curve, so that the sums need not be saved."""
        due = self.save_took <= self.settings.save_share * (time.monotonic() - self.saved)
        if self.folder is not None and self.group.is_first and (due or self.progress.step >= self.last_step):
            begun = time.monotonic()
            save_state(self.folder, self.network, self.optimiser, self.progress)
            self.saved = time.monotonic()
            self.save_took = self.saved - begun


class _Clock:
    """Speed of training and time spent waiting for batches, since `start`."""

    def __init__(self, n_images: int, step: int) -> None:
        self.n_images, self.waited = n_images, Waited()
        self.start(step)

    def start(self, step: int) -> None:
        """Restart the measurement."""
        self._step, self._begun, self._waited = step, time.perf_counter(), self.waited.seconds

    def read(self, step: int) -> dict[str, float]:
        """Speed, share of the time spent waiting, and peak GPU memory."""
        seconds = time.perf_counter() - self._begun
        n_images = self.n_images * (step - self._step)
        values = {
            "images_per_second": n_images / seconds,
            "share_waited": (self.waited.seconds - self._waited) / seconds,
        }
        if torch.cuda.is_available():
            values["gpu_memory_bytes"] = float(torch.cuda.max_memory_allocated())
        return values


def best_step(curve: list[CurveRow], metric: str | None) -> int:
    """The step with the best metric, the last of equal ones; 0 if there is none."""
    sign = -1 if metric == MEDIAN else 1
    return max(((sign * value, step) for step, name, value in curve if name == metric), default=(0.0, 0))[1]


def learning_rate(step: int, settings: TrainingSettings) -> float:
    """Learning rate of a step."""
    warm = min(1.0, (step + 1) / (settings.warmup + 1))
    if settings.schedule == "cosine":
        return settings.learning_rate * warm * 0.5 * (1 + math.cos(math.pi * step / settings.steps))
    return settings.learning_rate * warm * settings.decay ** (step // settings.decay_every)


def uses_bfloat16(precision: str, device: torch.device) -> bool:
    """Whether to compute in bfloat16: if requested, or if `auto` and the hardware supports it natively."""
    if precision != "auto":
        return precision == "bfloat16"
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    # Older versions of torch cannot tell; float32 is then the safe choice.
    capabilities: dict[str, bool] = getattr(torch.cpu, "get_capabilities", dict)()
    return bool(capabilities.get("avx512_bf16") or capabilities.get("amx_bf16") or capabilities.get("bf16"))


def _on_device(batch: Batch | Plan, device: torch.device) -> list[Tensor]:
    """The fields of a batch as tensors, in order."""
    tensors = rendered(batch, device) if isinstance(batch, Plan) else batch.on(device)
    return [torch.as_tensor(getattr(tensors, field.name)) for field in fields(tensors)]


def _terms(model: nn.Module, batch: list[Tensor], settings: TrainingSettings) -> losses.Terms:
    rgb_a, rgb_b, uv_a, uv_b, others_b, foreground, valid = batch
    with torch.autocast(rgb_a.device.type, torch.bfloat16, enabled=uses_bfloat16(settings.precision, rgb_a.device)):
        cells = model(torch.cat([rgb_a, rgb_b]))
    # Distances are differences of close numbers, so they and the loss are computed in float32.
    cells_a, cells_b = cells.float().contiguous().chunk(2)
    matches_a, matches_b = sampled(cells_a, uv_a), sampled(cells_b, uv_b)
    if settings.loss == "infonce":
        return losses.infonce(cells_a, cells_b, matches_a, matches_b, uv_a, uv_b, settings.alpha, settings.match_weight)
    others = sampled(cells_b, others_b.flatten(1, 2)).unflatten(1, others_b.shape[1:3])
    return losses.contrastive(matches_a, matches_b, others, foreground, valid, settings.contrastive)
