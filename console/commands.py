"""The commands, as Typer sees them. Imported by `cli` only, which says what to install if a package is missing."""

from __future__ import annotations

from importlib import import_module
from typing import Annotated, Any, Final

import typer
from typer.core import TyperGroup

from .operate import reaching

PLACES: Final = {
    "demo": "service.demo_command:demo",
    "ls": "operate.looking:ls",
    "tree": "operate.looking:tree",
    "top": "operate.looking:top",
    "inspect": "operate.looking:inspect",
    "trace": "operate.following:trace",
    "logs": "operate.following:logs",
    "ask": "operate.speaking:ask",
    "tell": "operate.speaking:tell",
    "suspend": "operate.changing:suspend",
    "resume": "operate.changing:resume",
    "restart": "operate.changing:restart",
    "stop": "operate.changing:stop",
    "start": "operate.changing:start",
    "remove": "operate.changing:remove",
    "bind": "operate.changing:bind",
    "unbind": "operate.changing:unbind",
    "protect": "operate.changing:protect",
    "checkpoint": "operate.changing:checkpoint",
    "why": "operate.remembering:why",
    "history": "operate.remembering:history",
    "events": "operate.remembering:events",
    "dead-letters": "operate.remembering:dead_letters",
    "diagnose": "operate.diagnosing:diagnose",
    "plan": "operate.declaring:plan",
    "apply": "operate.declaring:apply",
    "dashboard": "operate.showing:dashboard",
    "run": "service.service_run:run",
    "new": "service.project:new",
    "doctor": "service.doctor:doctor",
    "check-upgrade": "upgrade_commands:check",
    "replay": "upgrade_commands:replay",
    "coverage": "mechanism_commands:show_coverage",
    "select": "mechanism_commands:show_selection",
    "quarantine": "operate.retrying:quarantine",
    "connections": "operate.connecting:connections",
    "repair": "operate.repairing:repair",
    "store": "store_commands:store",
    "nats": "nats_commands:nats",
}
"""The module of each command, and the function or the group there that it is."""


class OneByOne(TyperGroup):
    """A group whose commands are imported when they are asked for: none waits for what the others need."""

    def list_commands(self, ctx: Any) -> list[str]:
        """All names, in the order of the help."""
        return list(PLACES)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """One command; for a name that is none all of them, from which the nearest one is suggested."""
        for name in [cmd_name] if cmd_name in PLACES else PLACES:
            if name not in self.commands:
                self.commands[name] = _imported(name)
        return self.commands.get(cmd_name)


def _imported(name: str) -> Any:
    module, _, part = PLACES[name].partition(":")
    found: Any = vars(import_module(f".{module}", __package__))[part]
    if isinstance(found, typer.Typer):
        return typer.main.get_command(found)
    alone = typer.Typer(add_completion=False)
    alone.command(name)(found)
    return typer.main.get_command(alone)


commands = typer.Typer(
    name="holdfast",
    cls=OneByOne,
    help="Actors in supervision trees, with crash recovery that loses nothing.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


def _print_version(wanted: bool) -> None:
    if not wanted:
        return
    from importlib.metadata import PackageNotFoundError, version  # only now: it takes longer than many commands need

    try:
        typer.echo(f"holdfast {version('holdfast')}")
    except PackageNotFoundError:  # Run from a checkout that is not installed.
        typer.echo("holdfast, not installed")
    raise typer.Exit


@commands.callback()
def holdfast(
    show_version: Annotated[
        bool, typer.Option("--version", help="Print the version and exit.", callback=_print_version, is_eager=True)
    ] = False,
    node: Annotated[
        str,
        typer.Option(
            "--node",
            envvar="HOLDFAST_NODE",
            metavar="NODE",
            help="Of several programs of a system: a pid, a machine, or a role (leader, standby).",
        ),
    ] = "",
) -> None:
    """Actors in supervision trees, with crash recovery that loses nothing."""
    reaching.NODE.set(node)
