"""Write requirements.lock: the exact version of everything that `.[dev]` brings, as the registry has it today.

Run by `make lock`, to move to newer versions on purpose. One file serves every Python we support: nothing we depend on
resolves differently between them.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent

HEADER = """\
# Written by `make lock`: everything `pip install bask-data[dev]` brings, at the versions the tests passed with.
# torch names its own CUDA libraries exactly, and only its CUDA build brings them, so they are not repeated here.
"""

# Held at a version until a newer one has been tried with the whole test run, GPU included.
HELD = ("torch==2.13.0",)

# What torch's CUDA build brings along and its CPU build does not.
CUDA = re.compile(r"^(nvidia-.*|cuda-.*|triton)$")


def resolved() -> dict[str, str]:
    """Every distribution the project needs, by name."""
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--dry-run", "--ignore-installed"]
    report = subprocess.run(
        [*command, "--report", "-", f"{ROOT}[dev]", *HELD], check=True, stdout=subprocess.PIPE
    ).stdout
    versions = {}
    for item in json.loads(report)["install"]:
        name = re.sub(r"[-_.]+", "-", item["metadata"]["name"]).lower()
        # A local version (torch's `+cpu`) is one build of the release; which one is the machine's business.
        versions[name] = item["metadata"]["version"].partition("+")[0]
    return {name: version for name, version in versions.items() if name != "bask-data" and not CUDA.match(name)}


def main() -> None:
    """Render the lock next to pyproject.toml."""
    lines = [f"{name}=={version}\n" for name, version in sorted(resolved().items())]
    (ROOT / "requirements.lock").write_text(HEADER + "".join(lines))
    print(f"requirements.lock: {len(lines)} distributions")


if __name__ == "__main__":
    main()
