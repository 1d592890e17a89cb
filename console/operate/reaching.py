"""Which running system a command is for, and how a command ends that cannot do what it is asked."""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Callable, Generator, Iterable
from contextvars import ContextVar
from pathlib import Path
from typing import Annotated, Any, Final

import msgspec
import typer

from ...actors.errors import HoldfastError
from ...actors.values.path_parts import CONTROL
from ...system.history.paths import literal, one_meant
from ...system.options import ProgramRole
from ...system.script import UntrustedFile
from ..overview import ActorRow
from ..remote import NotAnswering, NotReached, RemoteSystem
from ..runtime_folder import FoundSocket, found_sockets, sweep
from ..wire import NotRunningHere, WrongUser
from .patterns import select

FAILED: Final = 1
UNUSABLE: Final = 2
GREETING_SECONDS: Final = 4.0
"""How long a system has to show that it answers, before it is asked for what may take longer."""


UNPRINTED: Final = dict.fromkeys(CONTROL, "?")
"""What stands for characters that no terminal is to obey. Addresses have none, but messages and errors may."""


def printable(text: str) -> str:
    """A text from a running system as one line of a terminal.

    >>> printable("/app/till\\x1b[31m\\n/app/safe")
    '/app/till?[31m?/app/safe'
    """
    return text.translate(UNPRINTED)


class NoSystem(HoldfastError, text="{problem}"):
    """There is no running system that is meant, or there are several."""

    problem: str


NODE: ContextVar[str] = ContextVar("the program that is meant of several of a system", default="")
"""What was given as `holdfast --node NODE`: a pid, a machine, or a role; empty if nothing was."""


class RunningProgram(msgspec.Struct, frozen=True):
    """A program with a control endpoint, and what it says of itself: nulls if it does not answer."""

    name: str
    pid: int
    socket: Path
    node: str | None = None
    role: ProgramRole | None = None
    leader: str | None = None
    since: float | None = None
    actors: int | None = None
    store: str | None = None

    @property
    def role_text(self) -> str:
        """Its role in words; of one that stands by with who leads."""
        if self.role is None:  # A program of an earlier version answers, and knows no roles.
            return "does not answer" if self.since is None else "?"
        return f"standby of {self.leader.partition(' (')[0]}" if self.role == "standby" and self.leader else self.role

    @property
    def runs(self) -> bool:
        """Whether the tree of the system runs in it, as far as it says."""
        return self.role in ("leader", "alone") or (self.role is None and self.since is not None)


def program_at(found: FoundSocket) -> RunningProgram:
    """Ask a program what it is."""
    known = {"name": found.system, "pid": found.pid, "socket": found.path}
    try:
        with RemoteSystem(found.path) as program:
            program.greet(GREETING_SECONDS)
            return msgspec.convert({**known, **program.about(), "socket": found.path}, RunningProgram)
    except HoldfastError:  # It is there, and stopped or hung.
        return RunningProgram(found.system, found.pid, found.path)


def complete_system(incomplete: str) -> list[str]:
    """The names of running systems, for the shell."""
    try:
        return sorted({one.system for one in found_sockets() if one.system.startswith(incomplete)})
    except HoldfastError:  # The folder is not to be trusted: a command says so, a shell that waits for words does not.
        return []


def complete_path(ctx: typer.Context, incomplete: str) -> list[str]:
    """The addresses in the system that is meant, for the shell."""
    return complete(ctx, incomplete, lambda remote: map(literal, remote.tree()))


def complete(ctx: typer.Context, incomplete: str, words: Callable[[RemoteSystem], Iterable[str]]) -> list[str]:
    """Words that the system that is meant knows, those that begin as what was typed; none if it does not answer."""
    try:
        NODE.set(ctx.find_root().params.get("node") or "")
        with RemoteSystem(chosen(ctx.params.get("system"), ctx.params.get("socket"))) as remote:
            return [word for word in words(remote) if word.startswith(incomplete)]
    except HoldfastError:  # A shell that waits for words has no use for a sentence.
        return []


System = Annotated[
    str | None,
    typer.Option(
        "--system",
        "-s",
        envvar="HOLDFAST_SYSTEM",
        metavar="NAME",
        help="The running system, by its name or its pid; the only one there is if left out.",
        autocompletion=complete_system,
    ),
]
Socket = Annotated[
    Path | None, typer.Option("--socket", metavar="FILE", help="The control endpoint of the running system, by path.")
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]
Yes = Annotated[bool, typer.Option("--yes", "-y", help="Do not ask before something is lost.")]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Only say what would be done.")]
Timeout = Annotated[float, typer.Option(min=0.1, max=3600.0, help="Seconds that it may take.")]
Paths = Annotated[
    list[str],
    typer.Argument(
        metavar="PATH...",
        help="Addresses, names or patterns, such as '/app/**[restarts>3]'.",
        autocompletion=complete_path,
    ),
]


WHOSE = "An address, a name, or a pattern such as '/app/bank/**'"
Patterned = Annotated[str, typer.Argument(help=f"{WHOSE}.", autocompletion=complete_path)]
ONE = "One actor: its address or its name"


