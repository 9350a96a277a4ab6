from __future__ import annotations

import numpy as np

from bask_data.sim.experts import EXPERTS
from bask_data.sim.inventory import THINGS
from bask_data.sim.options import TASKS


def test_every_task_has_objects_and_an_expert_that_moves_one_of_them() -> None:
    assert list(THINGS) == list(EXPERTS) == list(TASKS)
    for task in TASKS:
        things, _ = THINGS[task](np.random.default_rng(0))
        labelled = [name for thing in things for name in thing.labelled]
        assert len(set(labelled)) == len(labelled)
        assert EXPERTS[task].moves in labelled


def test_tasks_keep_their_numbers_which_are_part_of_the_seed() -> None:
    assert TASKS[:6] == ("microwave", "lid", "phone", "rubbish", "drawer", "mug")
