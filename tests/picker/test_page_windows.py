"""The page in windows of several sizes, and during long work of the server, in a real browser."""

from __future__ import annotations

import threading

import pytest

from bask_data.picker.draft import KeypointMark
from bask_data.progress import progress
from tests.picker.browsing import count, opened, proposals, ready, served_of, settled_text
from tests.picker.pickable import recordings_of

pytest.importorskip("uvicorn")
pytest.importorskip("starlette")
playwright = pytest.importorskip("playwright.sync_api")

MEASURED = """() => {
  const root = document.documentElement;
  const main = views[0], { scale, canvas } = main.viewport, box = main.canvas.getBoundingClientRect();
  const inner = (element) => {
    const box = element.getBoundingClientRect();
    return box.left >= 0 && box.top >= 0 && box.right <= innerWidth && box.bottom <= innerHeight;
  };
  return {
    filled: [scale * main.camera.width / canvas.width, scale * main.camera.height / canvas.height],
    width: box.width, n_views: shownViews().length,
    isInside: [...document.querySelectorAll(".bar button, .view:not([hidden]), aside, footer")].every(inner),
    isScrolled: root.scrollWidth > innerWidth || root.scrollHeight > innerHeight,
  };
}"""


OUTLINE = """() => {
  const { tagName } = document.activeElement, { outlineStyle, outlineWidth } = getComputedStyle(document.activeElement);
  return [tagName, outlineStyle, outlineWidth];
}"""


@pytest.mark.parametrize(
    ("width", "height", "least_width", "n_views"), [(800, 600, 400, 4), (1280, 800, 700, 5), (1920, 1080, 1100, 9)]
)
def test_the_main_picture_fills_its_column_and_nothing_is_cut_off(
    page, served_page, width: int, height: int, least_width: int, n_views: int
) -> None:
    page.set_viewport_size({"width": width, "height": height})
    opened(page, served_page.url)
    found = page.evaluate(MEASURED)
    assert min(found["filled"]) > 0.97
    assert found["width"] >= least_width
    assert found["n_views"] == n_views
    assert (found["isInside"], found["isScrolled"]) == (True, False)


def test_the_number_of_views_follows_the_size_of_the_window(page, served_page) -> None:
    page.set_viewport_size({"width": 800, "height": 600})
    opened(page, served_page.url)
    hidden = page.evaluate("() => views.filter((view) => !view.isShown).map((view) => [view.isLoaded, view.picture])")
    assert hidden == [[False, None]] * 5
    page.set_viewport_size({"width": 1920, "height": 1080})
    page.wait_for_function("() => shownViews().length === 9")
    ready(page)
    page.set_viewport_size({"width": 700, "height": 1000})
    page.wait_for_function("() => shownViews().at(-1).root.offsetTop > views[0].root.offsetHeight")
    assert not page.evaluate(MEASURED)["isScrolled"]


def test_the_element_with_keyboard_focus_is_outlined(page, served_page) -> None:
    opened(page, served_page.url)
    outlined = set()
    for _ in range(40):
        page.keyboard.press("Tab")
        tag, style, width = page.evaluate(OUTLINE)
        if tag != "BODY":
            assert (style, width) == ("solid", "2px"), tag
            outlined.add(tag)
    assert outlined >= {"BUTTON", "INPUT", "SELECT", "CANVAS"}


def test_proposing_shows_progress_across_a_reload_and_can_be_cancelled(page, page_dataset, tmp_path) -> None:
    go_on = threading.Event()

    def slow(scene: str, n: int) -> list[KeypointMark]:
        for i in progress(range(4 * n), "choosing keypoints"):
            if i == 2 * n:
                go_on.wait(60)
        return proposals(scene, n)

    def propose(n: int) -> None:
        page.locator("#propose").click()
        page.locator("#propose-n").fill(str(n))
        page.locator("#propose-go").click()

    with served_of(recordings_of(page_dataset), tmp_path, page, slow) as server:
        opened(page, server.url)
        propose(5)
        settled_text(page, "#job-title", "Proposing 5 keypoints in a")
        settled_text(page, "#job-time", "50 % · ")
        settled_text(page, "#job-time", " left")
        assert page.locator("#job-bar").evaluate("(bar) => bar.value") == 0.5
        assert page.locator("#propose").is_disabled()
        page.reload()
        settled_text(page, "#job-time", "50 % · ")
        page.locator("#job-cancel").click()
        settled_text(page, "#job-time", "cancelling …")
        go_on.set()
        playwright.expect(page.locator("#job")).to_be_hidden()
        playwright.expect(page.locator("#propose")).to_be_enabled()
        count(page, 0)
        propose(3)
        count(page, 3)
        playwright.expect(page.locator("#job")).to_be_hidden()


def test_a_command_that_ends_during_a_job_is_said_after_a_reload(page, page_dataset, tmp_path) -> None:
    go_on = threading.Event()

    def slow(scene: str, n: int) -> list[KeypointMark]:
        assert go_on.wait(60)
        return proposals(scene, n)

    with served_of(recordings_of(page_dataset), tmp_path, page, slow) as server:
        opened(page, server.url)
        page.locator("#propose").click()
        page.locator("#propose-go").click()
        settled_text(page, "#job-title", "Proposing")
        page.reload()
        settled_text(page, "#job-title", "Proposing keypoints")
        page.is_refused = True
        page.route("**/api/*", lambda route: route.abort())
        settled_text(page, "#status", "The command behind this page has ended")
        playwright.expect(page.locator("#job")).to_be_hidden()
        page.unroute("**/api/*")
        go_on.set()
