from __future__ import annotations

import numpy as np
import pytest

from bask_data.errors import UsageError
from bask_data.sim import textures
from bask_data.sim import world as world_module
from bask_data.sim.options import MAX_CLUTTER, TASKS, SimOptions, TaskName
from bask_data.sim.scan import scan
from bask_data.sim.world import GAP, TABLE, World
from tests.sim.worlds import views, world_of

TOUCHING: dict[TaskName, list[tuple[int, int]]] = {
    "microwave": [(1, 2)],
    "lid": [(1, 2)],
    "phone": [],
    "rubbish": [],
    "drawer": [(1, 2)],
    "mug": [],
}


@pytest.mark.parametrize("task", TASKS)
def test_objects_are_at_rest_on_the_table_and_apart_in_every_layout(task: TaskName) -> None:
    world = world_of(task, clutter=3)
    places = []
    for seed in range(6):
        world.restore(world.lay_out(np.random.default_rng(seed)))
        things = list(world.things.values())
        for i, a in enumerate(things):
            for b in things[:i]:
                gap = world.distance(world.geoms_of(a.name), world.geoms_of(b.name), 1.0)
                assert gap > GAP - 1e-3 or a.on == b.name
        poses = world.world_from_objects()
        assert (np.abs(poses[:, :2, 3]) < TABLE).all()
        assert (poses[:, 2, 3] > -0.01).all()
        assert world.touching() == TOUCHING[task]
        places.append(poses[:, :2, 3])
    assert np.std(places, axis=0).max() > 0.03


def test_same_seed_gives_the_same_world_and_another_seed_other_objects() -> None:
    first, same, other = (World(SimOptions(task="rubbish", seed=seed)) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first.model.tex_data, same.model.tex_data)
    np.testing.assert_array_equal(first.model.geom_size, same.model.geom_size)
    assert (first.model.tex_data != other.model.tex_data).mean() > 0.5
    assert not np.allclose(first.model.geom_size, other.model.geom_size)
    layouts = [world.lay_out(np.random.default_rng(7)) for world in (first, same)]
    for name in vars(layouts[0]):
        np.testing.assert_array_equal(getattr(layouts[0], name), getattr(layouts[1], name))


def test_another_background_changes_the_table_but_not_the_objects_and_their_poses() -> None:
    seen = []
    for background_seed in (None, 1, 1, 2):
        world = world_of("phone", background_seed=background_seed)
        [view] = views(world, scan(world, np.random.default_rng(0)), "wrist", [3])
        seen.append(view)
    usual, first, again, other = seen
    for view in (first, other):
        np.testing.assert_array_equal(view.instance, usual.instance)
        np.testing.assert_array_equal(view.depth, usual.depth)
        on_objects = view.instance > 0
        np.testing.assert_array_equal(view.rgb[on_objects], usual.rgb[on_objects])
        ground = (view.instance == 0) & (view.depth > 0)
        assert (view.rgb != usual.rgb).any(axis=-1)[ground].mean() > 0.9
    np.testing.assert_array_equal(first.rgb, again.rgb)
    assert np.abs(first.rgb.astype(int) - other.rgb).mean() > 10


def test_coverings_of_many_seeds_differ_in_colour_and_pattern() -> None:
    coverings = [textures.covering(np.random.default_rng([seed, 0]), 64).astype(float) for seed in range(12)]
    assert np.ptp([covering.mean(axis=(0, 1)) for covering in coverings], axis=0).min() > 60
    along = np.array([[covering.std(axis=axis).mean() for axis in (0, 1)] for covering in coverings])
    # Stripes vary along one axis only, stone and cheques along both.
    assert (along[:, 0] > 2 * along[:, 1]).any() and (along[:, 0] < 1.3 * along[:, 1]).any()


def test_a_scene_does_not_depend_on_earlier_ones() -> None:
    world = World(SimOptions(task="phone"))
    fresh = world.lay_out(np.random.default_rng(5))
    world.lay_out(np.random.default_rng(6))
    again = world.lay_out(np.random.default_rng(5))
    np.testing.assert_array_equal(fresh.qpos, again.qpos)
    np.testing.assert_array_equal(fresh.body_pos, again.body_pos)
    np.testing.assert_array_equal(fresh.light_diffuse, again.light_diffuse)


def test_more_clutter_does_not_change_the_tasks_objects_and_labels() -> None:
    bare, full = (world_of("rubbish", clutter=n) for n in (0, 3))
    assert full.label_names == {**bare.label_names, 5: "clutter1", 6: "clutter2", 7: "clutter3"}
    for name in bare.labels:
        np.testing.assert_array_equal(
            bare.model.geom_size[bare.geoms_of(name)], full.model.geom_size[full.geoms_of(name)]
        )


def test_the_largest_clutter_fits_on_the_table() -> None:
    for task in TASKS:
        world = world_of(task, clutter=MAX_CLUTTER)
        world.lay_out(np.random.default_rng(0))


def test_too_many_objects_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(world_module, "GAP", 0.5)
    with pytest.raises(
        UsageError, match="--clutter: expected objects that fit on the table 50 cm apart, got 4 objects"
    ):
        World(SimOptions(task="rubbish")).lay_out(np.random.default_rng(0))


def test_the_door_starts_open() -> None:
    world = world_of("microwave")
    angles = []
    for seed in range(5):
        world.restore(world.lay_out(np.random.default_rng(seed)))
        angles.append(float(world.data.joint("door").qpos[0]))
    assert max(angles) < -0.8
    assert np.ptp(angles) > 0.2


@pytest.mark.parametrize("task", ["microwave", "rubbish", "drawer", "mug"])
def test_the_walls_of_a_hollow_object_differ(task: TaskName) -> None:
    """A texture extends through a body: with one texture, the inside of a wall would show the outside of another."""
    world = World(SimOptions(task=task))
    materials = world.things[
        {"microwave": "microwave", "rubbish": "bin", "drawer": "cabinet", "mug": "mug"}[task]
    ].materials
    pictures = [_texture(world, name) for name in materials]
    assert len(materials) >= 5
    for i, picture in enumerate(pictures):
        assert all((picture != other).mean() > 0.5 for other in pictures[:i])


def _texture(world: World, name: str) -> np.ndarray:
    texture = world.model.texture(name)
    begin = int(world.model.tex_adr[texture.id])
    return world.model.tex_data[begin : begin + 6 * textures.FACE**2 * 3]
