"""Pages that are generated when the site is built: the command line, the Python packages and the index of decisions.

A hook of mkdocs; nothing of what it writes is in the repository, so nothing can be out of date.
"""

from __future__ import annotations

import ast
import os
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[2]
DECISIONS = ROOT / "docs" / "decisions"

PACKAGES = {
    "bask_data": "What a script or a notebook imports.",
    "notebook": "What `bask_data.open` returns.",
    "torch": "PyTorch datasets: frames and matches.",
    "tracker": "Keypoints on a running robot.",
    "observing": "The half of the tracker that needs the network.",
    "pipeline": "The whole pipeline: run it, ask for its status.",
    "engine": "Stages, their state, and running them.",
    "sources": "What brings recordings into a dataset.",
    "dataset": "`dataset.json`: items, splits, paths.",
    "kinds": "A typed handle for each kind of artifact: open, read, write.",
    "artifact": "Manifests, digests, publishing.",
    "core": "Pure functions on arrays: no files, no clock, no hidden randomness.",
    "formats": "Readers of other people's recordings.",
    "export": "Writers of what policy-learning libraries read.",
}
"""The public modules, and what each is for. One that does not exist is left out."""

LAYERS = {
    "cli": "commands: parse, one call, print",
    "torch": "PyTorch datasets for users",
    "notebook": "datasets as users open them in Python",
    "report": "the HTML page",
    "view": "Rerun, videos",
    "picker": "the picking page",
    "pipeline": "the whole pipeline",
    "drawing": "pictures",
    "evaluation": "numbers against ground truth",
    "export": "files for policy learning",
    "stages": "one verb each: open inputs, call core or nn, write",
    "sources": "recordings in",
    "engine": "declare, plan, make and publish",
    "tracker": "keypoints on a robot",
    "dataset": "items, splits, paths",
    "kinds": "a typed handle for each kind of artifact",
    "artifact": "manifest, digests, atomic publishing",
    "formats": "readers of other people's files",
    "nn": "networks and training",
    "sim": "the simulator",
    "core": "pure functions on arrays",
}
"""What the drawing of the layers says beside a line; only of what needs saying."""

SUBJECTS = {
    "000": "Data and parameters",
    "001": "Set-up and tests",
    "002": "Keypoint filters",
    "003": "Scenes, masks and matches",
    "004": "Networks",
    "005": "Simulator and measurements",
    "006": "Reports, views and the picking page",
}
"""The first three digits of a decision's number say what it is about."""


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Fill in the parts of the navigation that follow from what there is."""
    for section in config.nav or []:
        for entries in section.values():
            if isinstance(entries, list):
                for entry in entries:
                    if entry.get("Python") == "reference/":
                        entry["Python"] = [navigation_of(name) for name in packages()]
                    if entry.get("Decisions") == "decisions/":
                        entry["Decisions"] = ["decisions/index.md", *(f"decisions/{note.name}" for note in decisions())]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages."""
    pages = {
        "reference/cli.md": command_line_page(),
        "decisions/index.md": decisions_page(),
        "contributing.md": root_page("CONTRIBUTING.md"),
        "changelog.md": root_page("CHANGELOG.md"),
    }
    pages |= {page_of(name): module_page(name) for top in packages() for name in modules(top)}
    for uri, content in pages.items():
        files.append(File.generated(config, uri, content=content))
    return files


def root_page(name: str) -> str:
    """A document of the repository's root, its links made relative to docs/."""
    return (ROOT / name).read_text(encoding="utf-8").replace("](docs/", "](")


# Decisions ------------------------------------------------------------------------------------------------------------


def decisions() -> list[Path]:
    """The notes, by number."""
    return sorted(DECISIONS.glob("[0-9]*.md"))


def decisions_page() -> str:
    """The index of the notes, by subject."""
    lines = [
        "# Decisions",
        "",
        "Why things are as they are: one page for each choice that could have gone otherwise.",
        "",
    ]
    subject = ""
    for note in decisions():
        if SUBJECTS.get(note.name[:3], "Other") != subject:
            subject = SUBJECTS.get(note.name[:3], "Other")
            lines += ["", f"## {subject}", ""]
        lines.append(f"- {note.name[:4]}: [{title_of(note)}]({note.name})")
    return "\n".join(lines) + "\n"


def title_of(note: Path) -> str:
    """A note's heading, without its number."""
    first = note.read_text(encoding="utf-8").splitlines()[0]
    return re.sub(r"^#\s*(\d+\.\s*)?", "", first)


# Python ---------------------------------------------------------------------------------------------------------------


