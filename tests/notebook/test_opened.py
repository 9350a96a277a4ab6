from __future__ import annotations

import base64
import pickle
import re
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

import bask_data as bask
from bask_data.dataset import Dataset
from bask_data.errors import BadData, UsageError
from bask_data.kinds import Correspondences, Demonstration, DescriptorNet, KeypointTrack, Scan
from bask_data.notebook.opened import OpenDataset
from tests.datasets import add_scan, publish_artifact, publish_recording
from tests.scenes import intrinsics, orbit, tabletop
from tests.tiny import HEIGHT, PARAMS, WIDTH

N_FRAMES = 8


def recorded(dataset: Dataset, item: str, kind: type[Scan] | type[Demonstration]) -> None:
    scene, K, poses = tabletop(2, seed=0, spread=0.12), intrinsics(HEIGHT, WIDTH), orbit(N_FRAMES, 0.5, n_turns=0.6)
    views = [scene.render(K, one, HEIGHT, WIDTH) for one in poses]
    publish_recording(
        dataset,
        item,
        rgb=[view.rgb for view in views],
        depth=[view.depth for view in views],
        K=K,
        world_from_cameras=poses,
        kind=kind,
    )


@pytest.fixture(scope="module")
def ds(tmp_path_factory: pytest.TempPathFactory) -> OpenDataset:
    """A scan with everything up to its matches, which `run` made, and a demonstration with a track."""
    dataset = Dataset.create(tmp_path_factory.mktemp("notebook") / "d", name="a <table>")
    recorded(dataset, "table1", Scan)
    recorded(dataset, "demo0", Demonstration)

    def fill(out: Path) -> None:
        with KeypointTrack.writer(out, names=["tip", "rim"], filter="particle", cameras=["wrist"]) as writer:
            for i_frame in range(N_FRAMES):
                writer.append(
                    mean=np.full((2, 3), i_frame / 10),
                    covariance=np.tile(np.diag([4e-4, 9e-4, 12e-4]), (2, 1, 1)),
                    mode=np.zeros((2, 3)),
                    n_eff=np.ones(2),
                    log_evidence=np.zeros(2),
                    cameras={"wrist": (np.ones((2, 2)), np.ones(2, dtype=bool))},
                )

    publish_artifact(dataset, KeypointTrack, "demo0", fill)
    opened = bask.open(dataset.root)
    for stage in ("reconstruct", "objects", "masks", "correspondences"):
        [outcome] = opened.run(stage, only="table1", **PARAMS.get(stage, {}))
        assert outcome.status == "made"
    return opened


def test_importing_the_package_imports_nothing_that_takes_long() -> None:
    heavy = ("numpy", "torch", "zarr", "pydantic", "cv2", "bask_data.tracker", "bask_data.notebook")
    code = f"import bask_data, sys; dir(bask_data); sys.exit([name for name in {heavy} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode == 1 and done.stderr.strip() == "[]") or done.returncode == 0, done.stderr
    assert {*bask.__all__, "open", "torch"} <= {*dir(bask)}
    assert all(getattr(bask, name) for name in (*bask.__all__, "open", "torch"))


def test_a_star_leaves_the_builtin_open_and_does_not_load_torch() -> None:
    code = "import builtins, sys; from bask_data import *; assert open is builtins.open and 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", f"{code}; KeypointTracker"], check=True)


def test_the_package_offers_what_users_need_alone() -> None:
    code = "import bask_data as bask, bask_data.stages; print(*(name for name in dir(bask) if name[0] != '_'))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["KeypointTracker", "errors", "open", "torch"]
    assert bask.errors.BaskError


