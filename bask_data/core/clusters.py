"""Exact DBSCAN on a grid so fine that all points of a cell are neighbours of each other.

A surface has many points within `eps` of each point; the textbook method spends its time and memory on finding them
all. In cells of edge eps / sqrt(3), all points are neighbours and all core points are in one cluster without any
comparison, and the search of other cells ends as soon as the answer is known. The grid only saves work: no result
depends on its origin.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from bask_data.core.compiled import compiled

REACH = 2
"""Cells in each direction that can hold a neighbour: three cells away is 2 eps / sqrt(3) > eps."""
COLUMNS = np.array(
    sorted(
        ((x, y) for x in range(-REACH, REACH + 1) for y in range(-REACH, REACH + 1)),
        key=lambda column: (column[0] ** 2 + column[1] ** 2, column),
    ),
    dtype=np.int64,
)
"""(25, 2) offsets in x and y of the neighbours of a cell, nearest first; cells of one column follow each other in the
order of keys."""
MAX_KEY = 2**62
"""Greatest number of cells: half the range of the 64-bit keys, so that neighbours have keys, too."""
ROUNDING = 1e-9
"""Relative margin: cells are smaller, so that rounding cannot make their diagonal longer than eps; and weights that
equal `core_weight` reach it in any order of summation."""


def dbscan(
    points: Float[ndarray, "n 3"], weights: Float[ndarray, "n"], eps: float, core_weight: float
) -> Int[ndarray, "n"]:
    """Cluster of each point, numbered from 0; -1 is noise.

    A point is a core when the weights within `eps` of it, its own included, reach `core_weight`. With weights 1 that
    is the usual `min_samples`; with the surface area of each vertex it does not depend on the density of vertices.
    Cores within `eps` of each other are one cluster; other points join the cluster of their nearest core within `eps`.
    The clusters do not depend on the order of the points.

    Args:
        eps: metres between neighbours.

    Raises:
        ValueError: `eps` or `core_weight` is not positive, a point is not finite, or the points spread over more than
            10^6 eps.

    Source: Ester et al. 1996; cells after Gunawan 2013.
    """
    if not (eps > 0 and core_weight > 0):
        raise ValueError(f"eps and core_weight must be > 0, got {eps} and {core_weight}")
    if not len(points):
        return np.zeros(0, np.int64)
    if not np.isfinite(points).all():
        raise ValueError("points must be finite")
    edge = eps / np.sqrt(3) * (1 - ROUNDING)
    lowest = points.min(axis=0)
    # Room for the reach on both sides keeps the neighbours of the outermost cells from wrapping into other columns.
    n_cells = np.floor((points.max(axis=0) - lowest) / edge) + 1 + 2 * REACH
    if n_cells.prod() > MAX_KEY:
        raise ValueError(f"eps of {eps} is too small for points that spread over {np.ptp(points, axis=0).max():.3g}")
    stride_x, stride_y = int(n_cells[1] * n_cells[2]), int(n_cells[2])
    key = _keys(points, lowest, edge, stride_x, stride_y)
    order = np.argsort(key, kind="stable")
    key = key[order]
    first = np.flatnonzero(np.diff(key, prepend=-1))
    labels = np.empty(len(points), np.int64)
    labels[order] = _clusters(
        points[order],
        weights[order].astype(np.float64),
        key[first],
        np.append(first, len(key)),
        COLUMNS[:, 0] * stride_x + COLUMNS[:, 1] * stride_y,
        eps * eps,
        core_weight * (1 - ROUNDING),
    )
    return labels


@compiled
def _keys(
    points: Float[ndarray, "n 3"], lowest: Float[ndarray, "3"], edge: float, stride_x: int, stride_y: int
) -> Int[ndarray, "n"]:
    """(n,) int64: the cell of each point; neighbours in z have neighbouring keys."""
    key = np.empty(len(points), np.int64)
    for i in range(len(points)):
        x = np.int64(np.floor((points[i, 0] - lowest[0]) / edge)) + REACH
        y = np.int64(np.floor((points[i, 1] - lowest[1]) / edge)) + REACH
        z = np.int64(np.floor((points[i, 2] - lowest[2]) / edge)) + REACH
        key[i] = x * stride_x + y * stride_y + z
    return key


@compiled
def _clusters(
    points: Float[ndarray, "n 3"],
    weights: Float[ndarray, "n"],
    cells: Int[ndarray, "c"],
    start: Int[ndarray, "c+1"],
    columns: Int[ndarray, "k"],
    eps2: float,
    core_weight: float,
) -> Int[ndarray, "n"]:
    """(n,) int64 labels of points sorted by cell.

    Args:
        cells: keys of the occupied cells, rising.
        start: the points of cell c are start[c] to start[c + 1].
        columns: differences of keys to the neighbouring columns, the cell's own first.
    """
    is_core = _cores(points, weights, cells, start, columns, eps2, core_weight)
    # The cell's core points, to which alone others connect, come first; so a scan of them ends early.
    n_cells = len(cells)
    n_core = np.zeros(n_cells, np.int64)
    core = np.empty(len(points), np.int64)
    for c in range(n_cells):
        for i in range(start[c], start[c + 1]):
            if is_core[i]:
                core[start[c] + n_core[c]] = i
                n_core[c] += 1
    root = np.arange(n_cells)
    # Adjacent cells first: once nearly all are joined, few cells further apart need their points compared.
    for reach in (1, REACH):
        _join(points, cells, start, columns, eps2, core, n_core, root, reach)
    cluster = np.full(n_cells, -1)
    n_clusters = 0
    for c in range(n_cells):
        if n_core[c]:
            top = _root(root, c)
            if cluster[top] < 0:
                cluster[top] = n_clusters
                n_clusters += 1
            cluster[c] = cluster[top]
    return _labels(points, cells, start, columns, eps2, is_core, core, n_core, cluster)


@compiled
def _cores(
    points: Float[ndarray, "n 3"],
    weights: Float[ndarray, "n"],
    cells: Int[ndarray, "c"],
    start: Int[ndarray, "c+1"],
    columns: Int[ndarray, "k"],
    eps2: float,
    core_weight: float,
) -> Bool[ndarray, "n"]:
    """(n,) bool: where the weights within eps reach the core's."""
    n_cells = len(cells)
    weight = np.zeros(n_cells)
    for c in range(n_cells):
        for i in range(start[c], start[c + 1]):
            weight[c] += weights[i]
    is_core = np.zeros(len(points), np.bool_)
    begin = np.zeros(len(columns), np.int64)
    for c in range(n_cells):
        _advance(begin, cells, columns, cells[c])
        if weight[c] >= core_weight:
            is_core[start[c] : start[c + 1]] = True
            continue
        for i in range(start[c], start[c + 1]):
            total = weight[c]
            for k in range(len(columns)):
                d, last = begin[k], cells[c] + columns[k] + REACH
                while total < core_weight and d < n_cells and cells[d] <= last:
                    if d != c:
                        for j in range(start[d], start[d + 1]):
                            if _distance2(points, i, j) <= eps2:
                                total += weights[j]
                    d += 1
                if total >= core_weight:
                    is_core[i] = True
                    break
    return is_core


