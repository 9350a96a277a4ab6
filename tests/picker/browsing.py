"""A user's actions on the page, and what the page shows."""

from __future__ import annotations

import io
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from bask_data.kinds import Recording
from bask_data.picker.desk import Desk
from bask_data.picker.draft import Draft, KeypointMark
from bask_data.picker.gallery import Gallery
from tests.picker.pickable import HEIGHT, WIDTH, untrained
from tests.picker.serving import Served

Propose = Callable[[str, int], list[KeypointMark]]


def proposals(scene: str, n: int) -> list[KeypointMark]:
    """Keypoints in a row."""
    return [
        KeypointMark(name=f"object_{i}", recording=scene, camera="wrist", frame=1, u=40 + i, v=50) for i in range(n)
    ]


@contextmanager
def served_of(
    recordings: dict[str, Recording],
    tmp_path: Path,
    page,
    propose: Callable[[str, int], list[KeypointMark]] = proposals,
) -> Iterator[Served]:
    """A server without the dataset's stages; the page is left before the server ends."""
    desk = Desk(
        Gallery(recordings, untrained()),
        Draft(tmp_path / "picks.json"),
        propose=propose,
        save=lambda marks: ("", ""),
        title="table",
    )
    server = Served(desk)
    try:
        yield server
    finally:
        page.goto("about:blank")  # Requests after the server's end would count as faults.
        server.end()


def ready(page) -> None:
    """Wait until every visible view has its picture and can be searched."""
    page.wait_for_function(
        "() => views.length && shownViews().length && shownViews().every((view) => view.root.matches('.ready'))"
    )


def opened(page, url: str) -> None:
    page.goto(url)
    ready(page)


def place_of(page, u: float, v: float, view: int = 0) -> tuple[float, float]:
    """Position on the page, CSS pixels, of a pixel (u, v) in a view."""
    box = page.locator(".screen canvas").nth(view).bounding_box()
    zoom = min(box["width"] / WIDTH, box["height"] / HEIGHT)
    x, y = box["x"] + (box["width"] - zoom * WIDTH) / 2, box["y"] + (box["height"] - zoom * HEIGHT) / 2
    return x + zoom * (u + 0.5), y + zoom * (v + 0.5)


def count(page, n: int) -> None:
    """Wait until the page shows n keypoints."""
    import playwright.sync_api as playwright

    playwright.expect(page.locator("#count")).to_have_text(str(n))


def click(page, u: float, v: float, n_after: int) -> None:
    page.mouse.click(*place_of(page, u, v))
    count(page, n_after)


def frame_in(page, view: int, recording: str, i_frame: int) -> None:
    """Show a frame in a view."""
    page.locator(".recording").nth(view).select_option(recording)
    page.locator(".frame").nth(view).fill(str(i_frame))
    ready(page)


def pixels(page, view: int) -> np.ndarray:
    from PIL import Image

    picture = Image.open(io.BytesIO(page.locator(".screen").nth(view).screenshot()))
    return np.asarray(picture.convert("RGB")).astype(int)


def settled(page, view: int, is_enough) -> np.ndarray:
    """A view's pixels as soon as `is_enough` holds: drawing follows the server's answers."""
    for _ in range(200):
        shown = pixels(page, view)
        if is_enough(shown):
            return shown
        time.sleep(0.1)
    raise AssertionError("the view never reached the expected look")


def settled_text(page, selector: str, text: str) -> None:
    """Wait until an element contains a text."""
    import playwright.sync_api as playwright

    playwright.expect(page.locator(selector)).to_contain_text(text)
