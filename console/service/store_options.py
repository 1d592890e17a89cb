"""What all commands take that work with a store on the disk: the path of its database, and the file with its key."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def file_path(path: Path) -> Path:
    """A path, if it is not the address of servers.

    Raises:
        BadParameter: it is one.
    """
    if path.parts[:1] in (("nats:",), ("tls:",)):
        problem = (
            "this is for a store in a file: copy the one on servers into a file (holdfast store copy), and take that"
        )
        raise typer.BadParameter(problem)
    return path


StorePath = Annotated[
    Path,
    typer.Argument(
        metavar="STORE", help="The database of a store: app.db, as in store='sqlite:app.db'.", callback=file_path
    ),
]
KeyFile = Annotated[
    Path | None,
    typer.Option(
        "--key-file",
        envvar="HOLDFAST_STORE_KEY_FILE",
        help="Of an encrypted store: the file with its key, which only its owner may read.",
    ),
]
