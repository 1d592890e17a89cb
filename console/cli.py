"""The `holdfast` command. What it needs beside the library comes with the extra `cli`."""

from __future__ import annotations

import os
import signal
import sys

EXTRA = {"rich", "textual", "typer"}
"""The packages of other people that the command imports: those of the extra `cli`."""


def app() -> None:
    """Run the command line; without its extra, say what to install instead of showing a traceback.

    Nor is there a traceback of a fault of the command itself, unless HOLDFAST_TRACEBACK is set. If nobody reads the
    output any more, as behind `head`, the command ends by SIGPIPE, as others do: no exit status of its own says that.
    """
    try:
        from .commands import commands

        try:
            commands()
        finally:
            sys.stdout.flush()
    except SystemExit as end:  # So typer and rich end a command whose output is not read.
        if isinstance(end.__context__, BrokenPipeError):
            end_unread()
        raise
    except ModuleNotFoundError as missing:
        sys.exit(missing_extra(missing))
    except Exception as error:
        if isinstance(error, BrokenPipeError):
            end_unread()
        if os.environ.get("HOLDFAST_TRACEBACK"):
            raise
        hint = "HOLDFAST_TRACEBACK=1 shows where"
        sys.exit(f"holdfast: this is a fault of the command, {type(error).__name__}: {error} ({hint})")


def end_unread() -> None:
    """End the process by SIGPIPE."""
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    os.kill(os.getpid(), signal.SIGPIPE)


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
