"""The objects of a scene, separated from the support and the rest of the background."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import Field, field_validator

from bask_data.engine import Params, stage
from bask_data.errors import UsageError
from bask_data.kinds import InstanceRow, ObjectInstances, Reconstruction, Scan
from bask_data.kinds.objects import FLAG_TEXTS, NeighbourRow, PlaneRow
from bask_data.stages.mesh_quality import spread_evenly

if TYPE_CHECKING:
    import numpy as np

    from bask_data.core.objects import Split
    from bask_data.core.planes import Plane
    from bask_data.core.sightings import PosedDepth

N_LOOKS = 12
"""Most frames looked at again, to tell what is hidden from what is empty. Chosen to bound time and memory, sensitivity
not measured."""
ONE_SIDE_DEG = 20.0
"""Degrees between the directions of cameras that look from one side. Chosen, sensitivity not measured."""
FAR = 10.0
"""Depth above this counts as not measured, metres, as in `masks`."""


class ObjectsParams(Params):
    """Parameters of the split."""

    support: Literal["planes", "plane", "none"] = Field(
        "planes",
        description="The background. planes: the support plane and the walls of bins and shelves; plane: the support "
        "plane only; none: nothing, everything in the workspace is objects.",
    )
    plane: tuple[float, float, float, float] | None = Field(
        None,
        description="The support plane nx,ny,nz,d in the world frame, metres, n towards the objects and n.x + d = 0. "
        "Default: searched.",
    )
    up: tuple[float, float, float] | None = Field(
        None,
        description="Direction that the support plane faces, in the world frame, within 30 degrees. Default: guessed "
        "from the cameras.",
    )
    inlier: float = Field(0.01, gt=0, description="Greatest distance of a plane's points in the search, metres.")
    above: tuple[float, float] | None = Field(
        None,
        description="Heights above the support plane between which surface belongs to objects, metres: 0.01,0.3. "
        "Default: from a voxel, or 4 sigma of the plane's noise, to 1 m.",
    )
    margin: float = Field(
        0.0, description="Metres by which objects may project beyond the edge of the support that was seen."
    )
    eps: float = Field(0.02, gt=0, description="Greatest gap within one object, metres.")
    core_area: float | None = Field(
        None,
        gt=0,
        description="Surface within eps that makes a point the core of an object, m2. Default: 0.2 pi eps^2.",
    )
    min_area: float = Field(0.001, ge=0, description="Least surface of an object, m2.")
    max_extent: float = Field(0.6, gt=0, description="Greatest length of an object, metres.")
    touching: Literal["auto", "one", "divide"] = Field(
        "auto",
        description="Objects that touch. one: they are one object; divide: at creases of their surface, which may "
        "divide hollow objects, too; auto: divide where all cameras look from one side.",
    )
    names: tuple[str, ...] = Field((), description="Names of the objects, in order of surface, the largest first.")
    seed: int = Field(0, ge=0, description="Seed of the random choices.")

    @field_validator("above")
    @classmethod
    def _low_first(cls, heights: tuple[float, float] | None) -> tuple[float, float] | None:
        if heights is not None and not 0 <= heights[0] < heights[1]:
            raise ValueError("low,high in metres with 0 <= low < high")
        return heights


@stage(makes=ObjectInstances, version=3)
def objects(scan: Scan, reconstruction: Reconstruction, params: ObjectsParams, out: Path) -> None:
    """Split the surface into the objects on the support plane and the background.

    The support plane is the largest one that faces up, as guessed from the cameras, with little surface below it. The
    surface above it, without walls, is clustered (DBSCAN); objects are numbered by surface, the largest first. Objects
    that touch become one, unless divided at creases; the table of objects lists those that nearly touch.
    """
    import numpy as np

    from bask_data.core.objects import SplitSettings, split_objects
    from bask_data.core.planes import upward

    for name in ("plane", "above"):
        if params.support == "none" and getattr(params, name) is not None:
            raise UsageError("objects", name, expected=f"no {name} with --support none", got=f"{getattr(params, name)}")
    world_from_cameras = np.concatenate([camera.world_from_cameras for camera in scan.cameras])
    estimated = reconstruction.metadata.quality.workspace == "estimated"
    settings = SplitSettings(
        voxel_size=reconstruction.voxel_size,
        support=params.support,
        plane=_vector("plane", params.plane),
        up=_unit("up", params.up),
        guess_up=upward(world_from_cameras),
        inlier=params.inlier,
        above=params.above,
        margin=params.margin,
        eps=params.eps,
        core_area=params.core_area,
        min_area=params.min_area,
        max_extent=params.max_extent,
        views=_views(scan),
        divide=params.touching == "divide" or (params.touching == "auto" and _from_one_side(world_from_cameras)),
        # A given box ends where its author wants it to, often at the very side of an object.
        bounds=np.reshape(reconstruction.metadata.bounds, (2, 3)) if estimated else None,
    )
    rng = np.random.default_rng(params.seed)
    split = split_objects(reconstruction.vertices, reconstruction.triangles, rng, settings)
    names = [*params.names, *[""] * len(split.instances)]
    support = split.background.support
    rows = [_plane_row("support", support)] if support else []
    rows += [_plane_row("structure", one) for one in split.background.structure]
    ObjectInstances.write(
        out,
        vertex_instance=split.vertex_instance,
        support_plane=support.plane if support else np.zeros(4),
        instances=[
            InstanceRow(
                id=one.id,
                name=name,
                n_vertices=one.n_vertices,
                area_m2=one.area,
                centroid=one.centroid,
                extents=one.extents,
                concave_share=one.concave_share,
                seen=round(one.seen, 3),
                flags=list(one.doubts),
            )
            for one, name in zip(split.instances, names, strict=False)
        ],
        planes=rows,
        neighbours=[NeighbourRow(a=one.a, b=one.b, gap_m=one.gap) for one in split.neighbours],
        warnings=_warnings(split, params),
    )


def _from_one_side(world_from_cameras: np.ndarray) -> bool:
    """Whether all cameras look in nearly one direction: what they show of one object is then rarely hollow."""
    import numpy as np

    ahead = world_from_cameras[:, :3, 2]
    return bool((ahead @ ahead[0]).min() > np.cos(np.deg2rad(ONE_SIDE_DEG)))


def _views(scan: Scan) -> tuple[PosedDepth, ...]:
    """Some frames of all cameras, evenly over their paths."""
    from bask_data.core import depth
    from bask_data.core.sightings import PosedDepth

    frames = [(camera, i_frame) for camera in scan.cameras for i_frame in range(camera.n_frames)]
    return tuple(
        PosedDepth(
            depth.in_range(camera.depth(i_frame), 0.0, FAR),
            camera.Ks[i_frame],
            camera.world_from_cameras[i_frame],
        )
        for camera, i_frame in (frames[i] for i in spread_evenly(len(frames), N_LOOKS))
    )


def _plane_row(role: Literal["support", "structure"], found: Plane) -> PlaneRow:
    nx, ny, nz, d = found.plane.tolist()
    return PlaneRow(role=role, plane=(nx, ny, nz, d), area_m2=found.area, noise_m=found.noise)


def _vector(name: str, values: tuple[float, ...] | None) -> np.ndarray | None:
    import numpy as np

    if values is None:
        return None
    vector = np.asarray(values, dtype=np.float64)
    if not np.linalg.norm(vector[:3]) > 0:
        raise UsageError("objects", name, expected="a direction that is not zero", got=",".join(map(str, values)))
    return vector


def _unit(name: str, values: tuple[float, ...] | None) -> np.ndarray | None:
    import numpy as np

    vector = _vector(name, values)
    return None if vector is None else vector / np.linalg.norm(vector)


def _warnings(split: Split, params: ObjectsParams) -> list[str]:
    """Warnings for the user, one sentence each."""
    from bask_data.core.creases import CONCAVE_SHARE

    warnings = list(split.warnings)
    if split.n_too_large:
        warnings.append(
            f"{split.n_too_large} clusters longer than {params.max_extent} m became background: furniture, or objects "
            "that touch; see --max-extent, --eps and the workspace of `reconstruct`"
        )
    if split.n_too_many:
        warnings.append(f"only the 255 largest objects were kept, {split.n_too_many} more became background")
    if not split.instances:
        warnings.append(
            f"no object was found ({split.n_too_small} clusters smaller than {params.min_area} m2): look at the mesh, "
            "then see --plane, --up, --above and --min-area"
        )
    if hollow := [one for one in split.instances if one.concave_share >= CONCAVE_SHARE]:
        which = ", ".join(f"{one.id} ({one.concave_share:.0%} of it lies inside its hull)" for one in hollow)
        warnings.append(f"hollow, or several objects that touch: {which}")
    if flagged := [one for one in split.instances if one.doubts]:
        which = ", ".join(f"{one.id} ({', '.join(FLAG_TEXTS[doubt] for doubt in one.doubts)})" for one in flagged)
        warnings.append(f"flagged, and not trained on by default: {which}")
    if split.neighbours:
        pairs = ", ".join(f"{one.a} and {one.b} ({100 * one.gap:.1f} cm)" for one in split.neighbours)
        warnings.append(f"objects that nearly touch: {pairs}")
    if split.instances and len(params.names) > len(split.instances):
        warnings.append(f"{len(params.names)} names were given, but {len(split.instances)} objects found")
    return warnings
