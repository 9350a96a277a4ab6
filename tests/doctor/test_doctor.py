"""`bask-data doctor` on recordings and datasets, as it is typed."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from pathlib import Path
from typing import get_args

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner, Result

from bask_data.cli.app import app
from bask_data.dataset import Dataset
from bask_data.doctor.examination import Examination, ExaminedCamera, by_place, frames_of
from bask_data.doctor.page import render
from bask_data.doctor.text import FailOn, fails
from bask_data.findings import CODES, Finding
from tests.datasets import copied
from tests.scripts import script
from tests.tiny import write_recording


def run(*words: object) -> Result:
    return CliRunner().invoke(app, ["doctor", *map(str, words)])


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A recording on disk, and `--read-as` for it."""
    folder = tmp_path_factory.mktemp("doctor") / "table"
    options = write_recording(folder, n_frames=16)
    return folder, shlex.join(["frames", *options])


@pytest.fixture
def own(recording: tuple[Path, str], tmp_path: Path) -> tuple[Path, str]:
    """The test's own copy of the recording."""
    return Path(shutil.copytree(recording[0], tmp_path / "table")), recording[1]


def documented(answer: Result) -> dict:
    return json.loads(answer.stdout)


def codes_of(answer: Result) -> set[str]:
    return {finding["code"] for finding in documented(answer)["findings"]}


def test_a_good_recording_is_found_right(recording: tuple[Path, str]) -> None:
    source, read_as = recording
    answer = run(source, "--read-as", read_as)
    assert answer.exit_code == 0, answer.output
    assert re.search(r"table/wrist: reading: sure", answer.stdout)
    assert answer.stdout.splitlines()[-1].startswith(f"{source}: 0 errors, 0 warnings, ")


def test_rotated_bits_of_depth_are_an_error_of_their_own(own: tuple[Path, str]) -> None:
    source, read_as = own
    for path in source.glob("*.depth.png"):
        raw = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        raw[raw > 0] += 8192 - np.uint16(np.median(raw[raw > 0]))
        cv2.imwrite(str(path), (raw << 3) | (raw >> 13))
    answer = run(source, "--read-as", read_as, "--json")
    assert answer.exit_code == 4 and codes_of(answer) == {"depth-rotated"}


def test_a_wrong_unit_is_an_error_with_evidence_meaning_and_fix(recording: tuple[Path, str]) -> None:
    source, read_as = recording
    answer = run(source, "--read-as", read_as.replace("0.0001", "0.001"), "--json")
    assert answer.exit_code == 4
    document = documented(answer)
    [finding] = [each for each in document["findings"] if each["severity"] == "error"]
    assert finding["code"] == "other-unit" and finding["place"] == "table/wrist"
    assert finding["meaning"] == CODES["other-unit"].meaning
    assert "0.0001" in finding["fix"]
    assert document["counts"]["error"] == 1 and document["failed"]


def test_poses_that_point_the_other_way_are_an_error(own: tuple[Path, str]) -> None:
    source, read_as = own
    for file in source.glob("*.pose.txt"):
        np.savetxt(file, np.linalg.inv(np.loadtxt(file)))
    answer = run(source, "--read-as", read_as, "--json")
    assert answer.exit_code == 4
    assert "other-reading" in codes_of(answer)


def test_a_pose_that_is_not_finite_is_found_and_the_other_frames_are_examined(own: tuple[Path, str]) -> None:
    source, read_as = own
    np.savetxt(source / "frame-003.pose.txt", np.full((4, 4), np.inf))
    answer = run(source, "--read-as", read_as)
    assert answer.exit_code == 4
    assert "unreadable" in answer.stdout and "--skip-bad" in answer.stdout
    assert "table/wrist: reading: sure" in answer.stdout


def test_an_image_that_is_damaged_is_a_finding(own: tuple[Path, str]) -> None:
    source, read_as = own
    for file in source.glob("*.depth.png"):
        file.write_bytes(file.read_bytes()[:200])
    answer = run(source, "--read-as", read_as, "--json")
    assert answer.exit_code == 4
    assert codes_of(answer) == {"unreadable"}
    assert documented(answer)["cameras"] == []


