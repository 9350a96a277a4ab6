"""Pages that are generated when the site is built: the command line, the Python packages and the index of decisions.

A hook of mkdocs; nothing of what it writes is in the repository, so nothing can be out of date.
"""

from __future__ import annotations

import os
import re
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
    "engine": "Stages, their state, and running them.",
    "dataset": "`dataset.json`: items, splits, paths.",
    "kinds": "A typed handle for each kind of artifact: open, read, write.",
    "artifact": "Manifests, digests, publishing.",
    "core": "Pure functions on arrays: no files, no clock, no hidden randomness.",
    "formats": "Readers of other people's recordings.",
    "export": "Writers of what policy-learning libraries read.",
}
"""The public modules, and what each is for. One that does not exist is left out."""

SUBJECTS = {
    "00": "Data and parameters",
    "01": "Set-up and tests",
    "02": "Keypoint filters",
    "03": "Scenes, masks and matches",
    "04": "Networks",
    "05": "Simulator and measurements",
    "06": "Pages in a browser",
}
"""The first two digits of a decision's number say what it is about."""


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Fill in the parts of the navigation that follow from what there is."""
    for section in config.nav or []:
        for entries in section.values():
            if isinstance(entries, list):
                for entry in entries:
                    if entry.get("Python") == "reference/":
                        entry["Python"] = [f"reference/{name}.md" for name in packages()]
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
    pages |= {f"reference/{name}.md": package_page(name) for name in packages()}
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
        if SUBJECTS.get(note.name[:2], "Other") != subject:
            subject = SUBJECTS.get(note.name[:2], "Other")
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
    package = ROOT / "bask_data"
    return [
        name
        for name in PACKAGES
        if name == "bask_data" or (package / name).is_dir() or (package / f"{name}.py").is_file()
    ]


def package_page(name: str) -> str:
    """The page of a public module; mkdocstrings fills in what its source says."""
    path = name if name == "bask_data" else f"bask_data.{name}"
    options = "\n    options:\n      show_submodules: false\n" if name == "bask_data" else "\n"
    return f"# {path}\n\n{PACKAGES[name]}\n\n::: {path}{options}"


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

    os.environ["COLUMNS"] = "92"  # what the page has room for
    group: Any = typer.main.get_command(app)
    context = typer.Context(group, info_name="bask-data")
    lines = ["# Command line", "", "What each command's `--help` prints.", ""]
    lines += ["```text", group.get_help(context).rstrip(), "```", ""]
    for path, help_text in commands(group, context):
        lines += [f"## {' '.join(path)}", "", "```text", help_text.rstrip(), "```", ""]
    return "\n".join(lines)
