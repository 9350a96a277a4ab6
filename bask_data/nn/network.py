"""Descriptor networks: images in, a descriptor for every pixel out; and descriptors in, distance maps out."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from copy import copy
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from numpy import ndarray
from safetensors.torch import save
from torch import Tensor, nn

from bask_data.core.geometry import scale_pixels
from bask_data.nn.backbones import BACKBONES, Triple, named
from bask_data.nn.resnet import STRIDE, sampled, upsampled
from bask_data.nn.weights import load_weights, read_weights


@dataclass(frozen=True)
class NetworkSettings:
    """Configuration of a network: everything but its weights.

    Args:
        backbone: one of `BACKBONES`.
        descriptor_dim: number of dimensions D of a descriptor.
        height: height that images are resized to, pixels; the width follows from the aspect ratio.
        mean, std: normalisation of the colour channels in [0, 1]. Default: those of the published weights.
    """

    backbone: str
    descriptor_dim: int
    height: int
    mean: Triple | None = None
    std: Triple | None = None


class DescriptorNetwork(nn.Module):
    """A Dense Object Net with the resizing and normalisation of its input.

    Args:
        state: weights, by name, that the encoder reads its sizes from; they are not loaded.

    Raises:
        ValueError: the backbone is unknown.
    """

    def __init__(self, settings: NetworkSettings, state: Mapping[str, Tensor] | None = None) -> None:
        super().__init__()
        backbone = named(settings.backbone)
        self.settings = replace(settings, mean=settings.mean or backbone.mean, std=settings.std or backbone.std)
        self.encoder = backbone.build(settings.descriptor_dim, state or {})
        self._frozen = backbone.frozen
        self.is_folded = False
        if backbone.frozen:
            self.encoder.requires_grad_(False)
            self.encoder.get_submodule("head").requires_grad_(True)

    @property
    def device(self) -> torch.device:
        """Device of the weights."""
        return next(self.encoder.parameters()).device

    def trainable_parameters(self) -> Iterator[nn.Parameter]:
        """Parameters that training changes: only the head's if the encoder is frozen."""
        return (parameter for parameter in self.parameters() if parameter.requires_grad)

    def train(self, mode: bool = True) -> DescriptorNetwork:
        """Set the mode; a frozen encoder stays in evaluation mode, or its batch statistics would drift."""
        super().train(mode)
        if self._frozen:
            self.encoder.eval()
            self.encoder.get_submodule("head").train(mode)
        return self

    def channels_last(self) -> None:
        """Store the weights channels-last, as the images are: faster convolutions on a CPU, no slower on a GPU."""
        for parameter in self.encoder.parameters():
            if parameter.ndim == 4:
                parameter.data = parameter.data.contiguous(memory_format=torch.channels_last)

    def normalised(self, rgb: UInt8[Tensor, "b h w 3"]) -> Float[Tensor, "b 3 h w"]:
        """Images normalised by `mean` and `std`, as the encoder expects them."""
        mean = torch.tensor(self.settings.mean, device=rgb.device) * 255.0
        std = torch.tensor(self.settings.std, device=rgb.device) * 255.0
        # The permuted result is channels-last in memory, with which convolutions on a CPU are faster.
        return ((rgb.float() - mean) / std).permute(0, 3, 1, 2)

    def forward(self, rgb: UInt8[Tensor, "b h w 3"]) -> Float[Tensor, "b d h8 w8"]:
        """Descriptors at stride 8 of images of any size."""
        return self.encoder(self.normalised(rgb))

    def input_size(self, size: tuple[int, int]) -> tuple[int, int]:
        """(height, width) that an image of `size` is resized to: the network's height, the image's aspect ratio."""
        height = self.settings.height
        width = max(round(height * size[1] / size[0] / STRIDE), 1) * STRIDE
        return height, width

    def at_scale(self, scale: float) -> DescriptorNetwork:
        """The same network, with the same weights in memory, for images resized to `scale` times its height.

        Raises:
            ValueError: the scale is not above 0 and at most 1.
        """
        if not 0 < scale <= 1:
            raise ValueError(f"scale: expected above 0 and at most 1, got {scale:g}")
        scaled = copy(self)
        height = max(round(scale * self.settings.height / STRIDE), 1) * STRIDE
        scaled.settings = replace(self.settings, height=height)
        return scaled

    @torch.inference_mode()
    def cells(self, rgb: UInt8[ndarray, "*b h w 3"]) -> Float[Tensor, "*b d h8 w8"]:
        """Descriptors at stride 8 of the resized image: the output of `describe` before up-sampling."""
        images = rgb if rgb.ndim == 4 else rgb[None]
        size = self.input_size(images.shape[1:3])
        resized = np.stack([_resized(image, size) for image in images])
        was_training = self.training
        if was_training:  # Setting the mode of all modules takes milliseconds.
            self.eval()
        cells = self(torch.from_numpy(resized).to(self.device)).float()
        if was_training:
            self.train()
        return cells if rgb.ndim == 4 else cells[0]

    @torch.inference_mode()
    def describe(self, rgb: UInt8[ndarray, "*b h w 3"]) -> Float[Tensor, "*b d h2 w2"]:
        """A descriptor for every pixel of the resized image, whose size is `input_size`."""
        cells = self.cells(rgb)
        size = self.input_size((rgb.shape[-3], rgb.shape[-2]))
        full = upsampled(cells if rgb.ndim == 4 else cells[None], size)
        return full if rgb.ndim == 4 else full[0]

    @torch.inference_mode()
    def descriptors_at(self, rgb: UInt8[ndarray, "h w 3"], uv: Float[ndarray, "m 2"]) -> Float[Tensor, "m d"]:
        """Descriptors at pixels (u, v) of the original image."""
        size = (rgb.shape[0], rgb.shape[1])
        scaled = scale_pixels(uv.astype(np.float64), size, self.input_size(size)).astype(np.float32)
        return sampled(self.cells(rgb)[None], torch.from_numpy(scaled).to(self.device)[None])[0]

    def distance_maps(
        self, rgb: UInt8[ndarray, "*b h w 3"], references: Float[ndarray, "k d"]
    ) -> Float[ndarray, "*b k h2 w2"]:
        """Descriptor distance z of every pixel of the resized image to each reference."""
        return self.maps(self.cells(rgb), references)

    @torch.inference_mode()
    def maps(
        self, cells: Float[Tensor, "*b d h8 w8"], references: Float[ndarray, "k d"]
    ) -> Float[ndarray, "*b k h2 w2"]:
        """The result of `distance_maps` for the images from which `cells` were computed."""
        batch = cells if cells.ndim == 4 else cells[None]
        distances = maps_of_cells(batch, torch.from_numpy(references).to(cells.device)).cpu().numpy()
        return distances if cells.ndim == 4 else distances[0]

    def save(self, folder: Path) -> None:
        """Write `weights.safetensors` and `model.json`.

        Raises:
            ValueError: it is a network for inference, without batch normalisation of its own.
        """
        if self.is_folded:
            expected = "a network with its batch normalisation, from `bask_data.nn.network.load` or `create`"
            raise ValueError(f"network: expected {expected}, got one for inference.  fix: copy the folder it is from.")
        state = {name: value.detach().cpu().contiguous() for name, value in self.encoder.state_dict().items()}
        # `save_file` would create a file that only its owner may read.
        (folder / "weights.safetensors").write_bytes(save(state))
        content = {
            "network": BACKBONES[self.settings.backbone].description,
            "distance": "|a - b| / sqrt(descriptor_dim)",
        }
        text = json.dumps({**content, **asdict(self.settings)}, indent=2, sort_keys=True)
        (folder / "model.json").write_text(text + "\n", encoding="utf-8")


