"""Which format a source has, by names and first bytes of its files; and if none, what is nearest.

Nothing is decoded but depth in a layout that APC shares with others, and what is looked at is bounded. A format's
layout is known by its function in `recognise_folders.RECOGNISERS`, for single files by `recognise_files`; dumps without
a layout of their own by `recognise_frames`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from bask_data.formats.guess import Guess
from bask_data.formats.listing import Listing
from bask_data.formats.recognise.files import guess_of_file, zip_names
from bask_data.formats.recognise.folders import RECOGNISERS
from bask_data.formats.recognise.frames import Dump, find_dump, guess_of_dump, hints_of, other_images

MAX_INSIDE = 50
"""Sub-folders that are looked at if a folder is no recording itself."""


@dataclass(frozen=True)
class RecognisedSource:
    """What was found at a source.

    Args:
        guesses: formats that it may have.
        got: what is there, in words, if there is no guess.
        fix: what to do then.
    """

    guesses: tuple[Guess, ...]
    got: str = ""
    fix: str = ""


def recognise(source: Path) -> RecognisedSource:
    """The formats that a folder or file may have; if none, whether it is one level too high or low, or what is missing.

    Raises:
        MissingDependency: a library that opens a file is not installed.
    """
    if source.is_file():
        guess = guess_of_file(source)
        return RecognisedSource((guess,)) if guess else _nothing_in_file(source)
    listing = Listing(source)
    guesses = guesses_of_folder(listing)
    if guesses:
        return RecognisedSource(guesses)
    dump = find_dump(listing)
    guess = guess_of_dump(listing, dump)
    inside = _inside(listing)
    if guess and len(inside) < 2:
        return RecognisedSource((guess,))
    if inside:
        return _of_inside(inside, guess.options.get("camera", "") if guess else "")
    if above := _above(source):
        return RecognisedSource(
            (), f"a part of a recording: the folder above is {above.format}'s", _again(above.source)
        )
    if dump.color and dump.depth and not dump.has_poses and dump.color.keys & dump.depth.keys:
        return RecognisedSource((_without_poses(listing, dump),))
    return _nothing(listing, dump)


def guesses_of_folder(listing: Listing) -> tuple[Guess, ...]:
    """Formats with a layout of their own that a folder has."""
    found = (recogniser(listing) for recogniser in RECOGNISERS.values())
    return tuple(guess for guess in found if guess)


def _inside(listing: Listing) -> list[Guess]:
    """Recordings in the folders and files one level down."""
    found: list[Guess] = []
    for name in listing.folders()[:MAX_INSIDE]:
        if listing.has_folder(name):
            below = Listing(listing.root / name)
            guesses = guesses_of_folder(below)
            dump = None if guesses else guess_of_dump(below, find_dump(below))
            found += guesses or ((dump,) if dump else ())
    files = [guess_of_file(listing.root / name) for name in listing.files()[:MAX_INSIDE]]
    return [*found, *(guess for guess in files if guess)]


def _of_inside(inside: list[Guess], cameras: str) -> RecognisedSource:
    places = {guess.source for guess in inside}
    if len(places) == 1:
        reason = f"SOURCE holds it: {inside[0].source.name}"
        return RecognisedSource(tuple(replace(guess, reasons=(*guess.reasons, reason)) for guess in inside))
    names = [f"{guess.source.name} ({guess.format})" for guess in inside]
    shown = ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
    fix = _again(inside[0].source)
    if cameras:
        fix += f"; if these are cameras of one recording, `ingest frames` with --camera {cameras} and {{camera}}"
    return RecognisedSource((), f"a folder of {len(places)} recordings: {shown}", fix)


def _above(source: Path) -> Guess | None:
    """The recording that a folder is a part of: its format must have a layout, or its patterns lead into the folder.

    What lies in other folders beside it does not count: the folder above may hold many recordings, and this.
    """
    above = source.resolve().parent
    parent = Listing(above)
    if guesses_of_folder(parent):
        guesses = guesses_of_folder(Listing(above, n_levels=0))
        return guesses[0] if guesses and guesses[0].source == above else None
    guess = guess_of_dump(parent, find_dump(parent))
    name = f"{source.resolve().name}/"
    return guess if guess and any(value.startswith(name) for value in guess.options.values()) else None


def _without_poses(listing: Listing, dump: Dump) -> Guess:
    assert dump.color and dump.depth
    options = {"images": dump.color.pattern, "depth": dump.depth.pattern}
    if dump.calibration:
        options["intrinsics"] = dump.calibration
    reasons = (
        f"{len(dump.color.keys)} colour files {dump.color.pattern} and {len(dump.depth.keys)} depth files "
        f"{dump.depth.pattern}",
        "no poses: COLMAP finds them from the images, and depth gives their scale",
        *hints_of(dump),
        *other_images(dump),
    )
    return Guess("colmap", listing.root, reasons, options)


def _nothing(listing: Listing, dump: Dump) -> RecognisedSource:
    looked = "`bask-data ingest --help` lists the formats, docs/formats.md their layouts."
    if dump.color and dump.depth:
        got = f"colour {dump.color.pattern} and depth {dump.depth.pattern}, whose names have no number in common"
        fix = "write their pairs to associations.txt, lines `time file time file`, and use `bask-data ingest tum`; or "
        return RecognisedSource((), got, f"{fix}give files of one frame the same number.")
    if dump.color:
        got = f"{len(dump.color.keys)} images {dump.color.pattern}, but no depth"
        fix = "depth is needed: 16-bit PNG, TIFF, EXR or .npy, one file for each image."
        return RecognisedSource((), got, fix)
    if dump.depth:
        got = f"{len(dump.depth.keys)} depth images {dump.depth.pattern}, but no colour"
        return RecognisedSource((), got, "add colour images of the same numbers, or name the folder above them.")
    names = [*(f"{name}/" for name in listing.folders()), *listing.files()]
    packed = [name for name in names if name.lower().endswith((".zip", ".tar", ".tgz", ".tar.gz", ".7z"))]
    if packed:
        return RecognisedSource(
            (), f"archives: {', '.join(packed[:3])}", f"unpack {packed[0]}, and name its folder. {looked}"
        )
    shown = ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")
    if not names and (links := listing.links_out()):
        got = f"links to folders outside: {', '.join(links[:3])}"
        return RecognisedSource(
            (), got, f"name the folder that they lead to, {(listing.root / links[0]).resolve().parent}."
        )
    return RecognisedSource((), shown or "an empty folder", looked)


def _nothing_in_file(source: Path) -> RecognisedSource:
    folder = _of_parent(source)
    if folder:
        return RecognisedSource((), f"a file of a recording in the format {folder.format}", _again(folder.source))
    suffix = source.suffix.lower()
    if suffix == ".zip":
        names = zip_names(source)
        got = f"a zip file with {', '.join(names[:3])}" if names else "a damaged or empty zip file"
        return RecognisedSource((), got, "unpack it, and name its folder.")
    if suffix in (".tar", ".gz", ".tgz", ".7z", ".rar"):
        return RecognisedSource((), "an archive", "unpack it, and name its folder.")
    return RecognisedSource((), f"a file {suffix or 'without an ending'}", "name the folder of the recording.")


def _of_parent(source: Path) -> Guess | None:
    """The recording that the folder of a file is."""
    listing = Listing(source.parent)
    guesses = guesses_of_folder(listing)
    if guesses:
        return guesses[0]
    dump = find_dump(listing)
    guess = guess_of_dump(listing, dump)
    return guess if dump.color and "/" not in dump.color.pattern else None


def _again(source: Path) -> str:
    return f"bask-data ingest auto {source} ROOT"
