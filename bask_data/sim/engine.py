"""MuJoCo, and what it draws with where there is no screen; or a word on what is missing."""

from __future__ import annotations

import os
import sys
from importlib import import_module
from types import ModuleType
from typing import Any

from bask_data.errors import MissingDependency, imported

NO_GL_FIX = (
    "sudo apt-get install --no-install-recommends libegl1 libegl-mesa0 libgl1-mesa-dri; or, where EGL will not work, "
    "sudo apt-get install libosmesa6 and set MUJOCO_GL=osmesa."
)


def import_mujoco() -> ModuleType:
    """The module `mujoco`.

    Raises:
        MissingDependency: it is not installed, or cannot load what `MUJOCO_GL` names.
    """
    try:
        return imported("mujoco", "MuJoCo", user="simulator", extra="sim")
    except MissingDependency:
        raise
    except Exception as error:
        raise _nothing_to_draw_with(os.environ.get("MUJOCO_GL", ""), error) from error


def drawing(model: Any) -> tuple[Any, Any]:
    """An off-screen OpenGL context, made current, and MuJoCo's drawing context with the model's textures in it.

    On Linux MuJoCo would open a window unless `MUJOCO_GL` says otherwise; EGL works with and without a screen.

    Raises:
        MissingDependency: this machine has nothing to draw with.
    """
    mujoco = import_mujoco()
    backend = os.environ.get("MUJOCO_GL") or ("egl" if sys.platform == "linux" else "glfw")
    try:
        # The choice behind `mujoco.GLContext` was made when somebody first imported MuJoCo; ours must not depend on it.
        context = import_module(f"mujoco.{backend}").GLContext(model.vis.global_.offwidth, model.vis.global_.offheight)
        context.make_current()
        drawer = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_50.value)
    except Exception as error:
        raise _nothing_to_draw_with(backend, error) from error
    return context, drawer


def _nothing_to_draw_with(backend: str, error: Exception) -> MissingDependency:
    """Of whatever PyOpenGL and the bindings raise: AttributeError, TypeError, errors of their own."""
    said = (str(error).splitlines() or [""])[0]
    return MissingDependency(
        "simulator",
        f"MUJOCO_GL={backend}",
        expected="OpenGL without a screen",
        got=f"{type(error).__name__}: {said}",
        fix=NO_GL_FIX,
    )
