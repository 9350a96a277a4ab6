"""What a descriptor network was not trained on: held-out scenes, or else held-out frames."""

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
    """The scenes and frames to measure on.

    Args:
        scenes: by name.
        share: share of each camera's frames, from the last, to measure on.
        words: description for people.
        with_learned: pairs may join one of these frames with a training frame, like those that `train` validates on;
            otherwise both frames are held out.
    """

    scenes: tuple[str, ...]
    share: float
    words: str
    with_learned: bool = False

    def frames(self, frames: Frames, most: int) -> list[Frame]:
        """At most this many of a scene's frames to measure on, evenly spaced."""
        return frames.between(1.0 - self.share, 1.0, most)

    def partners(self, frames: Frames, most: int) -> list[Frame]:
        """At most this many of a scene's training frames that may be paired with these."""
        return frames.between(0.0, 1.0 - self.share, most) if self.with_learned else []

    def joined_with_learned(self) -> HeldOut:
        """The same frames, in pairs with at least one held-out frame."""
        words = f"pairs of a held-out frame and one that was trained on, as no matches join two {self.words}"
        return replace(self, words=words, with_learned=True)


def held_out(dataset: Dataset, variants: Sequence[str], scenes: Sequence[str] = ()) -> HeldOut:
    """What none of the variants was trained on: the test scenes, else the validation scenes, else the frames held out
    from training.

    Raises:
        UsageError: a scene or variant does not exist, or no scene can be measured.
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
        return _checked(dataset, HeldOut(tuple(scenes), 1.0, f"scenes asked for: {', '.join(scenes)}; {of_them}"))
    for use, names in (("test", splits.test), ("validation", splits.validation)):
        if names:
            _check_unseen(dataset, variants, names)
            return _checked(dataset, HeldOut(names, 1.0, f"held-out scenes ({use}): {', '.join(names)}"))
    nets = [DescriptorNet(dataset.path(DescriptorNet, variant=name)) for name in variants]
    # A frame is unseen by all variants if the one that held out the fewest did not see it.
    share = min(net.metadata.held_out for net in nets)
    if share <= 0:
        words = "frames that were trained on: nothing is held out"
        kept_none = [name for name, net in zip(variants, nets, strict=True) if net.metadata.held_out <= 0]
        words += f" from {', '.join(kept_none)}" if len(kept_none) < len(nets) else ""
        return _checked(dataset, HeldOut(tuple(learned), 1.0, words))
    words = f"held-out frames: the last {share:.0%} of each camera's, of scenes that were trained on"
    return _checked(dataset, HeldOut(tuple(learned), share, words))


def _check_unseen(dataset: Dataset, variants: Sequence[str], scenes: Sequence[str]) -> None:
    """Raise `UsageError` if a network was trained on a scene: the split may have changed since."""
    for name in variants:
        net = DescriptorNet(dataset.path(DescriptorNet, variant=name))
        seen = [scene for scene in scenes if scene in (net.metadata.learned_from or ())]
        if seen:
            raise UsageError(
                net.path,
                ", ".join(seen),
                expected="scenes that the network was not trained on",
                got="training scenes: the split has changed since",
                fix="train the network again, or choose scenes with --scenes.",
            )


def learned_scenes(dataset: Dataset) -> list[str]:
    """The scenes that `train` learns from."""
    splits = dataset.file.splits
    aside = {*splits.validation, *splits.test}
    return list(splits.train) or [name for name in dataset.items("scene") if name not in aside]


def check_variants(dataset: Dataset, variants: Sequence[str]) -> None:
    """Raise an error for networks that do not exist, are damaged, or are of another version."""
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


def _checked(dataset: Dataset, wanted: HeldOut) -> HeldOut:
    """`wanted`, if all of its scenes have exact ground truth, or else masks and matches."""
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
