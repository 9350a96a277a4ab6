"""The pages that are generated when the documentation is built."""

from __future__ import annotations

import re
import subprocess
import sys
from types import ModuleType

import pytest
import yaml

from bask_data.formats import FORMATS
from tests.scripts import REPOSITORY, script


@pytest.fixture(scope="module")
def pages() -> ModuleType:
    """The hook of mkdocs, which is a file and no package."""
    return script("docs/site/pages.py", "site_pages")


def test_the_index_of_decisions_lists_every_note_once(pages: ModuleType) -> None:
    notes = {note.name for note in (REPOSITORY / "docs" / "decisions").glob("*.md")}
    listed = re.findall(r"\]\(([^)]+)\)", pages.decisions_page())
    assert sorted(listed) == sorted(notes)


def test_every_decision_begins_with_its_number_and_a_title(pages: ModuleType) -> None:
    numbers = [note.name[:4] for note in pages.decisions()]
    assert len(numbers) == len(set(numbers))
    for note in pages.decisions():
        first = note.read_text(encoding="utf-8").splitlines()[0]
        assert re.match(rf"# {int(note.name[:4])}\. \S", first), f"{note.name}: {first}"


def test_the_command_line_page_has_the_help_of_every_command(pages: ModuleType) -> None:
    text = pages.command_line_page()
    headings = re.findall(r"^## (.+)$", text, re.MULTILINE)
    assert {"ingest frames", "run", "encode", "evaluate masks", "doctor"} <= set(headings)
    assert text.count("\nUsage: bask-data") == len(headings) + 1


def test_every_public_module_has_a_page_and_a_place_in_the_navigation(pages: ModuleType) -> None:
    files = {
        ".".join(path.relative_to(REPOSITORY / "bask_data").with_suffix("").parts).removesuffix(".__init__")
        for path in (REPOSITORY / "bask_data" / "core").rglob("*.py")
    }
    assert set(pages.modules("core")) == files
    assert str(pages.navigation_of("core")).count("reference/core") == len(files)


def test_the_drawing_of_the_layers_names_every_module_of_the_contract(pages: ModuleType) -> None:
    drawing = pages.layers_drawing()
    modules = {path.stem for path in (REPOSITORY / "bask_data").iterdir() if path.suffix == ".py" or path.is_dir()}
    drawn = set(re.findall(r"\w+", " ".join(re.findall(r'class="name"[^>]*>([^<]+)', drawing))))
    assert {name for name in modules if not name.startswith("__")} - {"py"} == drawn


def test_building_the_site_needs_neither_torch_nor_open3d(pages: ModuleType) -> None:
    code = (
        f"import sys; sys.path.insert(0, {str(REPOSITORY / 'docs' / 'site')!r}); import pages; "
        "pages.command_line_page(); [pages.module_page(n) for t in pages.packages() for n in pages.modules(t)]; "
        "print(sorted({'torch', 'open3d', 'cv2'} & set(sys.modules)))"
    )
    answer = subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, check=True)
    assert answer.stdout.strip() == "[]"


@pytest.mark.parametrize(
    ("link", "complaint"),
    [
        ("[here](there.md#place)", ""),
        ("[here](nowhere.md)", "nowhere.md"),
        ("[here](there.md#nowhere)", "does not contain an anchor"),
        ("[here](/there.md)", "absolute link"),
    ],
)
def test_a_link_that_leads_nowhere_fails_the_build(tmp_path: Path, link: str, complaint: str) -> None:
    ours = yaml.safe_load((REPOSITORY / "mkdocs.yml").read_text(encoding="utf-8"))
    config = {"site_name": "test", "validation": ours["validation"], "theme": {"name": "mkdocs"}, "plugins": []}
    (tmp_path / "mkdocs.yml").write_text(yaml.safe_dump(config))
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "index.md").write_text(f"# Home\n\n{link}\n")
    (tmp_path / "docs" / "there.md").write_text("# There\n\n## Place\n")
    mkdocs = [sys.executable, "-m", "mkdocs", "build", "--strict"]
    answer = subprocess.run(mkdocs, cwd=tmp_path, capture_output=True, text=True)
    assert (answer.returncode == 0) == (not complaint), answer.stderr
    assert complaint in answer.stderr


def test_the_page_on_formats_lists_every_format() -> None:
    page = (REPOSITORY / "docs" / "formats.md").read_text(encoding="utf-8")
    listed = re.findall(r"\| `ingest (\w+)` \|", page)
    assert sorted(listed) == sorted(["sim", *(format.name for format in FORMATS)])
