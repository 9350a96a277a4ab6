"""Zooming and panning the page's pictures in a real browser: picks stay exact."""

from __future__ import annotations

import math
from collections.abc import Iterator

import cv2
import numpy as np
import pytest

from tests.picker.browsing import click, count, frame_in, opened, place_of, settled_text
from tests.picker.pickable import HEIGHT, WIDTH, frame

pytest.importorskip("uvicorn")
pytest.importorskip("starlette")
playwright = pytest.importorskip("playwright.sync_api")

WHEEL_OF_FOUR = -math.log(4) / 0.0015
"""Turn of the wheel that enlarges four times."""


MIDDLE_OF_LOUPE = """() => {
  const loupe = $("loupe");
  return [...loupe.getContext("2d").getImageData(loupe.width / 2, loupe.height / 2, 1, 1).data];
}"""


class Enlarged:
    """Expected positions of pixels on the main picture, enlarged about a pixel, computed independently of the page.

    A mouse is at whole CSS pixels only: the centre is the one nearest to (u, v).
    """

    def __init__(self, page, u: float, v: float, zoom: float = 4.0) -> None:
        box = page.locator(".screen canvas").first.bounding_box()
        fit = min(box["width"] / WIDTH, box["height"] / HEIGHT)
        x, y = place_of(page, u, v)
        self.x, self.y, self.scale = round(x), round(y), zoom * fit
        self.u, self.v = u + (self.x - x) / fit, v + (self.y - y) / fit

    def place(self, u: float, v: float) -> tuple[int, int]:
        """The whole CSS pixel nearest to a pixel of the image."""
        return round(self.x + self.scale * (u - self.u)), round(self.y + self.scale * (v - self.v))

    def pixel(self, x: int, y: int) -> tuple[float, float]:
        """The pixel of the image at a position on the page."""
        return self.u + (x - self.x) / self.scale, self.v + (y - self.y) / self.scale


def enlarged(page, u: float, v: float) -> Enlarged:
    """Enlarge the main picture four times about a pixel, with the wheel."""
    before = Enlarged(page, u, v)
    page.mouse.move(before.x, before.y)
    page.mouse.wheel(0, WHEEL_OF_FOUR)
    playwright.expect(page.locator("#main-view .zoom")).to_have_text("4.0×")
    return before


def test_a_pick_at_zoom_four_is_the_pixel_computed_and_so_are_heat_map_and_reading(page, served_page) -> None:
    opened(page, served_page.url)
    seen = enlarged(page, 60.0, 50.0)
    places = [seen.place(u, v) for u, v in ((60.0, 50.0), (66.3, 45.2), (52.4, 57.7))]
    wanted = [seen.pixel(*place) for place in places]
    for i, (place, (u, v)) in enumerate(zip(places, wanted, strict=True), start=1):
        page.mouse.move(*place)
        settled_text(page, "#status", f": {u:.1f}, {v:.1f}")
        asked = page.evaluate("() => [heat.at.u, heat.at.v]")
        np.testing.assert_allclose(asked, [u, v], atol=1e-3)
        page.mouse.click(*place)
        count(page, i)
        page.keyboard.press("Escape")
    found = [(mark.u, mark.v) for mark in served_page.desk.draft.marks]
    np.testing.assert_allclose(found, wanted, atol=0.051)  # The draft keeps tenths.


def test_a_keypoint_is_dragged_exactly_while_the_picture_is_enlarged(page, served_page) -> None:
    opened(page, served_page.url)
    click(page, 60, 50, 1)
    seen = enlarged(page, 58.0, 48.0)
    page.mouse.move(*seen.place(60, 50))
    page.mouse.down()
    to = seen.place(55.5, 52.5)
    page.mouse.move(*to, steps=4)
    page.mouse.up()
    playwright.expect(page.locator("#undo")).to_be_enabled()
    for _ in range(100):
        if served_page.desk.draft.marks[0].u < 56:
            break
        page.wait_for_timeout(50)
    [mark] = served_page.desk.draft.marks
    np.testing.assert_allclose([mark.u, mark.v], seen.pixel(*to), atol=0.051)


@pytest.mark.parametrize("way", ["middle button", "space"])
def test_panning_moves_the_pixel_with_the_pointer_and_picks_nothing(page, served_page, way: str) -> None:
    opened(page, served_page.url)
    seen = enlarged(page, 60.0, 50.0)
    x, y = seen.place(60, 50)
    page.mouse.move(x, y)
    if way == "space":
        page.locator("#main-view canvas").focus()
        page.keyboard.down(" ")
    button = "middle" if way == "middle button" else "left"
    page.mouse.down(button=button)
    page.mouse.move(x + 70, y - 40, steps=5)
    page.mouse.up(button=button)
    if way == "space":
        page.keyboard.up(" ")
    assert served_page.desk.draft.marks == ()
    page.mouse.click(x + 70, y - 40)
    count(page, 1)
    [mark] = served_page.desk.draft.marks
    np.testing.assert_allclose([mark.u, mark.v], seen.pixel(x, y), atol=0.051)


