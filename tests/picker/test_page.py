"""The page in a real browser."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from bask_data.cli.app import app
from bask_data.kinds import ReferenceKeypoints
from bask_data.picker.desk import Desk
from bask_data.picker.draft import Draft
from bask_data.picker.gallery import Gallery
from tests.nn import pairs
from tests.picker.browsing import click, count, frame_in, opened, pixels, place_of, ready, served_of, settled
from tests.picker.pickable import N_VIEWS, recordings_of, untrained
from tests.picker.serving import Served

pytest.importorskip("uvicorn")
pytest.importorskip("starlette")
playwright = pytest.importorskip("playwright.sync_api")


def spread_over(instance: np.ndarray, label: int, n: int) -> list[tuple[int, int]]:
    """Pixels (u, v) of an object, away from its edge and at least a few pixels apart."""
    from scipy.ndimage import binary_erosion

    inner = np.argwhere(binary_erosion(instance == label, iterations=2))
    chosen = [inner[0]]
    while len(chosen) < n:
        apart = np.linalg.norm(inner[:, None] - np.array(chosen)[None], axis=-1).min(axis=1)
        assert apart.max() > 2
        chosen.append(inner[apart.argmax()])
    return [(int(u), int(v)) for v, u in chosen]


@contextmanager
def ended(process: subprocess.Popen) -> Iterator[subprocess.Popen]:
    """The process, killed at the end of the test."""
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def test_sixteen_points_over_two_objects_survive_a_reload_and_are_saved(page, page_dataset) -> None:
    command = [
        sys.executable,
        "-m",
        "bask_data.cli",
        "reference",
        page_dataset.root,
        "--pick",
        "--no-browser",
        "--json",
    ]
    with ended(subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)) as process:
        line = next(line for line in process.stderr if line.startswith("open "))
        opened(page, line.split()[1])
        frame_in(page, 0, "a", 1)
        _, _, images = pairs.views(N_VIEWS, 0)
        wanted = [(u, v, label) for label in (1, 2) for u, v in spread_over(images[1].instance, label, 8)]
        for i, (u, v, _) in enumerate(wanted):
            click(page, u, v, i + 1)
        page.reload()
        ready(page)
        count(page, 16)
        page.keyboard.press("Control+z")
        count(page, 15)
        page.locator("#redo").click()
        count(page, 16)
        page.locator("#undo").click()
        count(page, 15)
        click(page, *wanted[15][:2], n_after=16)
        page.keyboard.press("Control+s")
        playwright.expect(page.locator("#saved-text")).to_have_text(
            # An untrained network confuses some of them.
            re.compile(r"16 keypoints saved as reference/main( \(ambiguous: .+\))?")
        )
        assert page.locator("#saved-next").inner_text() == f"bask-data encode {page_dataset.root}"
        page.locator("#finish").click()
        playwright.expect(page.locator("body")).to_have_text("Saved. You can close this page.")
        notes = process.stderr.read()
        results = json.loads(process.stdout.read())
        assert process.wait(60) == 0, notes
    assert f"next: bask-data encode {page_dataset.root}\n" in notes
    assert [(outcome["label"], outcome["status"]) for outcome in results["outcomes"]] == [("reference", "made")]
    kept = ReferenceKeypoints(page_dataset.path(ReferenceKeypoints))
    assert [(pick.recording, pick.frame, pick.instance) for pick in kept.picks] == [("a", 1, i) for _, _, i in wanted]
    np.testing.assert_allclose([(pick.u, pick.v) for pick in kept.picks], [uvi[:2] for uvi in wanted], atol=0.3)
    section = yaml.safe_load((page_dataset.root / "params.yaml").read_text())["reference@main"]
    assert (len(section["picks"]), section["auto"]) == (16, False)
    rows = json.loads(CliRunner().invoke(app, ["status", str(page_dataset.root), "--json"]).stdout)["artifacts"]
    assert {"stage": "reference", "label": "reference", "status": "up to date", "why": ""} in rows


def test_a_single_recording_fills_every_view(page, page_dataset, tmp_path) -> None:
    with served_of({"a": recordings_of(page_dataset)["a"]}, tmp_path, page) as server:
        opened(page, server.url)
        assert page.locator(".view.ready").count() == 9
        shown = page.evaluate("views.map((view) => view.frame.join())")
        assert len(set(shown[:N_VIEWS])) == N_VIEWS  # Frames repeat only when all are shown.


def test_a_keypoint_is_dragged_renamed_and_deleted(page, served_page) -> None:
    opened(page, served_page.url)
    click(page, 30, 40, 1)
    click(page, 90, 60, 2)
    page.mouse.move(*place_of(page, 30, 40))
    page.mouse.down()
    page.mouse.move(*place_of(page, 50, 45), steps=5)
    page.mouse.up()
    page.locator("#list li").first.dblclick()
    page.locator(".name-field").fill("rim")
    page.keyboard.press("Enter")
    playwright.expect(page.locator("#list li .name").first).to_contain_text("rim")
    rim, other = served_page.desk.draft.marks
    assert (rim.name, other.name) == ("rim", "point_2")
    np.testing.assert_allclose([rim.u, rim.v, other.u, other.v], [50, 45, 90, 60], atol=0.3)
    page.locator("#list li").first.click()
    page.keyboard.press("Delete")
    count(page, 1)
    assert [mark.name for mark in served_page.desk.draft.marks] == ["point_2"]
    page.keyboard.press("Control+z")
    count(page, 2)
    assert [mark.name for mark in served_page.desk.draft.marks] == ["rim", "point_2"]


def test_a_taken_name_is_reported(page, served_page) -> None:
    opened(page, served_page.url)
    click(page, 30, 40, 1)
    click(page, 90, 60, 2)
    page.keyboard.press("F2")
    page.locator(".name-field").fill("point_1")
    page.keyboard.press("Enter")
    playwright.expect(page.locator("#status")).to_contain_text(
        "expected a name that no other keypoint has, got point_1"
    )
    page.is_refused = True
    assert [mark.name for mark in served_page.desk.draft.marks] == ["point_1", "point_2"]


def test_everything_can_be_done_with_the_keyboard(page, served_page) -> None:
    opened(page, served_page.url)
    frame = page.locator(".frame").first.input_value()
    page.locator(".screen canvas").first.focus()
    for key in ("ArrowRight", "ArrowRight", "ArrowDown", "Enter"):
        page.keyboard.press(key)
    count(page, 1)
    [mark] = served_page.desk.draft.marks
    np.testing.assert_allclose([mark.u, mark.v], [63.5 + 2, 47.5 + 1])
    # The new keypoint is selected: arrows move it, and quick presses are one step.
    for key in ("Shift+ArrowLeft", "ArrowUp"):
        page.keyboard.press(key)
    for _ in range(200):
        if served_page.desk.draft.marks[0].u != mark.u:
            break
        page.wait_for_timeout(50)
    np.testing.assert_allclose([served_page.desk.draft.marks[0].u, served_page.desk.draft.marks[0].v], [55.5, 47.5])
    page.keyboard.press("Control+z")
    playwright.expect(page.locator("#redo")).to_be_enabled()
    assert served_page.desk.draft.marks == (mark,)
    page.keyboard.press(".")
    playwright.expect(page.locator(".frame").first).to_have_value(str(int(frame) + 1))
    page.keyboard.press("Escape")
    page.keyboard.press("?")
    assert page.locator("#keys").is_visible()
    page.keyboard.press("Escape")
    assert not page.locator("#keys").is_visible()


def test_hovering_lights_up_all_frames_and_h_turns_it_off(page, served_page) -> None:
    opened(page, served_page.url)
    before = [pixels(page, view) for view in range(3)]
    page.mouse.move(*place_of(page, 60, 50))
    for view in range(3):
        settled(page, view, lambda found, view=view: np.abs(found - before[view]).mean() > 5)
    page.keyboard.press("h")
    for view in (1, 2):
        # A ring at the best match remains.
        settled(page, view, lambda found, view=view: (np.abs(found - before[view]).max(axis=-1) > 30).mean() < 0.02)


def test_each_keypoint_is_shown_at_its_best_match(page, served_page) -> None:
    opened(page, served_page.url)
    before = pixels(page, 1)
    click(page, 60, 50, 1)
    page.mouse.move(3, 3)
    page.keyboard.press("Escape")
    settled(page, 1, lambda found: 0 < (np.abs(found - before).max(axis=-1) > 40).mean() < 0.02)
    page.keyboard.press("m")
    settled(page, 1, lambda found: np.abs(found - before).max() < 20)


def test_proposals_are_added_and_undone_as_one_step(page, served_page) -> None:
    opened(page, served_page.url)
    page.locator("#propose").click()
    page.locator("#propose-scene").select_option("b")
    page.locator("#propose-n").fill("5")
    page.locator("#propose-go").click()
    count(page, 5)
    assert {mark.recording for mark in served_page.desk.draft.marks} == {"b"}
    page.locator("#undo").click()
    count(page, 0)
    page.locator("#propose").click()
    page.keyboard.press("Escape")
    playwright.expect(page.locator("#propose-dialog")).to_be_hidden()
    count(page, 0)


def test_swapped_frames_survive_a_reload(page, served_page) -> None:
    opened(page, served_page.url)
    frame_in(page, 0, "lift", 1)
    frame_in(page, 2, "b", 3)
    page.locator(".swap").nth(2).click()
    playwright.expect(page.locator(".recording").first).to_have_value("b")
    playwright.expect(page.locator(".recording").nth(2)).to_have_value("lift")
    page.reload()
    ready(page)
    shown = [
        page.locator(".recording").nth(i).input_value() + page.locator(".frame").nth(i).input_value() for i in (0, 2)
    ]
    assert shown == ["b3", "lift1"]


def test_the_end_of_the_server_is_reported(page, page_dataset, tmp_path) -> None:
    desk = Desk(
        Gallery(recordings_of(page_dataset), untrained()),
        Draft(tmp_path / "picks.json"),
        propose=lambda scene, n: [],
        save=lambda marks: ("", ""),
        title="table",
    )
    server = Served(desk)
    opened(page, server.url)
    server.end()
    page.mouse.click(*place_of(page, 60, 50))
    playwright.expect(page.locator("#status")).to_contain_text("Your keypoints are kept: start it again.")
    page.is_refused = True
