"""One item's part of a Rerun recording: entities, times, and checks of what is read."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from bask_data.artifact import REMAKE, Artifact
from bask_data.drawing.colours import Colour, instance_colour
from bask_data.errors import BadData, BaskError
from bask_data.kinds.truth import ROBOT
from bask_data.view.choice import Shown

if TYPE_CHECKING:
    import rerun

CORNER = 0.5
"""Offset from our pixels to Rerun's, whose origin is the corner of the first pixel, not its centre."""
JPEG_QUALITY = 85
"""Quality, 0 to 100: a tenth of the bytes, without visible blocks unless enlarged."""
N_FRAMES_UNFLUSHED = 8
"""Frames that may wait in memory for Rerun's writer."""
FLUSH_SECONDS = 120
"""Seconds to wait for Rerun's writer; without a limit, Rerun waits forever for one that a full disk has killed."""
GREY: Colour = (150, 150, 150)
"""Colour of camera paths, and of ground truth that a view does not show."""
ORANGE: Colour = (240, 150, 40)
"""Colour of the robot."""


@dataclass(frozen=True)
class Eye:
    """The first viewpoint, metres, world frame."""

    position: np.ndarray
    target: np.ndarray
    up: np.ndarray


@dataclass
class DrawnItem:
    """One item in the recording.

    Args:
        layers: entities that exist, by their first name below the item or its world.
        heated: keypoints with heat maps, by camera.
        believed: keypoints with belief maps, by camera.
    """

    name: str
    shown: Shown
    cameras: list[str] = field(default_factory=list)
    layers: set[str] = field(default_factory=set)
    heated: dict[str, list[str]] = field(default_factory=dict)
    believed: dict[str, list[str]] = field(default_factory=dict)
    eye: Eye | None = None

    def note(self, is_shown: bool, layer: str, reason: str) -> None:
        """Record that a layer is shown, or else the command that makes it or the reason why it is missing."""
        if is_shown:
            self.layers.add(layer)
            self.shown.layers.append(layer)
        else:
            self.shown.missing.append(f"{layer} ({reason})")


class Sheet:
    """The part of a recording that belongs to one item."""

    def __init__(self, recording: rerun.RecordingStream, item: str) -> None:
        self._recording, self.item = recording, item
        self._n_frames = 0

    def log(self, place: Sequence[str], *archetypes: Any) -> None:
        """Add to an entity at the current time."""
        self._recording.log([self.item, *place], *archetypes)

    def fix(self, place: Sequence[str], *archetypes: Any) -> None:
        """Add to an entity for all times."""
        self._recording.log([self.item, *place], *archetypes, static=True)

    @contextmanager
    def at(self, *, frame: int, seconds: float | None = None, pair: int | None = None) -> Iterator[None]:
        """Log what follows at this frame, these seconds after the first, and this pair of views."""
        self._recording.set_time("frame", sequence=frame)
        if seconds is not None:
            self._recording.set_time("time", duration=seconds)
        if pair is not None:
            self._recording.set_time("pair", sequence=pair)
        yield
        self._recording.reset_time()
        self._n_frames += 1
        if self._n_frames % N_FRAMES_UNFLUSHED == 0:
            # Rerun accepts frames faster than it writes them, and would keep the rest in memory.
            self._recording.flush(timeout_sec=FLUSH_SECONDS)


@contextmanager
def reading(artifact: Artifact) -> Iterator[None]:
    """Turn whatever libraries raise for an inconsistent artifact into `BadData` that names it."""
    try:
        yield
    except BaskError:
        raise
    except (LookupError, ValueError, ArithmeticError, TypeError, AttributeError, cv2.error) as error:
        raise BadData(
            artifact.path,
            "",
            expected="consistent arrays and names",
            got=f"{type(error).__name__}: {str(error)[:200]}",
            fix=REMAKE,
        ) from error


def expect(where: Any, field: str, array: np.ndarray, shape: tuple[int | None, ...], kind: str) -> np.ndarray:
    """The array, checked to be finite and of this shape (None: any) and dtype kind (of "f", "u", "i", "b").

    Raises:
        BadData: it is not; the error names `where` and `field`.
    """
    fits = len(array.shape) == len(shape) and all(
        want is None or have == want for have, want in zip(array.shape, shape, strict=True)
    )
    if not fits or array.dtype.kind not in kind:
        wanted = " x ".join("any" if want is None else str(want) for want in shape)
        raise BadData(where, field, expected=f"shape {wanted}", got=f"{array.shape} {array.dtype}")
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise BadData(where, field, expected="finite numbers", got="NaN or infinity")
    return array


def name_labels(sheet: Sheet, places: Sequence[Sequence[str]], names: dict[int, str]) -> None:
    """Log names and colours of labels, for everything below these entities."""
    import rerun as rr

    context = [rr.AnnotationInfo(id=0, label="background", color=(0, 0, 0, 0))]
    for label, text in sorted(names.items()):
        if 0 < label <= ROBOT:
            context.append(rr.AnnotationInfo(id=label, label=text or f"object {label}", color=label_colour(label)))
    for place in places:
        sheet.fix(place, rr.AnnotationContext(context))


def label_colour(label: int) -> Colour:
    """The colour of an instance or label, the same as in reports."""
    return ORANGE if label == ROBOT else instance_colour(label)


def jpeg(rgb: np.ndarray) -> bytes:
    """The image (h, w, 3) uint8 as JPEG, in a tenth of its bytes."""
    done, data = cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    assert done, "OpenCV encodes any 8-bit image"
    return data.tobytes()
