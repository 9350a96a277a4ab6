"""A picker's server in this process, and a client for it."""

from __future__ import annotations

import contextlib
import http.client
import json
import socket
import threading
from collections.abc import Callable

from bask_data.picker.desk import Desk
from bask_data.picker.server import serve


class Served:
    """A server in a thread, and a client for it."""

    def __init__(self, desk: Desk) -> None:
        self.desk = desk
        self.run(lambda: serve(desk, 0, opened=self.open))

    def run(self, serving: Callable[[], None]) -> None:
        """Run `serving` in a thread until it calls `open`."""
        self._opened = threading.Event()
        self._thread = threading.Thread(target=serving, daemon=True)
        self._thread.start()
        assert self._opened.wait(60)

    def open(self, url: str) -> None:
        """Record the URL."""
        self.url = url
        self.host, _, rest = url.removeprefix("http://").partition("/")
        self.port, self.token = int(self.host.split(":")[1]), rest.partition("token=")[2]
        self._opened.set()

    def request(self, method: str, path: str, body: bytes | None = None, **headers: str) -> tuple[int, bytes]:
        named = {name.replace("_", "-"): value for name, value in headers.items()}
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=30)
        with contextlib.closing(connection):
            connection.request(method, path, body, named)
            answer = connection.getresponse()
            self.headers = answer.headers
            return answer.status, answer.read()

    def raw(self, text: bytes) -> int:
        """Status of the answer to raw bytes; 0 if the connection is closed without one."""
        with socket.create_connection(("127.0.0.1", self.port), timeout=30) as connection:
            connection.sendall(text)
            answer = connection.makefile("rb").readline()
        return int(answer.split()[1]) if answer else 0

    @property
    def headers_of_page(self) -> dict[str, str]:
        return {"X_Token": self.token, "Origin": f"http://{self.host}", "Content_Type": "application/json"}

    def ask(self, name: str, /, **body: object) -> tuple[int, bytes]:
        return self.request("POST", f"/api/{name}", json.dumps(body).encode(), **self.headers_of_page)

    def answer(self, name: str, /, **body: object) -> dict:
        status, text = self.ask(name, **body)
        assert status == 200, text
        return json.loads(text)

    def end(self) -> None:
        self.ask("close")
        self._thread.join(30)
        assert not self._thread.is_alive()
