"""Map a building while the process that holds the map is killed again and again: what `make demo` runs.

Data: the MIT Killian Court log of `rtb-data`, or a log of your own (`--log`).
Correct: nothing is lost, nothing is doubled, and the map is that of an undisturbed run, bit by bit.
Command: python examples/programs/demo.py [--kills N] [--method fresh] [--json]
"""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer
from map_demo.demo_runs import DemoPlan
from map_demo.log import LogError, killian_court
from map_demo.main import run_demo
from rich.console import Console

from holdfast import HoldfastError

DIFFERS = 1
UNUSABLE = 2

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


class RecoveryChoice(StrEnum):
    """How a killed mapper comes back."""

    HYBRID = "hybrid"
    FRESH = "fresh"


@app.command()
def demo(
    log: Annotated[
        Path | None,
        typer.Option("--log", help="A laser log: g2o text, or .zip or .gz of it. [default: MIT Killian Court]"),
    ] = None,
    kills: Annotated[int, typer.Option(min=0, max=1000, help="How often the mapper's process is killed.")] = 5,
    seed: Annotated[int, typer.Option(help="Draws the moments of the kills, and the questions.")] = 7,
    method: Annotated[RecoveryChoice, typer.Option(help="How the mapper comes back.")] = RecoveryChoice.HYBRID,
    interval: Annotated[float, typer.Option(min=0.05, help="Seconds between two snapshots.")] = 2.0,
    speed: Annotated[
        float, typer.Option(min=0.0, help="Times the pace of the recording; 0: as fast as it goes.")
    ] = 600.0,
    picture: Annotated[Path, typer.Option(help="Where both maps are drawn.")] = Path("holdfast-demo.png"),
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object and nothing else.")] = False,
) -> None:
    """Map a real building while the mapper's process is killed again and again; compare with an undisturbed run.

    Exit status 0: nothing lost, nothing doubled, the maps are equal bit by bit. 1: something differs. 2: there is
    nothing to run on.
    """
    try:
        plan = DemoPlan(log or killian_court(), kills, seed, method.value, interval, speed)
        report = run_demo(plan, Console(), picture=picture, as_json=as_json)
    except (LogError, OSError) as error:
        raise failed("demo", error, UNUSABLE) from error
    except HoldfastError as error:
        raise failed("demo", error, DIFFERS) from error
    if not report.is_good:
        raise typer.Exit(DIFFERS)


def failed(what: str, error: Exception, status: int) -> typer.Exit:
    """Say on stderr why it has failed, and return what ends the command with that status."""
    typer.echo(f"{what}: {error}", err=True)
    return typer.Exit(status)


if __name__ == "__main__":
    app()
