"""Readers of recordings in other formats: units, frames and conventions are converted here and nowhere else.

To add a format, touch two files:

1. `formats/<name>.py`, new, with a model of its options, derived from `Params`, whose descriptions are the help of
   `bask-data ingest <name>`, and with `read(source: Path, options) -> SourceRecording`. It returns the recording in our
   units and frames, states in `assumptions` what the files do not, and reads frames on demand.
2. `formats/__init__.py`: the import of the model, and a line in `FORMATS`.

The command line imports all models, but a reader only when it is used. Importing this file must not load NumPy or
OpenCV, so that `--help` stays fast: a small reader imports them inside its functions; one with array types in its
signatures needs them at its top, and keeps its model in `formats/options.py`.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from bask_data.formats.options import ApcOptions, FramesOptions, TumOptions
from bask_data.params import Params

if TYPE_CHECKING:
    import bask_data.formats.recording


@dataclass(frozen=True)
class Format:
    """A source format: `bask-data ingest <name>`, with the options of the model `options`."""

    name: str
    help: str
    options: type[Params]

    def read(self, source: Path, options: Params) -> bask_data.formats.recording.SourceRecording:
        """The recording in the folder `source`.

        Raises:
            BadData: a file is missing, corrupted, or contradicts the options.
            UsageError: `source` is not a folder, or an option is missing or invalid.
        """
        recording: bask_data.formats.recording.SourceRecording = import_module(f"bask_data.formats.{self.name}").read(
            source, options
        )
        return recording


FORMATS = (
    Format(
        "frames", "A folder of colour, depth and pose files by pattern: 7-Scenes, 3DMatch, own dumps.", FramesOptions
    ),
    Format("tum", "A TUM RGB-D sequence: rgb.txt, depth.txt and groundtruth.txt with timestamps.", TumOptions),
    Format("apc", "A MIT-Princeton APC scene: bit-rotated depth, poses, labels where there are any.", ApcOptions),
)
