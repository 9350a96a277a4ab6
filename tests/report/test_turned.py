"""The surface that can be turned, in a real browser."""

from __future__ import annotations

import io
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from bask_data.dataset import Dataset
from bask_data.report import write_report
from tests.report.filled import make_views, publish_frames, publish_scene

BACKGROUND = np.array([44, 48, 56])
OPTIONS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
"""WebGL is drawn on the processor: test machines have no GPU."""


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("turned")
    dataset, seen = Dataset.create(folder / "d"), make_views(0.3, 6)
    publish_frames(dataset, "table", seen)
    publish_scene(dataset, "table", seen)
    return write_report(dataset, folder / "report.html")


@pytest.fixture(scope="module")
def browser() -> Iterator[object]:
    playwright = pytest.importorskip("playwright.sync_api")
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if chromium is None:
        pytest.skip("no Chromium is installed")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium, args=OPTIONS)
        yield browser
        browser.close()


def pixels(page) -> np.ndarray:
    from PIL import Image

    picture = Image.open(io.BytesIO(page.locator(".surface canvas").screenshot()))
    return np.asarray(picture.convert("RGB")).astype(int)


def test_the_surface_is_drawn_turned_zoomed_and_coloured_by_object(browser, file):
    page = browser.new_page(viewport={"width": 800, "height": 900})
    page.set_default_timeout(60_000)
    faults: list[str] = []
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.on("console", lambda line: faults.append(line.text) if line.type == "error" else None)
    page.goto(file.as_uri())
    page.locator("#reconstruction").scroll_into_view_if_needed()
    page.wait_for_selector(".surface.shown")
    first = pixels(page)
    assert 0.05 < (np.abs(first - BACKGROUND).max(axis=2) > 20).mean() < 0.95
    assert page.locator(".surface + .tiles").is_hidden(), "the pictures that the surface replaces"
    box = page.locator(".surface canvas").bounding_box()
    page.mouse.move(box["x"] + 200, box["y"] + 200)
    page.mouse.down()
    page.mouse.move(box["x"] + 320, box["y"] + 220, steps=4)
    page.mouse.up()
    page.wait_for_timeout(200)
    turned = pixels(page)
    assert np.abs(turned - first).mean() > 2
    page.mouse.wheel(0, -400)
    page.wait_for_timeout(200)
    zoomed = pixels(page)
    assert (np.abs(zoomed - BACKGROUND).max(axis=2) > 20).mean() > (np.abs(turned - BACKGROUND).max(axis=2) > 20).mean()
    page.get_by_role("button", name="Reset").click()
    page.wait_for_timeout(200)
    assert np.abs(pixels(page) - first).mean() < 1
    page.get_by_role("button", name="Objects").click()
    page.wait_for_timeout(200)
    by_object = pixels(page)
    assert np.abs(by_object - first).mean() > 1
    assert faults == []
    page.close()


def test_without_a_script_the_pictures_stay(browser, file):
    context = browser.new_context(java_script_enabled=False)
    page = context.new_page()
    page.goto(file.as_uri())
    assert page.locator(".surface + .tiles").is_visible()
    assert page.locator(".surface").bounding_box()["height"] == 0
    context.close()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_narrow_page_does_not_scroll_sideways_and_hides_its_contents(browser, file, scheme):
    context = browser.new_context(viewport={"width": 390, "height": 844}, color_scheme=scheme)
    page = context.new_page()
    page.goto(file.as_uri())
    assert page.evaluate("document.documentElement.scrollWidth") == 390
    assert page.locator("nav.aside").is_hidden()
    assert not page.locator(".contents nav").is_visible()
    page.locator(".contents > summary").click()
    assert page.locator(".contents nav").is_visible()
    badges = page.locator(".verdicts .badge, .next")
    for i in range(badges.count()):
        assert (
            contrast(*badges.nth(i).evaluate("e => [getComputedStyle(e).color, getComputedStyle(e).backgroundColor]"))
            > 4.5
        )
    context.close()


def contrast(*colours: str) -> float:
    """Ratio of the luminances of two CSS colours, as WCAG 2 defines it."""

    def luminance(css: str) -> float:
        rgb = np.array([float(x) for x in css[css.index("(") + 1 : -1].split(",")[:3]]) / 255
        return float(np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4) @ [0.2126, 0.7152, 0.0722])

    low, high = sorted(map(luminance, colours))
    return (high + 0.05) / (low + 0.05)