def test_a_frame_has_its_arrays_in_metres(ds: OpenDataset) -> None:
    frames = ds.scans["table1"]
    assert len(frames) == N_FRAMES == len(list(frames)) and frames.cameras == ["wrist"]
    frame, scan = frames[-1], Scan(ds.root / "scan" / "table1").camera("wrist")
    assert (frame.index, frame.camera, frame.rgb.shape) == (N_FRAMES - 1, "wrist", (HEIGHT, WIDTH, 3))
    np.testing.assert_array_equal(frame.depth, scan.depth(N_FRAMES - 1))
    assert frame.depth.dtype == np.float32 and 0.2 < np.median(frame.depth) < 2
    np.testing.assert_array_equal(frame.world_from_camera, scan.world_from_cameras[-1])
    np.testing.assert_array_equal(frame.K, scan.Ks[-1])
    assert frame.time == scan.time[-1]
    assert frame.mask.shape == (HEIGHT, WIDTH) and {*np.unique(frame.mask)} == {0, 1, 2}
    some = frames[2:6:2]
    assert [one.index for one in some] == [2, 4] and some[-1].index == 4 and len(some[:0]) == 0
    assert [one.index for one in frames[::-1]] == list(range(N_FRAMES))[::-1]
    assert frames[np.int64(3)].index == 3
    np.testing.assert_array_equal(some.world_from_cameras, scan.world_from_cameras[2:6:2])
    np.testing.assert_array_equal(some.time, scan.time[[2, 4]])
    np.testing.assert_array_equal(some.K, scan.Ks[0])
    np.testing.assert_array_equal(some.Ks, scan.Ks[[2, 4]])
    assert len(ds.demonstrations["demo0"]) == N_FRAMES and ds.demonstrations["demo0"].robot is None


def test_a_changed_array_leaves_other_frames_as_they_are(ds: OpenDataset) -> None:
    frames, scan = ds.scans["table1"], Scan(ds.root / "scan" / "table1").camera("wrist")
    frames[0].K[:] = frames.K[:] = frames.Ks[:] = 0
    frames[0].world_from_camera[:] = frames.world_from_cameras[:] = frames.time[:] = 0
    np.testing.assert_array_equal(frames[0].K, scan.Ks[0])
    np.testing.assert_array_equal(frames.Ks, scan.Ks)
    np.testing.assert_array_equal(frames[0].world_from_camera, scan.world_from_cameras[0])
    np.testing.assert_array_equal(frames.time, scan.time)


def test_results_are_arrays(ds: OpenDataset) -> None:
    objects = ds.objects("table1")
    assert objects.id.tolist() == [1, 2] and objects.centroid.shape == (2, 3) and (objects.extents > 0).all()
    assert {*np.unique(objects.vertex_instance)} == {0, 1, 2}
    matches = ds.matches("table1")
    assert matches.uv_a.shape == matches.uv_b.shape == (len(matches), 2) and len(matches) > 50
    frames, i = ds.scans["table1"], len(matches) // 2
    for uv, by_pair in ((matches.uv_a, matches.frame_a), (matches.uv_b, matches.frame_b)):
        u, v = np.rint(uv[i]).astype(int)
        assert frames[int(by_pair[matches.pair[i]])].mask[v, u] == matches.instance[i]
    assert matches.pairs.tolist() == sorted({*matches.pair.tolist()})
    some = ds.matches("table1", int(matches.pair[-1]))
    assert 0 < len(some) < len(matches) and {*some.pair.tolist()} == {int(matches.pair[-1])}
    assert len(ds.matches("table1", np.array([0, 1]))) == len(ds.matches("table1", [0, 1]))
    assert len(ds.matches("table1", [])) == 0
    track = ds.keypoints("demo0")
    assert track.names == ("tip", "rim") and track.mean.shape == (N_FRAMES, 2, 3)
    np.testing.assert_allclose(track.mean[3], 0.3)
    np.testing.assert_allclose(track.spread, 0.05, rtol=1e-5)
    assert track.observed["wrist"].all() and track.pixel["wrist"].shape == (N_FRAMES, 2, 2)


