"""MuJoCo, imported with a renderer that needs no screen, or a word on what is missing."""

from __future__ import annotations

import os
import sys
from types import ModuleType
from typing import Any

from bask_data.errors import MissingDependency

NO_GL_FIX = (
    "sudo apt-get install --no-install-recommends libegl1 libegl-mesa0 libgl1-mesa-dri; without EGL: "
    "sudo apt-get install libosmesa6, and set MUJOCO_GL=osmesa."
)


def import_mujoco() -> ModuleType:
    """The module `mujoco`.

    MuJoCo decides when it is imported what to draw with, and on Linux takes windows unless told otherwise; EGL works
    with and without a screen.

    Raises:
        MissingDependency: MuJoCo is not installed, or what it draws with is not.
    """
    if sys.platform == "linux":
        os.environ.setdefault("MUJOCO_GL", "egl")
    try:
        import mujoco
    except ModuleNotFoundError as error:
        raise MissingDependency(
            "simulator", error.name or "", expected="MuJoCo", got="none", fix="pip install 'bask-data[sim]'"
        ) from None
    except Exception as error:
        # PyOpenGL raises whatever it meets when a library is missing: AttributeError, TypeError, its own errors.
        raise _no_gl(error) from error
    return mujoco


def gl_context(width: int, height: int) -> Any:
    """An off-screen OpenGL context of at least this size, made current.

    Raises:
        MissingDependency: this machine cannot make one.
    """
    mujoco = import_mujoco()
    try:
        context = mujoco.GLContext(width, height)
        context.make_current()
    except Exception as error:
        raise _no_gl(error) from error
    return context


def _no_gl(error: Exception) -> MissingDependency:
    backend = os.environ.get("MUJOCO_GL", "")
    return MissingDependency(
        "simulator",
        f"MUJOCO_GL={backend}",
        expected="OpenGL without a screen",
        got=f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else 'nothing works'}",
        fix=NO_GL_FIX,
    )
