"""Map a building on a fleet while its leading node and its leading server are killed: what `make fleet` runs.

Three NATS servers and two nodes, all processes of this machine. It needs a checkout, and the extra `nats`.
Data: the MIT Killian Court log of `rtb-data`, or a log of your own (`--log`).
Correct: nothing is lost, nothing is doubled, and the map is that of an undisturbed run, bit by bit.
Command: python examples/programs/fleet.py [--kills N] [--json]
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer
from demo import DIFFERS, UNUSABLE, failed
from map_demo.demo_runs import DemoPlan
from map_demo.log import LogError, killian_court
from map_demo.main import run_demo
from rich.console import Console

from holdfast import HoldfastError

sys.path.append(str(Path(__file__).parents[2]))  # The servers are those of the tests.
from map_demo.fleet_run import compare_fleet

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@app.command()
def fleet(
    log: Annotated[
        Path | None,
        typer.Option("--log", help="A laser log: g2o text, or .zip or .gz of it. [default: MIT Killian Court]"),
    ] = None,
    kills: Annotated[int, typer.Option(min=0, max=100, help="Leading node and leading server, in turn.")] = 4,
    seed: Annotated[int, typer.Option(help="Draws the moments of the kills, and the questions.")] = 7,
    interval: Annotated[float, typer.Option(min=0.05, help="Seconds between two snapshots.")] = 2.0,
    speed: Annotated[
        float, typer.Option(min=0.0, help="Times the pace of the recording; 0: as fast as it goes.")
    ] = 600.0,
    picture: Annotated[Path, typer.Option(help="Where both maps are drawn.")] = Path("holdfast-fleet.png"),
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object and nothing else.")] = False,
) -> None:
    """Map a real building on two nodes and three servers, whose leaders are killed; compare with an undisturbed run.

    Exit status 0: nothing lost, nothing doubled, the maps are equal bit by bit. 1: something differs. 2: there is
    nothing to run on.
    """
    try:
        plan = DemoPlan(log or killian_court(), kills, seed, "hybrid", interval, speed)
        report = run_demo(plan, Console(), picture=picture, as_json=as_json, compared=compare_fleet)
    except (LogError, OSError) as error:
        raise failed("fleet", error, UNUSABLE) from error
    except HoldfastError as error:
        raise failed("fleet", error, DIFFERS) from error
    if not report.is_good:
        raise typer.Exit(DIFFERS)


if __name__ == "__main__":
    app()
