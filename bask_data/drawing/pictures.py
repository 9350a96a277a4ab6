"""Pictures of colour, depth, masks, matches, heat maps and keypoints, and their data URIs."""

from __future__ import annotations

import base64
import colorsys
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from bask_data.core.geometry import scale_pixels

WHITE = (255, 255, 255)
"""Colour of ground-truth positions and outlines; no palette colour is white."""
INVALID = (128, 128, 128)
"""Colour of pixels without measured depth, and of occluded ground truth."""
HATCH, HATCH_PX = (24, 24, 24), 6
"""Colour of the hatching over parts of masks that no depth confirms, and its period in pixels."""
RING_PX = 7.0
"""Radius of the ring around a best match, pixels."""
N_LABEL_COLOURS = 255
"""Number of label colours: an 8-bit label image has no more labels. Larger ids repeat the colours."""
_SUBPIXEL_BITS = 4
"""Fraction bits of OpenCV's fixed-point coordinates: a sixteenth of a pixel, too small to see."""
_FONT = cv2.FONT_HERSHEY_SIMPLEX
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


def jpeg_uri(rgb: np.ndarray, quality: int = 80) -> str:
    """The image (h, w, 3) uint8 as a data URI."""
    # Chroma subsampling, the default, blurs thin coloured lines and dots.
    options = [
        cv2.IMWRITE_JPEG_QUALITY,
        quality,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
    ]
    done, data = cv2.imencode(".jpg", cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2BGR), options)
    assert done, "OpenCV encodes any 8-bit image"
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode()


def resize(image: np.ndarray, width: int) -> np.ndarray:
    """The image scaled to `width` pixels. Labels and depth must not be averaged: use `resize_labels`."""
    size = (width, max(1, round(image.shape[0] * width / image.shape[1])))
    shrinks = width < image.shape[1]
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)


