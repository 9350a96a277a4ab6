from __future__ import annotations

import contextlib
import http.client
import json
import struct
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from bask_data.errors import MissingDependency, UsageError
from bask_data.picker.desk import Desk
from bask_data.picker.draft import Draft, KeypointMark
from bask_data.picker.gallery import Gallery
from bask_data.picker.requests import EditRequest, MatchesRequest
from bask_data.picker.server import MOST_BODY_BYTES, listen, serve
from bask_data.progress import progress
from tests.picker.pickable import HEIGHT, WIDTH, frame, recordings_of, untrained
from tests.picker.serving import Served

pytest.importorskip("uvicorn")
pytest.importorskip("starlette")


@pytest.fixture(scope="module")
def recordings(pickable):
    return recordings_of(pickable)


SAVED: list[tuple[KeypointMark, ...]] = []


def save(marks: tuple[KeypointMark, ...]) -> tuple[str, str]:
    if marks[0].name == "broken":
        raise UsageError("reference", "picks", expected="better ones", got="these")
    SAVED.append(marks)
    return f"{len(marks)} saved", "bask-data encode"


def new_desk(recordings, folder: Path) -> Desk:
    proposed = KeypointMark(name="object_1_0", recording="a", camera="wrist", frame=0, u=5.0, v=6.0)
    gallery, draft = Gallery(recordings, untrained()), Draft(folder / "picks.json")
    return Desk(gallery, draft, propose=lambda scene, n: [proposed] * n, save=save, title="table")


@pytest.fixture(scope="module")
def standing(recordings, tmp_path_factory) -> Iterator[Served]:
    server = Served(new_desk(recordings, tmp_path_factory.mktemp("draft")))
    yield server
    server.end()


@pytest.fixture
def served(standing, recordings, tmp_path) -> Served:
    """The running server with a new desk: starting one for each test would take most of the time."""
    standing.desk.__dict__.update(new_desk(recordings, tmp_path).__dict__)
    SAVED.clear()
    return standing


AT = {"frame": ["a", "wrist", 0], "u": 40.0, "v": 50.0}


def test_the_page_includes_all_it_needs_and_forbids_the_rest(served) -> None:
    status, text = served.request("GET", f"/?token={served.token}")
    assert status == 200
    policy = served.headers["Content-Security-Policy"]
    nonce = policy.partition("'nonce-")[2].partition("'")[0]
    assert text.count(f'nonce="{nonce}"'.encode()) == 2
    assert b"async function ask(" in text and b".view" in text
    assert b"src=" not in text and b"http://" not in text and b"https://" not in text
    assert policy.startswith("default-src 'none'; ") and "unsafe" not in policy
    assert served.headers["Cache-Control"] == "no-store"
    assert served.headers["X-Frame-Options"] == "DENY"
    assert served.headers["Referrer-Policy"] == "no-referrer"
    assert "Access-Control-Allow-Origin" not in served.headers
    assert "Server" not in served.headers


def test_each_start_has_its_own_long_token(served, recordings, tmp_path) -> None:
    other = Served(new_desk(recordings, tmp_path))
    other.end()
    assert len(served.token) >= 32
    assert other.token != served.token
    assert served.request("GET", f"/?token={other.token}")[0] == 403


