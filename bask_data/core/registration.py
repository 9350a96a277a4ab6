"""Depth and colour brought to one image: depth of a camera beside the colour camera, or of another size."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float, Float32, UInt8
from numpy import ndarray
from scipy.sparse import csr_array

from bask_data.core.compiled import compiled
from bask_data.core.depth import DEPTH_SLACK, NOISE_SIGMAS, filled, noise_share

BLOCKED_PX = 1.5
"""Pixels of the depth camera beyond the last one on a near surface, in which nothing behind it is taken for visible:
its edge is within one pixel, a corner of it within 1.5. Measured on 40 ray-cast views of tables, the depth camera 25 mm
beside and of half the size: with 0.5, 1, 1.5 and 2, the background shows in 5778, 12, 7 and 5 of 10.6 million pixels
of near surfaces that both cameras see, and 98.8, 98.4, 98.0 and 97.4 % of the pixels that both see have depth."""

LARGEST_PX = 128
"""Pixels of the colour camera that a pixel of the depth camera may span, with a margin of `BLOCKED_PX` around it, to be
drawn. Keeps wrong transforms from filling images with single pixels: a phone's 256 x 192 spans 16 in 4032 x 3024."""

MOST_SKEW_PX = 0.01
"""Pixels by which the skews of two cameras may displace a row."""

ON_EDGE = 1e-6
"""Share of a triangle, and pixels, by which a pixel may lie outside it: rounding leaves no cracks between triangles,
and no border without depth where images have the same pixels."""


def registered_depth(
    depth: Float32[ndarray, "h w"],
    depth_K: Float[ndarray, "3 3"],
    color_K: Float[ndarray, "3 3"],
    color_size: tuple[int, int],
    color_from_depth: Float[ndarray, "4 4"],
    slack: tuple[float, float] = DEPTH_SLACK,
) -> Float32[ndarray, "H W"]:
    """The depth image that the colour camera would measure, of all that the depth camera sees.

    Neighbouring depths on one surface are joined by triangles, which are drawn into a z-buffer: no holes, whatever the
    sizes of the images. So are depths beside single missing pixels inside a surface, which would otherwise become gaps
    of several pixels that nothing closes later. Depths without such neighbours are drawn as the square of their pixel.
    Nothing spans a jump in depth; the edge is somewhere in the pixel between, so the colour image has no depth there.
    This and what only the colour camera sees stays 0.

    Args:
        depth: z-depth of the depth camera, metres; 0, negative and not finite mean no measurement.
        color_size: (height, width), pixels.
        slack: (a, b): neighbouring pixels on one surface differ by at most a + b z metres; more on a noisy sensor.

    Returns:
        z-depth of the colour camera, metres; 0 = none.
    """
    depth = np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))
    slack = (slack[0], max(slack[1], NOISE_SIGMAS * noise_share(depth)))
    depth = filled(depth, slack)
    # (u z', v z', z') = turn @ (x z, y z, z) + shift for pixel (x, y) at depth z: both cameras in one step.
    turn = color_K @ color_from_depth[:3, :3] @ np.linalg.inv(depth_K)
    shift = color_K @ color_from_depth[:3, 3]
    surface, front = np.zeros(color_size, np.float32), np.zeros(color_size, np.float32)
    right, down = _joined(depth, *slack), np.ascontiguousarray(_joined(np.ascontiguousarray(depth.T), *slack).T)
    has_triangle = _draw_surfaces(surface, right, down, depth, turn, shift)
    sideways = float(depth_K[0, 0] * np.linalg.norm(color_from_depth[:3, 3]))
    _draw_pixels(surface, front, has_triangle, right, down, depth, turn, shift, sideways)
    # Both hold 1 / z, and 0 where nothing was drawn.
    with np.errstate(divide="ignore", invalid="ignore"):
        z = 1 / surface
        is_seen = (surface > 0) & (z - 1 / front <= np.float32(slack[0]) + np.float32(slack[1]) * z)
    return np.where(is_seen, z, np.float32(0))


