"""Provenance: who made an artifact, when, where, and how long it took."""

from __future__ import annotations

import getpass
import os
import platform
import socket
import sys
from datetime import UTC, datetime
from pathlib import Path

from bask_data import __version__
from bask_data.artifact import write_json_atomically


def record(root: Path, target: Path, seconds: float, key: str) -> None:
    """Write the provenance of an artifact, outside it, so that no digest depends on it."""
    relative = target.relative_to(root)
    write_json_atomically(
        root / "provenance" / relative.parent / f"{relative.name}.json",
        {
            "key": key,
            "user": _user(),
            "host": socket.gethostname(),
            "time": datetime.now(UTC).isoformat(timespec="seconds"),
            "seconds": round(seconds, 3),
            "process_peak_bytes": _peak_bytes(),
            "bask_data": __version__,
            "python": platform.python_version(),
            "platform": platform.platform(),
            "packages": {
                name: str(getattr(sys.modules[name], "__version__", ""))
                for name in ("numpy", "open3d", "torch", "zarr", "sklearn", "cv2")
                if name in sys.modules
            },
        },
    )


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return str(os.getuid())


def _peak_bytes() -> int:
    try:
        # Not `ru_maxrss`, which starts at the peak of the parent process.
        line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
        return int(line.split()[1]) * 1024
    except (OSError, StopIteration):
        import resource

        # macOS counts in bytes, others in kibibytes.
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak if sys.platform == "darwin" else peak * 1024
