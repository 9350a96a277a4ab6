"""Early ends of a command: one line for a person, an exit code for a script."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from concurrent.futures import BrokenExecutor
from contextlib import contextmanager

import typer

from bask_data.cli.console import say, show_error
from bask_data.errors import BaskError, MissingDependency


@contextmanager
def reported() -> Iterator[None]:
    """Turn an exception inside into a line on stderr and the documented exit code.

    Raises:
        typer.Exit: with that code. With `BASK_DEBUG=1` an unexpected error passes through, with its traceback.
    """
    try:
        yield
    except (typer.Exit, typer.Abort, typer.TyperException):
        raise
    except KeyboardInterrupt:
        say("interrupted: finished work is kept; run the same command again to continue.")
        raise typer.Exit(130) from None
    except BrokenExecutor:
        say("error: a worker process was killed.  fix: it may have run out of memory; use fewer --jobs.")
        raise typer.Exit(1) from None
    except BrokenPipeError:
        # The reader of our output is gone. Without this the interpreter would complain when it flushes stdout.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise typer.Exit(1) from None
    except BaskError as error:
        show_error(error)
        raise typer.Exit(error.exit_code) from None
    except ImportError as error:
        missing = MissingDependency(
            "import", error.name or "", expected="an importable package", got=str(error), fix="bask-data doctor"
        )
        show_error(missing)
        raise typer.Exit(missing.exit_code) from None
    except OSError as error:
        if os.environ.get("BASK_DEBUG"):
            raise
        got = (error.strerror or type(error).__name__).lower()
        fix = "check the path, its permissions and the free space; BASK_DEBUG=1 shows the traceback."
        where = error.filename if isinstance(error.filename, str) else "file or output"
        show_error(BaskError(where, "", expected="a file or device to read or write", got=got, fix=fix))
        raise typer.Exit(1) from None
    except Exception as error:
        if os.environ.get("BASK_DEBUG"):
            raise
        say(f"error: {type(error).__name__}: {error}  fix: set BASK_DEBUG=1 for the traceback.")
        raise typer.Exit(1) from None
