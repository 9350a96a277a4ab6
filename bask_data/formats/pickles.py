"""Pickles of strangers, read without running them: an interpreter of the opcodes that plain data and arrays need.

Python's unpickler calls whatever a file names, and a restricted one still lets a small file claim gigabytes. Here names
are looked up in a table of this module, nothing is imported or called, and what is built is no larger than the file:
numbers, texts, lists, dictionaries, NumPy arrays of numbers, and `Record` for the classes that a caller names.
"""

from __future__ import annotations

import pickletools
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bask_data.errors import BadData
from bask_data.formats.files import read_bytes
from bask_data.formats.pickled_arrays import CALLS, DataType, PendingArray, Refused, array_of

MAX_PICKLE_BYTES = 256 * 2**20
"""Largest pickle that is read, bytes: an episode of RLBench takes 1 MB, or some 100 MB if its images are inside."""

MAX_OPCODES = 3_000_000
"""Most opcodes of a pickle: some 250 make an observation of RLBench, and one makes at most a hundred bytes."""


@dataclass
class Record:
    """An object of a class that the caller named, with its attributes; the class itself plays no part."""

    kind: str
    attributes: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class _Named:
    """A name that a pickle refers to."""

    module: str
    name: str

    def __str__(self) -> str:
        return f"{self.module}.{self.name}"


_KNOWN = (
    *CALLS,
    "numpy.ndarray",
    "copyreg._reconstructor",
    "copy_reg._reconstructor",
    "builtins.object",
    "__builtin__.object",
)
"""Names that may occur in pickles besides those of the caller's classes."""


class _Mark:
    """Where a group of objects begins on the stack."""


def read_pickle(path: Path, classes: tuple[str, ...] = ()) -> Any:
    """What a pickle file holds.

    Args:
        classes: full names of classes whose objects become `Record`; those of their constructors' arguments are lost.

    Raises:
        BadData: it names anything else, is damaged, or larger than `MAX_PICKLE_BYTES` or `MAX_OPCODES`.
    """
    data = read_bytes(path, MAX_PICKLE_BYTES)
    reader = _Reader(classes)
    actions = {opcode.name: getattr(reader, f"do_{opcode.name.lower()}", None) for opcode in pickletools.opcodes}
    try:
        for i, (opcode, argument, at) in enumerate(pickletools.genops(data)):
            if i >= MAX_OPCODES:
                raise Refused(f"more than {MAX_OPCODES} operations")
            act = actions[opcode.name]
            if act is None:
                raise Refused(f"operation {opcode.name} at byte {at}")
            act(argument)
        return reader.stack.pop()
    except Refused as refused:
        raise BadData(
            path,
            "",
            expected="a pickle of plain data and arrays of numbers",
            got=f"{refused}",
            fix="nothing of it was run; write the data as plain values and arrays.",
        ) from None
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, OverflowError, UnicodeError) as error:
        got, fix = f"{type(error).__name__}", "copy it again from its source."
        raise BadData(path, "", expected="a complete pickle", got=got, fix=fix) from error


