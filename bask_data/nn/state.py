"""What an interrupted training goes on from."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import dataclass, field
from operator import itemgetter
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

STATE = "state.safetensors"
BEST = "best~{step}.safetensors"
"""Weights that validated best so far. The step is in the name, so that a state finds those that belong to it."""

CurveRow = tuple[int, str, float]


@dataclass
class Progress:
    """How far a training has come, beside the network and the optimiser.

    Args:
        step: steps done.
        best_step: after which the network validated best; 0: none is known.
        best: its weights then, on the CPU.
    """

    step: int = 0
    curve: list[CurveRow] = field(default_factory=list)
    best_step: int = 0
    best: dict[str, Tensor] = field(default_factory=dict)


def copied(network: nn.Module) -> dict[str, Tensor]:
    """The network's weights as they are, on the CPU."""
    return {name: value.detach().cpu().clone().contiguous() for name, value in network.state_dict().items()}


def save_state(folder: Path, network: nn.Module, optimiser: torch.optim.Optimizer, progress: Progress) -> None:
    """Write everything training goes on from; a kill leaves the state before or this one."""
    best = folder / BEST.format(step=progress.best_step)
    if progress.best_step and not best.exists():
        _write(best, progress.best, {})
    tensors = {f"network.{name}": value for name, value in network.state_dict().items()}
    for i, state in optimiser.state_dict()["state"].items():
        tensors |= {f"optimiser.{i}.{name}": value for name, value in state.items()}
    metadata = {"step": progress.step, "best_step": progress.best_step, "curve": progress.curve}
    _write(folder / STATE, tensors, {name: json.dumps(value) for name, value in metadata.items()})
    # Only now: the state before this one may have needed other weights.
    for other in folder.glob(BEST.format(step="*")):
        if other != best:
            other.unlink()


def _write(file: Path, tensors: dict[str, Tensor], metadata: dict[str, str]) -> None:
    written = file.with_suffix(".part")
    save_file({name: value.detach().cpu().contiguous() for name, value in tensors.items()}, written, metadata)
    with written.open("rb") as handle:
        os.fsync(handle.fileno())
    written.replace(file)


def _words(opened: safe_open) -> dict[str, Any]:
    """What a state says beside its tensors."""
    return {name: json.loads(text) for name, text in opened.metadata().items()}


def saved_step(folder: Path) -> int:
    """Steps done when the state in a folder was saved; 0 where there is none."""
    if not (folder / STATE).exists():
        return 0
    with safe_open(folder / STATE, framework="pt") as opened:
        return int(_words(opened)["step"])


def remove_damaged_state(folder: Path) -> bool:
    """Take away a saved state that a disk has spoilt; whether there was one. All it costs is time."""
    if not (folder / STATE).exists():
        return False
    try:
        with safe_open(folder / STATE, framework="pt") as opened:
            _, best_step, _ = itemgetter("step", "best_step", "curve")(_words(opened))
        if best_step:
            with safe_open(folder / BEST.format(step=best_step), framework="pt"):
                pass
    except Exception:  # safetensors raises its own kinds, and what it reads may be anything.
        remove_state(folder)
        return True
    return False


def load_state(folder: Path, network: nn.Module, optimiser: torch.optim.Optimizer) -> Progress:
    """Take over the state saved in a folder; the very beginning where there is none."""
    if not (folder / STATE).exists():
        return Progress()
    with safe_open(folder / STATE, framework="pt") as opened:
        metadata = _words(opened)
        tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
    network.load_state_dict(
        {name.removeprefix("network."): value for name, value in tensors.items() if name.startswith("network.")}
    )
    parameters = [parameter for group in optimiser.param_groups for parameter in group["params"]]
    state = optimiser.state_dict()
    for name, value in tensors.items():
        if name.startswith("optimiser."):
            _, i, key = name.split(".")
            # Moments have to lie in memory as their parameter does: a fused step goes through all of them in one order.
            like = parameters[int(i)]
            moved = torch.empty_like(like).copy_(value) if value.shape == like.shape else value
            state["state"].setdefault(int(i), {})[key] = moved
    optimiser.load_state_dict(state)
    best_step = metadata["best_step"]
    return Progress(
        step=metadata["step"],
        curve=[(int(step), str(name), float(value)) for step, name, value in metadata["curve"]],
        best_step=best_step,
        best=load_file(folder / BEST.format(step=best_step)) if best_step else {},
    )


def remove_state(folder: Path) -> None:
    """Take away what `save_state` wrote."""
    for file in (folder / STATE, *folder.glob(BEST.format(step="*"))):
        file.unlink(missing_ok=True)


def remove_all_but_state(folder: Path) -> None:
    """Take away what a killed training left half-written, other libraries' temporary files among it."""
    kept = {folder / STATE, *folder.glob(BEST.format(step="*"))}
    for left in folder.iterdir():
        if left.is_dir():
            shutil.rmtree(left)
        elif left not in kept:
            left.unlink()
