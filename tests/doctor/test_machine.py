from __future__ import annotations

import json
import os
import signal
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from bask_data.doctor import machine as doctor
from bask_data.doctor.machine import Check, Probe


def fake_module(folder: Path, name: str, source: str, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder / f"{name}.py").write_text(source)
    monkeypatch.setenv("PYTHONPATH", str(folder))


def test_this_machine_passes_all_needed_checks(tmp_path: Path) -> None:
    found = doctor.checks(tmp_path)
    assert doctor.missing(found) == [], doctor.render(found)
    names = {check.name for check in found}
    assert {"python", "system libraries", "numpy", "import open3d", "GPU", "disk", "memory", "git"} <= names
    assert len(names) == len(found)


@pytest.mark.parametrize(
    ("version", "ok"), [((3, 10), False), ((3, 11), True), ((3, 13), True), ((3, 14), False), ((4, 0), False)]
)
def test_only_pythons_with_wheels_for_everything_pass(version: tuple[int, ...], ok: bool) -> None:
    check = doctor.python_check(version)
    assert check.ok is ok
    assert check.needed
    assert "3.11 to 3.13" in check.fix


def test_a_library_the_linker_cannot_load_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "PACKAGE_OF_LIBRARY", {"libc.so.6": "libc6", "libnosuchthing.so.7": "libnosuchthing7"})
    assert doctor.missing_libraries() == ["libnosuchthing.so.7"]


def test_missing_libraries_are_installed_by_one_command() -> None:
    [check] = doctor.library_checks(["libusb-1.0.so.0", "libEGL.so.1"])
    assert not check.ok
    assert check.found == "cannot load libEGL.so.1, libusb-1.0.so.0"
    assert check.fix == "sudo apt-get install --no-install-recommends libegl1 libusb-1.0-0"
    assert doctor.library_checks([]) == [Check("system libraries", True, "all found")]


@pytest.mark.parametrize(
    ("installed", "ok", "found"),
    [({"numpy": "2.4.6"}, True, "2.4.6"), ({"numpy": "1.26.4"}, False, "1.26.4"), ({}, False, "not installed")],
)
def test_a_distribution_out_of_range_is_missing(installed: dict[str, str], ok: bool, found: str) -> None:
    [check] = doctor.distribution_checks(["numpy<3,>=2.1", "dvc>=3; extra == 'dvc'"], installed)
    assert (check.ok, check.found, check.needed) == (ok, found, True)
    assert check.fix == "pip install 'numpy<3,>=2.1'"


def test_another_distribution_with_the_same_import_is_accepted() -> None:
    [check] = doctor.distribution_checks(["open3d>=0.20"], {"open3d-cpu": "0.20.0"})
    assert check.ok


def test_two_distributions_with_one_import_name_are_refused() -> None:
    assert doctor.rival_checks({"open3d": "0.20.0", "numpy": "2.4.6"}) == []
    [check] = doctor.rival_checks({"open3d": "0.20.0", "open3d-cpu": "0.20.0"})
    assert not check.ok
    assert check.fix == "pip uninstall -y open3d open3d-cpu && pip install open3d"


def test_an_import_that_lacks_a_library_names_its_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fault = "raise ImportError('libGL.so.1: cannot open shared object file: No such file or directory')"
    fake_module(tmp_path, "open3d", fault, monkeypatch)
    check = doctor.module_check("open3d")
    assert not check.ok
    assert check.found == "ImportError: libGL.so.1: cannot open shared object file: No such file or directory"
    assert check.fix.endswith("apt-get install --no-install-recommends libgl1")


def test_an_import_that_crashes_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake_module(tmp_path, "cv2", f"import os; os.kill(os.getpid(), {int(signal.SIGILL)})", monkeypatch)
    check = doctor.module_check("cv2")
    assert not check.ok
    assert check.found == "crashed with SIGILL (a wheel built for a newer CPU?)"
    assert check.fix == "pip install --force-reinstall --no-deps opencv-python-headless"


def test_an_import_that_hangs_is_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_PROBE_SECONDS", 0.2)
    assert doctor.probe("import time; time.sleep(60)").fault == "no answer in 0.2 s"


def test_a_file_in_the_current_folder_is_not_imported_as_a_module(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "json.py").write_text("raise SystemExit(9)")
    monkeypatch.chdir(tmp_path)
    assert doctor.module_check("json").ok