class _Reader:
    """The stack machine; a method for each opcode that is allowed."""

    def __init__(self, classes: tuple[str, ...]) -> None:
        self.stack: list[Any] = []
        self.memo: dict[int, Any] = {}
        self._classes = classes

    def do_proto(self, _: int | None) -> None:
        pass

    do_frame = do_stop = do_proto

    def do_none(self, _: None) -> None:
        self.stack.append(None)

    def do_newtrue(self, _: None) -> None:
        self.stack.append(True)

    def do_newfalse(self, _: None) -> None:
        self.stack.append(False)

    def _push(self, value: Any) -> None:
        self.stack.append(value)

    do_binint = do_binint1 = do_binint2 = do_long1 = do_long4 = do_binfloat = _push
    do_binunicode = do_short_binunicode = do_binunicode8 = _push
    do_binbytes = do_short_binbytes = do_binbytes8 = do_bytearray8 = _push

    def do_empty_list(self, _: None) -> None:
        self.stack.append([])

    def do_empty_dict(self, _: None) -> None:
        self.stack.append({})

    def do_empty_tuple(self, _: None) -> None:
        self.stack.append(())

    def do_mark(self, _: None) -> None:
        self.stack.append(_Mark)

    def do_tuple(self, _: None) -> None:
        self.stack.append(tuple(self._marked()))

    def do_tuple1(self, _: None) -> None:
        self._gather(1)

    def do_tuple2(self, _: None) -> None:
        self._gather(2)

    def do_tuple3(self, _: None) -> None:
        self._gather(3)

    def do_append(self, _: None) -> None:
        value = self.stack.pop()
        self._top(list).append(value)

    def do_appends(self, _: None) -> None:
        values = self._marked()
        self._top(list).extend(values)

    def do_setitem(self, _: None) -> None:
        value, key = self.stack.pop(), self.stack.pop()
        self._set([key, value])

    def do_setitems(self, _: None) -> None:
        self._set(self._marked())

    def do_pop(self, _: None) -> None:
        self.stack.pop()

    def do_memoize(self, _: None) -> None:
        self.do_binput(len(self.memo))

    def do_binput(self, i: int) -> None:
        self.memo[i] = self.stack[-1]
        if isinstance(self.stack[-1], PendingArray):
            self.stack[-1].places.append(i)

    def do_binget(self, i: int) -> None:
        self.stack.append(self.memo[i])

    do_long_binput, do_long_binget = do_binput, do_binget

    def do_global(self, text: str) -> None:
        module, name = text.split(" ", 1)
        self._name(module, name)

    def do_stack_global(self, _: None) -> None:
        name, module = self.stack.pop(), self.stack.pop()
        self._name(module, name)

    def do_newobj(self, _: None) -> None:
        arguments, named = self.stack.pop(), self.stack.pop()
        if not isinstance(named, _Named) or str(named) not in self._classes or not isinstance(arguments, tuple):
            raise Refused(f"an object of {named if isinstance(named, _Named) else 'something else than a class'}")
        self.stack.append(Record(named.name))

    def do_reduce(self, _: None) -> None:
        arguments, named = self.stack.pop(), self.stack.pop()
        if not isinstance(named, _Named) or not isinstance(arguments, tuple):
            raise Refused("a call of something else than a name")
        if str(named) in self._classes:
            self.stack.append(Record(named.name))
        elif str(named).endswith("._reconstructor"):
            cls = arguments[0]
            self.stack.extend([cls, ()])
            self.do_newobj(None)
        else:
            self.stack.append(CALLS[str(named)](*arguments))

    def do_build(self, _: None) -> None:
        state, built = self.stack.pop(), self.stack[-1]
        if isinstance(built, Record) and isinstance(state, dict):
            built.attributes.update(state)
        elif isinstance(built, PendingArray) and isinstance(state, tuple):
            _, shape, data_type, fortran, content = state
            self.stack[-1] = array_of(content, data_type, shape, "F" if fortran else "C")
            self.memo.update(dict.fromkeys(built.places, self.stack[-1]))
        elif isinstance(built, DataType) and isinstance(state, tuple) and state[1] in ("<", ">", "|", "="):
            built.order = state[1]
        else:
            raise Refused("a state for something that has none")

    def _name(self, module: Any, name: Any) -> None:
        named = _Named(str(module)[:100], str(name)[:100]) if isinstance(name, str) else _Named("", "")
        if str(named) not in self._classes and str(named) not in _KNOWN:
            raise Refused(f"the name {str(named)!a}")
        self.stack.append(named)

    def _top(self, kind: type) -> Any:
        if not isinstance(self.stack[-1], kind):
            raise Refused(f"items for something else than a {kind.__name__}")
        return self.stack[-1]

    def _marked(self) -> list[Any]:
        values: list[Any] = []
        while (value := self.stack.pop()) is not _Mark:
            values.append(value)
        return values[::-1]

    def _gather(self, n: int) -> None:
        if len(self.stack) < n:
            raise IndexError
        self.stack[-n:] = [tuple(self.stack[-n:])]

    def _set(self, items: list[Any]) -> None:
        found = self._top(dict)
        for key, value in zip(items[::2], items[1::2], strict=True):
            # Tuples within tuples as keys would take exponential time.
            if not isinstance(key, str | int):
                raise Refused(f"a key of type {type(key).__name__}")
            found[key] = value
