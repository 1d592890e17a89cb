"""The commands of repair: repair status, approve, deny, retry and set."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from typing import Annotated, Any, Final

import typer

from ..wire import RepairVerb
from .reaching import Json, Socket, System, reached, show_json
from .remembering import print_lines

STANCES: Final = ("off", "advise", "ask", "on")

repair = typer.Typer(
    name="repair",
    help="See how repair stands, approve or deny its plans, and say how far it may go.",
    no_args_is_help=True,
    add_completion=False,
)

Case = Annotated[int, typer.Argument(min=1, help="The number of the case, as `holdfast diagnose` tells it.")]


@repair.command()
def status(system: System = None, socket: Socket = None, as_json: Json = False) -> None:
    """Say how repair stands: how far it may go, what waits for approval, and how good its advice was.

    Exit status 0: done. 1: no repair runs. 2: no system answers.
    """
    _ordered("status", (), system, socket, as_json)


@repair.command()
def approve(case: Case, system: System = None, socket: Socket = None, as_json: Json = False) -> None:
    """Have the plan of a case carried out that waits for approval.

    Exit status 0: done. 1: no plan of this case waits. 2: no system answers.
    """
    _ordered("approve", (str(case),), system, socket, as_json)


@repair.command()
def deny(
    case: Case,
    why: Annotated[str, typer.Argument(help="Why; it is told with the end of the case.")] = "an operator said no",
    system: System = None,
    socket: Socket = None,
    as_json: Json = False,
) -> None:
    """Forbid the plan of a case: nobody whom it is for is touched before `holdfast repair retry`.

    Exit status 0: done. 1: no plan of this case waits. 2: no system answers.
    """
    _ordered("deny", (str(case), why), system, socket, as_json)


@repair.command()
def retry(
    components: Annotated[list[str] | None, typer.Argument(help="Components; without any, all.")] = None,
    system: System = None,
    socket: Socket = None,
    as_json: Json = False,
) -> None:
    """Let repair touch components again that it has given up, or that were denied to it.

    Exit status 0: done. 1: no repair runs. 2: no system answers.
    """
    _ordered("retry", tuple(components or ()), system, socket, as_json)


@repair.command("set")
def set_stance(
    stance: Annotated[str, typer.Argument(help="off, advise, ask or on.")],
    system: System = None,
    socket: Socket = None,
    as_json: Json = False,
) -> None:
    """Say how far repair goes from now on: off, advise, ask or on. A restart of the program forgets it.

    Exit status 0: done. 1: no repair runs. 2: there is no such stance, or no system answers.
    """
    if stance not in STANCES:
        raise typer.BadParameter(f"{stance!r} is none of {', '.join(STANCES)}")
    _ordered("set", (stance,), system, socket, as_json)


def _ordered(verb: RepairVerb, words: tuple[str, ...], system: Any, socket: Any, as_json: bool) -> None:
    with reached(f"repair {verb}", system, socket) as remote:
        told = asyncio.run(remote.order_repair(verb, words))
    if as_json:
        show_json(told)
    else:
        print_lines(line for one in told for line in repair_lines(one))


def repair_lines(one: dict[str, Any]) -> Iterator[str]:
    """How one repairer stands, a line for each thing; what there is nothing of is left out."""
    yield f"{one['repairer']}: repair is {one['stance']}; {one['cases']} cases, {one['useless']} plans did not help"
    if one["waiting"]:
        yield f"case {one['waiting']} waits: holdfast repair approve {one['waiting']}, or deny {one['waiting']}"
    if one["right"] or one["wrong"] or one["needless"] or one["missed"]:
        yield (
            f"advice: {one['right']} right ({one['seconds_saved']:.1f} s before somebody did it), "
            f"{one['wrong']} wrong, {one['needless']} needless; {one['missed']} restarts by order without advice"
        )
    yield from (f"given up: {name}: {one['reasons'][name]}" for name in one["given_up"])
    yield from (f"denied: {name}: {one['reasons'][name]}" for name in one["denied"])
