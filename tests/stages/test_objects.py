from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from bask_data.dataset import Dataset
from bask_data.engine import make, plan
from bask_data.kinds import ObjectInstances
from bask_data.stages.objects import ObjectsParams, objects
from tests import scenes
from tests.datasets import publish_mesh, publish_recording
from tests.meshes import THREE, block, joined, sheet, table
from tests.single_view import box

GOLDEN = Path(__file__).parent / "golden"


def dataset_of(root, vertices, triangles, scene=None):
    dataset = Dataset.create(root)
    cameras, K = scenes.orbit(3), scenes.intrinsics(48, 64)
    blank = np.zeros((48, 64, 3), np.uint8)
    depth = [scene.render(K, camera, 48, 64).depth if scene else np.full((48, 64), 0.7) for camera in cameras]
    publish_recording(
        dataset,
        "a",
        rgb=[blank] * 3,
        depth=depth,
        K=K,
        world_from_cameras=cameras,
    )
    publish_mesh(dataset, "a", vertices, triangles)
    return dataset


def run(dataset, **options):
    [task] = plan(dataset, objects, options=options)
    return make(task, force=True)


def made(dataset, **options):
    outcome = run(dataset, **options)
    assert outcome.status == "made", outcome.why
    return ObjectInstances(dataset.path(ObjectInstances, "a"))


def test_the_artifact_holds_labels_support_and_table_of_objects(tmp_path):
    vertices, triangles, truth = table(THREE)
    result = made(dataset_of(tmp_path / "d", vertices, triangles), names=("box", "tower"))
    assert result.vertex_instance.dtype == np.int32
    assert (result.vertex_instance == np.array([0, 1, 3, 2])[truth]).mean() > 0.995
    np.testing.assert_allclose(result.support_plane, [0, 0, 1, 0], atol=1e-4)
    assert [(row.id, row.name) for row in result.instances] == [(1, "box"), (2, "tower"), (3, "")]
    assert [row.n_vertices for row in result.instances] == np.bincount(result.vertex_instance)[1:].tolist()
    assert result.metadata.warnings == []
    [support] = result.metadata.planes
    assert (support.role, support.plane) == ("support", tuple(result.support_plane.tolist()))
    assert support.area_m2 == pytest.approx(0.42, rel=0.05)
    assert support.noise_m < 1e-4
    assert result.metadata.neighbours == []


def test_walls_are_told_as_structure_and_objects_that_nearly_touch_as_neighbours(tmp_path):
    vertices, triangles, _ = joined(
        [
            table(THREE)[:2],
            block(-0.094, -0.1, (0.04, 0.06, 0.08), 0.004),
            sheet((-0.35, 0.28, 0), (0.7, 0, 0), (0, 0, 0.2), 0.004),
        ]
    )
    dataset = dataset_of(tmp_path / "d", vertices, triangles)
    result = made(dataset, eps=0.005)
    assert [row.role for row in result.metadata.planes] == ["support", "structure"]
    np.testing.assert_allclose(result.metadata.planes[1].plane, [0, -1, 0, 0.28], atol=2e-3)
    [pair] = result.metadata.neighbours
    assert (pair.a, pair.b) == (1, 3)
    assert pair.gap_m == pytest.approx(0.006, abs=1e-4)
    assert result.metadata.warnings == ["objects that nearly touch: 1 and 3 (0.6 cm)"]
    with_wall = made(dataset, eps=0.005, support="plane")
    assert [row.role for row in with_wall.metadata.planes] == ["support"]
    assert "1 clusters longer than 0.6 m became background" in with_wall.metadata.warnings[0]


def test_version_3_gives_the_golden_result(tmp_path):
    golden = np.load(GOLDEN / "objects_v3.npz")
    assert objects.version == 3, "save a golden file for the new version"
    vertices, triangles, _ = table(THREE, noise=0.0008)
    result = made(dataset_of(tmp_path / "d", vertices, triangles))
    np.testing.assert_array_equal(result.vertex_instance, golden["vertex_instance"])
    np.testing.assert_allclose(result.support_plane, golden["support_plane"], atol=1e-9)


