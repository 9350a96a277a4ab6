"""Ways to show a recording: in the viewer's own window, or in a browser."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from urllib.parse import quote

from bask_data.errors import BaskError, UsageError

LOOPBACK = "127.0.0.1"
VIEWER = (sys.executable, "-m", "rerun", "--new", "--bind", LOOPBACK)
"""By default the viewer listens on all network interfaces, and hands files to a viewer that is already open."""


def has_display(environment: Mapping[str, str] = os.environ, platform: str = sys.platform) -> bool:
    """Whether a window can be opened."""
    if platform in ("darwin", "win32"):
        return True
    return bool(environment.get("DISPLAY") or environment.get("WAYLAND_DISPLAY"))


def show(file: Path, command: tuple[str, ...] = VIEWER) -> None:
    """Open a recording in the viewer, and return when its window is closed.

    Args:
        command: starts the viewer, with the file as its last argument.

    Raises:
        BaskError: the viewer fails.
    """
    code = subprocess.run([*command, str(file)], check=False).returncode
    if code:
        raise BaskError(
            "rerun", "", expected="a working viewer", got=f"exit code {code}", fix="use --web, or --save FILE.rrd."
        )


def serve(file: Path, port: int, *, say: Callable[[str], None], wait: Callable[[], None] | None = None) -> None:
    """Show a recording in browsers of this machine until interrupted.

    The viewer is at `port`, the recording at the next one, read from disk for each request.

    Args:
        say: called with the address when the viewer is ready.
        wait: returns when serving is to end; by default never.

    Raises:
        UsageError: a port is in use.
    """
    import rerun as rr

    handler = partial(_OneFile, file, f"http://{LOOPBACK}:{port}")
    try:
        server = ThreadingHTTPServer((LOOPBACK, port + 1), handler)
    except (OSError, OverflowError) as error:
        raise _port_taken(port, error) from error
    with server:
        try:
            rr.serve_web_viewer(web_port=port, open_browser=False)
        except RuntimeError as error:
            raise _port_taken(port, error) from error
        Thread(target=server.serve_forever, daemon=True).start()
        say(f"http://{LOOPBACK}:{port}/?url=http://{LOOPBACK}:{port + 1}/{quote(file.name)}")
        try:
            (wait or _forever)()
        finally:
            server.shutdown()


def _port_taken(port: int, error: Exception) -> UsageError:
    expected = f"ports {port} and {port + 1} free"
    return UsageError("view", "--port", expected=expected, got=str(error), fix="give another --port.")


def _forever() -> None:
    while True:
        time.sleep(3600)


class _OneFile(BaseHTTPRequestHandler):
    """Serves one file, for any request, to pages of one origin."""

    def __init__(self, file: Path, origin: str, *request: object) -> None:
        self._file, self._origin = file, origin
        super().__init__(*request)  # type: ignore[arg-type]

    def do_GET(self) -> None:
        with self._file.open("rb") as stream:
            self.send_response(200)
            self.send_header("Content-Type", "application/octet-stream")
            self.send_header("Content-Length", str(os.fstat(stream.fileno()).st_size))
            # Without it browsers refuse the file; with "*", any open page could read the recording.
            self.send_header("Access-Control-Allow-Origin", self._origin)
            self.end_headers()
            shutil.copyfileobj(stream, self.wfile, 2**20)

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing."""