@pytest.mark.parametrize(
    ("asked", "error", "message"),
    [
        (
            lambda ds: ds.scans["tabel1"],
            KeyError,
            "scan: expected one of table1, got 'tabel1'.  fix: did you mean table1?",
        ),
        (
            lambda ds: ds.scans["table1"]["wrist"],
            TypeError,
            r'got str \'wrist\'.  fix: .camera\("wrist"\) gives the frames',
        ),
        (lambda ds: ds.scans["table1"][1.5], TypeError, "frame: expected a whole number or a slice, got float 1.5"),
        (lambda ds: ds.scans["table1"][2:4][2], IndexError, "table1: frame: expected one of 0 to 1, got 2"),
        (lambda ds: ds.matches("table1", [0, 99]), UsageError, "pairs: expected some of 0 to 5, got 99"),
        (lambda ds: ds.matches("table1", [1.7]), UsageError, r"pairs: expected whole numbers, got \[1.7\]"),
        (lambda ds: ds.matches("table1", "x"), UsageError, "pairs: expected whole numbers, got 'x'"),
        (lambda ds: ds.matches("table1", [[0], [1, 2]]), UsageError, "pairs: expected whole numbers, got "),
        (lambda ds: ds.scans["table1"].camera("head"), UsageError, "camera: expected one of wrist, got head"),
        (lambda ds: ds.scans["table1"][8], IndexError, "table1: frame: expected one of 0 to 7, got 8"),
        (lambda ds: ds.demonstrations["demo0"][0].mask, UsageError, "mask: expected a frame of a scan, got the demon"),
        (lambda ds: ds.objects("demo0"), UsageError, "scene: expected one of table1, got demo0"),
        (lambda ds: ds.keypoints("demo0", "x"), UsageError, "variant: expected one of main, got x"),
        (
            lambda ds: ds.run("trane"),
            UsageError,
            "stage: expected one of reconstruct, .*, got trane.  fix: did you mean train",
        ),
        (lambda ds: ds.run("objects", only="x"), UsageError, "only: expected one of table1, demo0, got x"),
        (lambda ds: ds.run("encode"), UsageError, "encode demo0: expected its inputs, got "),
        (lambda ds: bask.open(ds.root / "scan"), BadData, "expected a dataset"),
        (lambda ds: bask.torch.Frames(ds, ["x"]), UsageError, "scans: expected some of table1, got x"),
    ],
)
def test_what_is_not_there_is_said_with_what_is(ds: OpenDataset, asked, error, message: str) -> None:
    with pytest.raises(error, match=message):
        asked(ds)


def test_what_has_not_been_made_is_said_with_how_to(tmp_path: Path) -> None:
    dataset = Dataset.create(tmp_path / "d")
    recorded(dataset, "table1", Scan)
    for asked in (lambda ds: ds.scans["table1"][0].mask, lambda ds: bask.torch.Frames(ds, masks=True)):
        with pytest.raises(UsageError, match=r'expected masks, got none.  fix: ds.run\("masks", only="table1"\)'):
            asked(bask.open(dataset.root))


