from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import zarr
from hypothesis import given
from hypothesis import strategies as st

from bask_data.export import ExportSettings, diffusion_policy, export
from tests.export.encoded import ACTIONS, picture, state


@pytest.fixture(scope="module")
def folder(encoded, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("diffusion") / "out.zarr"
    export(encoded[0], out, "diffusion-policy", ExportSettings(videos=True, test=("b",)))
    return out


def test_the_folder_is_zarr_v2_and_a_plain_reader_opens_it(folder: Path) -> None:
    assert (folder / ".zgroup").exists() and not list(folder.rglob("zarr.json"))
    root = zarr.open(str(folder), mode="r")
    assert root.metadata.zarr_format == 2
    assert set(root) == {"data", "meta"}


def test_every_value_of_every_frame_is_read_back(encoded, folder: Path) -> None:
    root = zarr.open(str(folder), mode="r")
    ends = root["meta/episode_ends"][:]
    assert (ends.tolist(), ends.dtype) == ([12, 21, 28], np.int64)
    assert root["meta/episode_split"][:].tolist() == [0, 0, 2]
    for name, begin, end in zip("acb", [0, *ends], ends, strict=False):
        demo, data = encoded[1][name], root["data"]
        n = len(demo.mean)
        np.testing.assert_allclose(data["state"][begin:end], state(demo), rtol=1e-6)
        np.testing.assert_array_equal(data["keypoints"][begin:end].reshape(n, 2, 3), demo.mean)
        np.testing.assert_allclose(data["action"][begin:end], demo.robot.action, rtol=1e-6)
        np.testing.assert_array_equal(data["time"][begin:end], demo.time)
        np.testing.assert_array_equal(data["observed"][begin:end], demo.observed["wrist"] | demo.observed["overhead"])
        for camera in ("wrist", "overhead"):
            images = np.stack([picture(i, camera) for i in range(n)])
            np.testing.assert_array_equal(data[camera][begin:end], images)


def test_every_array_has_every_frame(folder: Path) -> None:
    root = zarr.open(str(folder), mode="r")
    assert {values.shape[0] for _, values in root["data"].arrays()} == {28}


def test_arrays_name_their_values_and_units(folder: Path) -> None:
    data = zarr.open(str(folder), mode="r")["data"]
    assert data["action"].attrs["values"] == list(ACTIONS)
    assert (data["state"].attrs["values"][0], data["keypoints"].attrs["units"]) == ("handle.x", "metre")


@given(st.lists(st.integers(1, 9), min_size=1, max_size=6), st.integers(1, 8))
def test_appended_frames_are_read_back_whatever_the_parts_and_chunks(lengths: list[int], chunk: int) -> None:
    frames = np.arange(sum(lengths) * 2, dtype=np.float32).reshape(-1, 2)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(diffusion_policy, "CHUNK_BYTES", 8 * chunk)
        group = zarr.open_group(zarr.storage.MemoryStore(), mode="w", zarr_format=2)
        appender = diffusion_policy.Appender(group, "x", frames.shape, "float32", {})
        for part in np.split(frames, np.cumsum(lengths)[:-1]):
            appender.append(part)
        appender.close()
    assert group["x"].chunks[0] == min(chunk, len(frames))
    np.testing.assert_array_equal(group["x"][:], frames)
