"""Every command that the documentation shows is run, or at least understood by the command line.

A block marked ```bash is run, page by page and from top to bottom, unless a comment above it says why not:
`<!-- not run: needs a display -->`. The commands of such a block must still be ones that the command line accepts.
"""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import typer
import yaml
from typer.testing import CliRunner

from bask_data.cli.app import app
from bask_data.errors import UsageError
from tests.tiny import HEIGHT, PARAMS, WIDTH, write_recording

REPOSITORY = Path(__file__).parents[2]
PAGES = [
    REPOSITORY / "README.md",
    REPOSITORY / "CONTRIBUTING.md",
    REPOSITORY / "examples" / "README.md",
    *sorted((REPOSITORY / "docs").rglob("*.md")),
]
BLOCK = re.compile(r"^( *)```(\w*)[^\n]*\n(.*?)^\1```", re.MULTILINE | re.DOTALL)
REASON = re.compile(r"<!-- not run: (.+?) -->\s*$", re.DOTALL)
INLINE = re.compile(r"`([^`\n]+)`")
SHELLS = {"bash", "sh", "shell", "console"}

GROUP: Any = typer.main.get_command(app)


@dataclass(frozen=True)
class Block:
    """A fenced block of a page."""

    language: str
    code: str
    reason: str
    """Why it is not run; empty where it is."""

    @property
    def commands(self) -> list[list[str]]:
        """Its commands as words, comments left out and continued lines joined."""
        lines = self.code.replace("\\\n", " ").splitlines()
        return [words for line in lines if (words := shlex.split(line, comments=True))]


def blocks(text: str) -> list[Block]:
    found = []
    for match in BLOCK.finditer(text):
        reason = REASON.search(text[: match.start()])
        indent = match[1]
        code = "\n".join(line.removeprefix(indent) for line in match[3].splitlines())
        found.append(Block(match[2], code, reason[1] if reason else ""))
    return found


def shell_blocks(page: Path) -> list[Block]:
    return [block for block in blocks(page.read_text(encoding="utf-8")) if block.language in SHELLS]


def understood(words: list[str]) -> None:
    """Parse `bask-data ...` as the command line does, without running it."""
    command, context = GROUP, GROUP.make_context("bask-data", list(words))
    while hasattr(command, "resolve_command"):
        name, command, rest = command.resolve_command(context, [*context._protected_args, *context.args])
        context = command.make_context(name, rest, parent=context)


def command_of(words: list[str]) -> tuple[Any, list[str]]:
    """The command that the first words name, or None, and the words after them."""
    command: Any = GROUP
    while words and hasattr(command, "get_command"):
        inner = command.get_command(typer.Context(command), words[0])
        if inner is None:
            break
        command, words = inner, words[1:]
    return (None if hasattr(command, "get_command") else command), words


def check_other(words: list[str]) -> None:
    """Of a command that is not ours: that the target or the file it names exists."""
    if words[0] == "make":
        targets = re.findall(r"^([\w-]+):", (REPOSITORY / "Makefile").read_text(), re.MULTILINE)
        names = [word for word in words[1:] if "=" not in word]
        assert set(names) <= set(targets), names
    if words[0] == "python" and words[1].endswith(".py"):
        assert (REPOSITORY / words[1]).is_file(), words[1]


def without_environment(words: list[str]) -> list[str]:
    while words and re.match(r"[A-Z_]+=", words[0]):
        words = words[1:]
    return words


def name_of(page: Path) -> str:
    return str(page.relative_to(REPOSITORY))


