"""The objects of each task."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from bask_data.sim.cabinet import cabinet
from bask_data.sim.mug import mug
from bask_data.sim.objects import Dimensions, Thing, lid, microwave, phone, rubbish
from bask_data.sim.options import TaskName

THINGS: dict[TaskName, Callable[[np.random.Generator], tuple[list[Thing], Dimensions]]] = {
    "microwave": microwave,
    "lid": lid,
    "phone": phone,
    "rubbish": rubbish,
    "drawer": cabinet,
    "mug": mug,
}
