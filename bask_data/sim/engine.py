"""Import of MuJoCo and off-screen OpenGL, with errors that name missing packages."""

from __future__ import annotations

import os
import sys
from importlib import import_module
from types import ModuleType
from typing import Any

from bask_data.errors import MissingDependency, imported

NO_GL_FIX = (
    "sudo apt-get install --no-install-recommends libegl1 libegl-mesa0 libgl1-mesa-dri; or, if EGL does not work, "
    "sudo apt-get install libosmesa6 and set MUJOCO_GL=osmesa."
)


def import_mujoco() -> ModuleType:
    """The module `mujoco`.

    Raises:
        MissingDependency: it is not installed, or cannot load the backend named by `MUJOCO_GL`.
    """
    try:
        return imported("mujoco", "MuJoCo", user="simulator", extra="sim")
    except MissingDependency:
        raise
    except Exception as error:
        raise _no_rendering(os.environ.get("MUJOCO_GL", ""), error) from error


def drawing(model: Any) -> tuple[Any, Any]:
    """An off-screen OpenGL context, made current, and MuJoCo's drawing context with the model's textures in it.

    On Linux, MuJoCo opens a window unless `MUJOCO_GL` is set; EGL works with and without a screen.

    Raises:
        MissingDependency: no OpenGL backend works on this machine.
    """
    mujoco = import_mujoco()
    backend = os.environ.get("MUJOCO_GL") or ("egl" if sys.platform == "linux" else "glfw")
    try:
        # `mujoco.GLContext` was chosen when MuJoCo was first imported; this choice must not depend on it.
        context = import_module(f"mujoco.{backend}").GLContext(model.vis.global_.offwidth, model.vis.global_.offheight)
        context.make_current()
        drawer = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_50.value)
    except Exception as error:
        raise _no_rendering(backend, error) from error
    return context, drawer


def _no_rendering(backend: str, error: Exception) -> MissingDependency:
    """The error for any exception of PyOpenGL or its bindings: AttributeError, TypeError, or their own."""
    message = (str(error).splitlines() or [""])[0]
    return MissingDependency(
        "simulator",
        f"MUJOCO_GL={backend}",
        expected="OpenGL without a screen",
        got=f"{type(error).__name__}: {message}",
        fix=NO_GL_FIX,
    )
