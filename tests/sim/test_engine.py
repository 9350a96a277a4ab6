from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from bask_data.errors import MissingDependency
from bask_data.sim.engine import import_mujoco
from bask_data.sim.rendering import Renderer
from tests.sim.worlds import world_of


def test_without_mujoco_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(MissingDependency, match=r"expected MuJoCo, got none.  fix: pip install 'bask-data\[sim\]'"):
        import_mujoco()


def test_without_opengl_the_packages_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "nosuchthing")
    with pytest.raises(
        MissingDependency, match=r"MUJOCO_GL=nosuchthing: expected OpenGL without a screen.*libegl1.*MUJOCO_GL=osmesa"
    ):
        Renderer(world_of("phone"))


def test_a_backend_that_mujoco_refuses_when_it_is_imported_is_reported() -> None:
    code = "from bask_data.sim.engine import import_mujoco; import_mujoco()"
    answer = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "MUJOCO_GL": "nonsense"},
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
    )
    assert "MissingDependency: simulator: MUJOCO_GL=nonsense: expected OpenGL without a screen" in answer.stderr


def test_rendering_does_not_depend_on_who_imported_mujoco_first() -> None:
    code = (
        "import mujoco\n"
        "from bask_data.sim.options import SimOptions\n"
        "from bask_data.sim.rendering import Renderer\n"
        "from bask_data.sim.world import World\n"
        "with Renderer(World(SimOptions(task='phone', height=32, width=32))) as renderer:\n"
        "    print(renderer.view('overhead').depth.shape)\n"
    )
    environment = {name: value for name, value in os.environ.items() if name not in ("MUJOCO_GL", "DISPLAY")}
    answer = subprocess.run(
        [sys.executable, "-c", code], env=environment, cwd=Path(__file__).parents[2], capture_output=True, text=True
    )
    assert "(32, 32)" in answer.stdout, answer.stderr