@compiled
def _join(
    points: Float[ndarray, "n 3"],
    cells: Int[ndarray, "c"],
    start: Int[ndarray, "c+1"],
    columns: Int[ndarray, "k"],
    eps2: float,
    core: Int[ndarray, "n"],
    n_core: Int[ndarray, "c"],
    root: Int[ndarray, "c"],
    reach: int,
) -> None:
    """Join the cells up to `reach` apart in z that have core points within eps of each other, in `root`."""
    n_cells = len(cells)
    # The nearest nine columns are those side by side.
    columns = columns[: (2 * reach + 1) ** 2]
    begin = np.zeros(len(columns), np.int64)
    for c in range(n_cells):
        _advance(begin, cells, columns, cells[c])
        if not n_core[c]:
            continue
        for k in range(len(columns)):
            d, last = begin[k], cells[c] + columns[k] + reach
            # Each pair of cells is visited once.
            while d < c and cells[d] <= last:
                a, b = _root(root, c), _root(root, d)
                near = a != b and n_core[d] and cells[d] >= last - 2 * reach
                if near and _meet(points, start, eps2, core, n_core, c, d):
                    root[max(a, b)] = min(a, b)
                d += 1


@compiled
def _meet(
    points: Float[ndarray, "n 3"],
    start: Int[ndarray, "c+1"],
    eps2: float,
    core: Int[ndarray, "n"],
    n_core: Int[ndarray, "c"],
    c: int,
    d: int,
) -> bool:
    """Whether two cells have core points within eps of each other."""
    for i in range(start[c], start[c] + n_core[c]):
        for j in range(start[d], start[d] + n_core[d]):
            if _distance2(points, core[i], core[j]) <= eps2:
                return True
    return False


@compiled
def _labels(
    points: Float[ndarray, "n 3"],
    cells: Int[ndarray, "c"],
    start: Int[ndarray, "c+1"],
    columns: Int[ndarray, "k"],
    eps2: float,
    is_core: Bool[ndarray, "n"],
    core: Int[ndarray, "n"],
    n_core: Int[ndarray, "c"],
    cluster: Int[ndarray, "c"],
) -> Int[ndarray, "n"]:
    """(n,) int64: cluster of each core point's cell, that of the nearest core for others within eps of one, else -1."""
    n_cells = len(cells)
    labels = np.full(len(points), -1)
    begin = np.zeros(len(columns), np.int64)
    for c in range(n_cells):
        _advance(begin, cells, columns, cells[c])
        for i in range(start[c], start[c + 1]):
            if is_core[i]:
                labels[i] = cluster[c]
                continue
            nearest = eps2
            for k in range(len(columns)):
                d, last = begin[k], cells[c] + columns[k] + REACH
                while d < n_cells and cells[d] <= last:
                    for j in range(start[d], start[d] + n_core[d]):
                        distance2 = _distance2(points, i, core[j])
                        # Of cores at equal distances the lower cluster's, so that their order does not matter.
                        if distance2 < nearest or (distance2 == nearest and (labels[i] < 0 or cluster[d] < labels[i])):
                            nearest = distance2
                            labels[i] = cluster[d]
                    d += 1
    return labels


@compiled
def _advance(begin: Int[ndarray, "k"], cells: Int[ndarray, "c"], columns: Int[ndarray, "k"], cell: int) -> None:
    """Move each column's `begin` to the first cell in reach of `cell`; as cells rise, so do all of them."""
    for k in range(len(columns)):
        while begin[k] < len(cells) and cells[begin[k]] < cell + columns[k] - REACH:
            begin[k] += 1


@compiled
def _distance2(points: Float[ndarray, "n 3"], i: int, j: int) -> float:
    x, y, z = points[i, 0] - points[j, 0], points[i, 1] - points[j, 1], points[i, 2] - points[j, 2]
    return x * x + y * y + z * z


@compiled
def _root(root: Int[ndarray, "c"], c: int) -> int:
    while root[c] != c:
        root[c] = root[root[c]]
        c = root[c]
    return c