def color_at_depth_size(
    rgb: UInt8[ndarray, "H W 3"],
    color_K: Float[ndarray, "3 3"],
    depth_K: Float[ndarray, "3 3"],
    depth_size: tuple[int, int],
) -> UInt8[ndarray, "h w 3"]:
    """The colour image with the pixels of a depth image from the same optical centre and direction.

    Where images shrink, a pixel is the mean of the area it covers, and otherwise interpolated. Intrinsics say which
    area that is: depth is often cropped, and then the ratio of sizes is not the ratio of focal lengths.

    Args:
        depth_size: (height, width), pixels.

    Returns:
        0 where the pixel's centre is outside the colour image.

    Raises:
        ValueError: the cameras differ in skew, so rows and columns of one are not those of the other.
    """
    height, width = rgb.shape[:2]
    (rows, row_shift), (columns, column_shift) = _axes(color_K, depth_K, depth_size)
    down = _weights(depth_size[0], height, rows, row_shift)
    across = _weights(depth_size[1], width, columns, column_shift)
    narrow = down @ rgb.reshape(height, -1).astype(np.float32)
    turned = narrow.reshape(depth_size[0], width, 3).transpose(1, 0, 2).reshape(width, -1)
    result = (across @ turned).reshape(depth_size[1], depth_size[0], 3).transpose(1, 0, 2)
    return np.ascontiguousarray(np.rint(result).astype(np.uint8))


def labels_at_depth_size(
    labels: UInt8[ndarray, "H W"],
    color_K: Float[ndarray, "3 3"],
    depth_K: Float[ndarray, "3 3"],
    depth_size: tuple[int, int],
) -> UInt8[ndarray, "h w"]:
    """Labels of the colour image with the pixels of a depth image from the same optical centre and direction: that of
    the nearest pixel, and 0 outside. Arguments and errors are those of `color_at_depth_size`."""
    index = [
        np.rint(scale * np.arange(n) + shift)
        for n, (scale, shift) in zip(depth_size, _axes(color_K, depth_K, depth_size), strict=True)
    ]
    inside = [(at >= 0) & (at < n) for at, n in zip(index, labels.shape, strict=True)]
    v, u = (np.where(ok, at, 0).astype(np.int64) for ok, at in zip(inside, index, strict=True))
    return np.where(inside[0][:, None] & inside[1], labels[np.ix_(v, u)], np.uint8(0))


def _axes(
    color_K: Float[ndarray, "3 3"], depth_K: Float[ndarray, "3 3"], depth_size: tuple[int, int]
) -> tuple[tuple[float, float], tuple[float, float]]:
    """(scale, shift) from rows and from columns of depth to those of colour."""
    color_from_depth = color_K @ np.linalg.inv(depth_K)
    if abs(color_from_depth[0, 1]) * depth_size[0] > MOST_SKEW_PX:
        raise ValueError(
            f"intrinsics: expected the same skew, got {color_K[0, 1]:g} of colour, {depth_K[0, 1]:g} of depth"
        )
    (scale_u, _, shift_u), (_, scale_v, shift_v), _ = color_from_depth.tolist()
    return (scale_v, shift_v), (scale_u, shift_u)


def _weights(n: int, n_source: int, scale: float, shift: float) -> csr_array:
    """Weights (n, n_source) of the source's pixels in each of n pixels along an axis; pixel i is centred at
    scale i + shift in the source."""
    centre = scale * np.arange(n) + shift
    # A box as wide as the pixel, in the source; a triangle two pixels wide, which interpolates, where it is narrower.
    reach = max(scale, 1.0) / 2 + 0.5
    n_weights = min(int(2 * reach) + 2, n_source)
    first = np.clip(np.ceil(centre - reach), 0, n_source - n_weights).astype(np.int64)
    index = first[:, None] + np.arange(n_weights)
    if scale > 1:
        low, high = centre[:, None] - scale / 2, centre[:, None] + scale / 2
        weight = np.minimum(index + 0.5, high) - np.maximum(index - 0.5, low)
    else:
        weight = 1 - np.abs(index - centre[:, None])
    inside = (centre >= -0.5) & (centre < n_source - 0.5)
    weight = np.maximum(weight, 0) * inside[:, None]
    weight /= np.maximum(weight.sum(axis=1, keepdims=True), np.finfo(np.float64).tiny)
    used = weight > 0
    row = np.broadcast_to(np.arange(n)[:, None], index.shape)
    return csr_array((weight[used].astype(np.float32), (row[used], index[used])), shape=(n, n_source))