def alone(path: str | None) -> str | None:
    """The address that is meant where no pattern is: with or without backslashes before its signs."""
    return path if path is None else one_meant(path) or path


OnePath = Annotated[
    str,
    typer.Argument(metavar="PATH", help=f"{ONE}.", autocompletion=complete_path, callback=alone),
]


RootOrOne = Annotated[
    str | None,
    typer.Argument(metavar="PATH", help=f"{ONE}.", autocompletion=complete_path, callback=alone),
]


NOBODY = "no system of yours is found by its name"
OF_ITS_OWN = (
    "a program opens an endpoint by control_endpoint(system), and with a path of its own it is reached by --socket FILE"
)


def chosen(system: str | None, socket: Path | None) -> Path:
    """The socket of the system that is meant; of several programs of it that of the one that runs its tree.

    Raises:
        NoSystem: there is none, or there are several. UntrustedFile: others may enter the folder of sockets.
    """
    if socket is not None:
        return socket
    sweep()
    live, node = found_sockets(), NODE.get()
    meant = [one for one in live if system in (None, "", one.system, str(one.pid))]
    if len(meant) == 1 and not node:
        return meant[0].path
    if not meant:
        there = ", ".join(f"{one.system} (pid {one.pid})" for one in live)
        wanted = f"no system {system!r} is found by its name" if system else NOBODY
        raise NoSystem("; ".join(filter(None, (wanted, f"there are {there}" if there else "", OF_ITS_OWN))))
    return _one_of([program_at(one) for one in meant], node).socket


def _one_of(programs: list[RunningProgram], node: str) -> RunningProgram:
    """The program that is meant. Raises NoSystem: none of them is, or several are."""
    there = ", ".join(f"{one.name} (pid {one.pid}, {one.role_text})" for one in programs)
    meant = [one for one in programs if node in ("", str(one.pid), one.node, one.role)]
    is_one_system = len({one.name for one in meant}) == 1
    running = [one for one in meant if one.runs]
    if is_one_system and len(running) == 1:
        return running[0]
    if len(meant) == 1:
        return meant[0]
    if not meant:
        raise NoSystem(f"no program is {node!r}, by its pid, machine or role; there are {there}")
    hint = "holdfast --node PID COMMAND" if is_one_system else "--system NAME"
    raise NoSystem(
        f"several {'programs' if is_one_system else 'systems'} run: {there}; say which is meant, with {hint}"
    )


@contextlib.contextmanager
def told(command: str) -> Generator[None, None, None]:
    """Say what went wrong in a sentence, and end with 2 if the system or a file cannot be had, else with 1."""
    try:
        yield
    except (NotReached, NotAnswering, NotRunningHere, NoSystem, WrongUser, UntrustedFile) as error:
        raise ended(command, error, UNUSABLE) from error
    except HoldfastError as error:
        raise ended(command, error, FAILED) from error


def ended(command: str, error: Exception | str, code: int) -> typer.Exit:
    """The end of a command that has failed, told on standard error."""
    typer.echo("\n".join(map(printable, f"holdfast {command}: {error}".split("\n"))), err=True)
    return typer.Exit(code)


@contextlib.contextmanager
def reached(command: str, system: str | None, socket: Path | None) -> Generator[RemoteSystem, None, None]:
    """The running system that is meant; whatever goes wrong ends the command with a sentence."""
    with told(command), RemoteSystem(chosen(system, socket)) as remote:
        remote.greet(GREETING_SECONDS)
        yield remote


def address_of(remote: RemoteSystem, path: str) -> str:
    """The address of the actor with this name; an address or a pattern as it is. Raises NoSuchActor."""
    return path if path.startswith("/") or {*"*?["} & {*path} else remote.whereis(path).path


def no_pattern(path: str) -> str:
    """What is to be said of an address at which nobody was found, if it looks as if it meant several.

    >>> no_pattern("/app/**"), no_pattern("/app/till")
    ("; '/app/**' is taken for one address: patterns are for other commands, such as `holdfast tree`", '')
    """
    if not {*"*[?"} & {*path}:
        return ""
    return f"; {path!r} is taken for one address: patterns are for other commands, such as `holdfast tree`"


def meant_rows(remote: RemoteSystem, paths: list[str]) -> list[ActorRow]:
    """The actors that the patterns mean. Raises BadPattern, NoSuchActor."""
    return select(remote.look().rows, paths)


def show_json(value: Any) -> None:
    """Print plain data as JSON, one document."""
    typer.echo(json.dumps(value, ensure_ascii=False, indent=2 if sys.stdout.isatty() else None))


def confirm(command: str, lost: list[str], *, yes: bool) -> None:
    """Ask before something is lost; nobody is asked if nothing is, or with `--yes`. Raises typer.Exit: no."""
    if yes or not lost:
        return
    for line in lost:
        typer.echo(line, err=True)
    if not sys.stdin.isatty():
        raise ended(command, "this needs a yes: say --yes", FAILED)
    if not typer.confirm("Go on?", err=True):
        raise ended(command, "nothing was done", FAILED)
