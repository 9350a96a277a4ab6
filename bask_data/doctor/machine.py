"""Checks of the machine, and the commands that install what is missing.

The module imports nothing but the standard library, as set-up runs it before anything else is installed:
`python3 -m bask_data.doctor --missing-packages` prints the Debian packages to install.
"""

from __future__ import annotations

import json
import os
import platform
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path

OLDEST_PYTHON = (3, 11)
"""The syntax of the code needs it; pyproject.toml says the same."""
NEWEST_PYTHON = (3, 13)
"""The newest for which every package we need has wheels."""

# Libraries that wheels link to but do not include; Open3D needs all of them. Containers often lack them.
PACKAGE_OF_LIBRARY = {
    "libEGL.so.1": "libegl1",
    "libGL.so.1": "libgl1",
    "libX11.so.6": "libx11-6",
    "libidn2.so.0": "libidn2-0",
    "libstdc++.so.6": "libstdc++6",
    "libudev.so.1": "libudev1",
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libz.so.1": "zlib1g",
}

# Modules with compiled code, whose import can fail or crash even if their distribution is installed.
DISTRIBUTION_OF_MODULE = {
    "cv2": "opencv-python-headless",
    "numba": "numba",
    "open3d": "open3d",
    "pyarrow": "pyarrow",
    "pycolmap": "pycolmap",
    "sklearn": "scikit-learn",
    "torch": "torch",
    "zarr": "zarr",
}

# Distributions with the same files; the one installed last wins, and uninstalling either breaks the other.
RIVALS = {
    "open3d": ("open3d", "open3d-cpu"),
    "opencv-python-headless": (
        "opencv-python-headless",
        "opencv-python",
        "opencv-contrib-python",
        "opencv-contrib-python-headless",
    ),
}

FREE_BYTES_WANTED = 5 * 10**9
"""Space for a few scenes: one of 500 frames takes about 1 GB with its artifacts."""
MEMORY_BYTES_WANTED = 4 * 10**9
"""With less memory, even a single job may not fit, unless voxels are larger than the default."""
_PROBE_SECONDS = 120
"""Time after which a probe counts as hanging: importing torch or Open3D takes seconds, a minute from a cold disk."""


@dataclass(frozen=True)
class Check:
    """Result of one check. bask-data does not work while a `needed` one is not `ok`.

    Args:
        found: what was found, in words.
        fix: command or advice; empty if there is none.
    """

    name: str
    ok: bool
    found: str
    needed: bool = True
    fix: str = ""


@dataclass(frozen=True)
class Probe:
    """Output of code run in a fresh interpreter, and its fault if it failed."""

    ok: bool
    output: str
    fault: str = ""


def checks(folder: Path | None = None) -> list[Check]:
    """All checks of this machine; disk space is checked in `folder`, by default the current one."""
    with ThreadPoolExecutor(max_workers=2) as pool:
        modules = list(pool.map(module_check, DISTRIBUTION_OF_MODULE))
    return [
        python_check(sys.version_info[:2]),
        *library_checks(missing_libraries()),
        *distribution_checks(metadata.requires("bask-data") or [], installed_versions()),
        *rival_checks(installed_versions()),
        *modules,
        cuda_check(probe(_ASK_TORCH), nvidia_driver_version()),
        *optional_checks(installed_versions()),
        *drawing_checks(installed_versions(), probe(_DRAW)),
        disk_check(folder or Path.cwd()),
        memory_check(),
    ]


def missing(results: Iterable[Check]) -> list[Check]:
    """Checks that are needed but not ok; with any, the exit code is 5."""
    return [check for check in results if check.needed and not check.ok]


def render(results: Iterable[Check]) -> str:
    """One line per check, followed by the fix if it is not ok."""
    lines = []
    for check in results:
        mark = "ok     " if check.ok else "MISSING" if check.needed else "note   "
        lines.append(f"{mark}  {check.name}: {check.found}")
        if check.fix and not check.ok:
            lines.append(f"         fix: {check.fix}")
    return "\n".join(lines)


def as_json(results: Iterable[Check]) -> str:
    """The checks as JSON."""
    return json.dumps([asdict(check) for check in results], indent=2)