def test_the_picture_stays_in_its_view_and_zooming_out_ends_at_the_whole_picture(page, served_page) -> None:
    opened(page, served_page.url)
    seen = enlarged(page, 60.0, 50.0)
    page.mouse.down(button="middle")
    page.mouse.move(seen.x + 5000, seen.y + 5000)
    page.mouse.up(button="middle")
    left, top = page.evaluate("() => [views[0].viewport.x, views[0].viewport.y]")
    assert (left, top) == (0, 0)
    page.mouse.move(seen.x, seen.y)
    page.mouse.wheel(0, 9000)
    playwright.expect(page.locator("#main-view .zoom")).to_be_hidden()
    click(page, 30, 40, 1)
    [mark] = served_page.desk.draft.marks
    np.testing.assert_allclose([mark.u, mark.v], [30, 40], atol=0.051)


def test_keys_zoom_about_the_cross_which_stays_visible_and_zero_shows_the_whole_picture(page, served_page) -> None:
    opened(page, served_page.url)
    page.locator("#main-view canvas").focus()
    page.keyboard.press("ArrowRight")
    for _ in range(4):
        page.keyboard.press("+")
    playwright.expect(page.locator("#main-view .zoom")).to_have_text("5.1×")
    for _ in range(5):
        page.keyboard.press("Shift+ArrowRight")
    x, y = page.evaluate("() => views[0].viewport.toCanvas(hovered.u, hovered.v)")
    box = page.locator("#main-view canvas").bounding_box()
    assert 0 < x < box["width"] and 0 < y < box["height"]
    page.keyboard.press("Enter")
    count(page, 1)
    [mark] = served_page.desk.draft.marks
    np.testing.assert_allclose([mark.u, mark.v], [63.5 + 51, 47.5])
    page.keyboard.press("0")
    playwright.expect(page.locator("#main-view .zoom")).to_be_hidden()
    page.keyboard.press("+")
    page.locator("#main-view .zoom").click()
    playwright.expect(page.locator("#main-view .zoom")).to_be_hidden()


def test_another_frame_of_the_camera_keeps_the_zoom_and_another_recording_resets_it(page, served_page) -> None:
    opened(page, served_page.url)
    frame_in(page, 0, "a", 1)
    enlarged(page, 60.0, 50.0)
    page.locator("#main-view .frame").fill("2")
    playwright.expect(page.locator("#main-view .zoom")).to_have_text("4.0×")
    frame_in(page, 0, "b", 0)
    assert page.evaluate("() => views[0].viewport.zoom") == 1


def test_the_loupe_shows_the_pixel_that_a_click_picks(page, served_page) -> None:
    opened(page, served_page.url)
    frame_in(page, 0, "b", 1)
    data = np.frombuffer(served_page.desk.gallery.picture(frame("b", 1)), np.uint8)
    picture = cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1]
    for u, v in ((60, 50), (61, 50), (20, 80)):
        page.mouse.move(*place_of(page, u, v))
        settled_text(page, "#status", f": {u:.1f}, {v:.1f}")
        page.evaluate("() => new Promise(requestAnimationFrame)")
        middle = page.evaluate(MIDDLE_OF_LOUPE)
        np.testing.assert_allclose(middle[:3], picture[v, u], atol=3)
    playwright.expect(page.locator("#loupe")).to_be_visible()
    page.keyboard.press("l")
    playwright.expect(page.locator("#loupe")).to_be_hidden()


@pytest.fixture
def touched(browser, served_page) -> Iterator[object]:
    """The page on a touch screen."""
    page = browser.new_page(viewport={"width": 1400, "height": 860}, has_touch=True)
    opened(page, served_page.url)
    yield page
    page.close()


class Fingers:
    """Fingers on the screen, through Chromium's DevTools protocol."""

    def __init__(self, page) -> None:
        self.session = page.context.new_cdp_session(page)

    def send(self, kind: str, *points: tuple[float, float]) -> None:
        fingers = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(points)]
        self.session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": fingers})


def test_two_fingers_zoom_about_their_midpoint_and_a_tap_picks_exactly(touched, served_page) -> None:
    fingers, seen = Fingers(touched), Enlarged(touched, 60.0, 50.0)
    x, y = seen.x, seen.y
    fingers.send("touchStart", (x - 30, y))
    fingers.send("touchStart", (x - 30, y), (x + 30, y))
    for share in (45, 75, 120):
        fingers.send("touchMove", (x - share, y), (x + share, y))
    fingers.send("touchEnd")
    playwright.expect(touched.locator("#main-view .zoom")).to_have_text("4.0×")
    assert served_page.desk.draft.marks == ()
    place = seen.place(66.0, 46.0)
    touched.touchscreen.tap(*place)
    count(touched, 1)
    [mark] = served_page.desk.draft.marks
    np.testing.assert_allclose([mark.u, mark.v], seen.pixel(*place), atol=0.051)


def test_one_finger_pans_an_enlarged_picture_and_picks_nothing(touched, served_page) -> None:
    fingers = Fingers(touched)
    seen = enlarged(touched, 60.0, 50.0)
    before = touched.evaluate("() => views[0].viewport.x")
    fingers.send("touchStart", (seen.x, seen.y))
    for step in (10, 40, 60):
        fingers.send("touchMove", (seen.x + step, seen.y))
    fingers.send("touchEnd")
    moved = touched.evaluate("() => views[0].viewport.x") - before
    assert 45 <= moved <= 60  # The distance that distinguishes a drag from a tap is not panned.
    assert served_page.desk.draft.marks == ()
