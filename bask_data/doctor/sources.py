"""A recording in another format, examined without a dataset: what a reader refuses becomes a finding."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from bask_data.doctor.examination import Examination, ExaminedCamera
from bask_data.doctor.recording import Settings, examine_camera
from bask_data.doctor.recording_checks import stamp_findings
from bask_data.errors import BadData
from bask_data.findings import Finding
from bask_data.formats import Format
from bask_data.formats.options.common import SourceOptions
from bask_data.formats.prepare import prepared
from bask_data.formats.recording import PreparedRecording, SourceRecording
from bask_data.formats.verdict import codes_in
from bask_data.progress import progress
from bask_data.sources.episodes import are_several, chosen_episodes


@dataclass(frozen=True)
class AskedSource:
    """A source, and how it is read.

    Args:
        command: the command that reads it so, for people.
    """

    format: Format
    source: Path
    options: SourceOptions
    command: str


def examine_source(asked: AskedSource, with_pictures: bool = False) -> Examination:
    """All checks of a recording that is read as asked; of a source of many, of the episodes asked for or the first.

    Raises:
        UsageError: an option is missing or invalid.
        MissingDependency: a library that decodes the format is not installed.
    """
    try:
        names = asked.format.episodes(asked.source, asked.options)
    except BadData as error:
        return Examination(str(asked.source), (), (_refused(asked.source.name, error),), (), asked.command)
    wanted = str(getattr(asked.options, "episode", ""))
    if len(names) < 2 or (wanted and not are_several(wanted)):
        return _examined(asked, asked.source.resolve().stem, with_pictures)
    chosen = chosen_episodes(asked.source, names, wanted) if wanted else [names[0]]
    parts = []
    for name in progress(chosen, "examining episodes", len(chosen)):
        one = replace(asked, options=asked.options.model_copy(update={"episode": name}))
        parts.append(_examined(one, name, with_pictures))
    left = len(names) - len(chosen)
    evidence = f"{len(chosen)} of {len(names)} episodes were examined"
    fix = f"--read-as '{asked.format.name} --episode all' examines all, --episode 3:6 a range"
    note = (Finding("not-examined", asked.source.name, evidence, fix),) if left else ()
    return Examination(
        str(asked.source),
        tuple(camera for part in parts for camera in part.cameras),
        (*note, *(each for part in parts for each in part.findings)),
        tuple(sentence for part in parts for sentence in part.right),
        asked.command,
        parts[0].assumptions,
    )


def _examined(asked: AskedSource, name: str, with_pictures: bool) -> Examination:
    """All checks of one recording."""
    refused: list[Finding] = []
    cameras: list[ExaminedCamera] = []
    read = None
    try:
        opened = asked.format.opened(asked.source, asked.options.model_copy(update={"trust": True}))
        read, refused = _read(asked, name, opened)
    except BadData as error:
        refused = [_refused(name, error)]
    if read is not None:
        settings = Settings(with_pictures)
        for camera in progress(read.cameras, f"examining {name}", len(read.cameras)):
            # It was read with --trust only so that nothing is refused.
            judged = replace(read.agreements[camera.name], is_trusted=asked.options.trust)
            known = (judged, read.registrations[camera.name])
            cameras.append(examine_camera(f"{name}/{camera.name}", camera, settings, known))
        refused += stamp_findings(name, {camera.name: camera.time for camera in read.cameras})
    return Examination(
        str(asked.source), tuple(cameras), tuple(refused), (), asked.command, read.assumptions if read else {}
    )


def _read(asked: AskedSource, name: str, opened: SourceRecording) -> tuple[PreparedRecording, list[Finding]]:
    """The recording without the frames that cannot be used, and what is wrong with those."""
    options = asked.options.model_copy(update={"trust": True})
    try:
        return prepared(asked.source, opened, options), []
    except BadData as error:
        if options.skip_bad:
            raise
        return prepared(asked.source, opened, options.model_copy(update={"skip_bad": True})), [_refused(name, error)]


def _refused(name: str, error: BadData) -> Finding:
    notes = "; ".join(getattr(error, "__notes__", []))
    code = next(iter(codes_in(error.fault)), "unreadable")
    return Finding(code, name, f"{error.fault}{f' {notes}' if notes else ''}", error.fix)
