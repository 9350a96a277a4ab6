"""The page's server: reachable from this machine only, and only with the token in its URL."""

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
"""Most bytes of a request's body. The page's largest, a search in nine frames, has less than 1 kB, or 5 kB with the
longest names. The bound keeps hostile requests from filling memory; a quarter or ten times of it would do."""

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
"""Files of the page's one script, in the order of their dependencies."""


class Guard:
    """Middleware that admits the page's requests and the first visit by its URL, and refuses all others.

    Other pages open in the same browser can send requests to this server, too. Their `Origin` gives them away, and
    their `Host` if they reach this address under another name (DNS rebinding). Neither has the token.
    """

    def __init__(self, app: ASGIApp, hosts: frozenset[str], token: str) -> None:
        self._app, self._hosts, self._token = app, hosts, token.encode()
        self._origins = frozenset(f"http://{host}" for host in hosts)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer 403, or pass the request on."""
        if scope["type"] == "lifespan" or self._is_allowed(scope):
            await self._app(scope, receive, send)
            return
        if scope["type"] == "http":
            from starlette.responses import PlainTextResponse

            text = "Refused. Open the URL that bask-data printed.\n"
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
        if any(value.decode("latin-1").lower() not in self._origins for value in origin):
            return False
        if scope["path"] == "/":
            tokens = [value.encode() for value in parse_qs(scope["query_string"].decode("latin-1")).get("token", [])]
        else:
            # A form of another page can post here, but it cannot add a header, and it states its origin.
            tokens = values.get(b"x-token", []) if len(origin) == 1 else []
        return len(tokens) == 1 and secrets.compare_digest(tokens[0], self._token)


def application(desk: Desk, hosts: frozenset[str], token: str, close: Callable[[], None]) -> ASGIApp:
    """The web application: the page and its requests.

    Args:
        hosts: accepted values of the `Host` header, `name:port`.
        token: secret of the page's URL.
        close: stops the server.
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
    """The page's HTML with styles and script inlined; it loads nothing else."""
    text = (PAGE / "index.html").read_text(encoding="utf-8")
    for mark, names in (("/*STYLE*/", STYLE), ("/*PROGRAM*/", PROGRAM)):
        text = text.replace(mark, "\n".join((PAGE / name).read_text(encoding="utf-8") for name in names))
    return text.replace("NONCE", nonce)


def _answering(answer: Callable[[Any], Any]) -> Callable[[HttpRequest], Awaitable[Response]]:
    """An endpoint that calls a method of the desk: JSON in; JSON or bytes out."""
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
            field, expected, got = fault_in_json(error)
            return refused(400, str(UsageError(field or "request", expected=expected, got=got)))
        try:
            content = await run_in_threadpool(answer, parsed)
        except BaskError as error:
            return refused(400, str(error))
        if isinstance(content, bytes):
            return Response(content, media_type="application/octet-stream", headers=HEADERS)
        return JSONResponse(content, headers=HEADERS)

    return endpoint


def serve(desk: Desk, port: int, *, opened: Callable[[str], None]) -> None:
    """Serve the page on this machine until it is closed or interrupted.

    Args:
        port: TCP port; 0 selects a free one.
        opened: receives the URL once the server listens.

    Raises:
        MissingDependency: the packages of the extra `pick` are not installed.
        UsageError: the port is in use.
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
        ws="none",  # Unused, and browsers let any page open a WebSocket to any host.
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
            desk.jobs.cancel()


def listen(port: int) -> socket.socket:
    """A socket listening on the loopback interface; `UsageError` if the port is in use."""
    listening = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((LOOPBACK, port))
    except (OSError, OverflowError) as error:
        listening.close()
        expected, fix = f"port {port} to be free", "choose another --port."
        raise UsageError("reference", "--port", expected=expected, got=str(error), fix=fix) from error
    listening.listen(64)
    return listening
