"""The `holdfast` command. What it needs beside the library comes with the extra `demo`."""

from __future__ import annotations

import sys

EXTRA = frozenset({"PIL", "numpy", "rich", "typer"})


def app() -> None:
    """Run the command line; without the extra, say what to install instead of showing a traceback."""
    try:
        from .commands import commands

        commands()
    except ModuleNotFoundError as missing:
        sys.exit(missing_extra(missing))


def missing_extra(missing: ModuleNotFoundError) -> str:
    """What to tell a user who lacks a package of the extra.

    Raises:
        ModuleNotFoundError: the package is none of the extra's; that is a fault of the installation, not a choice.
    """
    package = (missing.name or "").partition(".")[0]
    if package not in EXTRA:
        raise missing
    return f"holdfast: this command needs the package {package!r}, which is not installed: pip install holdfast[demo]"


if __name__ == "__main__":
    app()
