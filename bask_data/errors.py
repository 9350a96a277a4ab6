"""Errors caused by users, files or machines, each with an exit code for scripts."""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from types import ModuleType


class BaskError(Exception):
    """An error caused by a user, a file or a machine; printed without a traceback.

    The message has the form `where: field: expected ..., got ....  fix: ...`; every part but `where` is optional.
    """

    exit_code = 1

    def __init__(
        self,
        where: str | Path,
        field: str = "",
        *,
        expected: str = "",
        got: object = "",
        fix: str = "",
    ) -> None:
        self.where = str(where)
        self.field = field
        self.expected = expected
        self.got = str(got)
        self.fix = fix
        super().__init__(f"{self.fault}  fix: {fix}" if fix else self.fault)

    @property
    def fault(self) -> str:
        """The message without the fix."""
        parts = [self.where] if self.where else []
        if self.field:
            parts.append(self.field)
        difference = ", ".join(
            text
            for text in (
                f"expected {self.expected}" if self.expected else "",
                f"got {self.got}" if self.got else "",
            )
            if text
        )
        if difference:
            parts.append(difference + ".")
        return ": ".join(parts)

    def __reduce__(self) -> tuple[object, ...]:
        # Keyword-only arguments do not survive the default pickling, and errors cross process pools.
        return (_rebuild, (type(self), self.where, self.field, self.expected, self.got, self.fix))


def _rebuild(cls: type[BaskError], where: str, field: str, expected: str, got: str, fix: str) -> BaskError:
    return cls(where, field, expected=expected, got=got, fix=fix)


class UsageError(BaskError):
    """The command line or a configuration requests something that does not exist or is not allowed."""

    exit_code = 2


class WouldOverwrite(BaskError):
    """The target exists and `--force` was not given."""

    exit_code = 3


class BadData(BaskError):
    """A file has invalid content."""

    exit_code = 4


class MissingDependency(BaskError):
    """A package or system library is not installed."""

    exit_code = 5


def imported(module: str, what: str, *, user: str, extra: str) -> ModuleType:
    """A module of an optional package.

    Args:
        what: common name or description of the package.
        user: the command or option that needs it.
        extra: the extra of `bask-data` that installs it.

    Raises:
        MissingDependency: the package, or one of its own dependencies, is not installed.
    """
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        fix = f"pip install 'bask-data[{extra}]'"
        raise MissingDependency(user, error.name or module, expected=what, got="none", fix=fix) from None


def run(main: Callable[[], object]) -> None:
    """Run the main function of a script; a `BaskError` ends the script with a line on stderr, not a traceback.

    Raises:
        SystemExit: with the exit code of the error.
    """
    try:
        main()
    except BaskError as error:
        print("\n".join([f"error: {error}", *getattr(error, "__notes__", [])]), file=sys.stderr)
        raise SystemExit(error.exit_code) from None