def test_fail_on_says_from_which_severity_on_the_command_fails(filled: Dataset, tmp_path: Path) -> None:
    dataset = copied(filled, tmp_path / "dataset")
    (dataset.root / "old.zip").write_bytes(b"0")
    answer = run(dataset.root, "--fail-on", "warn", "--only", "demo-a")
    assert "unlisted-file" in answer.stdout
    assert answer.exit_code == 4


@pytest.mark.parametrize(
    ("code", "failing"),
    [
        ("damaged", {"error", "warning", "warn", "note"}),
        ("unlisted-file", {"warning", "warn", "note"}),
        ("stale", {"note"}),
        (None, set()),
    ],
)
def test_a_severity_fails_what_is_as_bad_or_worse(code: str | None, failing: set[str]) -> None:
    examination = Examination("data", findings=(Finding(code, "place", "evidence"),) if code else ())
    assert {level for level in get_args(FailOn) if fails(examination, level)} == failing


def test_a_dataset_and_its_recordings_are_examined(filled: Dataset) -> None:
    answer = run(filled.root, "--json")
    assert answer.exit_code == 0, answer.output
    document = documented(answer)
    assert [camera["place"] for camera in document["cameras"]] == ["scan-a/wrist", "demo-a/wrist"]
    assert document["cameras"][0]["n_frames"] == 6
    assert document["counts"]["error"] == 0
    assert any(sentence.startswith("objects and masks") for sentence in document["right"])


def test_only_some_recordings_of_a_dataset(filled: Dataset) -> None:
    document = documented(run(filled.root, "--only", "demo-a", "--json"))
    assert [camera["place"] for camera in document["cameras"]] == ["demo-a/wrist"]


def test_a_recording_that_is_gone_is_an_error_and_the_others_are_examined(filled: Dataset, tmp_path: Path) -> None:
    dataset = copied(filled, tmp_path / "dataset")
    shutil.rmtree(dataset.root / "scan" / "scan-a")
    answer = run(dataset.root, "--json")
    assert answer.exit_code == 4
    assert "damaged" in codes_of(answer)
    assert [camera["place"] for camera in documented(answer)["cameras"]] == ["demo-a/wrist"]


def test_the_page_holds_findings_pictures_and_nothing_from_elsewhere(
    recording: tuple[Path, str], tmp_path: Path
) -> None:
    source, read_as = recording
    file = tmp_path / "new" / "page.html"
    answer = run(source, "--read-as", read_as.replace("0.0001", "0.001"), "--report", file)
    page = file.read_text()
    assert answer.exit_code == 4
    assert "other-unit" in page and "reading: sure" not in page
    assert page.count("data:image/jpeg") >= 4
    assert re.findall(r'(?:src|href)="(?!data:|#)', page) == []
    assert list(file.parent.iterdir()) == [file]


def test_what_files_say_is_text_on_the_page_and_the_page_runs_no_script() -> None:
    evil = "<script>alert(1)</script>\"'"
    finding = Finding("unreadable", f"{evil}/wrist 3", evil, evil)
    page = render(
        Examination(evil, (ExaminedCamera(evil, {}, (finding,), (evil,)),), read_as=evil, assumptions={evil: evil})
    )
    assert "<script" not in page and "&lt;script&gt;" in page
    assert "content=\"default-src 'none'; img-src data:; style-src 'unsafe-inline'\"" in page


@pytest.mark.parametrize("depth_scale", ["0.0001", "0.001"])
def test_ingest_writes_the_page_also_when_it_refuses(recording, tmp_path: Path, depth_scale: str) -> None:
    source, read_as = recording
    options = shlex.split(read_as.replace("0.0001", depth_scale))[1:]
    file = tmp_path / "page.html"
    words = ["ingest", "frames", str(source), str(tmp_path / "data"), "--scene", "table", *options]
    answer = CliRunner().invoke(app, [*words, "--report", str(file)])
    is_refused = depth_scale == "0.001"
    assert answer.exit_code == (4 if is_refused else 0), answer.output
    assert (tmp_path / "data").exists() != is_refused
    page = file.read_text()
    assert ("other-unit" in page) == is_refused and "ingest frames" in page