def python_check(version: tuple[int, ...]) -> Check:
    """Check that all dependencies have wheels for this version of Python."""
    wanted = f"{_dotted(OLDEST_PYTHON)} to {_dotted(NEWEST_PYTHON)}"
    ok = OLDEST_PYTHON <= version <= NEWEST_PYTHON
    return Check("python", ok, platform.python_version(), fix=f"make setup PYTHON=... with Python {wanted}")


def missing_libraries() -> list[str]:
    """Shared libraries that the dynamic linker cannot load, tried in a fresh process, as loading can crash."""
    if sys.platform != "linux":
        return []
    code = (
        "import ctypes, sys\nfor name in sys.argv[1:]:\n    try: ctypes.CDLL(name)\n    except OSError: print(name)\n"
    )
    answer = probe(code, *PACKAGE_OF_LIBRARY)
    return answer.output.split() if answer.ok else []


def library_checks(missing_names: Iterable[str]) -> list[Check]:
    """A single check with one command that installs all missing libraries."""
    names = sorted(missing_names)
    if not names:
        return [Check("system libraries", True, "all found")]
    packages = " ".join(sorted({PACKAGE_OF_LIBRARY[name] for name in names}))
    return [
        Check(
            "system libraries",
            False,
            f"cannot load {', '.join(names)}",
            fix=f"sudo apt-get install --no-install-recommends {packages}",
        )
    ]


def installed_versions() -> dict[str, str]:
    """Version by distribution name, in lower case with dashes."""
    return {
        (distribution.metadata["Name"] or "").lower().replace("_", "-"): distribution.version
        for distribution in metadata.distributions()
    }


def distribution_checks(requirements: Iterable[str], installed: dict[str, str]) -> list[Check]:
    """Checks that the required Python distributions are installed in accepted versions."""
    from packaging.requirements import Requirement  # Imported late: it may be missing during set-up.

    results = []
    for text in sorted(requirements):
        requirement = Requirement(text)
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": ""}):
            continue
        name = requirement.name.lower()
        version = next((installed[rival] for rival in RIVALS.get(name, (name,)) if rival in installed), None)
        ok = version is not None and requirement.specifier.contains(version, prereleases=True)
        wanted = f"{requirement.name}{requirement.specifier}"
        results.append(Check(name, ok, version or "not installed", fix=f"pip install '{wanted}'"))
    return results


def rival_checks(installed: dict[str, str]) -> list[Check]:
    """Failed checks for distributions that overwrite each other."""
    results = []
    for chosen, rivals in RIVALS.items():
        present = [name for name in rivals if name in installed]
        if len(present) > 1:
            fix = f"pip uninstall -y {' '.join(present)} && pip install {chosen}"
            results.append(Check(f"one {chosen}", False, f"{' and '.join(present)} overwrite each other", fix=fix))
    return results


def module_check(module: str) -> Check:
    """Check that a module can be imported."""
    answer = probe(f"import {module}")
    fix = ""
    library = next((name for name in PACKAGE_OF_LIBRARY if name in answer.fault), None)
    if library:
        fix = f"sudo apt-get install --no-install-recommends {PACKAGE_OF_LIBRARY[library]}"
    elif not answer.ok:
        fix = f"pip install --force-reinstall --no-deps {DISTRIBUTION_OF_MODULE[module]}"
    return Check(f"import {module}", answer.ok, "works" if answer.ok else answer.fault, fix=fix)


_ASK_TORCH = """
import json, torch
cuda = torch.cuda.is_available()
name = torch.cuda.get_device_name(0) if cuda else ""
print(json.dumps({"version": torch.__version__, "built_for": torch.version.cuda, "cuda": cuda, "name": name}))
"""


def cuda_check(torch_says: Probe, driver: str | None) -> Check:
    """Check that torch can use the GPU, if there is one.

    Args:
        torch_says: output of `_ASK_TORCH`.
        driver: version of the NVIDIA driver; None without one.
    """
    if not torch_says.ok:
        return Check("GPU", False, "unknown, as torch does not work", needed=False)
    torch = json.loads(torch_says.output)
    if torch["cuda"]:
        return Check("GPU", True, f"{torch['name']}, CUDA {torch['built_for']}", needed=False)
    if driver is None:
        return Check("GPU", True, "none; training runs on the CPU", needed=False)
    if torch["built_for"] is None:
        fix = "pip install --force-reinstall torch, from a package index with CUDA builds"
        return Check("GPU", False, f"driver {driver}, but torch {torch['version']} is a CPU build", False, fix)
    fix = f"update the NVIDIA driver to one for CUDA {torch['built_for']}, or install torch for an older CUDA"
    return Check("GPU", False, f"torch cannot use it with driver {driver}", False, fix)


