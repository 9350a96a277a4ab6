"""The page's server: on this machine only, for those who have the link, and for nothing but what is listed here."""

from __future__ import annotations

import secrets
import socket
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_type_hints
from urllib.parse import parse_qs

from pydantic import ValidationError

from bask_data.errors import BaskError, UsageError, imported
from bask_data.picker.desk import Desk
from bask_data.picker.draft import fault_in_json
from bask_data.picker.requests import Request

if TYPE_CHECKING:
    from starlette.applications import Starlette
    from starlette.requests import Request as HttpRequest
    from starlette.responses import Response
    from starlette.types import ASGIApp, Receive, Scope, Send

LOOPBACK = "127.0.0.1"
MOST_BODY_BYTES = 64 * 1024
"""Bytes of a request's body. The largest that the page sends, a search in seven frames, takes 0.6 kB, and 4 kB with the
longest names. It keeps a hostile request from filling memory, so a quarter or ten times of it are as good."""

HEADERS = {
    "Cache-Control": "no-store",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}
PAGE = Path(__file__).parent / "page"
STYLE = ("controls.css", "views.css", "panels.css")
PROGRAM = tuple(
    f"{name}.js"
    for name in (
        *("state", "server", "frames", "viewport", "pointers", "view", "heat"),
        *("paint", "loupe", "layout", "list", "jobs", "start"),
    )
)
"""One program in several files; what one defines, the later ones may use while they are read."""


