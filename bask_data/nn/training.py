"""The training loop: deterministic, resumable, and never waiting for data."""

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
"""The one metric of a validation that is better when smaller."""


@dataclass(frozen=True)
class TrainingSettings:
    """How a network is trained.

    Args:
        loss: `contrastive` is the paper's; `infonce` the cross-entropy of heat maps, which learns faster.
        alpha: temperature of the heat maps that `infonce` trains; the one keypoints are read with.
        match_weight: weight of the matches' z^2 in `infonce`.
        accumulate: parts that a batch is computed in, one after the other, their gradients summed: less memory.
        schedule: `step` multiplies the rate by `decay` every `decay_every` steps, `cosine` lets it fall to zero.
        warmup: steps over which the rate rises from zero.
        frozen_batch_norm: keep the statistics of pretrained weights, which small batches would spoil.
        precision: `auto` is bfloat16 where the hardware computes with it, else float32.
        validate_every: steps between two validations; the last step is always validated.
        best_by: metric of the validation that chooses the step whose weights are kept; None keeps the last.
        patience: validations in a row that may bring nothing better before training ends early; None: any number.
        log_every: steps between two rows of the curve.
        save_share: largest part of the time that goes into saving states. Of a large network one takes seconds.
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
    """What came of a training.

    Args:
        curve: loss terms, rate and validation metrics by step.
        step: steps after which the network had the weights it has; less than were done if it was better then.
        n_steps: steps done; less than asked for if training ended early.
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
    """Train in place; of several processes the first has the weights that validated best, the others the last.

    Interrupted and called again with the same arguments and an untrained network, it goes on from the last saved state
    and ends with the same weights: on a CPU to the bit, with the same number of threads; on a GPU, whose sums are in no
    fixed order, nearly.

    Args:
        state_folder: where the state is saved, and looked for at the start; `remove_state` takes it away when the
            result is safe.
        steps: wraps the range of steps, to show progress.
        watch: told every row of the curve as it comes, and what depends on the machine: speed, and the share of the
            time that was spent waiting for batches.

    Raises:
        FloatingPointError: the loss is no number any more.
        TooManyProcesses: a batch holds fewer pairs.
    """
    run = _Run(network, examples.sample, settings, group, state_folder)

    # Images for a GPU are made there, out of a plan: a CPU would be too slow for it.
    made_of = plan_of_step if network.device.type == "cuda" else batch_of_step

    def make(step: int) -> list[Batch | Plan]:
        source, sample, augment = examples.source, examples.sample, examples.augment
        return [made_of(source, settings.seed, step, sample, augment, part) for part in run.parts]

    numbers = steps(range(run.progress.step, run.last_step))
    with closing(ahead(make, numbers, settings.steps, run.clock.waited)) as made:
        for step, batches in made:
            run.learn(step, batches)
            validates = validate is not None and run.is_at(settings.validate_every)
            if validates or run.is_at(settings.log_every):
                run.round_off(validate if validates else None, watch)
            if run.progress.step >= run.last_step:
                break
    if run.progress.best:
        network.load_state_dict(run.progress.best)
    network.eval()
    return Trained(run.progress.curve, run.progress.best_step or run.progress.step, run.progress.step)


class _Run:
    """A training under way."""

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
        # The mean over a batch's pairs from means over parts; over processes, the mean is taken of what they give.
        self.weights = [len(part) * group.size / sample.n_pairs for part in self.parts]
        network.channels_last()
        # Fused, a step takes a third of the time, which on a CPU is a tenth of everything.
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
        """Where training ends: here, if validation has not got better for long enough."""
        if self.settings.patience is not None:
            since = {step for step, name, _ in self.progress.curve if name == self.settings.best_by}
            if sum(step > self.progress.best_step for step in since) >= self.settings.patience:
                return self.progress.step
        return self.settings.steps

    def is_at(self, every: int) -> bool:
        """Whether so many steps have passed again, or all."""
        return self.progress.step % every == 0 or self.progress.step == self.settings.steps

    def learn(self, step: int, batches: list[Batch | Plan]) -> None:
        """One step of the optimiser."""
        for of_optimiser in self.optimiser.param_groups:
            of_optimiser["lr"] = learning_rate(step, self.settings)
        self.optimiser.zero_grad(set_to_none=True)
        for i, (batch, weight) in enumerate(zip(batches, self.weights, strict=True), start=1):
            with self.group.sending(self.model, i == len(batches)):
                terms = _terms(self.model, _on_device(batch, self.network.device), self.settings)
                (terms.loss * weight).backward()
            # Sums stay on the device: reading a number there would make the CPU wait for it.
            for name, value in terms.logged.items():
                self.sums[name] = self.sums[name] + value if name in self.sums else value
        self.optimiser.step()
        self.progress.step = step + 1

    def round_off(self, validate: Validate | None, watch: Watch) -> None:
        """Enter what happened since the last time into the curve, validate, keep the best, and save."""
        values = self._means() | {"learning_rate": self.optimiser.param_groups[0]["lr"]}
        step, speed = self.progress.step, self.clock.read(self.progress.step)
        if not math.isfinite(values["loss"]):
            raise FloatingPointError(f"loss is {values['loss']} at step {step}; a smaller learning rate may help")
        if validate is not None:
            values |= self.group.told(validate(self.network) if self.group.is_first else {})
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
        """A state lies between two rows of the curve, or the sums would be part of it."""
        due = self.save_took <= self.settings.save_share * (time.monotonic() - self.saved)
        if self.folder is not None and self.group.is_first and (due or self.progress.step >= self.last_step):
            begun = time.monotonic()
            save_state(self.folder, self.network, self.optimiser, self.progress)
            self.saved = time.monotonic()
            self.save_took = self.saved - begun


