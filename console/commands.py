"""The commands, as Typer sees them. Imported by `cli` only, which says what to install if a package is missing."""

from __future__ import annotations

from enum import StrEnum
from importlib.metadata import PackageNotFoundError, version
from typing import Annotated

import typer
from rich.console import Console

from .. import HoldfastError, run
from . import mechanism_commands, upgrade_commands
from .nats_commands import nats
from .operate import (
    changing,
    connecting,
    declaring,
    diagnosing,
    following,
    looking,
    reaching,
    remembering,
    repairing,
    retrying,
    showing,
    speaking,
)
from .service import doctor, project, service_run
from .store_commands import store

commands = typer.Typer(
    name="holdfast",
    help="Actors in supervision trees, with crash recovery that loses nothing.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)

DIFFERS = 1


class RecoveryChoice(StrEnum):
    """How a killed account comes back."""

    HYBRID = "hybrid"
    FRESH = "fresh"


def _print_version(wanted: bool) -> None:
    if not wanted:
        return
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


@commands.command()
def demo(
    seconds: Annotated[float, typer.Option(min=0.1, max=3600.0, help="How long processes are killed.")] = 4.0,
    method: Annotated[RecoveryChoice, typer.Option(help="How a killed account comes back.")] = RecoveryChoice.HYBRID,
    seed: Annotated[int, typer.Option(help="Draws which process is killed, and when.")] = 7,
) -> None:
    """Run a bank whose accounts are killed with SIGKILL again and again while their customers pay in.

    Exit status 0: every payment was answered and booked once. 1: a payment was lost or doubled.
    """
    from .bank_demo import show_bank

    try:
        report = run(show_bank(Console(), seconds=seconds, method=method.value, seed=seed))
    except HoldfastError as error:
        typer.echo(f"holdfast demo: {error}", err=True)
        raise typer.Exit(DIFFERS) from error
    if not report.is_good:
        raise typer.Exit(DIFFERS)


for command in (
    looking.ls,
    looking.tree,
    looking.top,
    looking.inspect,
    following.trace,
    following.logs,
    speaking.ask,
    speaking.tell,
    changing.suspend,
    changing.resume,
    changing.restart,
    changing.stop,
    changing.start,
    changing.remove,
    changing.bind,
    changing.unbind,
    changing.protect,
    changing.checkpoint,
    remembering.why,
    remembering.history,
    remembering.events,
    remembering.dead_letters,
    diagnosing.diagnose,
    declaring.plan,
    declaring.apply,
    showing.dashboard,
    service_run.run,
    project.new,
    doctor.doctor,
):
    commands.command()(command)
commands.command("check-upgrade")(upgrade_commands.check)
commands.command("replay")(upgrade_commands.replay)
commands.command("coverage")(mechanism_commands.show_coverage)
commands.command("select")(mechanism_commands.show_selection)
commands.add_typer(retrying.quarantine)
commands.add_typer(connecting.connections)
commands.add_typer(repairing.repair)
commands.add_typer(store)
commands.add_typer(nats)
