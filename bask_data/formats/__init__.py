"""Readers of other people's recordings: units, frames and conventions are converted here and nowhere else.

Only the options are imported up front. A reader, and with it NumPy and OpenCV, is imported when it is first used, so
that `--help` stays fast.
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

    def read(self, source: Path, options: Params) -> bask_data.formats.recording.Recording:
        """The recording in the folder `source`.

        Raises:
            BadData: a file is missing, broken, or does not hold what the options say.
            UsageError: the options name something that does not exist.
        """
        recording: bask_data.formats.recording.Recording = import_module(f"bask_data.formats.{self.name}").read(
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
