"""What all sub-commands of `ingest` do with their options: read one recording, or one per episode, and report it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from bask_data.cli.console import say, show_outcome, shown_progress, warn
from bask_data.cli.options import checked_options
from bask_data.cli.working import finish, quoted, with_options
from bask_data.errors import BadData, UsageError
from bask_data.formats import Format
from bask_data.formats.options.common import SourceOptions

if TYPE_CHECKING:
    from bask_data.engine import Outcome
    from bask_data.sources.episodes import EpisodeIngested


@dataclass(frozen=True)
class IngestRequest:
    """A recording to read, or several: `--episode all`.

    Args:
        options: those of the format that were set, by field.
        picture: file for a picture of depth's edges over colour.
        report: file for the doctor's page.
    """

    format: Format
    source: Path
    root: Path
    scene: str
    kind: Literal["scan", "demonstration"]
    options: dict[str, Any]
    force: bool = False
    as_json: bool = False
    picture: Path | None = None
    report: Path | None = None


def run_ingest(request: IngestRequest) -> None:
    """Read the recordings, print what was assumed and made, and exit with the code of the first failure."""
    outcomes: list[Outcome] = []
    assumptions: dict[str, str] = {}
    shown: set[tuple[str, str]] = set()
    with shown_progress():
        for each in _ingested(request):
            # Episodes of one source mostly repeat them.
            _show_assumptions({name: text for name, text in each.assumptions.items() if (name, text) not in shown})
            shown |= set(each.assumptions.items())
            for outcome in each.outcomes:
                show_outcome(outcome)
            outcomes += each.outcomes
            assumptions |= each.assumptions
    following = f"bask-data run {quoted(request.root)}"
    finish(f"ingest {request.format.name}", outcomes, request.as_json, following, assumptions=assumptions)


def _ingested(request: IngestRequest) -> Iterator[EpisodeIngested]:
    from bask_data.sources.episodes import EpisodeIngested, are_several, ingest_episodes
    from bask_data.sources.ingest import ingest

    format = request.format
    options = checked_options(format.options, request.options, f"bask-data ingest {format.name}")
    assert isinstance(options, SourceOptions)
    arguments: dict[str, Any] = {
        "format": format,
        "source": request.source,
        "options": options,
        "kind": request.kind,
        "force": request.force,
    }
    if are_several(str(getattr(options, "episode", ""))):
        for name, file in (("--picture", request.picture), ("--report", request.report)):
            if file:
                raise UsageError(name, expected="one episode", got="several", fix="pass --episode NAME.")
        yield from ingest_episodes(request.root, request.scene, **arguments)
    else:
        try:
            ingested = ingest(request.root, request.scene, **arguments)
        except BadData:
            _write_page(request, options)  # That is when it is needed.
            raise
        yield EpisodeIngested(request.scene, *ingested)
        if request.picture:
            _draw(request.root / request.kind / request.scene, request.picture)
        _write_page(request, options)


def _write_page(request: IngestRequest, options: SourceOptions) -> None:
    """Write the doctor's page about the source, if asked to."""
    if request.report is None:
        return
    from bask_data.doctor.page import write_page
    from bask_data.doctor.sources import AskedSource, examine_source

    asked = AskedSource(request.format, request.source, options, command_of(request, {}))
    say(f"  made        {write_page(examine_source(asked, with_pictures=True), request.report)}")


def _draw(recording: Path, file: Path) -> None:
    """Draw the edges of depth over colour of a recording that was read."""
    from bask_data.formats.registration import save_picture
    from bask_data.kinds import Recording

    cameras = Recording(recording).cameras
    save_picture(
        file,
        [(camera.n_frames, lambda i, c=camera: (c.rgb(i), c.depth(i))) for camera in cameras],  # type: ignore[misc]
    )


def _show_assumptions(assumptions: dict[str, str]) -> None:
    """Print what was assumed, and after it, apart from it, what is wrong or cannot be told."""
    from bask_data.findings import CODES
    from bask_data.formats.verdict import advice, codes_in, is_doubtful

    alarming = {}
    for name, text in assumptions.items():
        if any(CODES[code].severity != "note" for code in codes_in(text)):
            alarming[name] = text
        else:
            doubtful = name.endswith("agreement") and is_doubtful(text)
            say(f"  note        {name}: {text}" if doubtful else f"  assumed     {name}: {text}")
    for name, text in alarming.items():
        warn(f"{name}: {text}{advice(text)}")


def command_of(request: IngestRequest, missing: dict[str, str]) -> str:
    """The command line of a request, quoted for a shell, with placeholders for what is missing."""
    options = {f"--{flag_of(name)}": value for name, value in {**request.options, **missing}.items()}
    words = f"bask-data ingest {request.format.name} {quoted(request.source)} {quoted(request.root)}"
    kind = {} if request.kind == "scan" else {"--as": request.kind}
    force = {"--force": True} if request.force else {}
    return with_options(words, {"--scene": request.scene, **kind, **options, **force})


def flag_of(field: str) -> str:
    """A field of options as it is typed, without the dashes."""
    return field.replace("_", "-")