def test_everything_says_what_is_inside(ds: OpenDataset) -> None:
    assert repr(ds) == f"<dataset a <table> at {ds.root}: 1 scan: table1, 1 demonstration: demo0>"
    assert repr(ds.scans) == "<1 scan: table1>"
    assert repr(ds.scans["table1"]) == f"<scan table1: 8 frames of camera wrist, {WIDTH}x{HEIGHT}>"
    assert repr(ds.scans["table1"][1:3]) == f"<scan table1: 2 of 8 frames of camera wrist, {WIDTH}x{HEIGHT}>"
    assert repr(ds.scans["table1"][0]) == f"<frame 0 of camera wrist: {WIDTH}x{HEIGHT}, 0.00 s>"
    assert repr(ds.keypoints("demo0")) == "<2 keypoints over 8 frames, particle filter: tip, rim>"
    assert repr(ds.objects("table1")).startswith("<2 objects of ")
    assert re.fullmatch(r"<\d+ matches in 6 pairs of frames>", repr(ds.matches("table1")))
    assert (
        f'<td style="text-align: left">{ds.objects("table1").rows[1].n_vertices}</td>'
        in ds.objects("table1")._repr_html_()
    )
    assert (
        ds.scans["table1"]._repr_html_().count("<img") == 3 and ds.scans["table1"][:1]._repr_html_().count("<img") == 1
    )
    assert "<img" not in ds.scans["table1"][:0]._repr_html_() and ds._repr_html_().count("<img") == 6
    assert repr(bask.torch.Frames(ds)) == f"<{N_FRAMES} frames of table1>"
    assert repr(bask.torch.Matches(ds, n=5)) == "<6 pairs of frames with 5 matches each, of table1, seed 0>"
    html = ds._repr_html_()
    assert "&lt;table&gt;" in html and "a <table>" not in html
    encoded = re.search(r'src="data:image/jpeg;base64,([^"]+)"', ds.scans["table1"]._repr_html_())
    picture = cv2.imdecode(np.frombuffer(base64.b64decode(encoded[1]), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    away, swapped = (
        np.abs(one.astype(int) - ds.scans["table1"][0].rgb).mean() for one in (picture, picture[..., ::-1])
    )
    assert away < 10 and away < 0.7 * swapped  # JPEG does not keep noise.


def test_a_recording_that_is_not_there_leaves_the_others_to_be_seen(tmp_path: Path) -> None:
    dataset = Dataset.create(tmp_path / "d")
    for name in ("table1", "table2"):
        add_scan(dataset, name)
    shutil.rmtree(dataset.path(Scan, "table1"))
    html = bask.open(dataset.root)._repr_html_()
    assert "scan/table1: expected scan, got none.  fix: ingest it again." in html and html.count("<img") == 2


def test_a_notebook_completes_names(ds: OpenDataset) -> None:
    assert ds.scans._ipython_key_completions_() == ["table1"]
    assert {"scans", "demonstrations", "objects", "matches", "keypoints", "run", "status"} <= {*dir(ds)}
    assert "tabel1" not in ds.scans and ds.scans.get("tabel1") is None
    assert {"rgb", "depth", "mask", "K", "world_from_camera", "time"} <= {*dir(ds.scans["table1"][0])}


def test_recordings_cross_to_other_processes(ds: OpenDataset) -> None:
    frames = ds.scans["table1"]
    mask = frames[2].mask  # Masks are open.
    scans, again, frame = pickle.loads(pickle.dumps((ds.scans, frames[1:4], frames[2])))  # noqa: S301
    for other in (scans["table1"][2], again[1], frame):
        np.testing.assert_array_equal(other.rgb, frames[2].rgb)
        np.testing.assert_array_equal(other.mask, mask)
    assert repr(again) == repr(frames[1:4]) and again[1].index == 2


def test_frames_are_listed_without_opening_a_camera(ds: OpenDataset, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patched:
        patched.setattr(Scan, "camera", lambda self, name: pytest.fail("opened"))
        frames = bask.torch.Frames(ds)
    assert len(frames) == N_FRAMES and frames[N_FRAMES - 1]["camera"] == "wrist"


def test_an_artifact_is_read_as_its_kind(ds: OpenDataset) -> None:
    assert ds.artifact(Scan, "table1").camera_shapes() == {"wrist": (N_FRAMES, HEIGHT, WIDTH)}
    with pytest.raises(UsageError, match=r'descriptor/main: expected descriptor, got none.  fix: ds.run\("train"\)'):
        ds.artifact(DescriptorNet)


def test_frames_come_as_tensors_and_cross_to_a_worker(ds: OpenDataset) -> None:
    frames = bask.torch.Frames(ds, ["table1", "table1"], masks=True)
    assert len(frames) == N_FRAMES  # Named twice, a scan counts once.
    frame = ds.scans["table1"][3]
    again = pickle.loads(pickle.dumps(frames))  # noqa: S301
    for one in (frames[3], again[3]):
        np.testing.assert_array_equal(one["rgb"].numpy().transpose(1, 2, 0), frame.rgb)
        np.testing.assert_array_equal(one["depth"].numpy(), frame.depth)
        np.testing.assert_array_equal(one["mask"].numpy(), frame.mask)
    [batch, *_] = DataLoader(frames, batch_size=4, num_workers=1, multiprocessing_context="spawn")
    assert batch["rgb"].shape == (4, 3, HEIGHT, WIDTH) and batch["scan"] == ["table1"] * 4


@pytest.mark.parametrize("context", ["fork", "spawn"])
def test_samples_and_their_order_do_not_depend_on_workers(ds: OpenDataset, context: str) -> None:
    matches = bask.torch.Matches(ds, "table1", n=20, seed=1)
    _ = matches[0]  # Files are open when workers fork.

    def batches(**options) -> list[dict]:
        order = torch.Generator().manual_seed(7)
        return list(DataLoader(matches, batch_size=2, shuffle=True, generator=order, **options))

    here, there = batches(), batches(num_workers=2, multiprocessing_context=context)
    assert [one["pair"].tolist() for one in here] != [[0, 1], [2, 3], [4, 5]]
    for one, other in zip(here, there, strict=True):
        for name, value in one.items():
            assert torch.equal(value, other[name]) if isinstance(value, torch.Tensor) else value == other[name], name


def test_a_sample_of_matches_has_both_frames(ds: OpenDataset, monkeypatch: pytest.MonkeyPatch) -> None:
    frames, matches = bask.torch.Frames(ds), bask.torch.Matches(ds, n=4)
    of_both = {f"{name}_{side}" for name in {*frames[0], "uv"} - {"scan"} for side in "ab"}
    assert {*matches[0]} == {"scan", "pair", "instance"} | of_both
    stored = ds.matches("table1")
    with monkeypatch.context() as patched:  # A sample reads neither table as a whole.
        patched.setattr(Correspondences, "pairs", lambda self: pytest.fail("read again"))
        patched.setattr(Correspondences, "matches", lambda self, pairs=None: pytest.fail("read as a whole"))
        again = pickle.loads(pickle.dumps(matches))  # noqa: S301
        samples = [again[i] for i in (*range(len(matches)), -1)]
    for sample in samples:
        assert (sample["camera_b"], sample["frame_b"]) == ("wrist", stored.frame_b[sample["pair"]])
        frame = frames[sample["frame_b"]]
        for name in ("rgb", "depth", "K", "world_from_camera"):
            assert torch.equal(sample[f"{name}_b"], frame[name])


def test_matches_are_the_same_for_the_same_seed_wherever_they_are_read(ds: OpenDataset) -> None:
    matches = bask.torch.Matches(ds, n=30, seed=3)
    there, first = ds.matches("table1"), matches[0]
    pair = there.pair == first["pair"]
    known = {(*a, *b) for a, b in zip(there.uv_a[pair].tolist(), there.uv_b[pair].tolist(), strict=True)}
    drawn = {(*a, *b) for a, b in zip(first["uv_a"].tolist(), first["uv_b"].tolist(), strict=True)}
    assert drawn <= known and first["uv_a"].shape == (30, 2)
    again = pickle.loads(pickle.dumps(matches))[0]  # noqa: S301
    np.testing.assert_array_equal(again["uv_a"], first["uv_a"])
    other = bask.torch.Matches(ds, n=30, seed=4)[0]
    assert not np.array_equal(other["uv_a"], first["uv_a"])
    i_frame = int(there.frame_b[first["pair"]])
    np.testing.assert_array_equal(
        first["rgb_b"].numpy().transpose(1, 2, 0), ds.scans["table1"].camera(there.camera_b[first["pair"]])[i_frame].rgb
    )
    assert bask.torch.Matches(pickle.loads(pickle.dumps(ds)), n=2)[0]["instance"].shape == (2,)  # noqa: S301
