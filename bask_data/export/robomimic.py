"""robomimic: one HDF5 file with a group `data/demo_<i>` per demonstration and a list of names in `mask` per split.

It serves imitation learning only: rewards are 0, and 1 in the last frame, as demonstrations are assumed to succeed;
there is no `next_obs`.
"""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bask_data.errors import imported
from bask_data.export.episodes import SINGLE_FILE, Episode, Episodes
from bask_data.export.images import blocks
from bask_data.export.robomimic_cameras import write_cameras
from bask_data.progress import progress

if TYPE_CHECKING:
    import numpy as np

MASKS = {"train": "train", "validation": "valid", "test": "test"}
"""robomimic's names of the splits."""

NO_ENVIRONMENT = 2
"""robomimic's number for Gym environments. It has none for a lack of environment, and uses it only for rollouts."""


def write(out: Path, episodes: Episodes) -> list[str]:
    """Write the file; notes on the range of actions."""
    import h5py

    largest = 0.0
    # The earliest layout that holds all this: readers open it whatever their version.
    with h5py.File(out / SINGLE_FILE, "w", libver="earliest") as file:
        # Not an attribute: these are limited to 64 kB, and hundreds of demonstrations take more.
        file["bask"] = json.dumps(episodes.described("robomimic"), ensure_ascii=False, allow_nan=False)
        data = file.create_group("data")
        data.attrs["total"] = episodes.n_frames
        environment = {"env_name": episodes.dataset.file.name, "type": NO_ENVIRONMENT, "env_kwargs": {}}
        data.attrs["env_args"] = json.dumps({**environment, "env_type": NO_ENVIRONMENT})
        for i, episode in enumerate(progress(episodes, "exporting demonstrations", len(episodes))):
            _write_episode(data.create_group(f"demo_{i}"), episode, episodes)
            largest = max(largest, float(abs(episode.values["action"]).max()))
        for split, mask in MASKS.items():
            if names := [f"demo_{i}" for i in episodes.in_split(split)]:
                file.create_dataset(f"mask/{mask}", data=_bytes(names))
    note = f"robomimic expects actions from -1 to 1; the largest magnitude is {largest:.3g}."
    return [note] if largest > 1 else []


def description(file: Path) -> object:
    """The description in an HDF5 file; None if there is none, or only a link to one."""
    h5py = imported("h5py", "h5py", user="export", extra="export")
    # A damaged or foreign file may raise any exception; it counts as no export.
    with suppress(Exception), h5py.File(file, "r") as opened:
        if isinstance(opened.get("bask", getlink=True), h5py.HardLink):
            return json.loads(opened["bask"].asstr()[()])
    return None


def _write_episode(group: Any, episode: Episode, episodes: Episodes) -> None:
    import numpy as np

    n = episode.entry.n_frames
    last = np.zeros(n, np.float32)
    last[-1] = 1.0
    group.attrs["num_samples"] = n
    group.attrs.update({name: getattr(episode.entry, name) for name in ("name", "task", "fps", "digest")})
    group["actions"], group["rewards"], group["dones"] = episode.values["action"], last, last
    group["states"], group["time"] = np.zeros((n, 0), np.float32), episode.values["time"]
    for column in episodes.columns:
        if column.name not in ("time", "action"):
            # robomimic multiplies observations without converting them, which fails for bool.
            values = episode.values[column.name]
            group[f"obs/{column.name}"] = values.astype(np.float32) if column.dtype == "bool" else values
            group[f"obs/{column.name}"].attrs.update({"units": column.units, "description": column.description})
    group["actions"].attrs["values"] = _bytes(episodes.column("action").values)
    for name, camera in episode.cameras.items():
        size = (*episodes.cameras[name], 3)
        images = group.create_dataset(
            f"obs/{name}_image", (n, *size), "uint8", chunks=(1, *size), compression="gzip", shuffle=False
        )
        at = 0
        for block in blocks(camera, episode.entry.name, 32):
            images[at : at + len(block)] = block
            at += len(block)
    if episodes.settings.cameras:
        write_cameras(group, episode)


def _bytes(names: Any) -> np.ndarray:
    """Names as bytes (n,), the type that robomimic decodes."""
    import numpy as np

    return np.array([name.encode() for name in names], dtype="S")