def resize_labels(labels: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Labels or depth resampled to `size` (height, width) by nearest neighbour."""
    return cv2.resize(labels, (size[1], size[0]), interpolation=cv2.INTER_NEAREST_EXACT)


def depth_picture(depth: np.ndarray, near: float, far: float) -> np.ndarray:
    """Depth (metres) in colours from blue (near) to red (far); grey where nothing was measured."""
    level = np.clip((depth - near) / max(far - near, 1e-6), 0, 1)
    colours = cv2.cvtColor(cv2.applyColorMap((level * 255).astype(np.uint8), cv2.COLORMAP_TURBO), cv2.COLOR_BGR2RGB)
    colours[depth <= 0] = INVALID
    return colours


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


def mask_picture(
    rgb: np.ndarray, instance: np.ndarray, labels: np.ndarray | None, width: int, measured: np.ndarray | None = None
) -> np.ndarray:
    """The image with instances tinted, outlined and numbered; outlines of ground-truth labels, if given, in white.

    Args:
        measured: (h, w) bool; where False, no depth confirms the instance, and it is hatched.
    """
    picture = resize(rgb, width)
    instance = resize_labels(instance, picture.shape[:2])
    ids = [int(i) for i in np.unique(instance) if i]
    colours = palette(max(ids, default=0))
    table = np.zeros((256, 3), np.uint8)
    table[1 : len(colours) + 1] = np.array(colours, np.uint8).reshape(-1, 3)
    tint = table[instance]
    inside = instance > 0
    picture[inside] = (0.6 * picture[inside] + 0.4 * tint[inside]).astype(np.uint8)
    if measured is not None:
        unconfirmed = inside & (resize_labels(measured.astype(np.uint8), picture.shape[:2]) == 0)
        v, u = np.indices(unconfirmed.shape)
        picture[unconfirmed & ((u + v) % HATCH_PX < 2)] = HATCH
    picture = np.ascontiguousarray(picture)
    if labels is not None:
        labels = resize_labels(labels, picture.shape[:2])
        for label in np.unique(labels[labels > 0]):
            _outline(picture, labels == label, (255, 255, 255), 1)
    for i in ids:
        mask = instance == i
        _outline(picture, mask, colours[i - 1], 2)
        # The point deepest inside the mask, where a number hides least of its outline.
        inner = cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]
        v, u = np.unravel_index(inner.argmax(), inner.shape)
        _tag(picture, str(i), (float(u), float(v)), colours[i - 1])
    return picture


def _outline(picture: np.ndarray, mask: np.ndarray, colour: Colour, thickness: int) -> None:
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(picture, contours, -1, colour, thickness, cv2.LINE_AA)


def _tag(picture: np.ndarray, text: str, centre: tuple[float, float], colour: Colour) -> None:
    """A number on a box of this colour, in black or white, whichever contrasts more."""
    scale = 0.45
    (width, height), _ = cv2.getTextSize(text, _FONT, scale, 1)
    u = int(np.clip(centre[0] - width / 2, 2, max(picture.shape[1] - width - 3, 2)))
    v = int(np.clip(centre[1] + height / 2, height + 3, max(picture.shape[0] - 3, height + 3)))
    cv2.rectangle(picture, (u - 2, v - height - 3), (u + width + 2, v + 3), colour, -1)
    bright = 0.299 * colour[0] + 0.587 * colour[1] + 0.114 * colour[2] > 130
    cv2.putText(picture, text, (u, v), _FONT, scale, (0, 0, 0) if bright else (255, 255, 255), 1, cv2.LINE_AA)


def spread_matches(instance: np.ndarray, n_wanted: int) -> np.ndarray:
    """Indices of the matches to draw: a random sample with a fixed seed, balanced over instances."""
    order = np.random.default_rng(0).permutation(len(instance))
    rank = np.zeros(len(instance), dtype=np.int64)
    for i in np.unique(instance):
        mine = order[instance[order] == i]
        rank[mine] = np.arange(len(mine))
    return np.sort(order[np.argsort(rank[order], kind="stable")][:n_wanted])


def matches_picture(rgb_a: np.ndarray, rgb_b: np.ndarray, uv_a: np.ndarray, uv_b: np.ndarray, width: int) -> np.ndarray:
    """Two images side by side, with each match as a line in a colour of its own."""
    gap = 6
    left, right = resize(rgb_a, (width - gap) // 2), resize(rgb_b, (width - gap) // 2)
    height = max(len(left), len(right))
    picture = np.full((height, left.shape[1] + gap + right.shape[1], 3), 255, np.uint8)
    picture[: len(left), : left.shape[1]] = left
    picture[: len(right), left.shape[1] + gap :] = right
    start = scale_pixels(uv_a.astype(np.float64), rgb_a.shape[:2], left.shape[:2])
    end = scale_pixels(uv_b.astype(np.float64), rgb_b.shape[:2], right.shape[:2])
    end[:, 0] += left.shape[1] + gap
    for a, b, colour in zip(start, end, palette(len(start)), strict=True):
        cv2.line(picture, _fixed(a), _fixed(b), colour, 1, cv2.LINE_AA, _SUBPIXEL_BITS)
        for point in (a, b):
            _dot(picture, point, 3.0, colour)
    return picture


@dataclass(frozen=True)
class Mark:
    """A keypoint to draw, in pixels of the image as recorded.

    Args:
        seen: whether the filter considers it visible to the camera; drawn filled, otherwise hollow.
        trail: (n, 2) earlier pixels, oldest first; NaN breaks the line.
        covariance: (2, 2) square pixels; drawn as its one-sigma ellipse.
        truth: (2,) ground truth; a cross, joined to the mark by a line.
    """

    number: int
    pixel: np.ndarray
    colour: Colour
    seen: bool = True
    trail: np.ndarray | None = None
    covariance: np.ndarray | None = None
    truth: np.ndarray | None = None


def marks_picture(rgb: np.ndarray, marks: Sequence[Mark], width: int) -> np.ndarray:
    """The image with numbered keypoints in their colours."""
    picture = np.ascontiguousarray(resize(rgb, width))
    size, new_size = rgb.shape[:2], picture.shape[:2]
    factor = width / rgb.shape[1]
    for mark in marks:
        if mark.trail is not None and len(mark.trail) > 1:
            _line(picture, scale_pixels(mark.trail.astype(np.float64), size, new_size), mark.colour)
    for mark in marks:
        point = scale_pixels(mark.pixel.astype(np.float64), size, new_size)
        truth = None if mark.truth is None else scale_pixels(mark.truth.astype(np.float64), size, new_size)
        if truth is not None and np.isfinite(truth).all() and np.isfinite(point).all():
            cv2.line(picture, _fixed(point), _fixed(truth), (255, 255, 255), 1, cv2.LINE_AA, _SUBPIXEL_BITS)
        if truth is not None and np.isfinite(truth).all():
            _cross(picture, truth, mark.colour)
        if not np.isfinite(point).all():
            continue
        if mark.covariance is not None and np.isfinite(mark.covariance).all():
            _ellipse(picture, point, mark.covariance * factor**2, mark.colour)
        _dot(picture, point, 5.0, mark.colour, filled=mark.seen)
    for mark in marks:
        point = scale_pixels(mark.pixel.astype(np.float64), size, new_size)
        if np.isfinite(point).all() and (np.abs(point) < 2 * width).all():
            _number(picture, str(mark.number), point + np.array([8, -7]))
    return picture


def heat_picture(
    rgb: np.ndarray, heat: np.ndarray, marks: Sequence[Mark], width: int, *, truth_seen: bool = True
) -> np.ndarray:
    """A heat map (any resolution, scaled to its maximum) overlaid on the dimmed image.

    Args:
        marks: best matches as rings, ground truth as crosses joined to them.
        truth_seen: whether the ground truth is visible in the image; if not, its crosses are grey.
    """
    picture = resize(rgb, width).astype(np.float32)
    size = (picture.shape[1], picture.shape[0])
    level = np.clip(cv2.resize((heat / max(float(heat.max()), 1e-12)).astype(np.float32), size), 0, 1)
    glow = cv2.applyColorMap((level * 255).astype(np.uint8), cv2.COLORMAP_INFERNO)
    glow = cv2.cvtColor(glow, cv2.COLOR_BGR2RGB).astype(np.float32)
    grey = picture.mean(axis=2, keepdims=True)
    weight = level[..., None] ** 0.7
    blended = (1 - weight) * (0.55 * (0.5 * picture + 0.5 * grey)) + weight * glow
    drawn = np.clip(blended, 0, 255).astype(np.uint8)
    for mark in marks:
        point = scale_pixels(mark.pixel.astype(np.float64), rgb.shape[:2], drawn.shape[:2])
        truth = mark.pixel * np.nan if mark.truth is None else mark.truth.astype(np.float64)
        truth = scale_pixels(truth, rgb.shape[:2], drawn.shape[:2])
        if np.isfinite([*point, *truth]).all() and truth_seen:
            # The line ends at the ring, whose inside stays visible.
            start = point + (truth - point) * min(1.0, RING_PX / max(float(np.linalg.norm(truth - point)), 1e-9))
            cv2.line(drawn, _fixed(start), _fixed(truth), WHITE, 1, cv2.LINE_AA, _SUBPIXEL_BITS)
        if np.isfinite(truth).all():
            _cross(drawn, truth, WHITE if truth_seen else INVALID, 5.0)
        if np.isfinite(point).all():
            _dot(drawn, point, RING_PX, mark.colour, filled=False)
    return drawn


def crop_picture(rgb: np.ndarray, pixel: np.ndarray, half: int, width: int, colour: Colour) -> np.ndarray:
    """An enlarged square around a pixel, with a cross on it; `half` pixels from the centre to an edge."""
    padded = np.pad(rgb, ((half, half), (half, half), (0, 0)), mode="edge")
    u, v = np.rint(np.clip(pixel, 0, [rgb.shape[1] - 1, rgb.shape[0] - 1])).astype(int)
    crop = padded[v : v + 2 * half + 1, u : u + 2 * half + 1]
    picture = np.ascontiguousarray(resize(crop, width))
    middle = scale_pixels(pixel.astype(np.float64) - [u, v] + half, crop.shape[:2], picture.shape[:2])
    _cross(picture, middle, colour)
    return picture


def _fixed(point: np.ndarray) -> tuple[int, int]:
    # Far outside the image, OpenCV's fixed-point coordinates overflow.
    u, v = np.rint(np.clip(point, -20000, 20000) * 2**_SUBPIXEL_BITS).astype(int)
    return int(u), int(v)


def _dot(picture: np.ndarray, point: np.ndarray, radius: float, colour: Colour, filled: bool = True) -> None:
    size = round(radius * 2**_SUBPIXEL_BITS)
    if filled:
        # A black and a white ring: one of them stands out from any background, even one of the dot's colour.
        for more, stroke in ((2.0, (0, 0, 0)), (1.0, (255, 255, 255)), (0.0, colour)):
            ring = size + round(more * 2**_SUBPIXEL_BITS)
            cv2.circle(picture, _fixed(point), ring, stroke, -1, cv2.LINE_AA, _SUBPIXEL_BITS)
    else:
        cv2.circle(picture, _fixed(point), size, (0, 0, 0), 4, cv2.LINE_AA, _SUBPIXEL_BITS)
        cv2.circle(picture, _fixed(point), size, colour, 2, cv2.LINE_AA, _SUBPIXEL_BITS)


def _cross(picture: np.ndarray, point: np.ndarray, colour: Colour, arm: float = 7.0) -> None:
    for thickness, stroke in ((4, (0, 0, 0)), (2, colour)):
        for direction in (np.array([arm, arm]), np.array([arm, -arm])):
            ends = _fixed(point - direction), _fixed(point + direction)
            cv2.line(picture, *ends, stroke, thickness, cv2.LINE_AA, _SUBPIXEL_BITS)


def _number(picture: np.ndarray, text: str, point: np.ndarray) -> None:
    u, v = (int(x) for x in np.rint(point))
    cv2.putText(picture, text, (u, v), _FONT, 0.45, (0, 0, 0), 3, cv2.LINE_AA)
    cv2.putText(picture, text, (u, v), _FONT, 0.45, (255, 255, 255), 1, cv2.LINE_AA)


def _line(picture: np.ndarray, points: np.ndarray, colour: Colour) -> None:
    for a, b in pairwise(points):
        if np.isfinite([*a, *b]).all():
            cv2.line(picture, _fixed(a), _fixed(b), colour, 1, cv2.LINE_AA, _SUBPIXEL_BITS)


def _ellipse(picture: np.ndarray, point: np.ndarray, covariance: np.ndarray, colour: Colour) -> None:
    values, vectors = np.linalg.eigh(covariance)
    axes = np.sqrt(np.clip(values, 0, picture.shape[1] ** 2))
    angle = float(np.rad2deg(np.arctan2(vectors[1, 1], vectors[0, 1])))
    size = tuple(round(float(x) * 2**_SUBPIXEL_BITS) for x in (axes[1], axes[0]))
    cv2.ellipse(picture, _fixed(point), size, angle, 0, 360, colour, 1, cv2.LINE_AA, _SUBPIXEL_BITS)
