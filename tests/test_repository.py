from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import jaxtyping
import numpy as np
import pytest
from packaging.requirements import Requirement

from bask_data.core import geometry

REPOSITORY = Path(__file__).parent.parent
CODE = sorted(
    file for folder in ("bask_data", "pipelines", "benchmarks", ".ci") for file in (REPOSITORY / folder).rglob("*.py")
)
HEAVY = {"cv2", "dask", "distributed", "matplotlib", "numba", "open3d", "pycolmap", "scipy", "sklearn", "torch", "zarr"}


def tracked(folder: str) -> list[Path]:
    """What is in the repository, without what a run left beside it."""
    answer = subprocess.run(["git", "ls-files", "-z", folder], cwd=REPOSITORY, capture_output=True, text=True)
    if answer.returncode != 0:  # an unpacked release
        return [file for file in (REPOSITORY / folder).rglob("*") if file.is_file()]
    return [REPOSITORY / name for name in answer.stdout.split("\0") if name]


def run_python(code: str, *options: str) -> str:
    return subprocess.run(
        [sys.executable, *options, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, check=True
    ).stdout


# What we promise to users ---------------------------------------------------------------------------------------------


def test_the_licence_is_apache_2() -> None:
    text = (REPOSITORY / "LICENSE").read_text()
    assert "Apache License" in text and "Version 2.0, January 2004" in text and "END OF TERMS AND CONDITIONS" in text
    assert tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]["license"] == "Apache-2.0"


def test_what_ships_as_data_is_small() -> None:
    assert 0 < sum(file.stat().st_size for file in tracked("datasets")) <= 12 * 10**6


def test_every_recording_that_ships_has_its_licence_beside_it() -> None:
    recordings = {file.relative_to(REPOSITORY).parts[1] for file in tracked("datasets") if len(file.parts) > 2}
    recordings = {name for name in recordings if (REPOSITORY / "datasets" / name).is_dir()}
    assert recordings
    assert [name for name in recordings if not (REPOSITORY / "datasets" / name / "LICENSE").is_file()] == []


def test_links_between_documents_lead_somewhere() -> None:
    broken = []
    # Those of docs/ are checked by `make docs`: some of their targets are generated.
    for document in [file for file in tracked("*.md") if REPOSITORY / "docs" not in file.parents]:
        for target in re.findall(r"\]\(([^)#\s]+)", document.read_text()):
            if "://" not in target and not (document.parent / target).exists():
                broken.append(f"{document.relative_to(REPOSITORY)}: {target}")
    assert broken == []


# What a data file cannot make us do -----------------------------------------------------------------------------------