def nvidia_driver_version() -> str | None:
    """Version of the NVIDIA kernel driver; None without one."""
    if shutil.which("nvidia-smi") is None:
        return None
    command = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
    try:
        answer = subprocess.run(command, capture_output=True, text=True, timeout=30)
    except (OSError, subprocess.TimeoutExpired):
        return None
    versions = answer.stdout.split()
    return versions[0] if answer.returncode == 0 and versions else None


def optional_checks(installed: dict[str, str]) -> list[Check]:
    """Checks of programs and packages that only some commands need."""
    git = shutil.which("git")
    return [
        Check("git", git is not None, git or "not found; DVC needs it", False, "sudo apt-get install git"),
        _extra_check("dvc", "dvc", "`dvc repro` needs it", installed),
        _extra_check("distributed", "cluster", "--cluster needs it", installed),
        _extra_check("mujoco", "sim", "`ingest sim` needs it", installed),
    ]


def _extra_check(name: str, extra: str, purpose: str, installed: dict[str, str]) -> Check:
    version = installed.get(name)
    found = version or f"not installed; {purpose}"
    return Check(name, version is not None, found, False, f"pip install 'bask-data[{extra}]'")


_DRAW = """
import mujoco, sys
from bask_data.errors import MissingDependency
from bask_data.sim.engine import drawing
try:
    context, drawer = drawing(mujoco.MjModel.from_xml_string("<mujoco/>"))
except MissingDependency as error:
    sys.exit(error.got)
drawer.free()
context.free()
"""


def drawing_checks(installed: dict[str, str], drawn: Probe) -> list[Check]:
    """Check that the simulator, if installed, can render without a screen."""
    from bask_data.sim.engine import NO_GL_FIX

    if "mujoco" not in installed:
        return []
    return [Check("drawing", drawn.ok, "works" if drawn.ok else drawn.fault, needed=False, fix=NO_GL_FIX)]


def disk_check(folder: Path) -> Check:
    """Check of the free disk space in the dataset's folder."""
    existing = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    free = shutil.disk_usage(existing).free
    fix = "free disk space, or use another disk: a scene of 500 frames takes about 1 GB with its artifacts"
    return Check("disk", free >= FREE_BYTES_WANTED, f"{free / 1e9:.1f} GB free at {existing}", needed=False, fix=fix)


def memory_check() -> Check:
    """Check of the memory for one job."""
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    found = f"{total / 1e9:.1f} GB, {cores} cores"
    return Check(
        "memory", total >= MEMORY_BYTES_WANTED, found, needed=False, fix="use --jobs 1 and a larger voxel size"
    )


def probe(code: str, *arguments: str) -> Probe:
    """Run Python code in a fresh interpreter, so that a crash does not end this process."""
    # `-P` keeps a file named torch.py in the current folder from being imported as torch.
    command = [sys.executable, "-P", "-c", code, *arguments]
    try:
        answer = subprocess.run(command, capture_output=True, text=True, timeout=_PROBE_SECONDS)
    except subprocess.TimeoutExpired:
        return Probe(False, "", f"no answer in {_PROBE_SECONDS} s")
    if answer.returncode < 0:
        return Probe(False, answer.stdout, f"crashed with {_signal_name(-answer.returncode)}")
    if answer.returncode > 0:
        lines = answer.stderr.strip().splitlines()
        return Probe(False, answer.stdout, lines[-1] if lines else f"exit code {answer.returncode}")
    return Probe(True, answer.stdout)


def _signal_name(number: int) -> str:
    try:
        name = signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
    return f"{name} (a wheel built for a newer CPU?)" if name == "SIGILL" else name


def _dotted(version: tuple[int, ...]) -> str:
    return ".".join(map(str, version))


def main(arguments: list[str]) -> int:
    """Entry point for set-up, with a Python that has no packages yet; returns the exit code."""
    if arguments == ["--missing-packages"]:
        print(*sorted({PACKAGE_OF_LIBRARY[name] for name in missing_libraries()}))
        return 0
    results = checks()
    print(render(results))
    return 5 if missing(results) else 0
