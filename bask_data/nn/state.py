"""The saved state from which an interrupted training resumes."""

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
"""Best weights so far by validation. The step in the name identifies the state they belong to."""

CurveRow = tuple[int, str, float]


@dataclass
class Progress:
    """Progress of a training, apart from the network and the optimiser.

    Args:
        step: steps done.
        curve: logged values as (step, name, value).
        best_step: number of steps after which validation was best; 0: not yet validated.
        best: the weights at that step, on the CPU.
    """

    step: int = 0
    curve: list[CurveRow] = field(default_factory=list)
    best_step: int = 0
    best: dict[str, Tensor] = field(default_factory=dict)


def copied(network: nn.Module) -> dict[str, Tensor]:
    """A copy of the network's weights on the CPU."""
    return {name: value.detach().cpu().clone().contiguous() for name, value in network.state_dict().items()}


def save_state(folder: Path, network: nn.Module, optimiser: torch.optim.Optimizer, progress: Progress) -> None:
    """Write everything that resuming needs; a kill leaves the previous state or this one."""
    best = folder / BEST.format(step=progress.best_step)
    if progress.best_step and not best.exists():
        _write(best, progress.best, {})
    tensors = {f"network.{name}": value for name, value in network.state_dict().items()}
    for i, state in optimiser.state_dict()["state"].items():
        tensors |= {f"optimiser.{i}.{name}": value for name, value in state.items()}
    metadata = {"step": progress.step, "best_step": progress.best_step, "curve": progress.curve}
    _write(folder / STATE, tensors, {name: json.dumps(value) for name, value in metadata.items()})
    # Not earlier: the previous state needs its own best weights.
    for other in folder.glob(BEST.format(step="*")):
        if other != best:
            other.unlink()


def _write(file: Path, tensors: dict[str, Tensor], metadata: dict[str, str]) -> None:
    written = file.with_suffix(".part")
    save_file({name: value.detach().cpu().contiguous() for name, value in tensors.items()}, written, metadata)
    with written.open("rb") as handle:
        os.fsync(handle.fileno())
    written.replace(file)


def _metadata(opened: safe_open) -> dict[str, Any]:
    """Everything in a state but its tensors."""
    return {name: json.loads(text) for name, text in opened.metadata().items()}


def saved_step(folder: Path) -> int:
    """Steps done when the state in a folder was saved; 0 if there is none."""
    if not (folder / STATE).exists():
        return 0
    with safe_open(folder / STATE, framework="pt") as opened:
        return int(_metadata(opened)["step"])


def remove_damaged_state(folder: Path) -> bool:
    """Delete a corrupted state and return whether there was one. Training then starts over: only time is lost."""
    if not (folder / STATE).exists():
        return False
    try:
        with safe_open(folder / STATE, framework="pt") as opened:
            _, best_step, _ = itemgetter("step", "best_step", "curve")(_metadata(opened))
        if best_step:
            with safe_open(folder / BEST.format(step=best_step), framework="pt"):
                pass
    except Exception:  # safetensors has its own exceptions, and the file may contain anything.
        remove_state(folder)
        return True
    return False


def load_state(folder: Path, network: nn.Module, optimiser: torch.optim.Optimizer) -> Progress:
    """Restore the state saved in a folder into network and optimiser; without one, progress at step 0."""
    if not (folder / STATE).exists():
        return Progress()
    with safe_open(folder / STATE, framework="pt") as opened:
        metadata = _metadata(opened)
        tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
    network.load_state_dict(
        {name.removeprefix("network."): value for name, value in tensors.items() if name.startswith("network.")}
    )
    parameters = [parameter for group in optimiser.param_groups for parameter in group["params"]]
    state = optimiser.state_dict()
    for name, value in tensors.items():
        if name.startswith("optimiser."):
            _, i, key = name.split(".")
            # Moments need the memory layout of their parameter: a fused step traverses all of them in one order.
            like = parameters[int(i)]
            laid_out = torch.empty_like(like).copy_(value) if value.shape == like.shape else value
            state["state"].setdefault(int(i), {})[key] = laid_out
    optimiser.load_state_dict(state)
    best_step = metadata["best_step"]
    return Progress(
        step=metadata["step"],
        curve=[(int(step), str(name), float(value)) for step, name, value in metadata["curve"]],
        best_step=best_step,
        best=load_file(folder / BEST.format(step=best_step)) if best_step else {},
    )


def remove_state(folder: Path) -> None:
    """Delete the files that `save_state` wrote."""
    for file in (folder / STATE, *folder.glob(BEST.format(step="*"))):
        file.unlink(missing_ok=True)


def remove_all_but_state(folder: Path) -> None:
    """Delete what a killed training left half-written, including temporary files of other libraries."""
    kept = {folder / STATE, *folder.glob(BEST.format(step="*"))}
    for path in folder.iterdir():
        if path.is_dir():
            shutil.rmtree(path)
        elif path not in kept:
            path.unlink()
