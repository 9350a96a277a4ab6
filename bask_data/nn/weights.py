"""Files of pretrained weights, read without executing code in them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import Tensor, nn


def read_weights(file: Path) -> dict[str, Tensor]:
    """Tensors by name from a `.safetensors` file or a torch file, whose code is not executed.

    Raises:
        ValueError: the file contains anything other than named dense tensors of finite numbers.
    """
    try:
        content = (
            load_file(file)
            if file.suffix == ".safetensors"
            else torch.load(file, map_location="cpu", weights_only=True)
        )
    except Exception as error:  # torch and safetensors have their own exceptions for broken files.
        # Compared by name: importing `pickle`, which defines it, is forbidden in this package.
        if type(error).__name__ == "UnpicklingError":
            raise ValueError("a file that contains code or other objects; nothing in it was executed") from error
        raise ValueError(f"a file that cannot be read: {str(error)[:300]}") from error
    if isinstance(content, dict) and isinstance(content.get("state_dict"), dict):
        content = content["state_dict"]
    if not isinstance(content, dict) or not all(
        isinstance(name, str) and isinstance(value, Tensor) for name, value in content.items()
    ):
        raise ValueError("expected tensors by name, as torch.save(network.state_dict(), ...) writes them")
    sparse = next((name for name, value in content.items() if value.layout != torch.strided), None)
    if sparse is not None:
        raise ValueError(f"{sparse} is sparse; expected dense tensors")
    not_finite = next((name for name, value in content.items() if not torch.isfinite(value).all()), None)
    if not_finite is not None:
        raise ValueError(f"{not_finite} contains values that are not finite")
    return dict(content)


def load_weights(encoder: nn.Module, state: Mapping[str, Tensor], ignored: tuple[str, ...] = ()) -> None:
    """Load pretrained weights; `head` keeps its random initialisation unless the weights include it.

    Args:
        ignored: prefixes of names in `state` that the encoder does not have, such as a classifier's.

    Raises:
        ValueError: a parameter has another shape or type, is missing, or is unknown. Unknown ones are refused because
            a deeper network has all names of a shallower one, with the same shapes, and would be taken for it.
    """
    own = encoder.state_dict()
    for name in sorted(own.keys() & state.keys()):
        if own[name].shape != state[name].shape:
            raise ValueError(f"{name}: expected shape {tuple(own[name].shape)}, got {tuple(state[name].shape)}")
        # Integers would be converted silently: quantised weights without their scale.
        if own[name].is_floating_point() and not state[name].is_floating_point():
            raise ValueError(f"{name}: expected floating-point numbers, got {str(state[name].dtype).split('.')[-1]}")
    # Older published files have no counters of batches, and nothing depends on these.
    needed = [name for name in own if not name.startswith("head.") and not name.endswith("num_batches_tracked")]
    missing = [name for name in needed if name not in state]
    if len(missing) == len(needed):
        raise ValueError(f"names such as {min(state, default='none')}, not {needed[0]}")
    if missing:
        raise ValueError(f"weights without {missing[0]} ({len(missing)} tensors are missing)")
    unknown = [name for name in state if name not in own and not name.startswith(ignored)]
    if unknown:
        raise ValueError(f"weights with {unknown[0]} ({len(unknown)} tensors are unknown)")
    encoder.load_state_dict({**own, **{name: value for name, value in state.items() if name in own}})