# Loops over pixels and triangles --------------------------------------------------------------------------------------


@compiled
def _joined(depth, a, b):  # type: ignore[no-untyped-def]
    """Whether each pixel and the next one in its row are on one surface: their depths are close, or each follows from
    the plane on the other's side, as those of a floor seen at a small angle do. Then 1 / z is linear in the pixel."""
    height, width = depth.shape
    is_joined = np.zeros((height, width), np.bool_)
    for y in range(height):
        for x in range(width - 1):
            p, q = depth[y, x], depth[y, x + 1]
            if p <= 0 or q <= 0:
                continue
            most = a + b * min(p, q)
            is_joined[y, x] = abs(p - q) <= most
            if is_joined[y, x] or x == 0 or x + 2 == width:
                continue
            before, after = depth[y, x - 1], depth[y, x + 2]
            if before > p / 2 and after > q / 2:  # Otherwise the plane passes the camera before it gets there.
                is_joined[y, x] = abs(1 / (2 / p - 1 / before) - q) <= most and abs(1 / (2 / q - 1 / after) - p) <= most
    return is_joined


@compiled
def _draw_surfaces(surface, right, down, depth, turn, shift):  # type: ignore[no-untyped-def]
    """Triangles between joined depths: two of a square of four pixels, or one of three. Returns which pixels have one.

    Args:
        right, down: whether a pixel is joined to the next one in its row and column.
    """
    height, width = depth.shape
    has_triangle = np.zeros((height, width), np.bool_)
    for y in range(height - 1):
        b, d = _place(turn, shift, 0, y, depth[y, 0]), _place(turn, shift, 0, y + 1, depth[y + 1, 0])
        for x in range(width - 1):
            top, bottom, left, far = right[y, x], right[y + 1, x], down[y, x], down[y, x + 1]
            a, c = b, d
            b, d = (
                _place(turn, shift, x + 1, y, depth[y, x + 1]),
                _place(turn, shift, x + 1, y + 1, depth[y + 1, x + 1]),
            )
            if top and left:
                _draw(surface, a, b, c)
            if bottom and far:
                _draw(surface, d, b, c)
            if not (top and left and bottom and far):
                if top and far:
                    _draw(surface, b, a, d)
                if bottom and left:
                    _draw(surface, c, a, d)
            # A pixel has a triangle with its neighbours in row and column, or with one of them and the pixel across.
            has_triangle[y, x] |= (top and (left or far)) or (left and bottom)
            has_triangle[y, x + 1] |= (top and (left or far)) or (far and bottom)
            has_triangle[y + 1, x] |= (bottom and (left or far)) or (left and top)
            has_triangle[y + 1, x + 1] |= (bottom and (left or far)) or (far and top)
    return has_triangle