def test_same_inputs_same_bytes(tmp_path):
    vertices, triangles, _ = table(THREE, noise=0.0008)
    digests = {run(dataset_of(tmp_path / name, vertices, triangles)).digest for name in ("one", "two")}
    assert len(digests) == 1


def test_no_objects_is_a_result_with_a_warning(tmp_path):
    result = made(dataset_of(tmp_path / "d", *table([])[:2]))
    assert result.instances == []
    assert not result.vertex_instance.any()
    assert result.metadata.warnings[0].startswith("no object was found (0 clusters smaller than 0.001 m2)")


def test_without_a_support_the_plane_is_zeros(tmp_path):
    vertices, triangles, truth = table(THREE)
    triangles = triangles[(truth[triangles] > 0).all(axis=1)]
    result = made(dataset_of(tmp_path / "d", vertices, triangles), support="none")
    assert len(result.instances) == 3
    np.testing.assert_array_equal(result.support_plane, np.zeros(4))


def test_a_given_plane_is_scaled_to_a_unit_normal(tmp_path):
    vertices, triangles, _ = table(THREE)
    result = made(dataset_of(tmp_path / "d", vertices, triangles), plane=(0, 0, 2, 0))
    np.testing.assert_array_equal(result.support_plane, [0, 0, 1, 0])
    assert len(result.instances) == 3


def test_what_was_dropped_is_told(tmp_path):
    vertices, triangles, _ = table([*THREE, (-0.3, 0.2, (0.35, 0.02, 0.02))])
    result = made(dataset_of(tmp_path / "d", vertices, triangles), max_extent=0.3, names=("a", "b", "c", "d"))
    assert result.metadata.warnings == [
        "1 clusters longer than 0.3 m became background: furniture, or objects that touch; see --max-extent, --eps and "
        "the workspace of `reconstruct`",
        "4 names were given, but 3 objects found",
    ]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"support": "none", "plane": (0, 0, 1, 0)}, "plane: expected no plane with --support none"),
        ({"support": "none", "above": (0.01, 0.2)}, "above: expected no above with --support none, got (0.01, 0.2)"),
        ({"plane": (0, 0, 0, 1)}, "plane: expected a direction that is not zero, got 0.0,0.0,0.0,1.0"),
        ({"up": (0, 0, 0)}, "up: expected a direction that is not zero, got 0.0,0.0,0.0"),
    ],
)
def test_a_wrong_option_is_refused(tmp_path, options, message):
    outcome = run(dataset_of(tmp_path / "d", *table([])[:2]), **options)
    assert outcome.status == "failed"
    assert message in outcome.why


def test_heights_in_the_wrong_order_are_refused():
    with pytest.raises(ValidationError, match="low,high in metres with 0 <= low < high"):
        ObjectsParams(above=(0.3, 0.01))


if __name__ == "__main__":  # Run as a module when the version was raised: python -m tests.stages.test_objects
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        mesh = table(THREE, noise=0.0008)
        fresh = made(dataset_of(Path(folder) / "d", *mesh[:2]))
        np.savez_compressed(
            GOLDEN / f"objects_v{objects.version}.npz",
            vertex_instance=fresh.vertex_instance,
            support_plane=fresh.support_plane,
        )


def test_flags_are_written_told_and_found(tmp_path):
    raised = block(0.0, 0.05, (0.05, 0.05, 0.05), 0.004, bottom=0.1)
    vertices, triangles, _ = joined([table(THREE[:1])[:2], raised])
    scene = scenes.Scene((box(-0.15, -0.07, (0.10, 0.06, 0.08)), box(0.025, 0.075, (0.05, 0.05, 0.05), bottom=0.1)))
    result = made(dataset_of(tmp_path / "d", vertices, triangles, scene))
    assert [row.flags for row in result.instances] == [[], ["floating"]]
    assert result.instances[1].reasons == "not standing on the support"
    assert "flagged, and not trained on by default: 2 (not standing on the support)" in result.metadata.warnings
    assert [(finding.code, finding.place) for finding in result.findings()] == [("object-floating", "a object 2")]
    assert result.instances[0].seen > 0.9


def test_a_scene_without_objects_is_a_finding(tmp_path):
    [finding] = made(dataset_of(tmp_path / "d", *table([])[:2])).findings()
    assert finding.code == "no-object"
    assert finding.severity == "warning"
