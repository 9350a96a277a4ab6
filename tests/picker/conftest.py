"""Fixtures with a real browser and the page's server."""

from __future__ import annotations

import shutil
from collections.abc import Iterator

import pytest

from bask_data.dataset import Dataset
from tests.datasets import copied
from tests.picker.browsing import served_of
from tests.picker.pickable import recordings_of
from tests.picker.serving import Served


@pytest.fixture(scope="module")
def browser() -> Iterator[object]:
    playwright = pytest.importorskip("playwright.sync_api")
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if chromium is None:
        pytest.skip("no Chromium is installed")
    # As patient as the page's actions: by default an expectation fails after 5 seconds, on a busy machine too soon.
    playwright.expect.set_options(timeout=60_000)
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture
def page(browser) -> Iterator[object]:
    page = browser.new_page(viewport={"width": 1400, "height": 860})
    page.set_default_timeout(60_000)
    # The browser logs each failed request; tests that provoke one set `is_refused`.
    page.faults, page.is_refused = [], False
    page.on("pageerror", lambda error: page.faults.append(str(error)))
    page.on("console", lambda line: page.faults.append(line.text) if line.type == "error" else None)
    yield page
    page.close()
    assert page.is_refused or page.faults == []


@pytest.fixture(scope="module")
def page_dataset(pickable, tmp_path_factory) -> Dataset:
    return copied(pickable, tmp_path_factory.mktemp("page") / "d")


@pytest.fixture
def served_page(page, page_dataset, tmp_path) -> Iterator[Served]:
    with served_of(recordings_of(page_dataset), tmp_path, page) as server:
        yield server
