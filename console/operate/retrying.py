"""The commands for messages that were put aside: quarantine lists them, quarantine retry and drop settle them."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import msgspec
import typer
from typer.core import TyperGroup

from ...actors.errors import SpecError
from ...system.history.evidence import PutAside
from ..remote import RemoteSystem
from .patterns import read_pattern, refuse_address
from .reaching import (
    FAILED,
    WHOSE,
    Json,
    Patterned,
    Socket,
    System,
    Yes,
    complete,
    complete_path,
    confirm,
    ended,
    reached,
    show_json,
)
from .remembering import print_lines
from .told_lines import quarantine_line

LISTING = "list"


class ListByDefault(TyperGroup):
    """A group of commands of which `list` is meant where none of them is named: `holdfast quarantine /app/till`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Name the listing if no command is named; a shell that completes words has named none yet."""
        is_named = bool(args) and (args[0] in self.commands or args[0] in ctx.help_option_names)
        is_early = not args and ctx.resilient_parsing
        return super().parse_args(ctx, args if is_named or is_early else [LISTING, *args])

    def shell_complete(self, ctx: Any, incomplete: str) -> Any:
        """The commands, and the addresses that the listing takes."""
        listing = self.commands[LISTING]
        address = next(one for one in listing.params if one.name == "path")
        with listing.make_context(LISTING, [], parent=ctx, resilient_parsing=True) as inner:
            return [*super().shell_complete(ctx, incomplete), *address.shell_complete(inner, incomplete)]


quarantine = typer.Typer(
    name="quarantine",
    cls=ListByDefault,
    help="List, retry or drop the messages that were put aside because they have ended their actor's process.",
    add_completion=False,
)


def put_aside_of(remote: RemoteSystem, path: str | None) -> list[PutAside]:
    """What is in quarantine of those who are meant; they need not be there any more. Raises BadPattern."""
    found = remote.put_aside()
    if path is None:
        return found
    pattern, rows = read_pattern(path), remote.look().rows
    refuse_address(pattern, {row.path for row in rows} | {one.address for one in found})
    there = {row.path for row in rows if pattern.matches(row)}
    is_like = pattern.is_like if not pattern.conditions else there.__contains__
    return [one for one in found if one.address in there or is_like(one.address)]


def complete_id(ctx: typer.Context, incomplete: str) -> list[str]:
    """The ids of what is in quarantine at the address that was typed, for the shell."""
    path: str | None = ctx.params.get("path")
    return complete(ctx, incomplete, lambda remote: [str(one.id) for one in put_aside_of(remote, path)])


Id = Annotated[
    int | None,
    typer.Argument(
        min=0,
        max=2**63 - 1,
        metavar="[ID]",
        help="The number of one message; without it, all.",
        autocompletion=complete_id,
    ),
]


@quarantine.command(LISTING, hidden=True)
def list_quarantine(
    path: Annotated[
        str | None, typer.Argument(help=f"{WHOSE}; without one, of all.", autocompletion=complete_path)
    ] = None,
    system: System = None,
    socket: Socket = None,
    as_json: Json = False,
) -> None:
    """List the messages that were put aside because they have ended their actor's process again and again.

    Exit status 0: done, also if there is none. 2: no system answers.
    """
    with reached("quarantine", system, socket) as remote:
        messages = put_aside_of(remote, path)
    if as_json:
        show_json({"quarantine": msgspec.to_builtins(messages)})
    else:
        print_lines(map(quarantine_line, messages), none="no such message is in quarantine")


@quarantine.command()
def retry(path: Patterned, id: Id = None, system: System = None, socket: Socket = None, as_json: Json = False) -> None:
    """Have messages in quarantine handled as if they had come now. Who had asked has long got `Quarantined`.

    Exit status 0: done. 1: nothing is there, or one could not be retried; the others were. 2: no system answers.
    """
    with reached("quarantine retry", system, socket) as remote:
        _settle(remote, "retry", _meant(remote, path, id), as_json)


@quarantine.command()
def drop(
    path: Patterned,
    id: Id = None,
    system: System = None,
    socket: Socket = None,
    yes: Yes = False,
    as_json: Json = False,
) -> None:
    """Forget messages in quarantine: they become dead letters. You are asked before.

    Exit status 0: done. 1: nothing is there, or one could not be dropped; the others were. 2: no system answers.
    """
    with reached("quarantine drop", system, socket) as remote:
        meant = _meant(remote, path, id)
        confirm("quarantine drop", [f"this is dropped: {quarantine_line(one)}" for one in meant], yes=yes)
        _settle(remote, "drop", meant, as_json)


def _meant(remote: RemoteSystem, path: str, id: int | None) -> list[PutAside]:
    """The messages that are meant. Raises SpecError: there is none, or the number may be that of several actors."""
    found = put_aside_of(remote, path)
    if id is not None and len({one.address for one in found}) > 1:
        raise SpecError(path, f"several actors are meant, each of which may have a message {id}: write an address")
    meant = [one for one in found if id in (None, one.id)]
    if not meant:
        which = "nothing" if id is None else f"no message {id}"
        raise SpecError(path, f"{which} of it is in quarantine: `holdfast quarantine` lists what is")
    return meant


def _settle(remote: RemoteSystem, verb: Literal["retry", "drop"], meant: list[PutAside], as_json: bool) -> None:
    """Have it done for these messages and no others, and show for which it was done."""
    done, failed = list[PutAside](), list[str]()
    for one in meant:
        try:
            settled, not_settled = remote.settle_put_aside(verb, one.address, one.id)
        except SpecError as error:  # Somebody else has settled it meanwhile.
            settled, not_settled = [], [str(error)]
        done += settled
        failed += not_settled
    if as_json:
        told: Any = {"done": msgspec.to_builtins(done), "failed": failed}
        show_json(told)
    else:
        words = {"retry": "handled again", "drop": "dropped"}
        print_lines(f"{words[verb]}: {quarantine_line(one)}" for one in done)
    if failed:
        raise ended(f"quarantine {verb}", "; ".join(failed), FAILED)
