"""The commands that help to choose a fault-tolerance mechanism: coverage and select. They need no running system."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Any, Final, TypeAlias

import msgspec
import typer

from ..actors.errors import HoldfastError
from ..actors.kernel.actor import Actor
from ..ftm.model.application import Application
from ..ftm.model.change_model import Choice as FoundChoice
from ..ftm.model.change_model import (
    FaultClasses,
    Pricing,
    RefusedStack,
    Resources,
    recovery_price,
    resource_price,
    response_price,
    select,
)
from ..ftm.model.coverage import built_in_mechanisms, coverage
from ..ftm.model.mechanism import find, load
from ..ftm.model.mechanism_declaration import FAULTS, Mechanisms
from ..system.upgrade.new_program import load_named
from .operate.reaching import FAILED, UNUSABLE, Json, ended, show_json


class Cheapest(StrEnum):
    """What is cheap: the fewest resources, the shortest reply, or the shortest outage."""

    RESOURCES = "resources"
    RESPONSE = "response"
    RECOVERY = "recovery"


PRICES: Final[dict[Cheapest, Pricing]] = {
    Cheapest.RESOURCES: resource_price,
    Cheapest.RESPONSE: response_price,
    Cheapest.RECOVERY: recovery_price,
}


def complete_fault(incomplete: str) -> list[str]:
    """The classes of faults, for the shell."""
    return [name for name in FAULTS if name.startswith(incomplete)]


def complete_mechanism(incomplete: str) -> list[str]:
    """The names of the mechanisms that come with the package, for the shell."""
    return [one.name.lower() for one in built_in_mechanisms() if one.name.lower().startswith(incomplete.lower())]


Among: TypeAlias = Annotated[
    list[str] | None,
    typer.Option(
        "--mechanism",
        help="Only this mechanism, such as pbr, or a file that defines one; may be repeated.",
        autocompletion=complete_mechanism,
    ),
]


def show_coverage(mechanisms: Among = None, as_json: Json = False) -> None:
    """Show which faults each mechanism tolerates, what it needs of the actor, and what it costs.

    Exit status 0: done. 2: there is no such mechanism.
    """
    table = coverage(_among("coverage", mechanisms))
    if not as_json:
        typer.echo(table.text())
        return
    plain = [msgspec.to_builtins(one, order="deterministic") for one in table.entries]
    show_json({"faults": list(FAULTS), "mechanisms": plain})


def show_selection(
    faults: Annotated[
        list[str],
        typer.Argument(metavar="FAULT...", help=f"{', '.join(FAULTS)}.", autocompletion=complete_fault),
    ],
    actor: Annotated[
        str | None, typer.Option("--actor", metavar="MODULE:CLASS", help="Read what the application is like from it.")
    ] = None,
    units: Annotated[int, typer.Option(min=1, help="Processing units that fail independently.")] = 1,
    bandwidth: Annotated[float, typer.Option(min=0.0, help="Bytes per second between them.")] = float("inf"),
    cpu: Annotated[float, typer.Option(min=0.0, max=1.0, help="Part of a unit's time that is left.")] = 1.0,
    energy: Annotated[float, typer.Option(min=0.0, max=1.0, help="Part of the battery that is left.")] = 1.0,
    certificates: Annotated[bool, typer.Option("--certificates", help="There is a certification authority.")] = False,
    deterministic: Annotated[
        bool | None, typer.Option("--deterministic/--not-deterministic", help="Same inputs, same outputs.")
    ] = None,
    state_access: Annotated[
        bool | None, typer.Option("--state-access/--no-state-access", help="Its state can be taken and put back.")
    ] = None,
    assertions: Annotated[int | None, typer.Option(min=0, help="Assertions that it brings.")] = None,
    versions: Annotated[int | None, typer.Option(min=1, help="Versions of it that there are.")] = None,
    rate: Annotated[float, typer.Option(min=0.0, help="Requests per second.")] = 0.0,
    turn_seconds: Annotated[float, typer.Option(min=0.0, help="Seconds that one of them is computed.")] = 0.0,
    state_bytes: Annotated[int | None, typer.Option(min=0, help="Size of its state.")] = None,
    request_bytes: Annotated[int, typer.Option(min=0, help="Size of a request.")] = 0,
    price: Annotated[Cheapest, typer.Option(help="What is to be small.")] = Cheapest.RESOURCES,
    mechanisms: Among = None,
    as_json: Json = False,
) -> None:
    """Say which mechanisms, alone or composed, tolerate these faults with what there is; the cheapest comes first.

    What is not said of the application is read from --actor, or taken to be the best case.

    Exit status 0: there is one. 1: there is none, and the reasons are told. 2: no such fault, actor or mechanism.
    """
    given: dict[str, Any] = {
        "is_deterministic": deterministic,
        "has_state_access": state_access,
        "assertions": assertions,
        "versions": versions,
        "state_bytes": state_bytes,
        "rate": rate,
        "turn_seconds": turn_seconds,
        "request_bytes": request_bytes,
    }
    known = {name: value for name, value in given.items() if value is not None}
    try:
        wanted = FaultClasses.of(*faults)
    except ValueError as error:
        raise ended("select", error, UNUSABLE) from error
    found = select(
        wanted,
        _application(actor, known),
        Resources(units, bandwidth, cpu, energy, certificates),
        _among("select", mechanisms),
        price=PRICES[price],
    )
    if as_json:
        show_json(
            {
                "faults": [name for name in FAULTS if name in wanted.classes],
                "best": list(found.best.layers) if found.best is not None else None,
                "valid": list(map(_plain_choice, found.valid)),
                "refused": list(map(_plain_refusal, found.refused)),
                "degraded": list(map(_plain_choice, found.degraded)),
            }
        )
    else:
        typer.echo(found.explain())
    if found.best is None:
        raise typer.Exit(FAILED)


def _application(actor: str | None, known: dict[str, Any]) -> Application:
    """What the application is like: what was said goes before what its class says."""
    if actor is None:
        return Application(**known)
    try:
        kind = load_named(actor)
    except HoldfastError as error:
        raise ended("select", error, UNUSABLE) from error
    if not (isinstance(kind, type) and issubclass(kind, Actor)):
        raise ended("select", f"{actor} is no actor class: say --actor module:Class", UNUSABLE)
    return Application.of(kind, **known)


def _among(command: str, names: list[str] | None) -> Mechanisms | None:
    """The mechanisms with these names, or in these files; None means all that come with the package."""
    try:
        return [load(one) if one.endswith(".py") else find(one.lower()) for one in names] if names else None
    except HoldfastError as error:
        raise ended(command, error, UNUSABLE) from error


def _plain_choice(one: FoundChoice) -> dict[str, Any]:
    """A valid choice, or one that leaves faults uncovered, as plain data."""
    return {
        "mechanisms": list(one.layers),
        "price": one.price,
        "units": one.units,
        "bytes_per_second": one.bytes_per_second,
        "load": one.load,
        "uncovered": [name for name in FAULTS if name in one.uncovered],
    }


def _plain_refusal(one: RefusedStack) -> dict[str, Any]:
    """A refused composition as plain data; the stage is F, A or R."""
    return {"mechanisms": list(one.layers), "stage": one.stage, "why": one.why}
