"""Colours of instances, keypoints and scales."""

from __future__ import annotations

import colorsys

import cv2
import numpy as np

WHITE = (255, 255, 255)
"""Colour of ground-truth positions and outlines; no palette colour is white."""
INVALID = (128, 128, 128)
"""Colour of pixels without measured depth, and of occluded ground truth."""
N_LABEL_COLOURS = 255
"""Number of label colours: an 8-bit label image has no more labels. Larger ids repeat the colours."""
Colour = tuple[int, int, int]


def palette(n: int) -> list[Colour]:
    """n distinct colours that stand out on photographs; a smaller palette begins a larger one."""
    return [_colour(i) for i in range(n)]


def instance_colour(i: int) -> Colour:
    """The colour of an instance, by its id from 1."""
    return _colour((i - 1) % N_LABEL_COLOURS)


def _colour(i: int) -> Colour:
    # Steps of the golden ratio keep each hue away from those just before it.
    red, green, blue = colorsys.hsv_to_rgb((0.02 + i * 0.618034) % 1.0, (0.85, 0.6)[i // 8 % 2], 1.0)
    return round(255 * red), round(255 * green), round(255 * blue)


def css(colour: Colour) -> str:
    """The colour in CSS notation, `#rrggbb`."""
    return "#{:02x}{:02x}{:02x}".format(*colour)


def turbo_gradient() -> str:
    """The colours of `depth_picture`, near to far, as a CSS gradient."""
    return _gradient(cv2.COLORMAP_TURBO)


def heat_gradient() -> str:
    """The colours of `heat_picture`, zero to maximum, as a CSS gradient."""
    return _gradient(cv2.COLORMAP_INFERNO)


def _gradient(colour_map: int) -> str:
    ramp = cv2.applyColorMap(np.linspace(0, 255, 12).astype(np.uint8)[:, None], colour_map)[:, 0]
    return f"linear-gradient(90deg,{','.join(css((int(r), int(g), int(b))) for b, g, r in ramp)})"


def instance_colours(vertex_instance: np.ndarray, vertex_colours: np.ndarray) -> np.ndarray:
    """Vertex colours (n, 3) uint8: instances in their own colours, background in a faint grey of its brightness."""
    grey = vertex_colours.astype(np.float32).mean(axis=1, keepdims=True)
    result = np.repeat(70 + 0.4 * grey, 3, axis=1)
    on_object = vertex_instance > 0
    table = np.array(palette(N_LABEL_COLOURS), np.float32)
    result[on_object] = table[(vertex_instance[on_object] - 1) % N_LABEL_COLOURS]
    return result.astype(np.uint8)
