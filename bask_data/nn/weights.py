"""Files of pretrained weights, read without running what may be in them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import Tensor, nn


def read_weights(file: Path) -> dict[str, Tensor]:
    """Tensors by name from a `.safetensors` file, or a torch file, of which no code is run.

    Raises:
        ValueError: the file holds something else than tensors of finite numbers by name.
    """
    try:
        content = (
            load_file(file)
            if file.suffix == ".safetensors"
            else torch.load(file, map_location="cpu", weights_only=True)
        )
    except Exception as error:  # torch and safetensors raise their own kinds for broken files.
        # By its name: to import the module that has it is forbidden everywhere here.
        if type(error).__name__ == "UnpicklingError":
            raise ValueError("a file that holds code, or something else than tensors; none of it was run") from error
        raise ValueError(f"a file that cannot be read: {str(error)[:300]}") from error
    if isinstance(content, dict) and isinstance(content.get("state_dict"), dict):
        content = content["state_dict"]
    if not isinstance(content, dict) or not all(
        isinstance(name, str) and isinstance(value, Tensor) for name, value in content.items()
    ):
        raise ValueError("expected tensors by name, as torch.save(network.state_dict(), ...) writes them")
    laid_out = next((name for name, value in content.items() if value.layout != torch.strided), None)
    if laid_out is not None:
        raise ValueError(f"{laid_out} is sparse; expected dense tensors")
    spoilt = next((name for name, value in content.items() if not torch.isfinite(value).all()), None)
    if spoilt is not None:
        raise ValueError(f"{spoilt} has numbers that are not finite")
    return dict(content)


def load_weights(encoder: nn.Module, state: Mapping[str, Tensor], ignored: tuple[str, ...] = ()) -> None:
    """Take over pretrained weights; `head`, which is trained here, keeps its random start unless it is given.

    Args:
        ignored: beginnings of names that the file may have and the encoder has not, such as a classifier's.

    Raises:
        ValueError: a parameter has another shape or type, is missing, or there are more. A deeper network of the same
            kind has all a shallower one's names in the same shapes, and would otherwise pass for it.
    """
    own = encoder.state_dict()
    for name in sorted(own.keys() & state.keys()):
        if own[name].shape != state[name].shape:
            raise ValueError(f"{name}: expected shape {tuple(own[name].shape)}, got {tuple(state[name].shape)}")
        # Whole numbers would be taken over in silence: quantised weights without their scale.
        if own[name].is_floating_point() and not state[name].is_floating_point():
            raise ValueError(f"{name}: expected floating-point numbers, got {str(state[name].dtype).split('.')[-1]}")
    # Counters of seen batches came late to published files, and nothing depends on them.
    needed = [name for name in own if not name.startswith("head.") and not name.endswith("num_batches_tracked")]
    missing = [name for name in needed if name not in state]
    if len(missing) == len(needed):
        raise ValueError(f"names such as {min(state, default='none')}, not {needed[0]}")
    if missing:
        raise ValueError(f"{missing[0]} is missing, one of {len(missing)}")
    unknown = [name for name in state if name not in own and not name.startswith(ignored)]
    if unknown:
        raise ValueError(f"{unknown[0]} is not known, one of {len(unknown)}")
    encoder.load_state_dict({**own, **{name: value for name, value in state.items() if name in own}})