@compiled
def _draw_pixels(surface, front, has_triangle, right, down, depth, turn, shift, sideways):  # type: ignore[no-untyped-def]
    """Squares of pixels without a triangle into `surface`; squares with a margin, of pixels at the edge of what is
    behind them or not measured, into `front`.

    Args:
        sideways: pixels, at 1 m, by which the cameras are apart: so far may a near surface that ends with the image go
            on beside it, in front of what the depth camera sees.
    """
    height, width = depth.shape
    for y in range(height):
        for x in range(width):
            z = depth[y, x]
            if z <= 0:
                continue
            if not has_triangle[y, x]:
                _draw_rectangle(surface, turn, shift, z, x - 0.5, y - 0.5, x + 0.5, y + 0.5)
            is_edge = (
                (x + 1 < width and not right[y, x] and not 0 < depth[y, x + 1] < z)
                or (x > 0 and not right[y, x - 1] and not 0 < depth[y, x - 1] < z)
                or (y + 1 < height and not down[y, x] and not 0 < depth[y + 1, x] < z)
                or (y > 0 and not down[y - 1, x] and not 0 < depth[y - 1, x] < z)
            )
            if sideways == 0:  # From the same centre, what is behind a near surface stays behind it.
                continue
            if is_edge or x == 0 or y == 0 or x == width - 1 or y == height - 1:
                reach = BLOCKED_PX if is_edge else 0.5
                beyond = BLOCKED_PX + sideways / z
                x0, y0 = x - (beyond if x == 0 else reach), y - (beyond if y == 0 else reach)
                x1, y1 = x + (beyond if x == width - 1 else reach), y + (beyond if y == height - 1 else reach)
                _draw_rectangle(front, turn, shift, z, x0, y0, x1, y1)


@compiled
def _draw_rectangle(buffer, turn, shift, z, left, top, right, bottom):  # type: ignore[no-untyped-def]
    """A rectangle of the depth image, at one z-depth."""
    a, b = _place(turn, shift, left, top, z), _place(turn, shift, right, top, z)
    c, d = _place(turn, shift, right, bottom, z), _place(turn, shift, left, bottom, z)
    _draw(buffer, a, b, c)
    _draw(buffer, a, c, d)


@compiled
def _place(turn, shift, x, y, z):  # type: ignore[no-untyped-def]
    """Pixel and 1 / z of the colour camera at a pixel and z-depth of the depth camera; 0 behind the camera."""
    across = (turn[0, 0] * x + turn[0, 1] * y + turn[0, 2]) * z + shift[0]
    down = (turn[1, 0] * x + turn[1, 1] * y + turn[1, 2]) * z + shift[1]
    ahead = (turn[2, 0] * x + turn[2, 1] * y + turn[2, 2]) * z + shift[2]
    if ahead <= 0:
        return 0.0, 0.0, 0.0
    return across / ahead, down / ahead, 1 / ahead


@compiled
def _draw(buffer, p, q, r):  # type: ignore[no-untyped-def]
    """A triangle of (u, v, 1 / z) into a buffer of the largest 1 / z at the centre of each pixel. In the image of a
    plane, 1 / z is linear."""
    if p[2] <= 0 or q[2] <= 0 or r[2] <= 0:
        return
    pu, pv, qu, qv, ru, rv = p[0], p[1], q[0] - p[0], q[1] - p[1], r[0] - p[0], r[1] - p[1]
    left, right = pu + min(0.0, qu, ru), pu + max(0.0, qu, ru)
    top, bottom = pv + min(0.0, qv, rv), pv + max(0.0, qv, rv)
    area = qu * rv - qv * ru
    if right - left > LARGEST_PX or bottom - top > LARGEST_PX or area == 0:
        return
    height, width = buffer.shape
    inverse, to_q, to_r = 1 / area, q[2] - p[2], r[2] - p[2]
    for v in range(max(math.ceil(top - ON_EDGE), 0), min(math.floor(bottom + ON_EDGE), height - 1) + 1):
        dv = v - pv
        for u in range(max(math.ceil(left - ON_EDGE), 0), min(math.floor(right + ON_EDGE), width - 1) + 1):
            du = u - pu
            of_q, of_r = (du * rv - dv * ru) * inverse, (qu * dv - qv * du) * inverse
            if of_q >= -ON_EDGE and of_r >= -ON_EDGE and of_q + of_r <= 1 + ON_EDGE:
                buffer[v, u] = max(buffer[v, u], p[2] + of_q * to_q + of_r * to_r)
