"""Meshes of blocks on a table, made by formula: what fusion would give without its errors."""

from __future__ import annotations

import numpy as np


def sheet(origin, along, across, step):
    """A rectangle as a triangle mesh, corners counter-clockwise seen from `along` x `across`."""
    origin, along, across = (np.asarray(one, float) for one in (origin, along, across))
    n, m = (max(2, round(float(np.linalg.norm(one)) / step) + 1) for one in (along, across))
    i, j = np.mgrid[:n, :m]
    vertices = origin + (i / (n - 1))[..., None] * along + (j / (m - 1))[..., None] * across
    index = np.arange(n * m).reshape(n, m)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    triangles = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    return vertices.reshape(-1, 3), triangles


def joined(parts):
    """One mesh; vertices at the same place become one. Also the number of the first part each vertex came from."""
    vertices = np.concatenate([part[0] for part in parts])
    start = np.cumsum([0, *(len(part[0]) for part in parts)])
    triangles = np.concatenate([part[1] + begin for part, begin in zip(parts, start[:-1], strict=True)])
    source = np.repeat(np.arange(len(parts)), np.diff(start))
    _, first, inverse = np.unique(np.round(vertices, 7), axis=0, return_index=True, return_inverse=True)
    return vertices[first].astype(np.float32), inverse.reshape(-1)[triangles].astype(np.int32), source[first]


def block(x, y, size, step, bottom=0.0):
    """Five faces of a box that stands at (x, y): the underside is unseen."""
    w, d, h = size
    return joined(
        [
            sheet((x, y, bottom), (w, 0, 0), (0, 0, h), step),
            sheet((x + w, y, bottom), (0, d, 0), (0, 0, h), step),
            sheet((x + w, y + d, bottom), (-w, 0, 0), (0, 0, h), step),
            sheet((x, y + d, bottom), (0, -d, 0), (0, 0, h), step),
            sheet((x, y, bottom + h), (w, 0, 0), (0, d, 0), step),
        ]
    )[:2]


def table(blocks, step=0.004, noise=0.0, seed=0):
    """A table of 0.7 x 0.6 m with blocks (x, y, (w, d, h)); the truth is 0 on the table and 1.. on the blocks."""
    vertices, triangles, source = joined(
        [sheet((-0.35, -0.3, 0), (0.7, 0, 0), (0, 0.6, 0), step), *(block(*one, step) for one in blocks)]
    )
    source = np.where(vertices[:, 2] <= 0, 0, source)
    noisy = vertices + np.random.default_rng(seed).normal(scale=noise, size=vertices.shape)
    return noisy.astype(np.float32), triangles, source


THREE = [(-0.2, -0.1, (0.10, 0.06, 0.08)), (0.0, 0.05, (0.05, 0.05, 0.05)), (0.15, -0.15, (0.04, 0.04, 0.12))]