def test_a_page_about_several_episodes_is_refused(tmp_path: Path) -> None:
    words = ["ingest", "rlbench", str(tmp_path), str(tmp_path / "data"), "--scene", "a", "--episode", "all"]
    answer = CliRunner().invoke(app, [*words, "--report", str(tmp_path / "page.html")])
    assert answer.exit_code == 2
    assert "--report: expected one episode, got several" in answer.stderr


def test_what_is_said_alike_of_several_places_is_said_once() -> None:
    places = [f"scan{i}/overhead" for i in range(6)]
    findings = [Finding("hardly-moves", place, "it rests") for place in places]
    other = Finding("frame-off", "scan0/wrist 12", "far off")
    groups = by_place([*findings, other])
    assert groups["scan0/wrist"] == [other]
    [one] = groups["scan0/overhead, scan1/overhead, scan2/overhead, scan3/overhead and 2 more"]
    assert (one.code, one.evidence) == ("hardly-moves", "it rests")
    assert next(iter(groups)) == "scan0/wrist"


@pytest.mark.parametrize(
    ("place", "evidence", "frames"),
    [
        ("table/wrist 12", "far off", [12]),
        ("table/wrist 3-5, 9", "far off", [3, 4, 5, 9]),
        ("table/wrist", "frame 7: 1.36 times as bright", [7]),
        ("table/wrist", "3 frames: 2, 8-9: off by 12 mm", [2, 8, 9]),
        ("table/wrist", "frames 4-6 repeat the colour image of the frame before", [4, 5, 6]),
        ("table/wrist", "36% of the pixels have depth in the median frame", []),
        ("masks of scan 2b", "none", []),
    ],
)
def test_frames_that_a_finding_names_are_shown(place: str, evidence: str, frames: list[int]) -> None:
    assert frames_of(Finding("frame-off", place, evidence)) == frames


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--report", "x.html"], "--report: expected a PATH, got none"),
        (["{source}", "--only", "a"], "--only: expected a dataset, got a recording"),
        (["{source}", "--read-as", "fames"], "--read-as: expected one of frames, tum"),
        (["{source}", "--read-as", "frames --colr x"], "expected an option of this command, got --colr.  fix: did you"),
        (["{source}", "--read-as", "frames --depth-scale x"], "--depth-scale"),
        (["{source}"], "--intrinsics"),
        (["{source}/frame-000.pose.txt"], "expected a dataset, or a recording of a known format"),
        (["{dataset}", "--read-as", "frames"], "--read-as: expected a recording, got a dataset"),
        (["{dataset}", "--only", "nobody"], "--only: expected one of"),
        (
            ["{dataset}", "--only", "demo-a", "--report", "{dataset}"],
            "--report: expected a file to write, got a folder",
        ),
        (["nowhere"], "expected a"),
    ],
)
def test_what_cannot_be_examined_is_refused(recording, filled: Dataset, words: list[str], message: str) -> None:
    answer = run(*(word.format(source=recording[0], dataset=filled.root) for word in words))
    assert answer.exit_code == 2, answer.output
    assert message in answer.stderr


def test_the_documentation_lists_the_codes_as_they_are() -> None:
    table = script("docs/doctor_table.py")
    page = table.PAGE.read_text()
    assert table.rendered(page) == page, "fix: python docs/doctor_table.py"
    assert all(f"| `{code}` | {CODES[code].severity} |" in page for code in CODES)


def test_a_page_without_a_place_for_the_codes_is_refused() -> None:
    with pytest.raises(ValueError, match="expected one place for the table"):
        script("docs/doctor_table.py").rendered("nothing")