def dangers(source: str) -> list[str]:
    """Calls and imports through which a data file could run code."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else [alias.name for alias in node.names]
            found += [
                name for name in names if name.split(".")[0] in {"pickle", "marshal", "shelve", "dill", "cloudpickle"}
            ]
        elif isinstance(node, ast.Call):
            call = ast.unparse(node.func)
            options = {option.arg: ast.unparse(option.value) for option in node.keywords}
            loads_weights = call in {"torch.load", "joblib.load"} and options.get("weights_only") != "True"
            unpickles = call.endswith(".load") and options.get("allow_pickle", "False") != "False"
            makes_objects = call in {"yaml.load", "yaml.unsafe_load", "yaml.full_load"}
            if loads_weights or unpickles or makes_objects or call in {"eval", "exec"}:
                found.append(call)
    return found


@pytest.mark.parametrize("file", CODE, ids=lambda file: str(file.relative_to(REPOSITORY)))
def test_no_data_file_can_make_the_code_run_it(file: Path) -> None:
    assert dangers(file.read_text()) == []


@pytest.mark.parametrize(
    ("source", "danger"),
    [
        ("import pickle", "pickle"),
        ("from marshal import loads", "marshal"),
        ("torch.load(path)", "torch.load"),
        ("torch.load(path, weights_only=False)", "torch.load"),
        ("joblib.load(path)", "joblib.load"),
        ("np.load(path, allow_pickle=True)", "np.load"),
        ("yaml.load(text, Loader=Loader)", "yaml.load"),
        ("eval(text)", "eval"),
    ],
)
def test_code_that_trusts_a_data_file_would_be_found(source: str, danger: str) -> None:
    assert dangers(source) == [danger]


def test_safe_ways_of_loading_are_left_alone() -> None:
    assert dangers("torch.load(path, weights_only=True); np.load(path); yaml.safe_load(text); json.load(file)") == []


# What keeps the command line quick ------------------------------------------------------------------------------------


@pytest.mark.parametrize("module", ["bask_data.cli", "bask_data.pipeline", "bask_data.formats", "bask_data.kinds"])
def test_what_the_command_line_imports_is_light(module: str) -> None:
    loaded = run_python(f"import sys, {module}; print(*sys.modules)").split()
    assert {name.split(".")[0] for name in loaded} & HEAVY == set()


def test_the_doctor_comes_before_anything_is_installed() -> None:
    # Without `site` there is nothing but the standard library.
    assert "libEGL" in run_python("import bask_data.doctor.machine as d; print(*d.PACKAGE_OF_LIBRARY)", "-S")


# What keeps the code of one kind --------------------------------------------------------------------------------------


@pytest.mark.parametrize("arguments", [["check"], ["format", "--check"]], ids=["lint", "format"])
def test_the_code_passes_the_linter(arguments: list[str]) -> None:
    ruff = Path(sys.executable).parent / "ruff"
    answer = subprocess.run([ruff, *arguments, "--quiet", "."], cwd=REPOSITORY, capture_output=True, text=True)
    assert answer.returncode == 0, answer.stdout + answer.stderr


def test_the_test_run_checks_shapes() -> None:
    points = np.zeros((5, 3))
    assert geometry.transform(np.eye(4), points).shape == (5, 3)
    with pytest.raises(jaxtyping.TypeCheckError):
        geometry.transform(np.eye(3), points)


# What set-up installs -------------------------------------------------------------------------------------------------


def locked() -> dict[str, str]:
    lines = (REPOSITORY / "requirements.lock").read_text().splitlines()
    return dict(line.split("==") for line in lines if line and not line.startswith("#"))


def test_the_lock_holds_exact_versions_and_names_no_place_to_get_them_from() -> None:
    assert all(
        re.fullmatch(r"[a-z0-9-]+", name) and re.fullmatch(r"[0-9][0-9a-z.]*", v) for name, v in locked().items()
    )


def test_the_lock_has_a_version_in_range_for_everything_declared() -> None:
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    declared = [
        *project["dependencies"],
        # What two benchmarks compare with is installed by hand, when they are run, without what it asks for.
        *(line for name, extra in project["optional-dependencies"].items() if name != "xfeat" for line in extra),
    ]
    versions, outside = locked(), []
    for requirement in map(Requirement, declared):
        name = requirement.name.lower()
        if name != "bask-data" and not (name in versions and requirement.specifier.contains(versions[name])):
            outside.append(f"{requirement}: {versions.get(name)}")
    assert outside == []


def test_set_up_says_which_pythons_fit_when_none_does(tmp_path: Path) -> None:
    # Its stamp would end the script at once, so it runs in a folder without a virtual environment.
    (tmp_path / ".ci").mkdir()
    for name in (".ci/setup", "pyproject.toml", "requirements.lock"):
        (tmp_path / name).write_bytes((REPOSITORY / name).read_bytes())
    old = tmp_path / "python3.9"
    old.write_text("#!/bin/sh\necho 3.9\n")
    old.chmod(0o755)
    answer = subprocess.run(
        ["bash", tmp_path / ".ci/setup"],
        env={"PATH": "/usr/bin:/bin", "PYTHON": str(old)},
        capture_output=True,
        text=True,
    )
    assert answer.returncode == 5
    assert "expected Python 3.11, 3.12 or 3.13" in answer.stderr and "python3.9 is 3.9." in answer.stderr
    assert not (tmp_path / ".venv").exists()