def test_missing_packages_of_single_commands_are_noted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor.shutil, "which", lambda _: None)
    git, dvc, distributed, *others = doctor.optional_checks({"dvc": "3.67.1"})
    assert (git.ok, git.needed, git.found, git.fix) == (
        False,
        False,
        "not found; DVC needs it",
        "sudo apt-get install git",
    )
    assert (dvc.ok, dvc.found) == (True, "3.67.1")
    assert (distributed.ok, distributed.needed, distributed.fix) == (False, False, "pip install 'bask-data[cluster]'")
    [mujoco] = [check for check in others if check.name == "mujoco"]
    assert (mujoco.ok, mujoco.needed, mujoco.fix) == (False, False, "pip install 'bask-data[sim]'")


def test_rendering_is_checked_if_the_simulator_is_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    assert doctor.drawing_checks({}, Probe(False, "", "No module named 'mujoco'")) == []
    [works] = doctor.drawing_checks({"mujoco": "3.17.0"}, doctor.probe(doctor._DRAW))
    assert (works.ok, works.needed, works.found) == (True, False, "works")
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    monkeypatch.setenv("PYOPENGL_PLATFORM", "egl")
    [broken] = doctor.drawing_checks({"mujoco": "3.17.0"}, doctor.probe(doctor._DRAW))
    assert not broken.ok
    assert "OSMesa" in broken.found
    assert "libegl1 libegl-mesa0" in broken.fix


def torch_says(cuda: bool = False, built_for: str | None = None) -> Probe:
    document = {"version": "2.13.0", "built_for": built_for, "cuda": cuda, "name": "NVIDIA H100" if cuda else ""}
    return Probe(True, json.dumps(document))


@pytest.mark.parametrize(
    ("torch", "driver", "ok", "found", "fix"),
    [
        (torch_says(), None, True, "none; training runs on the CPU", ""),
        (torch_says(True, "13.0"), "580.95", True, "NVIDIA H100, CUDA 13.0", ""),
        (torch_says(), "580.95", False, "driver 580.95, but torch 2.13.0 is a CPU build", "with CUDA builds"),
        (
            torch_says(False, "13.0"),
            "470.1",
            False,
            "torch cannot use it with driver 470.1",
            "driver to one for CUDA 13.0",
        ),
        (Probe(False, "", "gone"), None, False, "unknown, as torch does not work", ""),
    ],
)
def test_a_gpu_is_never_needed_but_an_unusable_one_is_noted(
    torch: Probe, driver: str | None, ok: bool, found: str, fix: str
) -> None:
    check = doctor.cuda_check(torch, driver)
    assert (check.ok, check.found, check.needed) == (ok, found, False)
    assert fix in check.fix


def test_the_driver_version_is_read_from_nvidia_smi(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    command = tmp_path / "nvidia-smi"
    command.write_text("#!/bin/sh\necho 580.95.05\n")
    command.chmod(0o755)
    assert doctor.nvidia_driver_version() == "580.95.05"
    command.write_text("#!/bin/sh\necho has failed because it could not talk to the driver\nexit 9\n")
    assert doctor.nvidia_driver_version() is None
    monkeypatch.setenv("PATH", "")
    assert doctor.nvidia_driver_version() is None


def test_little_disk_space_is_noted_for_the_datasets_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda path: asked.append(path) or SimpleNamespace(free=10**9))
    check = doctor.disk_check(tmp_path / "not" / "there" / "yet")
    assert asked == [tmp_path]
    assert (check.ok, check.needed, check.found) == (False, False, f"1.0 GB free at {tmp_path}")


def test_a_report_shows_the_fix_of_failed_checks_only() -> None:
    fine = Check("numpy", True, "2.4.6", fix="pip install numpy")
    note = Check("git", False, "not found", needed=False, fix="sudo apt-get install git")
    fault = Check("torch", False, "not installed", fix="pip install torch")
    assert doctor.render([fine, note, fault]).splitlines() == [
        "ok       numpy: 2.4.6",
        "note     git: not found",
        "         fix: sudo apt-get install git",
        "MISSING  torch: not installed",
        "         fix: pip install torch",
    ]
    assert doctor.missing([fine, note, fault]) == [fault]
    assert json.loads(doctor.as_json([note]))[0]["needed"] is False


def test_set_up_gets_the_missing_packages_and_a_failed_check_is_exit_code_5(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(doctor, "missing_libraries", lambda: ["libusb-1.0.so.0", "libGL.so.1"])
    assert doctor.main(["--missing-packages"]) == 0
    assert capsys.readouterr().out == "libgl1 libusb-1.0-0\n"
    for ok, code in ((True, 0), (False, 5)):
        monkeypatch.setattr(doctor, "checks", lambda ok=ok: [Check("python", ok, sys.version)])
        assert doctor.main([]) == code
