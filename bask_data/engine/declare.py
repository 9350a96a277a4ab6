"""Declaring a function as a stage: its signature defines inputs and parameters."""

from __future__ import annotations

import importlib
import types
import typing
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from bask_data.artifact import Artifact
from bask_data.dataset import Splits
from bask_data.params import Params


@dataclass(frozen=True)
class Input:
    """An input of a stage. `gather`: a list over all items of the kind's scope."""

    name: str
    artifact: type[Artifact]
    gather: bool


@dataclass(frozen=True)
class Stage:
    """A declared stage; callable like the function it was declared from.

    Args:
        on_request: made only when it is asked for by name; `run` and `status` keep up to date what exists.
    """

    name: str
    makes: type[Artifact]
    version: int
    resumable: bool
    together: bool
    params: type[Params]
    inputs: tuple[Input, ...]
    wants_splits: bool
    function: Callable[..., None]
    help: str
    on_request: bool = False

    def __call__(self, *args: Any, **kwargs: Any) -> None:
        self.function(*args, **kwargs)

    def __reduce__(self) -> tuple[Any, ...]:
        # A stage is pickled by name: its module has it under the function's name.
        return _load_stage, (self.function.__module__, self.function.__name__)


def _load_stage(module: str, name: str) -> Stage:
    return getattr(importlib.import_module(module), name)


def stage(
    *,
    makes: type[Artifact],
    version: int,
    resumable: bool = False,
    together: bool = False,
    on_request: bool = False,
) -> Callable[[Callable[..., None]], Stage]:
    """Declare a function as the stage that makes a kind.

    Args:
        version: to be raised by hand when the results change; part of the skip key.
        resumable: after a kill, `out` still holds what the last attempt with the same key wrote.
        together: several processes started by torchrun can make one artifact. All are called; the first one writes.
        on_request: made only when it is asked for by name; `run` and `status` keep up to date what exists.
    """

    def declare(function: Callable[..., None]) -> Stage:
        hints = typing.get_type_hints(function)
        inputs, params, wants_splits = [], Params, False
        for name, hint in hints.items():
            if name in ("out", "log", "return"):
                continue
            if hint is Splits:
                wants_splits = True
            elif typing.get_origin(hint) is list:
                inputs.append(Input(name, typing.get_args(hint)[0], gather=True))
            elif isinstance(hint, types.UnionType):
                inputs.append(Input(name, typing.get_args(hint)[0], gather=False))
            elif issubclass(hint, Artifact):
                inputs.append(Input(name, hint, gather=False))
            else:
                assert issubclass(hint, Params), f"{function.__name__}: {name} is no input, Params or Splits"
                params = hint
        return Stage(
            name=function.__name__,
            makes=makes,
            version=version,
            resumable=resumable,
            together=together,
            params=params,
            inputs=tuple(inputs),
            wants_splits=wants_splits,
            function=function,
            help=(function.__doc__ or "").strip(),
            on_request=on_request,
        )

    return declare


def in_order(stages: Iterable[Stage]) -> list[Stage]:
    """The stages sorted so that each comes after those that make its inputs."""
    waiting, ordered = list(stages), []
    while waiting:
        unmade = {stage.makes for stage in waiting}
        ready = [stage for stage in waiting if not unmade & {input_.artifact for input_ in stage.inputs}]
        assert ready, "the stages form a cycle"
        ordered += ready
        waiting = [stage for stage in waiting if stage not in ready]
    return ordered