@pytest.mark.parametrize("page", [page for page in PAGES if shell_blocks(page)], ids=name_of)
def test_commands_of_a_page_run_or_say_why_not(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "datasets").symlink_to(REPOSITORY / "datasets")
    for block in shell_blocks(page):
        for words in map(without_environment, block.commands):
            if words and words[0] != "bask-data":
                assert block.reason, f"{words}: run only by hand, so say why: <!-- not run: ... -->"
                check_other(words)
            elif words and block.reason:
                for word in words:  # a folder that a command wants to find there
                    if re.fullmatch(r"[\w./-]+", word) and not word.startswith(("-", "/", ".")):
                        Path(word).mkdir(parents=True, exist_ok=True)
                understood(words[1:])
            elif words:
                answer = CliRunner().invoke(app, words[1:])
                assert answer.exit_code == 0, f"{shlex.join(words)}\n{answer.output}"


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_a_page_shows_commands_in_marked_blocks_only(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert re.findall(r"^ {4,}\$? ?bask-data .*", BLOCK.sub("", text), re.MULTILINE) == []
    unmarked = [block.code for block in blocks(text) if not block.language]
    assert unmarked == []


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_options_that_the_prose_names_exist(page: Path) -> None:
    text = BLOCK.sub("", page.read_text(encoding="utf-8"))
    unknown = []
    for code in INLINE.findall(text):
        words = code.replace("[", " ").replace("]", " ").split()
        command, rest = command_of(words[1:] if words[:1] == ["bask-data"] else words)
        if command is not None:
            known = {name for parameter in command.params for name in (*parameter.opts, *parameter.secondary_opts)}
            flags = {word.split("=")[0] for word in rest if word.startswith("--")}
            unknown += [f"{code}: {flag}" for flag in sorted(flags - known - {"--help"})]
    assert unknown == []


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_python_that_a_page_shows_is_python(page: Path) -> None:
    for block in blocks(page.read_text(encoding="utf-8")):
        if block.language == "python":
            compile(block.code, name_of(page), "exec")


@pytest.fixture(scope="module")
def place_with_a_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `my_dataset`: a scan `table1` and a demonstration `demo1`, everything made."""
    place = tmp_path_factory.mktemp("pages")
    data, files = str(place / "my_dataset"), str(place / "files")
    options = write_recording(place / "files")
    (place / "my_dataset").mkdir()
    (place / "my_dataset" / "params.yaml").write_text(yaml.safe_dump(PARAMS))
    for words in (
        ["ingest", "frames", files, data, "--scene", "table1", *options],
        ["ingest", "frames", files, data, "--scene", "demo1", "--as", "demonstration", *options],
        ["run", data],
    ):
        answer = CliRunner().invoke(app, words)
        assert answer.exit_code == 0, answer.output
    return place


def run_python(page: Path) -> dict[str, Any]:
    """What the Python of a page leaves behind, its blocks run one after the other."""
    names: dict[str, Any] = {}
    for block in blocks(page.read_text(encoding="utf-8")):
        if block.language == "python":
            exec(compile(block.code, name_of(page), "exec"), names)
    return names


def test_the_python_of_the_readme_runs(place_with_a_dataset: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(place_with_a_dataset)
    names = run_python(REPOSITORY / "README.md")
    assert names["ds"].scans["table1"][0].mask.shape == (HEIGHT, WIDTH)
    assert len(names["matches"]) > 0
    assert names["keypoints"].mean.shape == (8, PARAMS["reference"]["n"], 3)
    assert next(iter(names["loader"]))["rgb_a"].shape == (4, 3, HEIGHT, WIDTH)
    assert names["tracked"].mean.shape == names["keypoints"].mean[-1].shape


def test_the_python_of_its_page_runs(place_with_a_dataset: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(place_with_a_dataset)
    names = run_python(REPOSITORY / "docs" / "python.md")
    assert names["batch"]["rgb"].shape == (4, 3, HEIGHT, WIDTH)
    assert names["first"].any() and len(names["pairs"]) > 0
    assert names["track"].mean.shape == (8, PARAMS["reference"]["n"], 3)


@pytest.mark.parametrize(
    "words",
    ["reconstruct data --voxel 0.01", "ingest frame a b --scene c", "train", "encode data --filter kalman"],
)
def test_a_command_that_does_not_exist_is_noticed(words: str) -> None:
    with pytest.raises(UsageError):
        understood(words.split())


def test_a_reason_belongs_to_the_block_below_it() -> None:
    text = (
        "<!-- not run: slow -->\n```bash\nmake demo\n```\n\nand\n\n```bash\nbask-data info x \\\n  --json # all\n```\n"
    )
    slow, quick = blocks(text)
    assert (slow.reason, quick.reason) == ("slow", "")
    assert quick.commands == [["bask-data", "info", "x", "--json"]]
