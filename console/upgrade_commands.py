"""The commands that handle recorded turns again: `holdfast check-upgrade` and `holdfast replay`."""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from ..actors.errors import HoldfastError
from ..system.upgrade import AddressCheck, ReplayedState, ReplayedTurn, UpgradeCheck, check_upgrade, replay_actor
from ..system.upgrade.checked_upgrade import TURN_TIMEOUT
from .service.store_options import KeyFile, StorePath

DIFFERS: Final = 1
UNCHECKED: Final = 2
MOST_TEXT, MOST_TEXT_AS_JSON, MOST_ITEMS = 200, 10_000, 100
"""Characters of a text, and items of a list, that are shown; what is longer is cut."""

Recovery = Annotated[Path | None, typer.Option(metavar="FILE", help="The recovery file of the program.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]


def check(
    store: StorePath,
    spec: Annotated[
        str, typer.Argument(metavar="MODULE:SPEC", help="What the new program starts: shop.main:tree, or app.py:tree.")
    ],
    recovery: Recovery = None,
    key_file: KeyFile = None,
    turn_timeout: Annotated[float, typer.Option(min=0.1, help="Seconds that a turn may take.")] = TURN_TIMEOUT,
    as_json: Json = False,
) -> None:
    """Check whether new code goes on with what is recorded as the old code would: all turns are handled again.

    A running system may have the store open. Replies, outputs and states are compared; nothing that is sent gets out.

    Exit status 0: all is fine. 1: something differs. 2: something cannot be checked.
    """
    found = _had(
        "check-upgrade",
        lambda: check_upgrade(store, spec, recovery=recovery, store_key=key_file, turn_timeout=turn_timeout),
    )
    if as_json:
        typer.echo(json.dumps({"is_fine": found.is_fine, **dataclasses.asdict(found)}))
    else:
        _show_check(found)
    if not found.is_fine:
        raise typer.Exit(DIFFERS if found.has_differences else UNCHECKED)


def _show_check(found: UpgradeCheck) -> None:
    for one in found.addresses:
        typer.echo(f"{one.address}: {_verdict(one)}")
        if one.note:
            typer.echo(f"    {one.note}")
    count = sum(not one.is_fine for one in found.addresses)
    verdict = "all is fine" if found.is_fine else f"{count} of them are not fine"
    turns = sum(one.turns for one in found.addresses)
    typer.echo(f"{found.store}: {len(found.addresses)} addresses, {turns} turns handled again: {verdict}")


def _verdict(one: AddressCheck) -> str:
    handled = f"{one.turns} turns handled again"
    match one.verdict:
        case "fine":
            return f"fine, {handled}"
        case "differs":
            return f"DIFFERS at turn {one.turn} ({one.message}), {handled} before: {one.problem}"
        case _:
            return f"{one.verdict.upper()}: {one.problem}"


def replay(
    store: StorePath,
    address: Annotated[str, typer.Argument(help="The address of the actor: /app/bank/alice.")],
    until: Annotated[int | None, typer.Option(min=0, help="The last turn; the last one of all if left out.")] = None,
    since: Annotated[int | None, typer.Option("--from", min=0, help="The first turn that is shown.")] = None,
    spec: Annotated[
        str | None, typer.Option(metavar="MODULE:SPEC", help="What the program starts; else the recorded class alone.")
    ] = None,
    recovery: Recovery = None,
    key_file: KeyFile = None,
    breaks: Annotated[bool, typer.Option("--break", help="Stop in pdb before the handler of the last turn.")] = False,
    as_json: Json = False,
) -> None:
    """Handle the recorded turns of one actor again, show each of them, and the state after the last one.

    A running system may have the store open; nothing that is sent gets out. Long values are cut.

    Exit status 0: done. 1: a turn went another way than before. 2: it cannot be replayed.
    """
    turns: list[ReplayedTurn] = []
    ended = _had(
        "replay",
        lambda: replay_actor(
            store,
            address,
            until=until,
            since=since,
            target=spec,
            recovery=recovery,
            store_key=key_file,
            breaks=breaks,
            told=turns.append if as_json else _show_turn,
        ),
    )
    if as_json:
        found = {**dataclasses.asdict(ended), "turns": [dataclasses.asdict(one) for one in turns]}
        typer.echo(json.dumps(cut(found, MOST_TEXT_AS_JSON)))
    else:
        _show_state(ended)
    if ended.problem:
        raise typer.Exit(DIFFERS)


def _show_turn(one: ReplayedTurn) -> None:
    sender = f" from {one.sender}" if one.sender else ""
    typer.echo(f"turn {one.turn}: {one.type or one.kind} {_text(one.message)}{sender}, {_moment(one.time)}")
    if one.status != "ok":
        typer.echo(f"    {one.status}")
    if one.reply is not None:
        typer.echo(f"    replies {_text(one.reply)}")
    for out in one.outputs:
        more = [_text(out["message"])] if "message" in out else []
        more += [f"after {out['seconds']:g} s"] if out.get("seconds") else []
        more += [f"until {_moment(out['until'])}"] if "until" in out else []
        more += [f"and got {_text(out['got'])}"] if "got" in out else []
        more += ["and waits for it"] if "waits" in out else []
        typer.echo(" ".join(filter(None, (f"    output {out['output']}:", out["verb"], out["to"], out["type"], *more))))
    for name, (before, after) in one.changes.items():
        typer.echo(f"    {name}: {_text(before)} -> {_text(after)}")


def _moment(when: float) -> str:
    return time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(when))


def _show_state(ended: ReplayedState) -> None:
    typer.echo(f"{ended.address} after turn {ended.turn} of {ended.last}:")
    for name, value in ended.state.items():
        typer.echo(f"    {name} = {_text(value)}")
    if ended.problem:
        typer.echo(f"ended early: {ended.problem}")


def _text(value: Any) -> str:
    return "" if value is None else json.dumps(cut(value, MOST_TEXT), ensure_ascii=False)


def cut(value: Any, most: int) -> Any:
    """Plain data with long texts and lists cut.

    >>> cut({"memo": "0123456789"}, 4)
    {'memo': '0123... (10 characters)'}
    """
    match value:
        case str() if len(value) > most:
            return f"{value[:most]}... ({len(value)} characters)"
        case dict():
            return {name: cut(one, most) for name, one in value.items()}
        case list() | tuple() if len(value) > MOST_ITEMS:
            return [*(cut(one, most) for one in value[:MOST_ITEMS]), f"... ({len(value)} items)"]
        case list() | tuple():
            return [cut(one, most) for one in value]
        case _:
            return value


def _had(command: str, work: Callable[[], Any]) -> Any:
    try:
        return work()
    except (HoldfastError, OSError) as error:
        if isinstance(error, BrokenPipeError):  # Whoever reads it has enough, as `head` has.
            raise
        typer.echo(f"holdfast {command}: {error}", err=True)
        raise typer.Exit(UNCHECKED) from error
