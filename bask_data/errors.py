"""What can go wrong through no fault of ours, and the exit code that tells a script which it was."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from types import ModuleType


class BaskError(Exception):
    """Something a user, a file or a machine got wrong. Printed without a traceback.

    The message reads `where: field: expected ..., got ....  fix: ...`; every part but `where` may be left out.
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
        """The message without the way to mend it."""
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
    """The command line or a configuration asks for something that does not exist."""

    exit_code = 2


class WouldOverwrite(BaskError):
    """The target exists and `--force` was not given."""

    exit_code = 3


class BadData(BaskError):
    """A file does not hold what it should."""

    exit_code = 4


class MissingDependency(BaskError):
    """A package or system library is not installed."""

    exit_code = 5


def imported(module: str, what: str, *, user: str, extra: str) -> ModuleType:
    """A module of a package that not everybody needs.

    Args:
        what: the package as people call it, or what it is.
        user: the command or option that cannot do without.
        extra: of ours that brings it.

    Raises:
        MissingDependency: it, or a package that it needs itself, is not installed.
    """
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        fix = f"pip install 'bask-data[{extra}]'"
        raise MissingDependency(user, error.name or module, expected=what, got="none", fix=fix) from None