def packages() -> list[str]:
    """The public modules that there are."""
    return [name for name in PACKAGES if path_of(name).exists()]


def path_of(name: str) -> Path:
    """The source of a module, by its name within `bask_data`."""
    if name == "bask_data":
        return ROOT / "bask_data" / "__init__.py"
    path = ROOT / "bask_data" / name.replace(".", "/")
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def modules(name: str) -> list[str]:
    """A module and all inside it that are public."""
    if name == "bask_data" or path_of(name).name != "__init__.py":
        return [name]
    inner = sorted({path.stem for path in path_of(name).parent.iterdir() if path.suffix == ".py" or path.is_dir()})
    public = [f"{name}.{each}" for each in inner if not each.startswith("_")]
    return [name, *(each for module in public if path_of(module).exists() for each in modules(module))]


def page_of(name: str) -> str:
    """Where a module's page is."""
    return f"reference/{name}.md"


def navigation_of(name: str) -> dict[str, Any]:
    """A module's page, or the section of a package."""
    inner = modules(name)[1:]
    if not inner:
        return {name: page_of(name)}
    return {name: [page_of(name), *({each.partition(".")[2]: page_of(each)} for each in inner)]}


def module_page(name: str) -> str:
    """The page of a public module; mkdocstrings fills in what its source says."""
    path = name if name == "bask_data" else f"bask_data.{name}"
    lines = [f"# {path}", "", PACKAGES.get(name, ""), "", f"::: {path}"]
    if name == "bask_data":  # A star leaves these out, so their page has to name them.
        lines += ["    options:", "      members: [KeypointTracker, open]"]
    lines += [""]
    inner = modules(name)[1:]
    if inner:
        lines += ["## Modules", "", *(f"- [{each}]({each}.md): {first_sentence(each)}" for each in inner), ""]
    return "\n".join(lines)


def first_sentence(name: str) -> str:
    """What a module is, by its docstring."""
    text = ast.get_docstring(ast.parse(path_of(name).read_text(encoding="utf-8"))) or ""
    return re.sub(r"([<\[\]])", r"\\\1", " ".join(text.split("\n\n")[0].split()))


# The drawing of the layers --------------------------------------------------------------------------------------------


def on_page_markdown(markdown: str, page: Any, config: MkDocsConfig, files: Files) -> str:
    """Put the drawing of the layers where its page wants it."""
    return re.sub(r"<!-- layers: .*? -->", layers_drawing(), markdown)


def layers_drawing() -> str:
    """The contract of import-linter as an SVG, one row a layer."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    [layers] = [each["layers"] for each in project["tool"]["importlinter"]["contracts"] if each["id"] == "layers"]
    height = 34 * len(layers) + 16
    lines = [
        f'<div class="drawing"><svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 1040 {height}" role="img">',
        f'<title>The layers</title><path class="down" d="M14 12V{height - 12}m-5 -8l5 8l5 -8"/>',
    ]
    for i, layer in enumerate(layers):
        names = re.findall(r"\w+", layer)
        said = "; ".join(LAYERS[name] for name in names if name in LAYERS)
        y = 8 + 34 * i
        lines.append(f'<rect x="30" y="{y}" width="460" height="28" rx="3"/>')
        lines.append(f'<text class="name" x="260" y="{y + 19}" text-anchor="middle">{" · ".join(names)}</text>')
        lines.append(f'<text x="504" y="{y + 19}">{said}</text>')
    return "".join([*lines, "</svg></div>"])


# Command line ---------------------------------------------------------------------------------------------------------


def commands(group: Any, context: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], str]]:
    """The words and the help of every command that can be called, depth first, in the order of `--help`."""
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        if command.hidden:
            continue
        inner = typer.Context(command, info_name=name, parent=context)
        if hasattr(command, "list_commands"):
            yield from commands(command, inner, (*path, name))
        else:
            yield (*path, name), command.get_help(inner)


def command_line_page() -> str:
    """The help of every command, from the program itself."""
    from bask_data.cli.app import app

    os.environ["COLUMNS"] = "86"  # what the page has room for
    group: Any = typer.main.get_command(app)
    context = typer.Context(group, info_name="bask-data")
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = "86"  # what the page has room for
    try:
        helps = [(path, text.rstrip()) for path, text in [((), group.get_help(context)), *commands(group, context)]]
    finally:
        os.environ.pop("COLUMNS") if before is None else os.environ.update(COLUMNS=before)
    lines = ["# Command line", "", "What each command's `--help` prints.", ""]
    for path, text in helps:
        lines += [*([f"## {' '.join(path)}", ""] if path else []), "```text", text, "```", ""]
    return "\n".join(lines)
