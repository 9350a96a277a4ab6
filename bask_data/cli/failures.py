"""What ends a command early: one line for a person, an exit code for a script."""

from __future__ import annotations

import functools
import os
import sys
from collections.abc import Callable
from concurrent.futures.process import BrokenProcessPool
from typing import Any

import typer

from bask_data.cli.console import say, show_error
from bask_data.errors import BaskError, MissingDependency


def reporting(body: Callable[..., None]) -> Callable[..., None]:
    """The same command, with errors as one line for a person and an exit code for a script."""

    @functools.wraps(body)
    def command(*args: Any, **kwargs: Any) -> None:
        try:
            body(*args, **kwargs)
        except (typer.Exit, typer.Abort):
            raise
        except KeyboardInterrupt:
            say("interrupted: what was finished is kept; the same command goes on from there.")
            raise typer.Exit(130) from None
        except BrokenProcessPool:
            say("error: a worker process was killed.  fix: it may have run out of memory; use fewer --jobs.")
            raise typer.Exit(1) from None
        except BrokenPipeError:
            # Whoever read our output has gone: point it at nothing, or the interpreter complains when it closes it.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise typer.Exit(1) from None
        except BaskError as error:
            show_error(error)
            raise typer.Exit(error.exit_code) from None
        except ImportError as error:
            show_error(
                MissingDependency(
                    "import", error.name or "", expected="a package that loads", got=str(error), fix="bask-data doctor"
                )
            )
            raise typer.Exit(MissingDependency.exit_code) from None
        except Exception as error:
            if os.environ.get("BASK_DEBUG"):
                raise
            say(f"error: {type(error).__name__}: {error}  fix: set BASK_DEBUG=1 for the traceback.")
            raise typer.Exit(1) from None

    return command
