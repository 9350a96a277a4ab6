"""Pixels of augmented images: by OpenCV, or by torch if they are needed on a GPU.

Both give the same image up to the rounding of grey levels.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from functools import cache

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from numpy import ndarray
from torch import Tensor

from bask_data.nn.augment import AugmentedView, Layer
from bask_data.nn.augment_look import GRAIN, grain, grain_of


def drawn(view: AugmentedView) -> UInt8[ndarray, "h w 3"]:
    """The image of a view, rendered by OpenCV."""
    height, width = view.size
    out = np.empty((height, width, 3), np.uint8)
    for layer in view.layers:
        image = cv2.warpAffine(
            layer.picture,
            layer.out_from_picture,
            (width, height),
            flags=cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REFLECT,
        )
        out = image if layer.shown is None else cv2.copyTo(image, layer.shown.view(np.uint8), out)
    look = view.look
    out = cv2.transform(out, look.matrix)
    if look.blur:
        out = cv2.GaussianBlur(out, (_kernel_size(look.blur), _kernel_size(look.blur)), look.blur)
    if look.noise:
        noise = grain_of(out.shape, look.grain) * np.float32(look.noise)
        out = cv2.add(out, noise, dtype=cv2.CV_8U)
    return out


def drawn_on(views: Sequence[AugmentedView], device: torch.device) -> UInt8[Tensor, "b h w 3"]:
    """The images of views of equal size, rendered by torch on a device."""
    height, width = views[0].size
    out = torch.zeros((len(views), 3, height, width), device=device)
    for level in range(max(len(view.layers) for view in views)):
        by_shape = defaultdict(list)
        for i, view in enumerate(views):
            if level < len(view.layers):
                by_shape[view.layers[level].picture.shape].append(i)
        for indices in by_shape.values():
            _composite(out, indices, [views[i].layers[level] for i in indices])
    matrix = to_device(np.stack([view.look.matrix for view in views]).astype(np.float32), device)
    out = (torch.einsum("bij,bjhw->bihw", matrix[..., :3], out) + matrix[..., 3, None, None]).clamp(0, 255)
    blurs = [view.look.blur for view in views]
    if any(blurs):
        out = _blurred(out, blurs)
    pixels = out.permute(0, 2, 3, 1).contiguous()
    noise = np.array([view.look.noise for view in views], np.float32)
    if noise.any():
        first = to_device(np.array([view.look.grain for view in views]), device)
        index = (first[:, None] + torch.arange(pixels[0].numel(), device=device)) % GRAIN
        pixels += _grain_on(device)[index].view(pixels.shape) * to_device(noise, device)[:, None, None, None]
    return pixels.round().clamp(0, 255).to(torch.uint8)


def _composite(out: Float[Tensor, "b 3 h w"], indices: list[int], layers: list[Layer]) -> None:
    """Draw layers with pictures of equal shape over the images with these indices."""
    size = (out.shape[2], out.shape[3])
    pictures = to_device(np.stack([layer.picture for layer in layers]), out.device).permute(0, 3, 1, 2).float()
    theta = np.stack([_theta(layer, size) for layer in layers]).astype(np.float32)
    grid = F.affine_grid(to_device(theta, out.device), [len(layers), 3, *size], align_corners=False)
    images = F.grid_sample(pictures, grid, mode="bilinear", padding_mode="reflection", align_corners=False)
    everywhere = np.ones(size, bool)
    shown = to_device(np.stack([everywhere if layer.shown is None else layer.shown for layer in layers]), out.device)
    index = torch.tensor(indices, device=out.device)
    out[index] = torch.where(shown[:, None], images, out[index])


def _theta(layer: Layer, size: tuple[int, int]) -> Float[ndarray, "2 3"]:
    """`picture_from_view` in torch's coordinates, in which the edges of an image are at -1 and 1."""
    return (_unit_from_pixels(layer.picture.shape[:2]) @ np.linalg.inv(np.vstack([layer.out_from_picture, [0, 0, 1]])))[
        :2
    ] @ np.linalg.inv(_unit_from_pixels(size))


def _unit_from_pixels(size: tuple[int, ...]) -> Float[ndarray, "3 3"]:
    height, width = size
    return np.array([[2 / width, 0, 1 / width - 1], [0, 2 / height, 1 / height - 1], [0, 0, 1]])


def _kernel_size(sigma: float) -> int:
    return 2 * round(3 * sigma) + 1


def _blurred(images: Float[Tensor, "b 3 h w"], blurs: list[float]) -> Float[Tensor, "b 3 h w"]:
    radius = max(_kernel_size(sigma) // 2 for sigma in blurs)
    kernels = np.zeros((len(blurs), 2 * radius + 1), np.float32)
    kernels[:, radius] = 1.0
    for kernel, sigma in zip(kernels, blurs, strict=True):
        if sigma:
            own = _kernel_size(sigma)
            first = radius - own // 2
            kernel[first : first + own] = cv2.getGaussianKernel(own, sigma, cv2.CV_32F)[:, 0]
    n, height, width = len(blurs), images.shape[2], images.shape[3]
    weights = to_device(kernels, images.device).repeat_interleave(3, dim=0)
    flat = F.pad(images.reshape(1, 3 * n, height, width), (radius, radius, radius, radius), mode="reflect")
    flat = F.conv2d(flat, weights[:, None, None, :], groups=3 * n)
    return F.conv2d(flat, weights[:, None, :, None], groups=3 * n).view(n, 3, height, width)


def to_device(array: ndarray, device: torch.device) -> Tensor:
    """The array as a tensor on a device."""
    tensor = torch.from_numpy(array)
    # Only copies from pinned memory are asynchronous.
    return tensor.pin_memory().to(device, non_blocking=True) if device.type == "cuda" else tensor.to(device)


@cache
def _grain_on(device: torch.device) -> Float[Tensor, "n"]:
    return torch.from_numpy(grain().copy()).to(device)
