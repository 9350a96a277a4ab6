"""What stages made, as arrays."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING

from bask_data.kinds import InstanceRow
from bask_data.notebook.html import table_html

if TYPE_CHECKING:
    import numpy as np


@dataclass(frozen=True, repr=False, eq=False)
class ObjectArrays:
    """The objects of a scene, in the order of their ids.

    Attributes:
        id: (k,) as in masks.
        centroid: (k, 3) metres, world frame.
        extents: (k, 3) metres.
        rows: all that is known of each.
        vertex_instance: (n,) int32, of each vertex of the reconstruction; 0 is background.
        support_plane: (4,) nx, ny, nz, d: n.x + d = 0, n towards the objects; zeros: no plane.
    """

    id: np.ndarray
    centroid: np.ndarray
    extents: np.ndarray
    rows: tuple[InstanceRow, ...]
    vertex_instance: np.ndarray
    support_plane: np.ndarray

    def __len__(self) -> int:
        return len(self.id)

    def __repr__(self) -> str:
        sizes = ", ".join(_size(row.extents) for row in self.rows)
        return (
            f"<{_counted(len(self), 'object')} of {len(self.vertex_instance)} vertices{': ' if sizes else ''}{sizes}>"
        )

    def _repr_html_(self) -> str:
        rows = [
            (row.id, row.name, _size(row.extents), ", ".join(f"{x:.3f}" for x in row.centroid), row.n_vertices)
            for row in self.rows
        ]
        columns = ("id", "name", "size", "centroid (m, world)", "vertices")
        return f"{table_html(columns, rows)}<code>{escape(repr(self))}</code>"


@dataclass(frozen=True, repr=False, eq=False)
class MatchArrays:
    """Matches between frames of a scan, a row each.

    Attributes:
        pair: (n,) number of the pair of frames.
        instance: (n,) object that both pixels show.
        uv_a, uv_b: (n, 2) float32 pixels in the first and the second frame; integers are pixel centres.
        camera_a, camera_b: (n_pairs,) names, by pair.
        frame_a, frame_b: (n_pairs,) numbers of the frames, by pair.
    """

    pair: np.ndarray
    instance: np.ndarray
    uv_a: np.ndarray
    uv_b: np.ndarray
    camera_a: np.ndarray
    camera_b: np.ndarray
    frame_a: np.ndarray
    frame_b: np.ndarray

    @property
    def pairs(self) -> np.ndarray:
        """(m,) the pairs that have matches here, each once, in order."""
        import numpy as np

        return np.unique(self.pair)

    def __len__(self) -> int:
        return len(self.pair)

    def __repr__(self) -> str:
        return f"<{_counted(len(self), 'match', 'matches')} in {_counted(len(self.pairs), 'pair')} of frames>"


@dataclass(frozen=True, repr=False, eq=False)
class TrackArrays:
    """The keypoints of a demonstration over time; positions in metres and the world frame, NaN: not localised.

    Attributes:
        names: (k) of the keypoints.
        mean, mode: (t, k, 3) float32.
        covariance: (t, k, 3, 3) float32, square metres.
        pixel: by camera (t, k, 2) float32, where its images have the mean.
        observed: by camera (t, k) bool.
    """

    names: tuple[str, ...]
    filter: str
    mean: np.ndarray
    mode: np.ndarray
    covariance: np.ndarray
    pixel: dict[str, np.ndarray]
    observed: dict[str, np.ndarray]

    @property
    def spread(self) -> np.ndarray:
        """(t, k) metres: standard deviation of the position, the root of the trace of `covariance`."""
        import numpy as np

        return np.sqrt(np.trace(self.covariance, axis1=2, axis2=3))

    def __len__(self) -> int:
        return len(self.mean)

    def __repr__(self) -> str:
        t, k = self.mean.shape[:2]
        names = ", ".join(self.names)
        return f"<{_counted(k, 'keypoint')} over {_counted(t, 'frame')}, {self.filter} filter: {names}>"


def _size(extents: tuple[float, ...]) -> str:
    return " x ".join(f"{100 * length:.1f}" for length in extents) + " cm"


def _counted(n: int, what: str, several: str = "") -> str:
    return f"{n} {what if n == 1 else several or what + 's'}"