def create(settings: NetworkSettings, seed: int, weights: Path | None = None) -> DescriptorNetwork:
    """An untrained network, determined by the seed.

    Args:
        weights: file of pretrained weights, .safetensors or torch's, with the original publisher's names of tensors.
            Default: the backbone's own, else random ones. Parameters of the head that are not in the file are random.

    Raises:
        ValueError: the backbone is unknown, needs a file, or does not match the file.
    """
    backbone = named(settings.backbone)
    if weights is None and backbone.weights is not None:
        weights = backbone.weights()
    state = {} if weights is None else backbone.renamed(read_weights(weights))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = DescriptorNetwork(settings, state)
    if weights is not None:
        load_weights(network.encoder, state, backbone.ignored)
    return network


def load(folder: Path, device: str | torch.device | None = None) -> DescriptorNetwork:
    """The network that `save` wrote, in evaluation mode.

    Args:
        device: default: the GPU if there is one, else the CPU.

    Raises:
        ValueError: `model.json` is damaged or does not match the weights.
    """
    content = json.loads((folder / "model.json").read_text(encoding="utf-8"))
    missing = [name for name in ("backbone", "descriptor_dim", "height", "mean", "std") if name not in content]
    if missing:
        raise ValueError(f"model.json: {missing[0]}: expected a value, got none")
    height = content["height"]
    if not (isinstance(height, int) and height > 0 and height % STRIDE == 0):
        raise ValueError(f"model.json: height: expected a multiple of {STRIDE}, got {height}")
    if not len(content["mean"]) == len(content["std"]) == 3:
        raise ValueError("model.json: mean, std: expected three numbers each")
    settings = NetworkSettings(
        backbone=content["backbone"],
        descriptor_dim=content["descriptor_dim"],
        height=height,
        mean=tuple(content["mean"]),
        std=tuple(content["std"]),
    )
    state = read_weights(folder / "weights.safetensors")
    network = DescriptorNetwork(settings, state)
    network.channels_last()
    try:
        network.encoder.load_state_dict(state)
    except RuntimeError as error:
        raise ValueError(f"weights.safetensors does not fit model.json: {str(error)[:300]}") from error
    return network.to(best_device() if device is None else device).eval()