class Guard:
    """Lets through what a page of this server asks for, and its first opening by the link; refuses all else.

    Other pages that the same browser has open can send requests here too. They are told by their origin; those that
    reach this address under a name of their own, by the host. Neither has the token.
    """

    def __init__(self, app: ASGIApp, hosts: frozenset[str], token: str) -> None:
        self._app, self._hosts, self._token = app, hosts, token.encode()
        self._origins = frozenset(f"http://{host}" for host in hosts)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer 403 or hand on."""
        if scope["type"] == "lifespan" or self._is_allowed(scope):
            await self._app(scope, receive, send)
            return
        if scope["type"] == "http":
            from starlette.responses import PlainTextResponse

            text = "Refused. Open the link that bask-data printed.\n"
            await PlainTextResponse(text, 403, HEADERS)(scope, receive, send)

    def _is_allowed(self, scope: Scope) -> bool:
        if scope["type"] != "http":
            return False
        values: dict[bytes, list[bytes]] = {}
        for name, value in scope["headers"]:
            values.setdefault(name.lower(), []).append(value)
        host, origin = values.get(b"host", []), values.get(b"origin", [])
        if len(host) != 1 or host[0].decode("latin-1").lower() not in self._hosts:
            return False
        if any(one.decode("latin-1").lower() not in self._origins for one in origin):
            return False
        if scope["path"] == "/":
            given = [one.encode() for one in parse_qs(scope["query_string"].decode("latin-1")).get("token", [])]
        else:
            # A form of another page can post here, but not with a header of its own, and it states its origin.
            given = values.get(b"x-token", []) if len(origin) == 1 else []
        return len(given) == 1 and secrets.compare_digest(given[0], self._token)


def application(desk: Desk, hosts: frozenset[str], token: str, close: Callable[[], None]) -> ASGIApp:
    """The page and what it asks for.

    Args:
        hosts: names and port under which the server may be spoken to.
        close: ends the server.
    """
    from starlette.applications import Starlette
    from starlette.responses import HTMLResponse, JSONResponse
    from starlette.routing import Route

    async def page(request: HttpRequest) -> Response:
        nonce = secrets.token_urlsafe(16)
        policy = (
            f"default-src 'none'; script-src 'nonce-{nonce}'; style-src 'nonce-{nonce}'; img-src blob: data:; "
            "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
        )
        return HTMLResponse(page_text(nonce), headers={**HEADERS, "Content-Security-Policy": policy})

    async def end(request: HttpRequest) -> Response:
        close()
        return JSONResponse({"closed": True}, headers=HEADERS)

    names = ("start", "edit", "describe", "picture", "heat", "matches", "propose", "save", "progress", "cancel")
    routes = [Route("/", page), Route("/api/close", end, methods=["POST"])]
    routes += [Route(f"/api/{name}", _answering(getattr(desk, name)), methods=["POST"]) for name in names]
    app: Starlette = Starlette(routes=routes)
    app.router.redirect_slashes = False
    return Guard(app, hosts, token)


def page_text(nonce: str) -> str:
    """The page with its style and its program inside: it asks for nothing else."""
    text = (PAGE / "index.html").read_text(encoding="utf-8")
    for mark, names in (("/*STYLE*/", STYLE), ("/*PROGRAM*/", PROGRAM)):
        text = text.replace(mark, "\n".join((PAGE / name).read_text(encoding="utf-8") for name in names))
    return text.replace("NONCE", nonce)


def _answering(answer: Callable[[Any], Any]) -> Callable[[HttpRequest], Awaitable[Response]]:
    """A method of the desk as an answer to requests: JSON in; JSON, or bytes, out."""
    from starlette.concurrency import run_in_threadpool
    from starlette.responses import JSONResponse, Response

    model: type[Request] = get_type_hints(answer)["request"]

    def refused(status: int, text: str) -> Response:
        return JSONResponse({"error": text}, status, HEADERS)

    async def endpoint(request: HttpRequest) -> Response:
        if request.headers.get("content-type", "").partition(";")[0].strip().lower() != "application/json":
            return refused(415, "expected application/json")
        body = bytearray()
        async for chunk in request.stream():
            body += chunk
            if len(body) > MOST_BODY_BYTES:
                return refused(413, f"expected at most {MOST_BODY_BYTES} bytes")
        try:
            parsed = model.model_validate_json(bytes(body))
        except ValidationError as error:
            field, expected, came = fault_in_json(error)
            return refused(400, str(UsageError(field or "request", expected=expected, got=came)))
        try:
            answered = await run_in_threadpool(answer, parsed)
        except BaskError as error:
            return refused(400, str(error))
        if isinstance(answered, bytes):
            return Response(answered, media_type="application/octet-stream", headers=HEADERS)
        return JSONResponse(answered, headers=HEADERS)

    return endpoint


def serve(desk: Desk, port: int, *, opened: Callable[[str], None]) -> None:
    """Serve the page on this machine until it is closed or interrupted.

    Args:
        port: 0 takes any that is free.
        opened: told the link, when it can be followed.

    Raises:
        MissingDependency: the packages for it are not installed.
        UsageError: the port is taken.
    """
    imported("uvicorn", "a web server", user="--pick", extra="pick")
    import uvicorn

    listening = listen(port)
    port = listening.getsockname()[1]
    token = secrets.token_urlsafe(24)
    hosts = frozenset(f"{name}:{port}" for name in (LOOPBACK, "localhost"))

    def close() -> None:
        server.should_exit = True

    config = uvicorn.Config(
        application(desk, hosts, token, close),
        log_level="critical",
        ws="none",  # There is nothing to be had by it, and browsers let any page open one anywhere.
        http="h11",
        lifespan="off",
        access_log=False,
        server_header=False,
        proxy_headers=False,
        limit_concurrency=64,
        h11_max_incomplete_event_size=16 * 1024,
        timeout_graceful_shutdown=3,
    )
    server = uvicorn.Server(config)
    with listening:
        opened(f"http://{LOOPBACK}:{port}/?token={token}")
        try:
            server.run(sockets=[listening])
        finally:
            desk.jobs.cancel()  # Nobody waits for it any more.


def listen(port: int) -> socket.socket:
    """A socket that only this machine reaches; `UsageError` when the port is taken."""
    listening = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((LOOPBACK, port))
    except (OSError, OverflowError) as error:
        listening.close()
        expected = f"port {port} to be free"
        raise UsageError(
            "reference", "--port", expected=expected, got=str(error), fix="give another --port."
        ) from error
    listening.listen(64)
    return listening
