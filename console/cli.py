"""The `holdfast` command. What it needs beside the library comes with the extra `cli`, its demo with `demo`."""

from __future__ import annotations

import sys

EXTRAS = {"rich": "cli", "typer": "cli", "PIL": "demo", "numpy": "demo"}
"""The packages of other people that the command imports, and the extra that each comes with."""


def app() -> None:
    """Run the command line; without its extra, say what to install instead of showing a traceback."""
    try:
        from .commands import commands

        commands()
    except ModuleNotFoundError as missing:
        sys.exit(missing_extra(missing))


def missing_extra(missing: ModuleNotFoundError) -> str:
    """What to tell a user who lacks a package of an extra.

    Raises:
        ModuleNotFoundError: the package is of no extra; that is a fault of the installation, not a choice.
    """
    package = (missing.name or "").partition(".")[0]
    if package not in EXTRAS:
        raise missing
    install = f"pip install 'holdfast[{EXTRAS[package]}]'"  # in quotes, for shells to which brackets mean something
    return f"holdfast: this command needs the package {package!r}, which is not installed: {install}"


if __name__ == "__main__":
    app()