HOSTILE = {
    "page without token": ("GET", "/", {}),
    "page with another token": ("GET", "/?token=x", {}),
    "page with two tokens": ("GET", "/?token=x&token={token}", {}),
    "page under another host": ("GET", "/?token={token}", {"Host": "evil.example:{port}"}),
    "page under another port": ("GET", "/?token={token}", {"Host": "127.0.0.1:1"}),
    "page under a host that begins well": ("GET", "/?token={token}", {"Host": "127.0.0.1:{port}.evil.example"}),
    "page for another origin": ("GET", "/?token={token}", {"Origin": "http://evil.example"}),
    "program without token": ("POST", "/api/start", {"Origin": "http://127.0.0.1:{port}"}),
    "program with another token": ("POST", "/api/start", {"Origin": "http://127.0.0.1:{port}", "X-Token": "x"}),
    "program with the token in its address": (
        "POST",
        "/api/start?token={token}",
        {"Origin": "http://127.0.0.1:{port}"},
    ),
    "program for another origin": ("POST", "/api/start", {"Origin": "http://evil.example", "X-Token": "{token}"}),
    "program for the origin of another port": (
        "POST",
        "/api/start",
        {"Origin": "http://127.0.0.1:1", "X-Token": "{token}"},
    ),
    "program for an origin by https": ("POST", "/api/start", {"Origin": "https://{host}", "X-Token": "{token}"}),
    "program of a sandboxed frame": ("POST", "/api/start", {"Origin": "null", "X-Token": "{token}"}),
    "program without an origin": ("POST", "/api/start", {"X-Token": "{token}"}),
    "progress without token": ("POST", "/api/progress", {"Origin": "http://127.0.0.1:{port}"}),
    "progress for another origin": ("POST", "/api/progress", {"Origin": "http://evil.example", "X-Token": "{token}"}),
    "cancelling without token": ("POST", "/api/cancel", {"Origin": "http://127.0.0.1:{port}"}),
    "cancelling for another origin": ("POST", "/api/cancel", {"Origin": "http://evil.example", "X-Token": "{token}"}),
    "cancelling by a form of another page": ("POST", "/api/cancel?token={token}", {"Origin": "http://evil.example"}),
    "program under another host": (
        "POST",
        "/api/start",
        {"Origin": "http://127.0.0.1:{port}", "X-Token": "{token}", "Host": "evil.example"},
    ),
    "question whether another origin may ask": (
        "OPTIONS",
        "/api/edit",
        {"Origin": "http://evil.example", "Access-Control-Request-Method": "POST"},
    ),
    "websocket of another origin": (
        "GET",
        "/?token={token}",
        {
            "Origin": "http://evil.example",
            "Connection": "Upgrade",
            "Upgrade": "websocket",
            "Sec-WebSocket-Version": "13",
            "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
        },
    ),
    "file above": ("GET", "/../../../../etc/passwd", {}),
    "file above, spelt otherwise": ("GET", "/%2e%2e/%2e%2e/etc/passwd?token={token}", {}),
    "file with two slashes": ("GET", "//etc/passwd?token={token}", {}),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_requests_are_refused(served, case: str) -> None:
    method, path, headers = HOSTILE[case]
    known = {"token": served.token, "port": served.port, "host": served.host}
    headers = {name: value.format(**known) for name, value in headers.items()}
    status, text = served.request(method, path.format(**known), b"{}" if method == "POST" else None, **headers)
    assert status == 403
    assert text == b"Refused. Open the URL that bask-data printed.\n"
    assert served.desk.draft.marks == ()


def test_requests_of_the_page_are_answered(served) -> None:
    # Each hostile request differs from one of these in a single property.
    assert served.request("GET", f"/?token={served.token}", Host=f"localhost:{served.port}")[0] == 200
    assert served.request("POST", "/api/start", b"{}", **served.headers_of_page)[0] == 200


@pytest.mark.parametrize(
    "path",
    [
        "/api/../api/none",
        "/etc/passwd",
        "/%2e%2e/etc/passwd",
        "//",
        "/index.html",
        "/picker.js",
        "/api/start/",
        "/api/picture/..%2f..%2fetc%2fpasswd",
        "/api/_place",
        "/api/__init__",
        "/api/state",
        "/api/jobs",
        "/docs",
    ],
)
def test_even_with_the_token_no_other_path_is_served(served, path: str) -> None:
    assert served.request("POST", path, b"{}", **served.headers_of_page)[0] in (403, 404)
    assert served.request("GET", path, **served.headers_of_page)[0] in (403, 404)


def test_a_websocket_is_never_opened(served) -> None:
    headers = {
        **served.headers_of_page,
        "Connection": "Upgrade",
        "Upgrade": "websocket",
        "Sec_WebSocket_Version": "13",
        "Sec_WebSocket_Key": "dGhlIHNhbXBsZSBub25jZQ==",
    }
    assert served.request("GET", "/api/start", **headers)[0] == 405


@pytest.mark.parametrize(
    ("text", "status"),
    [
        (b"GET /?token=%s HTTP/1.1\r\nHost: %s\r\nX: " + b"a" * 200000 + b"\r\n\r\n", 400),
        (b"GET /" + b"a" * 200000 + b"?token=%s HTTP/1.1\r\nHost: %s\r\n\r\n", 400),
        (b"GET /?token=%s HTTP/1.1\r\nHost: %s\r\nHost: evil.example\r\n\r\n", 400),
        (b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03 not HTTP\r\n\r\n", 400),
        (b"GET /?token=%s HTTP/1.1\r\n\r\n", 400),
    ],
    ids=["large header", "long address", "two hosts", "not HTTP", "no host"],
)
def test_malformed_requests_are_refused(served, text: bytes, status: int) -> None:
    filled = text.replace(b"%s", served.token.encode(), 1).replace(b"%s", served.host.encode(), 1)
    assert served.raw(filled) in (status, 0)
    assert served.answer("start")["title"] == "table"


def test_large_bodies_are_refused_with_and_without_a_stated_length(served) -> None:
    body = json.dumps({"do": "add", "name": "x" * MOST_BODY_BYTES}).encode()
    assert served.request("POST", "/api/edit", body, **served.headers_of_page)[0] == 413
    pieces = (body[i : i + 1000] for i in range(0, len(body), 1000))
    connection = http.client.HTTPConnection("127.0.0.1", served.port, timeout=30)
    with contextlib.closing(connection):
        headers = {name.replace("_", "-"): value for name, value in served.headers_of_page.items()}
        connection.request("POST", "/api/edit", pieces, headers, encode_chunked=True)
        assert connection.getresponse().status == 413


@pytest.mark.parametrize(
    ("name", "body", "message"),
    [
        ("edit", b"{", "request: expected JSON, got EOF while parsing"),
        ("edit", b"[" * 30000, "request: expected JSON, got recursion limit exceeded"),
        ("edit", b'{"do": "format"}', "do: expected one of add, move"),
        ("edit", b'{"do": "add"}', "edit: at: expected a pixel, got none"),
        ("edit", b'{"do": "undo", "more": 1}', "more: expected no field of that name"),
        ("edit", b'{"do": "add", "at": {"frame": ["a", "wrist", 0], "u": NaN, "v": 1}}', "expected "),
        ("edit", b'{"do": "add", "at": {"frame": ["a", "wrist", 0], "u": 1e9, "v": 1}}', "pixel: expected u 0..127"),
        ("edit", b'{"do": "add", "at": {"frame": ["../a", "wrist", 0], "u": 1, "v": 1}}', "expected a frame of"),
        ("edit", b'{"do": "rename", "name": "none", "new_name": "x"}', "name: expected the name of a keypoint"),
        ("picture", b'{"frame": ["../../etc", "passwd", 0]}', "frame: expected a frame of the dataset"),
        ("picture", b'{"frame": ["a", "wrist", 10000000000000000000000]}', "expected "),
        ("describe", b'{"frame": ["a"]}', "frame"),
        ("matches", json.dumps({"frames": [["a", "wrist", 0]] * 25}).encode(), "frames: expected "),
        ("propose", b'{"scene": "a", "n": 1000}', "n: expected less than or equal to 64"),
        ("progress", b'{"of": "propose"}', "of: expected no field of that name"),
        ("cancel", b'{"all": true}', "all: expected no field of that name"),
        ("save", b"{}", "save: expected a keypoint, got none.  fix: click on one first."),
    ],
)
def test_invalid_requests_are_refused_with_a_reason(served, name: str, body: bytes, message: str) -> None:
    status, text = served.request("POST", f"/api/{name}", body, **served.headers_of_page)
    assert status == 400
    assert message in json.loads(text)["error"]


def test_only_json_is_read(served) -> None:
    headers = {**served.headers_of_page, "Content_Type": "text/plain"}
    assert served.request("POST", "/api/edit", b'{"do": "clear"}', **headers) == (
        415,
        b'{"error":"expected application/json"}',
    )


@pytest.mark.parametrize("content_type", ["application/json; charset=utf-8", "Application/JSON;charset=UTF-8"])
def test_json_may_state_its_encoding(served, content_type: str) -> None:
    headers = {**served.headers_of_page, "Content_Type": content_type}
    assert served.request("POST", "/api/start", b"{}", **headers)[0] == 200


def test_keypoints_are_added_moved_renamed_and_deleted(served) -> None:
    served.answer("edit", do="add", at=AT)
    served.answer("edit", do="add", at={**AT, "u": 60.126}, name="rim")
    served.answer("edit", do="move", name="point_1", at={**AT, "v": 51.0})
    found = served.answer("edit", do="rename", name="point_1", new_name="knob")
    assert [(mark["name"], mark["u"], mark["v"]) for mark in found["marks"]] == [
        ("knob", 40.0, 51.0),
        ("rim", 60.1, 50.0),
    ]
    assert (found["can_undo"], found["can_redo"], found["is_saved"]) == (True, False, False)
    assert [mark["name"] for mark in served.answer("edit", do="delete", name="knob")["marks"]] == ["rim"]
    assert served.answer("edit", do="clear")["marks"] == []
    served.answer("edit", do="undo")
    served.answer("edit", do="undo")
    assert len(served.answer("edit", do="undo")["marks"]) == 2
    assert served.answer("edit", do="redo")["marks"][0]["name"] == "knob"
    elsewhere = {**AT, "frame": ["b", "wrist", 0]}
    status, text = served.ask("edit", do="move", name="knob", at=elsewhere)
    assert (status, "expected a pixel of the keypoint's own frame" in text.decode()) == (400, True)


def test_heat_maps_hold_the_distances_in_frames_with_descriptors(served) -> None:
    frames = [["a", "wrist", 0], ["a", "wrist", 1], ["lift", "wrist", 0], ["a", "wrist", 0]]
    served.answer("describe", frame=frames[1])
    status, answer = served.ask("heat", at=AT, frames=frames)
    assert status == 200
    [length] = struct.unpack("<I", answer[:4])
    header = json.loads(answer[4 : 4 + length])
    assert header["maps"][2] is None
    gallery = served.desk.gallery
    descriptor = gallery.descriptor_at(frame("a", 0), 40.0, 50.0)
    offset = 4 + length
    for (_, _, i), heat in zip(frames, header["maps"], strict=True):
        if heat is None:
            continue
        expected = gallery.find(descriptor, frame("a", i))
        n = heat["size"][0] * heat["size"][1]
        codes = np.frombuffer(answer[offset : offset + n], np.uint8).reshape(heat["size"])
        offset += n
        np.testing.assert_allclose(header["scale"] * (codes / 255) ** 2, expected.z, atol=0.005 * header["scale"])
        assert heat["best"] == list(expected.best)
        assert heat["z"] == pytest.approx(expected.z_best)
    assert offset == len(answer)
    np.testing.assert_allclose(header["maps"][0]["place"], [40.0, 50.0], atol=1e-6)


def test_all_keypoints_are_searched_in_frames_with_descriptors(served) -> None:
    served.answer("edit", do="add", at={**AT, "u": 40.5, "v": 50.5})
    served.answer("edit", do="add", at={**AT, "u": 60.5, "v": 30.5})
    found = served.answer("matches", frames=[["a", "wrist", 0], ["b", "wrist", 0]])
    assert found["names"] == ["point_1", "point_2"]
    own, other = found["frames"]
    np.testing.assert_allclose(own, [[40.5, 50.5, 0], [60.5, 30.5, 0]], atol=2e-3)
    assert other is None
    served.answer("edit", do="move", name="point_1", at={**AT, "u": 20.5, "v": 50.5})
    [own] = served.answer("matches", frames=[["a", "wrist", 0]])["frames"]
    np.testing.assert_allclose(own[0], [20.5, 50.5, 0], atol=2e-3)


def test_keypoints_may_change_while_they_are_searched(served, monkeypatch) -> None:
    served.answer("edit", do="add", at=AT)
    served.answer("edit", do="add", at={**AT, "u": 60.0})
    desk, find = served.desk, served.desk.gallery.find
    request = MatchesRequest(frames=(frame("a", 0),))
    desk.gallery.describe(frame("a", 0))

    def interrupted(*asked):
        monkeypatch.setattr(desk.gallery, "find", find)
        desk.edit(EditRequest(do="delete", name="point_2"))
        assert desk.matches(request)["names"] == ["point_1"]
        return find(*asked)

    monkeypatch.setattr(desk.gallery, "find", interrupted)
    assert desk.matches(request)["names"] == ["point_1", "point_2"]


def test_pictures_are_sent_as_jpeg(served) -> None:
    status, data = served.ask("picture", frame=["lift", "wrist", 1])
    assert (status, data[:3]) == (200, b"\xff\xd8\xff")
    assert served.headers["X-Content-Type-Options"] == "nosniff"


def test_proposals_are_one_step(served) -> None:
    found = served.answer("propose", scene="a", n=3)
    assert [mark["name"] for mark in found["marks"]] == ["object_1_0", "object_1_0_2", "object_1_0_3"]
    assert served.answer("edit", do="undo")["marks"] == []


def test_proposing_reports_progress_refuses_a_second_job_and_can_be_cancelled(served, monkeypatch) -> None:
    stepping, reached = threading.Event(), threading.Event()

    def slow(scene: str, n: int) -> list[KeypointMark]:
        for i in progress(range(n), "choosing keypoints"):
            reached.set()
            if i == 2:
                assert stepping.wait(30)
        raise AssertionError("the job went on after it was cancelled")

    monkeypatch.setattr(served.desk, "_propose", slow)
    assert served.answer("progress") == {"job": None}
    with ThreadPoolExecutor() as executor:
        proposing = executor.submit(served.answer, "propose", scene="a", n=8)
        assert reached.wait(30)
        while (job := served.answer("progress")["job"])["done"] < 2:
            pass
        assert (job["name"], job["label"], job["total"], job["can_cancel"]) == (
            "propose",
            "choosing keypoints",
            8,
            True,
        )
        assert job["seconds"] >= 0 and job["seconds_left"] >= 0
        assert served.answer("start")["job"]["name"] == "propose"
        # The draft can be edited meanwhile.
        served.answer("edit", do="add", at=AT)
        for name, body in (("propose", {"scene": "a", "n": 1}), ("save", {})):
            status, text = served.ask(name, **body)
            assert (status, f"{name}: expected no other job, got propose" in text.decode()) == (400, True)
        assert served.answer("cancel")["job"]["is_cancelled"]
        stepping.set()
        answer = proposing.result(30)
    assert (answer["is_cancelled"], len(answer["marks"])) == (True, 1)
    assert served.answer("progress") == {"job": None}


def test_saving_reports_its_result_and_a_later_change_is_unsaved(served) -> None:
    served.answer("edit", do="add", at=AT)
    found = served.answer("save")
    assert (found["summary"], found["next"], found["is_saved"]) == ("1 saved", "bask-data encode", True)
    assert [len(marks) for marks in SAVED] == [1]
    assert served.answer("edit", do="add", at=AT)["is_saved"] is False
    assert served.answer("edit", do="undo")["is_saved"] is True


def test_the_draft_can_be_edited_while_it_is_saved(served, tmp_path, monkeypatch) -> None:
    reached, edited = threading.Event(), threading.Event()

    def slow(marks: tuple[KeypointMark, ...]) -> tuple[str, str]:
        reached.set()
        assert edited.wait(30)
        return save(marks)

    monkeypatch.setattr(served.desk, "_save", slow)
    served.answer("edit", do="add", at=AT)
    with ThreadPoolExecutor() as executor:
        saving = executor.submit(served.answer, "save")
        assert reached.wait(30)
        assert executor.submit(served.answer, "edit", do="add", at=AT).result(5)["is_saved"] is False
        edited.set()
        found = saving.result(30)
    assert ([len(marks) for marks in SAVED], len(found["marks"]), found["is_saved"]) == ([1], 2, False)
    assert len(Draft(tmp_path / "picks.json").marks) == 2  # What was not saved survives the end of the command.
    assert served.answer("save")["is_saved"] is True
    assert not (tmp_path / "picks.json").exists()


def test_keypoints_that_cannot_be_saved_are_kept_and_the_error_is_shown(served) -> None:
    served.answer("edit", do="add", at=AT, name="broken")
    status, text = served.ask("save")
    assert (status, json.loads(text)["error"]) == (400, "reference: picks: expected better ones, got these.")
    assert len(served.answer("start")["marks"]) == 1


def test_start_lists_recordings_title_and_marks(served) -> None:
    found = served.answer("start")
    assert found["recordings"][0]["cameras"][0] == {"name": "wrist", "n_frames": 4, "width": WIDTH, "height": HEIGHT}
    assert (found["title"], found["marks"]) == ("table", [])


def test_a_port_in_use_is_reported() -> None:
    with listen(0) as first:
        port = first.getsockname()[1]
        assert first.getsockname()[0] == "127.0.0.1"
        with pytest.raises(UsageError, match=rf"--port: expected port {port} to be free, got .*choose another --port"):
            listen(port)


def test_missing_packages_are_reported_with_how_to_install_them(monkeypatch, served) -> None:
    monkeypatch.setitem(sys.modules, "uvicorn", None)
    with pytest.raises(MissingDependency, match=r"uvicorn: expected a web server.*pip install 'bask-data\[pick\]'"):
        serve(served.desk, 0, opened=print)
