"""The `holdfast` command. What it needs beside the library comes with the extra `cli`."""

from __future__ import annotations

import sys

EXTRA = {"rich", "typer"}
"""The packages of other people that the command imports: those of the extra `cli`."""


def app() -> None:
    """Run the command line; without its extra, say what to install instead of showing a traceback."""
    try:
        from .commands import commands

        commands()
    except ModuleNotFoundError as missing:
        sys.exit(missing_extra(missing))


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
