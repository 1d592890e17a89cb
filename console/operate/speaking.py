"""The commands that send one actor a message, as another actor would."""

from __future__ import annotations

import asyncio
import json
from typing import Annotated, Any

import typer

from ..remote import RemoteSystem
from .reaching import Json, OnePath, Socket, System, Timeout, printable, reached, show_json

Type = Annotated[
    str, typer.Argument(metavar="TYPE", help="A class of messages that it handles: its name, or module:Class.")
]
Fields = Annotated[str, typer.Argument(metavar="[JSON]", help="Its fields, as a JSON object.", show_default=False)]


def ask(
    path: OnePath,
    message: Type,
    fields: Fields = "{}",
    system: System = None,
    socket: Socket = None,
    timeout: Timeout = 5.0,
    as_json: Json = False,
) -> None:
    """Ask an actor, and print its reply: as JSON if that can say it, else as Python writes it.

    A field that is a ref is given as an address. The message waits its turn in the mailbox, as every other does.

    Exit status 0: it has replied. 1: it has refused or did not reply in time, or there is no such actor, class or
    field. 2: no system answers.
    """
    with reached("ask", system, socket) as remote:
        said = _sent(remote, path, message, fields, timeout, asks=True)
    if as_json:
        show_json(said)
    else:
        typer.echo(printable(said.get("text") or json.dumps(said.get("reply"), ensure_ascii=False)))


def tell(
    path: OnePath,
    message: Type,
    fields: Fields = "{}",
    system: System = None,
    socket: Socket = None,
    as_json: Json = False,
) -> None:
    """Send an actor a message, and do not wait until it is handled.

    Exit status 0: it is in the mailbox. 1: there is no such actor, class or field, or no room. 2: no system answers.
    """
    with reached("tell", system, socket) as remote:
        said = _sent(remote, path, message, fields, 5.0, asks=False)
    if as_json:
        show_json(said)
    else:
        typer.echo(f"told {path}")


def _sent(remote: RemoteSystem, path: str, message: str, fields: str, timeout: float, *, asks: bool) -> dict[str, Any]:
    return asyncio.run(remote.send_message(path, message, fields, asks=asks, timeout=timeout))
