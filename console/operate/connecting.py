"""The commands for connections: connections lists the programs, connections drop forgets what is kept for one."""

from __future__ import annotations

from typing import Annotated

import msgspec
import typer

from ...cluster.lines.lines import PeerLook
from .reaching import Json, Socket, System, Yes, confirm, reached, show_json
from .remembering import print_lines

connections = typer.Typer(
    name="connections",
    help="List the programs that are connected, or drop what is kept for a system that does not come back.",
    invoke_without_command=True,
    add_completion=False,
)


@connections.callback()
def list_connections(ctx: typer.Context, system: System = None, socket: Socket = None, as_json: Json = False) -> None:
    """List the programs that are connected, and what is kept for systems until they have accepted it.

    Exit status 0: done, also if there is none. 2: no system answers.
    """
    if ctx.invoked_subcommand is not None:
        return
    with reached("connections", system, socket) as remote:
        found = remote.connected()
    if as_json:
        show_json({"connections": msgspec.to_builtins(found)})
    else:
        print_lines(map(connection_line, found), none="no program is connected, and nothing is kept for one")


@connections.command()
def drop(
    name: Annotated[str, typer.Argument(metavar="NAME", help="The other system, as `holdfast connections` shows it.")],
    system: System = None,
    socket: Socket = None,
    yes: Yes = False,
    as_json: Json = False,
) -> None:
    """Drop what recorded actors have told a system that does not accept it: dead letters. You are asked before.

    Exit status 0: done. 1: no system of that name was ever connected. 2: no system answers.
    """
    with reached("connections drop", system, socket) as remote:
        meant = [one for one in remote.connected() if one.system == name]
        confirm("connections drop", [f"this is dropped: {connection_line(one)}" for one in meant], yes=yes)
        dropped = remote.drop_kept(name)
    if as_json:
        show_json({"system": name, "dropped": dropped})
    else:
        print_lines([f"{dropped} messages for /{name} were dropped"])


def connection_line(one: PeerLook) -> str:
    """A connection as a line of text."""
    state = "connected" if one.is_connected else "away"
    return f"/{one.system}  {state}, {one.kept} messages ({one.kept_bytes} bytes) are kept for it"