def best_device() -> torch.device:
    """The GPU if there is one, else the CPU."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def distance_maps(descriptors: Float[Tensor, "d h w"], references: Float[Tensor, "k d"]) -> Float[Tensor, "k h w"]:
    """z = |a - b| / sqrt(D) of every pixel to each reference, by one matrix product."""
    dimension, height, width = descriptors.shape
    # A common shift does not change distances, and the product is more accurate near the origin.
    centre = references.mean(dim=0)
    pixels, centred = descriptors.flatten(1) - centre[:, None], references - centre
    z_squared = (centred @ pixels).mul_(-2.0)
    z_squared += pixels.square().sum(dim=0)
    z_squared += centred.square().sum(dim=1, keepdim=True)
    return z_squared.clamp_(min=0.0).sqrt_().div_(math.sqrt(dimension)).reshape(-1, height, width)


def maps_of_cells(cells: Float[Tensor, "b d h8 w8"], references: Float[Tensor, "k d"]) -> Float[Tensor, "b k h w"]:
    """Distance maps of the up-sampled descriptors, without up-sampling them.

    A pixel's descriptor is a weighted mean of the four cells around it, p = sum w_i c_i. Its squared distance is thus
    |p - r|^2 = sum w_i |c_i - r|^2 - sum_{i<j} w_i w_j |c_i - c_j|^2: the up-sampled distances of the cells less a term
    that is the same for all references. This up-samples k + 1 maps instead of D.
    """
    n, dimension, height, width = cells.shape
    centre = references.mean(dim=0)
    pixels, centred = (cells - centre[:, None, None]).flatten(2), references - centre
    z_squared = torch.matmul(centred, pixels).mul_(-2.0)
    z_squared += pixels.square().sum(dim=1, keepdim=True)
    z_squared += centred.square().sum(dim=1, keepdim=True)
    size = (STRIDE * height, STRIDE * width)
    full = upsampled(z_squared.div_(dimension).reshape(n, -1, height, width), size)
    full -= _between(cells).div_(dimension)
    return full.clamp_(min=0.0).sqrt_()


def _between(cells: Float[Tensor, "b d h8 w8"]) -> Float[Tensor, "b 1 h w"]:
    """sum_{i<j} w_i w_j |c_i - c_j|^2 over the four cells around each pixel, with its bilinear weights w."""
    padded = F.pad(cells, (1, 1, 1, 1), mode="replicate")
    across = (padded[..., 1:] - padded[..., :-1]).square().sum(dim=1)
    down = (padded[..., 1:, :] - padded[..., :-1, :]).square().sum(dim=1)
    falling = (padded[..., 1:, 1:] - padded[..., :-1, :-1]).square().sum(dim=1)
    rising = (padded[..., 1:, :-1] - padded[..., :-1, 1:]).square().sum(dim=1)
    pairs = torch.stack([across[:, :-1], across[:, 1:], down[..., :-1], down[..., 1:], falling + rising], dim=1)
    # The weights are the same between any four cells.
    to_next = (torch.arange(STRIDE, device=cells.device) + 0.5) / STRIDE
    a, b = to_next.repeat(STRIDE), to_next.repeat_interleave(STRIDE)
    at, bt = a * (1 - a), b * (1 - b)
    weights = torch.stack([at * (1 - b) ** 2, at * b**2, bt * (1 - a) ** 2, bt * a**2, at * bt], dim=1)
    half = STRIDE // 2
    return F.pixel_shuffle(torch.einsum("pf,bfhw->bphw", weights, pairs), STRIDE)[..., half:-half, half:-half]


def best_matches(distances: Float[Tensor, "k h w"], size: tuple[int, int]) -> Float[ndarray, "k 2"]:
    """The pixel (u, v) of least distance in each map, in pixels of the image of `size` (height, width)."""
    height, width = distances.shape[1:]
    best = distances.flatten(1).argmin(dim=1).cpu().numpy()
    return scale_pixels(np.stack([best % width, best // width], axis=-1).astype(np.float64), (height, width), size)


def _resized(rgb: UInt8[ndarray, "h w 3"], size: tuple[int, int]) -> UInt8[ndarray, "h2 w2 3"]:
    if rgb.shape[:2] == size:
        return np.ascontiguousarray(rgb)
    # Area averaging keeps the edges of the image in place, as scale_pixels assumes, and avoids aliasing.
    shrinking = size[0] < rgb.shape[0]
    return cv2.resize(rgb, (size[1], size[0]), interpolation=cv2.INTER_AREA if shrinking else cv2.INTER_LINEAR)