class _Clock:
    """How fast training is, and how long it waited for batches."""

    def __init__(self, n_images: int, step: int) -> None:
        self.n_images, self.waited = n_images, Waited()
        self.start(step)

    def start(self, step: int) -> None:
        """Measure from here."""
        self._step, self._begun, self._waited = step, time.perf_counter(), self.waited.seconds

    def read(self, step: int) -> dict[str, float]:
        """Since the start."""
        seconds = time.perf_counter() - self._begun
        n_images = self.n_images * (step - self._step)
        found = {
            "images_per_second": n_images / seconds,
            "share_waited": (self.waited.seconds - self._waited) / seconds,
        }
        if torch.cuda.is_available():
            found["gpu_memory_bytes"] = float(torch.cuda.max_memory_allocated())
        return found


def best_step(curve: list[CurveRow], metric: str | None) -> int:
    """The step whose metric is best, the last of several; 0 if there is none."""
    sign = -1 if metric == MEDIAN else 1
    return max(((sign * value, step) for step, name, value in curve if name == metric), default=(0.0, 0))[1]


def learning_rate(step: int, settings: TrainingSettings) -> float:
    """The rate of a step."""
    warm = min(1.0, (step + 1) / (settings.warmup + 1))
    if settings.schedule == "cosine":
        return settings.learning_rate * warm * 0.5 * (1 + math.cos(math.pi * step / settings.steps))
    return settings.learning_rate * warm * settings.decay ** (step // settings.decay_every)


def uses_bfloat16(precision: str, device: torch.device) -> bool:
    """Whether to compute in bfloat16: where asked for, or where the hardware does it natively."""
    if precision != "auto":
        return precision == "bfloat16"
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    # Torch learned to tell in a late version; without, float32 is the safe answer.
    capabilities: dict[str, bool] = getattr(torch.cpu, "get_capabilities", dict)()
    return bool(capabilities.get("avx512_bf16") or capabilities.get("amx_bf16") or capabilities.get("bf16"))


def _on_device(batch: Batch | Plan, device: torch.device) -> list[Tensor]:
    """The fields of a batch as tensors, in order."""
    there = rendered(batch, device) if isinstance(batch, Plan) else batch.on(device)
    return [torch.as_tensor(getattr(there, field.name)) for field in fields(there)]


def _terms(model: nn.Module, batch: list[Tensor], settings: TrainingSettings) -> losses.Terms:
    rgb_a, rgb_b, uv_a, uv_b, others_b, foreground, valid = batch
    with torch.autocast(rgb_a.device.type, torch.bfloat16, enabled=uses_bfloat16(settings.precision, rgb_a.device)):
        cells = model(torch.cat([rgb_a, rgb_b]))
    # Distances are differences of close numbers: they and all that follows are in float32.
    cells_a, cells_b = cells.float().contiguous().chunk(2)
    matches_a, matches_b = sampled(cells_a, uv_a), sampled(cells_b, uv_b)
    if settings.loss == "infonce":
        return losses.infonce(cells_a, cells_b, matches_a, matches_b, uv_a, uv_b, settings.alpha, settings.match_weight)
    others = sampled(cells_b, others_b.flatten(1, 2)).unflatten(1, others_b.shape[1:3])
    return losses.contrastive(matches_a, matches_b, others, foreground, valid, settings.contrastive)
