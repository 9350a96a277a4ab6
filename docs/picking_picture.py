"""Draw the picture of the picking page from the dataset that `make demo` leaves: python docs/picking_picture.py"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from playwright.sync_api import sync_playwright

HERE = Path(__file__).parent
SIZE = {"width": 1280, "height": 800}
N_POINTS = 9
POINTER = (0.41, 0.56)
"""Where the pointer is, as shares of the main picture."""
READY = "() => views.length && shownViews().every((view) => view.root.matches('.ready'))"


def main() -> None:
    """Propose some keypoints on the page, move over one of its pictures, and keep what it looks like."""
    with tempfile.TemporaryDirectory() as folder:
        root = shutil.copytree(HERE.parent / "build" / "demo" / "dataset", Path(folder) / "demo")
        options = ("--pick", "--no-browser", "--variant", "hand", "--descriptor", "main")
        command = [sys.executable, "-m", "bask_data.cli", "reference", str(root), *options]
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
            try:
                assert process.stderr is not None
                draw(next(line for line in process.stderr if line.startswith("open ")).split()[1])
            finally:
                process.terminate()


def draw(url: str) -> None:
    """Take the picture of the page at a link."""
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        page = browser.new_page(viewport=SIZE)
        page.goto(url)
        page.locator("#propose").click()
        page.locator("#propose-n").fill(str(N_POINTS))
        page.locator("#propose-go").click()
        page.wait_for_function(f"() => state.marks.length === {N_POINTS}", timeout=300_000)
        page.locator("#list li").first.click()
        page.wait_for_function(READY, timeout=300_000)
        box = page.locator("#main-view canvas").bounding_box()
        assert box is not None
        page.mouse.move(box["x"] + POINTER[0] * box["width"], box["y"] + POINTER[1] * box["height"])
        page.wait_for_timeout(2000)
        page.screenshot(path=HERE / "picking.jpg", type="jpeg", quality=85)
        browser.close()


if __name__ == "__main__":
    main()
