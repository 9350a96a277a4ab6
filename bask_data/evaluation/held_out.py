"""What a descriptor network has not seen: the scenes set aside, or else the frames that training kept aside."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, replace

from bask_data.artifact import MANIFEST
from bask_data.dataset import Dataset
from bask_data.errors import UsageError
from bask_data.evaluation.frames import Frame, Frames
from bask_data.kinds import Correspondences, DescriptorNet, Scan, VisibleMasks


@dataclass(frozen=True)
class HeldOut:
    """What is measured on.

    Args:
        scenes: by name.
        share: of each camera's frames, the last, that are looked at.
        words: what that is, for people.
        with_learned: pairs may join one of these frames with one that was trained on, as those that `train` validates
            on may; otherwise both of their frames are held out.
    """

    scenes: tuple[str, ...]
    share: float
    words: str
    with_learned: bool = False

    def frames(self, frames: Frames, most: int) -> list[Frame]:
        """A scene's frames that are looked at, evenly over time, at most so many."""
        return frames.between(1.0 - self.share, 1.0, most)

    def partners(self, frames: Frames, most: int) -> list[Frame]:
        """A scene's frames that were trained on and may be joined with these, at most so many."""
        return frames.between(0.0, 1.0 - self.share, most) if self.with_learned else []

    def joined_with_learned(self) -> HeldOut:
        """The same frames, in pairs of which one frame at least is held out."""
        words = f"pairs of a held-out frame and one that was trained on, as no matches join two {self.words}"
        return replace(self, words=words, with_learned=True)


def held_out(dataset: Dataset, variants: Sequence[str], scenes: Sequence[str] = ()) -> HeldOut:
    """What none of the variants was trained on, as far as the dataset says: scenes for the test, or for validation, or
    else the frames kept from training.

    Raises:
        UsageError: a scene or a variant is asked for that is not there, or no scene can be measured.
    """
    check_variants(dataset, variants)
    splits = dataset.file.splits
    if scenes:
        dataset.select(scenes, "scene", option="--scenes")
    twice = sorted({name for name in scenes if scenes.count(name) > 1})
    if twice:
        raise UsageError(dataset.root, "--scenes", expected="each scene once", got=f"{twice[0]} more than once")
    learned = learned_scenes(dataset)
    if scenes:
        seen = [name for name in scenes if name in learned]
        of_them = f"trained on: {', '.join(seen)}" if seen else "none of them was trained on"
        return _there(dataset, HeldOut(tuple(scenes), 1.0, f"scenes asked for: {', '.join(scenes)}; {of_them}"))
    for use, names in (("test", splits.test), ("validation", splits.validation)):
        if names:
            _check_unseen(dataset, variants, names)
            return _there(dataset, HeldOut(names, 1.0, f"held-out scenes ({use}): {', '.join(names)}"))
    nets = [DescriptorNet(dataset.path(DescriptorNet, variant=name)) for name in variants]
    # A frame is new to all variants where the one that kept the fewest did not see it.
    share = min(net.metadata.held_out for net in nets)
    if share <= 0:
        words = "frames that were trained on: nothing is held out"
        kept_none = [name for name, net in zip(variants, nets, strict=True) if net.metadata.held_out <= 0]
        words += f" from {', '.join(kept_none)}" if len(kept_none) < len(nets) else ""
        return _there(dataset, HeldOut(tuple(learned), 1.0, words))
    words = f"held-out frames: the last {share:.0%} of each camera's, of scenes that were trained on"
    return _there(dataset, HeldOut(tuple(learned), share, words))


def _check_unseen(dataset: Dataset, variants: Sequence[str], scenes: Sequence[str]) -> None:
    """A split may have changed since a network was trained."""
    for name in variants:
        net = DescriptorNet(dataset.path(DescriptorNet, variant=name))
        seen = [scene for scene in scenes if scene in (net.metadata.learned_from or ())]
        if seen:
            raise UsageError(
                net.path,
                ", ".join(seen),
                expected="scenes that the network was not trained on",
                got="some that it was: the split has changed since",
                fix="train it again, or say which scenes you want (--scenes).",
            )


def learned_scenes(dataset: Dataset) -> list[str]:
    """The scenes that `train` learns from."""
    splits = dataset.file.splits
    aside = {*splits.validation, *splits.test}
    return list(splits.train) or [name for name in dataset.items("scene") if name not in aside]


def check_variants(dataset: Dataset, variants: Sequence[str]) -> None:
    """Refuse networks that are not there, or are damaged or of another version."""
    known = [
        name
        for name in dataset.variants(DescriptorNet)
        if (dataset.path(DescriptorNet, variant=name) / MANIFEST).exists()
    ]
    for name in variants or ("",):
        if name not in known:
            raise UsageError(
                dataset.root,
                "--variant",
                expected=f"one of {', '.join(known) or 'none: no network is trained'}",
                got=name or "none",
                fix=f"bask-data train {shlex.quote(str(dataset.root))} --variant {shlex.quote(name or 'main')}",
            )
        DescriptorNet(dataset.path(DescriptorNet, variant=name)).check_complete()


def _there(dataset: Dataset, wanted: HeldOut) -> HeldOut:
    """The same, if all of its scenes have what is read: exact truth, or else masks and matches."""
    for name in wanted.scenes:
        exact = Frames(dataset, name).truth is not None
        for kind in (Scan,) if exact else (Scan, VisibleMasks, Correspondences):
            if not (dataset.path(kind, name) / MANIFEST).exists():
                raise UsageError(
                    dataset.root,
                    name,
                    expected=f"a scene with {kind.kind}",
                    got="none",
                    fix=f"bask-data run {shlex.quote(str(dataset.root))}",
                )
    if not wanted.scenes:
        raise UsageError(dataset.root, "splits", expected="a scene to measure on", got="none", fix="bask-data split")
    return wanted
