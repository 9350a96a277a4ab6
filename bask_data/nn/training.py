"""The training loop: deterministic, resumable, and never waiting for data."""

from __future__ import annotations

import json
import math
import os
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

from bask_data.core.geometry import scale_pixels
from bask_data.nn import loss as losses
from bask_data.nn.augment import AugmentSettings
from bask_data.nn.network import DescriptorNetwork, distance_maps
from bask_data.nn.resnet import sampled
from bask_data.nn.sampling import Batch, PairSource, SampleSettings, batch_of_step

PREFETCHED = 3
"""Batches made ahead: enough to bridge a slow one, few enough to cost no memory."""

STATE = "state.safetensors"


@dataclass(frozen=True)
class TrainingSettings:
    """How a network is trained.

    Args:
        loss: `contrastive` is the paper's; `infonce` the cross-entropy of heat maps, which learns faster.
        alpha: temperature of the heat maps that `infonce` trains; the one keypoints are read with.
        match_weight: weight of the matches' z^2 in `infonce`.
        schedule: `step` multiplies the rate by `decay` every `decay_every` steps, `cosine` lets it fall to zero.
        warmup: steps over which the rate rises from zero.
        frozen_batch_norm: keep the statistics of pretrained weights, which small batches would spoil.
        precision: `auto` is bfloat16 where the hardware computes with it, else float32.
    """

    steps: int
    seed: int = 0
    loss: Literal["contrastive", "infonce"] = "contrastive"
    contrastive: losses.ContrastiveSettings = field(default_factory=losses.ContrastiveSettings)
    alpha: float = 4.0
    match_weight: float = 0.1
    learning_rate: float = 1e-4
    weight_decay: float = 1e-4
    schedule: Literal["step", "cosine"] = "step"
    decay: float = 0.9
    decay_every: int = 1000
    warmup: int = 0
    frozen_batch_norm: bool = False
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    validate_every: int = 500
    save_every: int = 100
    log_every: int = 20


CurveRow = tuple[int, str, float]


def train_network(
    network: DescriptorNetwork,
    source: PairSource,
    sample: SampleSettings,
    augment: AugmentSettings,
    settings: TrainingSettings,
    *,
    validate: Callable[[DescriptorNetwork], dict[str, float]] | None = None,
    state_folder: Path | None = None,
    steps: Callable[[range], Iterator[int]] = iter,
) -> list[CurveRow]:
    """Train in place and give the curve: loss terms, rate and validation metrics by step.

    Interrupted and called again with the same arguments and an untrained network, it goes on from the last saved state
    and ends with the same weights, to the bit on one machine and number of threads.

    Args:
        state_folder: where the state is saved, and looked for at the start; `remove_state` takes it away when the
            result is safe.
        steps: wraps the range of steps, to show progress.
    """
    optimiser = torch.optim.Adam(network.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay)
    network.channels_last()
    file = None if state_folder is None else state_folder / STATE
    first, curve = (0, []) if file is None or not file.exists() else load_state(file, network, optimiser)
    summed: dict[str, Tensor] = {}
    n_summed = 0
    for step, batch in _batches(source, sample, augment, settings, steps(range(first, settings.steps))):
        rate = learning_rate(step, settings)
        for group in optimiser.param_groups:
            group["lr"] = rate
        terms = _loss(network, batch, settings)
        optimiser.zero_grad(set_to_none=True)
        terms.loss.backward()
        optimiser.step()
        # Sums stay on the device: reading a number there would make the CPU wait for it.
        for name, value in {"loss": terms.loss.detach(), **terms.logged}.items():
            summed[name] = summed.get(name, 0.0) + value
        n_summed += 1
        done = step + 1
        if done % settings.log_every == 0 or done == settings.steps:
            values = {name: float(value) / n_summed for name, value in summed.items()}
            if not math.isfinite(values["loss"]):
                raise FloatingPointError(f"loss is {values['loss']} at step {done}; a smaller learning rate may help")
            curve += [(done, name, value) for name, value in values.items()]
            curve.append((done, "learning_rate", rate))
            summed, n_summed = {}, 0
        if validate is not None and (done % settings.validate_every == 0 or done == settings.steps):
            curve += [(done, name, value) for name, value in validate(network).items()]
        # A state lies between two rows of the curve, or the sums would be part of it.
        due = done % settings.save_every < settings.log_every
        if file is not None and ((due and done % settings.log_every == 0) or done == settings.steps):
            save_state(file, network, optimiser, done, curve)
    network.eval()
    return curve


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


def _loss(network: DescriptorNetwork, batch: Batch, settings: TrainingSettings) -> losses.Terms:
    device = network.device
    network.train()
    if settings.frozen_batch_norm:
        for module in network.modules():
            if isinstance(module, torch.nn.BatchNorm2d):
                module.eval()
    rgb = torch.from_numpy(np.concatenate([batch.rgb_a, batch.rgb_b])).to(device, non_blocking=True)
    with torch.autocast(device.type, torch.bfloat16, enabled=uses_bfloat16(settings.precision, device)):
        cells = network(rgb)
    # Distances are differences of close numbers: they and all that follows are in float32.
    cells_a, cells_b = cells.float().contiguous().chunk(2)
    uv_a, uv_b = torch.from_numpy(batch.uv_a).to(device), torch.from_numpy(batch.uv_b).to(device)
    matches_a, matches_b = sampled(cells_a, uv_a), sampled(cells_b, uv_b)
    if settings.loss == "infonce":
        return losses.infonce(cells_a, cells_b, matches_a, matches_b, uv_a, uv_b, settings.alpha, settings.match_weight)
    uv_other = torch.from_numpy(batch.non_matches_b).to(device)
    others = sampled(cells_b, uv_other.flatten(1, 2)).unflatten(1, uv_other.shape[1:3])
    foreground, valid = torch.from_numpy(batch.foreground).to(device), torch.from_numpy(batch.valid).to(device)
    return losses.contrastive(matches_a, matches_b, others, foreground, valid, settings.contrastive)


