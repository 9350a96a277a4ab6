"""The tables of docs/settings.md, which compare the presets with their sources."""

from __future__ import annotations

import math
from types import ModuleType

import pytest

from bask_data.config import load_config
from bask_data.core.filters.table import settings_named
from bask_data.engine import resolve
from bask_data.pipeline import STAGES
from bask_data.presets import PRESETS
from bask_data.stages.train import train
from bask_data.stages.train_params import TrainParams
from tests.scripts import REPOSITORY, script


@pytest.fixture(scope="module")
def tables() -> ModuleType:
    return script("docs/settings_tables.py")


def cells_of(page: str, name: str) -> dict[str, dict[str, str]]:
    """A table of the page: by setting and column."""
    text = page.split(f"<!-- table: {name} -->")[1].split("<!-- end -->")[0]
    head, _, *rows = ([cell.strip() for cell in line.strip("|").split("|")] for line in text.strip().splitlines())
    return {row[0].strip("`"): dict(zip(head, row, strict=True)) for row in rows}


def test_the_page_has_the_values_of_the_presets_as_they_are(tables: ModuleType) -> None:
    page = tables.PAGE.read_text()
    assert tables.rendered(page) == page, "fix: python docs/settings_tables.py"


def test_every_parameter_of_training_is_listed_with_each_preset(tables: ModuleType) -> None:
    rows = cells_of(tables.PAGE.read_text(), "train")
    assert list(rows) == list(TrainParams.model_fields)
    assert all(f"`{name}`" in row for row in rows.values() for name in PRESETS)
    shown = [rows["margin_background"][f"`{name}`"] for name in PRESETS]
    assert shown == ["(0.75)", "0.75", "0.75", "0.5"]
    assert [rows["match_root"][f"`{name}`"] for name in PRESETS] == ["(no)", "no", "yes", "(no)"]


@pytest.mark.parametrize("pipeline", ["bask", "bask-code", "florence"])
def test_the_pipelines_of_the_sources_train_as_the_presets_that_are_listed(pipeline) -> None:
    file = REPOSITORY / "pipelines" / pipeline / "params.yaml"
    of_pipeline = resolve(train, load_config(file, [], STAGES), "", "main", {})
    assert of_pipeline == resolve(train, load_config(None, [], STAGES, pipeline), "", "main", {})


@pytest.mark.parametrize("preset", ["default", "paper", "code"])
def test_settings_of_the_particle_filter_are_those_it_runs_with(tables: ModuleType, preset) -> None:
    rows, settings = cells_of(tables.PAGE.read_text(), "particle"), settings_named("particle", preset)
    assert list(rows) == list(vars(settings))
    for name, row in rows.items():
        value, shown = getattr(settings, name), row[f"`{preset}`"]
        if isinstance(value, float) and math.isfinite(value):
            assert float(shown) == pytest.approx(value, rel=0.005)


def test_a_source_of_a_setting_that_there_is_not_is_refused(tables: ModuleType) -> None:
    with pytest.raises(ValueError, match="expected settings that there are, got gone"):
        tables.table(["a"], {"gone": ["1"]}, 1, {"there": ["2"]})


def test_a_source_that_is_missing_beside_others_is_refused(tables: ModuleType) -> None:
    with pytest.raises(ValueError, match="there: expected 2 sources, got 1"):
        tables.table(["a", "b"], {"there": ["1"]}, 2, {"there": ["2"]})


def test_a_page_without_a_place_for_a_table_is_refused(tables: ModuleType) -> None:
    with pytest.raises(ValueError, match="expected one place for the table of train, got 0"):
        tables.rendered("nothing")


def test_a_page_that_is_out_of_date_is_found_and_mended(
    tables: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "settings.md"
    page.write_text(tables.PAGE.read_text().replace("| resnet101 |", "| resnet34 |"))
    monkeypatch.setattr(tables, "PAGE", page)
    assert tables.main(["--check"]) == 1
    assert "fix: python docs/settings_tables.py" in capsys.readouterr().out
    assert tables.main([]) == 0
    assert tables.main(["--check"]) == 0
