"""Options that recordings of simulators share."""

from __future__ import annotations

from pydantic import Field, FiniteFloat

from bask_data.formats.options.common import EpisodeOptions, Text


class SimulatedOptions(EpisodeOptions):
    """A simulator's recordings: several cameras, episodes, and images of object numbers."""

    cameras: tuple[str, ...] = Field(
        (), description="Cameras to read: agentview,wrist. All with colour, depth and calibration by default."
    )
    fps: FiniteFloat = Field(
        20.0, gt=0, description="Frames per second, where the files state none: time is frame number / fps."
    )
    objects: Text = Field(
        "",
        description="Objects as ground truth, if there are images of their numbers: NUMBER=NAME,NUMBER=NAME. All other "
        "numbers are background.",
    )