def _batches(
    source: PairSource,
    sample: SampleSettings,
    augment: AugmentSettings,
    settings: TrainingSettings,
    steps: Iterator[int],
) -> Iterator[tuple[int, Batch]]:
    """Batches in order, made by a thread ahead of their use: OpenCV and NumPy let go of the interpreter's lock."""
    threads = 1 if torch.get_num_threads() < 4 else 4

    def make(step: int) -> Batch:
        return batch_of_step(source, settings.seed, step, sample, augment)

    with ThreadPoolExecutor(threads, thread_name_prefix="batches") as pool:
        waiting: dict[int, object] = {}
        try:
            for step in steps:
                for ahead in range(step, min(step + PREFETCHED * threads, settings.steps)):
                    if ahead not in waiting:
                        waiting[ahead] = pool.submit(make, ahead)
                yield step, waiting.pop(step).result()  # type: ignore[attr-defined]
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def save_state(
    file: Path, network: DescriptorNetwork, optimiser: torch.optim.Adam, step: int, curve: list[CurveRow]
) -> None:
    """Write everything training goes on from; a kill leaves the state before or this one."""
    tensors = {f"network.{name}": value for name, value in network.state_dict().items()}
    for i, state in optimiser.state_dict()["state"].items():
        tensors |= {f"optimiser.{i}.{name}": value for name, value in state.items()}
    written = file.with_suffix(".part")
    contiguous = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    save_file(contiguous, written, metadata={"step": str(step), "curve": json.dumps(curve)})
    with written.open("rb") as handle:
        os.fsync(handle.fileno())
    written.replace(file)


def remove_state(folder: Path) -> None:
    """Take away what `save_state` wrote."""
    (folder / STATE).unlink(missing_ok=True)


def remove_all_but_state(folder: Path) -> None:
    """Take away what a killed training left half-written, other libraries' temporary files among it."""
    for left in folder.iterdir():
        if left.is_dir():
            shutil.rmtree(left)
        elif left.name != STATE:
            left.unlink()


def load_state(file: Path, network: DescriptorNetwork, optimiser: torch.optim.Adam) -> tuple[int, list[CurveRow]]:
    """Take over a saved state; gives the number of steps done and the curve so far."""
    with safe_open(file, framework="pt") as opened:
        metadata = opened.metadata()
        tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
    network.load_state_dict(
        {name.removeprefix("network."): value for name, value in tensors.items() if name.startswith("network.")}
    )
    state = optimiser.state_dict()
    for name, value in tensors.items():
        if name.startswith("optimiser."):
            _, i, key = name.split(".")
            state["state"].setdefault(int(i), {})[key] = value
    optimiser.load_state_dict(state)
    curve = [(int(step), str(name), float(value)) for step, name, value in json.loads(metadata["curve"])]
    return int(metadata["step"]), curve


@torch.inference_mode()
def pixel_errors(
    network: DescriptorNetwork, source: PairSource, i_pairs: list[int], n_matches: int
) -> tuple[Float[ndarray, "n"], Float[ndarray, "n"]]:
    """How far the best match lies from the true one, in pixels of the second image and as a share of its diagonal.

    Args:
        n_matches: taken of each pair, evenly over its list.
    """
    pixels, shares = [], []
    for i_pair in i_pairs:
        pair = source.pair(i_pair)
        chosen = np.unique(np.linspace(0, len(pair.instance) - 1, n_matches).round().astype(int))
        queries = network.descriptors_at(pair.rgb_a, pair.uv_a[chosen])
        distances = distance_maps(network.describe(pair.rgb_b), queries)
        best = distances.flatten(1).argmin(dim=1).cpu().numpy()
        size, map_size = pair.rgb_b.shape[:2], (distances.shape[1], distances.shape[2])
        found = np.stack([best % map_size[1], best // map_size[1]], axis=-1).astype(np.float64)
        error = np.linalg.norm(scale_pixels(found, map_size, size) - pair.uv_b[chosen], axis=1)
        pixels.append(error)
        shares.append(error / math.hypot(*size))
    return np.concatenate(pixels), np.concatenate(shares)


def validation_metrics(
    network: DescriptorNetwork, source: PairSource, n_pairs: int = 16, n_matches: int = 64
) -> dict[str, float]:
    """Median pixel error, and the share of matches found within 1, 2, 4 and 8 % of the image's diagonal."""
    i_pairs = np.unique(np.linspace(0, source.n_pairs - 1, n_pairs).round().astype(int)).tolist()
    pixels, shares = pixel_errors(network, source, i_pairs, n_matches)
    metrics = {"validation_median_error_px": float(np.median(pixels))}
    for percent in (1, 2, 4, 8):
        metrics[f"validation_pck_{percent}"] = float((shares <= percent / 100).mean())
    return metrics
