"""The command `holdfast demo`."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Final

import typer

from ... import HoldfastError, run

DIFFERS: Final = 1


class RecoveryChoice(StrEnum):
    """How a killed account comes back."""

    HYBRID = "hybrid"
    FRESH = "fresh"


def demo(
    seconds: Annotated[float, typer.Option(min=0.1, max=3600.0, help="How long processes are killed.")] = 4.0,
    method: Annotated[RecoveryChoice, typer.Option(help="How a killed account comes back.")] = RecoveryChoice.HYBRID,
    seed: Annotated[int, typer.Option(help="Draws which process is killed, and when.")] = 7,
) -> None:
    """Run a bank whose accounts are killed with SIGKILL again and again while their customers pay in.

    Exit status 0: every payment was answered and booked once. 1: a payment was lost or doubled.
    """
    from rich.console import Console

    from ..bank_demo import show_bank

    try:
        report = run(show_bank(Console(), seconds=seconds, method=method.value, seed=seed))
    except HoldfastError as error:
        typer.echo(f"holdfast demo: {error}", err=True)
        raise typer.Exit(DIFFERS) from error
    if not report.is_good:
        raise typer.Exit(DIFFERS)
