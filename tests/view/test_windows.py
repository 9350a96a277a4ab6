from __future__ import annotations

import json
import socket
import sys
import urllib.request
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from bask_data.cli.app import app
from bask_data.dataset import Dataset, Variant
from bask_data.errors import BaskError, UsageError
from bask_data.kinds import DescriptorNet
from bask_data.view.windows import has_display, serve, show
from tests.datasets import copied
from tests.report.filled import publish_network
from tests.view.recordings import Recording


@pytest.fixture(autouse=True)
def no_display(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)


def view(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["view", *(str(argument) for argument in arguments)])


def free_port() -> int:
    """A port that is free, as is the next one."""
    for _ in range(50):
        with socket.socket() as one, socket.socket() as other:
            one.bind(("127.0.0.1", 0))
            port = int(one.getsockname()[1])
            try:
                other.bind(("127.0.0.1", port + 1))
            except OSError:
                continue
            return port
    raise AssertionError("no two consecutive free ports")


# Windows --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("environment", "platform", "has_one"),
    [
        ({}, "linux", False),
        ({"DISPLAY": ""}, "linux", False),
        ({"DISPLAY": ":0"}, "linux", True),
        ({"WAYLAND_DISPLAY": "wayland-0"}, "linux", True),
        ({}, "darwin", True),
    ],
)
def test_a_display_is_known_by_the_environment(environment, platform, has_one):
    assert has_display(environment, platform) is has_one


def test_the_viewer_opens_the_file_and_is_waited_for(tmp_path):
    code = "import sys, time; time.sleep(0.2); open(sys.argv[1] + '.seen', 'w').close()"
    show(tmp_path / "a.rrd", (sys.executable, "-c", code))
    assert (tmp_path / "a.rrd.seen").exists()


def test_a_viewer_that_fails_says_what_to_do():
    with pytest.raises(BaskError, match="expected a working viewer, got exit code 7.  fix: use --web, or --save"):
        show(Path("a.rrd"), (sys.executable, "-c", "raise SystemExit(7)"))


def test_a_browser_of_this_machine_gets_the_viewer_and_the_file(tmp_path):
    (tmp_path / "my file.rrd").write_bytes(b"recording" * 1000)
    port, said = free_port(), []

    def look() -> None:
        address, _, file = said[0].partition("?url=")
        assert (address, file) == (f"http://127.0.0.1:{port}/", f"http://127.0.0.1:{port + 1}/my%20file.rrd")
        assert b"<html" in urllib.request.urlopen(address).read()
        answer = urllib.request.urlopen(file)
        assert answer.headers["Access-Control-Allow-Origin"] == f"http://127.0.0.1:{port}"
        assert answer.headers["Content-Length"] == "9000"
        assert answer.read() == b"recording" * 1000

    serve(tmp_path / "my file.rrd", port, say=said.append, wait=look)
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(("127.0.0.1", port + 1), timeout=5)


@pytest.mark.parametrize("which", [0, 1])
def test_a_port_in_use_is_reported(tmp_path, which):
    port = free_port()
    with socket.socket() as taken:
        taken.bind(("0.0.0.0", port + which))
        taken.listen()
        with pytest.raises(
            UsageError, match=f"--port: expected ports {port} and {port + 1} free, got .*another --port"
        ):
            serve(tmp_path / "a.rrd", port, say=print, wait=lambda: None)


# The command ----------------------------------------------------------------------------------------------------------


def test_without_a_display_the_error_says_what_to_do(filled):
    ended = view(filled.root)
    assert ended.exit_code == 2
    assert ended.stderr == (
        "error: view: expected a display to open a window on, got none.  fix: use --web, or --save FILE.rrd.\n"
    )


def test_with_a_display_the_viewer_is_opened_and_its_file_goes_afterwards(filled, monkeypatch):
    seen: list[Path] = []

    def look(file: Path) -> None:
        seen.append(file)
        assert Recording(file).entities

    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr("bask_data.view.windows.show", look)
    assert view(filled.root, "--every", "9").exit_code == 0
    assert [file.name for file in seen] == ["dataset.rrd"]
    assert not seen[0].exists()


def test_people_and_scripts_learn_what_is_shown_and_what_is_not(filled, tmp_path):
    ended = view(filled.root, "--save", tmp_path / "a.rrd", "--only", "demo-a,scan-a", "--every", "2", "--json")
    assert ended.exit_code == 0
    result = json.loads(ended.stdout)
    assert (result["command"], result["file"], result["bytes"]) == (
        "view",
        str(tmp_path / "a.rrd"),
        (tmp_path / "a.rrd").stat().st_size,
    )
    assert list(result["items"]) == ["demo-a", "scan-a"]
    assert result["items"]["demo-a"]["frames"] == {"wrist": 3}
    assert "shown       scan-a: 3 frames of wrist; surface, instances, masks, truth" in ended.stderr
    assert "missing     demo-a: gripper (only cameras were recorded)" in ended.stderr
    assert f"open it with: rerun {tmp_path / 'a.rrd'}" in ended.stderr


def test_a_network_s_variant_may_be_shown(filled: Dataset, tmp_path):
    dataset = copied(filled, tmp_path / "d")
    dataset.add_variant(DescriptorNet, "florence", Variant())
    publish_network(dataset, variant="florence")
    ended = view(dataset.root, "--variant", "florence", "--save", tmp_path / "a.rrd", "--only", "scan-a", "--json")
    assert ended.exit_code == 0, ended.stderr
    assert "heat maps" in json.loads(ended.stdout)["items"]["scan-a"]["layers"]
    ended = view(dataset.root, "--variant", "b", "--save", tmp_path / "b.rrd")
    assert "--variant: expected one of main, florence, got b" in ended.stderr


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["--only", "b"], 2, "--only: expected one of scan-a, demo-a, got b"),
        (["--variant", "b"], 2, "--variant: expected one of main, got b"),
        (["--port", "9090"], 2, "--port: expected --web as well"),
        (["--save", "a.txt"], 2, "--save: expected a name that ends in .rrd"),
        (["--every", "0", "--save", "a.rrd"], 2, "--every: expected a whole number of at least 1, got '0'"),
    ],
)
def test_errors_have_a_code_and_a_remedy(filled, arguments, code, message):
    ended = view(filled.root, *arguments)
    assert (ended.exit_code, message in ended.stderr) == (code, True), ended.stderr


def test_an_existing_file_is_refused(filled, tmp_path):
    (tmp_path / "a.rrd").write_text("mine")
    ended = view(filled.root, "--save", tmp_path / "a.rrd")
    assert ended.exit_code == 3
    assert "--force replaces it" in ended.stderr


def test_an_empty_dataset_has_nothing_to_show(tmp_path):
    ended = view(Dataset.create(tmp_path / "d").root, "--save", tmp_path / "a.rrd")
    assert ended.exit_code == 2
    assert "expected a recording, got none in the dataset.  fix: bask-data ingest --help" in ended.stderr


def test_without_rerun_the_error_says_what_to_install(filled, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    ended = view(filled.root, "--save", tmp_path / "a.rrd")
    assert ended.exit_code == 5
    assert "expected the Rerun SDK, got none.  fix: pip install 'bask-data[view]'" in ended.stderr
