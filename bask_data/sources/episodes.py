"""Ingest of several recordings of one source: robot data sets hold hundreds of episodes."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from bask_data.dataset import Dataset, check_name
from bask_data.engine import Outcome, progress
from bask_data.errors import BadData, UsageError
from bask_data.formats import Format
from bask_data.formats.options.common import SourceOptions
from bask_data.kinds import Demonstration, Scan
from bask_data.sources.ingest import ingest

ALL = "all"
_RANGE = re.compile(r"-?\d*:-?\d*(:[1-9]\d*)?")
LONGEST_ITEM = 64
"""Characters of a recording's name, by `check_name`."""


@dataclass(frozen=True)
class EpisodeIngested:
    """What became of an episode.

    Args:
        outcomes: of what was written; one that failed if the episode is bad.
        assumptions: about the source, in words.
    """

    name: str
    outcomes: list[Outcome]
    assumptions: dict[str, str]


def are_several(wanted: str) -> bool:
    """Whether `--episode` asks for all episodes or a range of them, not for one."""
    return wanted == ALL or bool(_RANGE.fullmatch(wanted))


def chosen_episodes(source: Path, names: Sequence[str], wanted: str) -> list[str]:
    """The episodes that `all`, or FIRST:END:STEP over all in their order, stands for.

    Raises:
        UsageError: there are none.
    """
    parts = [int(part) if part else None for part in wanted.split(":")] if wanted != ALL else [None]
    chosen = list(names[slice(None) if wanted == ALL else slice(*parts)])
    if not chosen:
        got = f"{len(names)} in the source" if names else "a source of one recording"
        fix = f"choose among 0:{len(names)}." if names else "leave out --episode."
        raise UsageError(source, "--episode", expected=f"episodes for {wanted!r}", got=got, fix=fix)
    return chosen


def items_of(item: str, episodes: Sequence[str]) -> dict[str, str]:
    """The name of each episode's recording, by the episode: `pour_demo_3`, `pour_variation0_episode3`.

    Raises:
        UsageError: two episodes would have the same name, or one is not allowed.
    """
    check_name(item, "ingest", "--scene")
    named: dict[str, str] = {}
    taken: set[str] = set()
    for episode in episodes:
        name = f"{item}_{re.sub(r'[^A-Za-z0-9_-]+', '_', episode)}"
        if len(name) > LONGEST_ITEM:
            fix = "choose a shorter --scene, or name a SOURCE further down."
            raise UsageError("ingest", "--scene", expected=f"at most {LONGEST_ITEM} characters", got=name, fix=fix)
        if name in taken:
            fix = "read them one by one, with --episode and a --scene each."
            raise UsageError("ingest", "--episode", expected="episodes of different names", got=f"two {name}", fix=fix)
        named[episode] = name
        taken.add(name)
    return named


def ingest_episodes(
    root: Path,
    item: str,
    *,
    format: Format,
    source: Path,
    options: SourceOptions,
    kind: Literal["scan", "demonstration"] = "scan",
    force: bool = False,
) -> Iterator[EpisodeIngested]:
    """Read the episodes that `options.episode` chooses, each as a recording of its own, and yield what became of each.

    Each is listed in the dataset when it is finished, or soon after: a process that is killed loses none, and the
    same call goes on where it stopped. With `options.skip_bad`, bad episodes fail and the others are read.

    Raises:
        WouldOverwrite: a recording of that name exists with other content and `force` is not set.
        UsageError: an option is invalid, or a name belongs to a recording of the other kind.
        BadData: an episode is damaged, and `options.skip_bad` is not set.
    """
    wanted = str(getattr(options, "episode", ""))
    items = items_of(item, chosen_episodes(source, format.episodes(source, options), wanted))
    dataset = Dataset.open_if_any(root)
    with ExitStack() as listing:
        if dataset is not None:
            listing.enter_context(dataset.adding_many())
        for episode, name in progress(items.items(), "reading episodes", len(items)):
            one = options.model_copy(update={"episode": episode})
            try:
                outcomes, assumptions = ingest(
                    dataset or root, name, format=format, source=source, options=one, kind=kind, force=force
                )
            except BadData as error:
                if not options.skip_bad:
                    error.add_note(f"in episode {episode}; --skip-bad reads the others. Finished episodes are kept.")
                    raise
                outcomes, assumptions = [_failed(kind, name, error)], {}
            yield EpisodeIngested(name, outcomes, assumptions)
            if dataset is None and (dataset := Dataset.open_if_any(root)) is not None:
                listing.enter_context(dataset.adding_many())


def _failed(kind: Literal["scan", "demonstration"], name: str, error: BadData) -> Outcome:
    makes = Scan if kind == "scan" else Demonstration
    label = f"ingest {makes.kind} {name}"
    return Outcome(label, makes.kind, name, "main", "", "failed", str(error), error=error)
