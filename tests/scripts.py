"""Scripts of the repository that belong to no package, as modules."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

REPOSITORY = Path(__file__).parent.parent


def script(path: str, name: str = "") -> ModuleType:
    """A script, by its path in the repository.

    Args:
        name: of the module; default: that of the file.
    """
    file = REPOSITORY / path
    name = name or file.stem
    spec = importlib.util.spec_from_file_location(name, file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # Dataclasses look their module up while it is loaded.
    spec.loader.exec_module(module)
    return module
