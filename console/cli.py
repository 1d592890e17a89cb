"""The `holdfast` command. What it needs beside the library comes with the extra `cli`."""

from __future__ import annotations

import os
import sys

EXTRA = {"rich", "textual", "typer"}
"""The packages of other people that the command imports: those of the extra `cli`."""


def app() -> None:
    """Run the command line; without its extra, say what to install instead of showing a traceback.

    Nor is there a traceback of a fault of the command itself, unless HOLDFAST_TRACEBACK is set.
    """
    try:
        from .commands import commands

        commands()
    except ModuleNotFoundError as missing:
        sys.exit(missing_extra(missing))
    except BrokenPipeError:  # Whoever reads it has enough, as `head` has.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except Exception as error:
        if os.environ.get("HOLDFAST_TRACEBACK"):
            raise
        hint = "HOLDFAST_TRACEBACK=1 shows where"
        sys.exit(f"holdfast: this is a fault of the command, {type(error).__name__}: {error} ({hint})")


def missing_extra(missing: ModuleNotFoundError) -> str:
    """What to tell a user who lacks a package of the extra.

    Raises:
        ModuleNotFoundError: the package is not of the extra; that is a fault of the installation, not a choice.
    """
    package = (missing.name or "").partition(".")[0]
    if package not in EXTRA:
        raise missing
    install = "pip install 'holdfast[cli]'"  # in quotes, for shells to which brackets mean something
    return f"holdfast: this command needs the package {package!r}, which is not installed: {install}"


if __name__ == "__main__":
    app()
