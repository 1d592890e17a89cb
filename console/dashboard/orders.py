"""What can be done in the page: each order is what a command of the same name does, warned of in the same words."""

from __future__ import annotations

import re
from collections.abc import Awaitable, Callable
from typing import Any, Final, Literal, assert_never, get_args

import msgspec

from ...actors.errors import NoSuchActor, SpecError
from ...system.history.evidence import PutAside
from ..operate.losses import WARNINGS, lost_by, tops
from ..operate.told_lines import quarantine_line
from ..overview import LOOK, ActorRow
from ..remote import RemoteChange
from ..wire import (
    AskQuarantined,
    ControlActor,
    DeclareTree,
    OrderRepair,
    Overview,
    RepairVerb,
    RestartActor,
    SettleQuarantined,
    Transact,
)
from .answers import Answers

Verb = Literal[
    "suspend",
    "resume",
    "restart",
    "kill",
    "stop",
    "start",
    "remove",
    "checkpoint",
    "protect",
    "bind",
    "unbind",
    "quarantine-retry",
    "quarantine-drop",
    "repair-approve",
    "repair-deny",
    "repair-retry",
    "repair-set",
    "apply",
]
VERBS: Final[tuple[Verb, ...]] = get_args(Verb)
PATIENCE: Final = 60.0
"""Seconds that an order may take."""
ONE_RESTART: Final = 10.0
"""Seconds for the restart, or the checkpoint, of one actor."""
MOST_PATHS: Final = 1000
MECHANISM: Final = re.compile(r"[A-Za-z][A-Za-z0-9_+-]*")
"""Names of mechanisms: a file with one would be code, which the page does not send."""
TREE: Final = "the page"
AGAIN: Final = (
    "it may end its actor again, each time, and its supervisor give up, if the cause is not mended; this is tried"
)
"""What a tree that was written in the page is called in errors."""


class PageOrder(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An order from the page.

    Attributes:
        verb: what is to be done.
        paths: to whom, by address.
        words: what belongs to the verb: mechanisms, a port and a target, the number of a message, a case, a stance.
        text: of "apply": the tree that is wanted, in TOML.
        is_confirmed: whether the warnings were shown, and the answer was yes.
        is_dry_run: only say what would be done; for orders that are transactions.
    """

    verb: Verb
    paths: tuple[str, ...] = ()
    words: tuple[str, ...] = ()
    text: str = ""
    is_confirmed: bool = False
    is_dry_run: bool = False


class OrderDone(msgspec.Struct, frozen=True):
    """What has become of an order.

    Attributes:
        warnings: what would be lost; if there are any, nothing was done, and a yes is needed.
        said: what was done, in lines.
        steps: of a transaction, in words.
        difference: how the tree has changed, or would, line by line.
        lost: what of recorded states is left behind.
        failed: what could not be done, in lines; the rest was.
    """

    warnings: list[str] = []
    said: list[str] = []
    steps: list[str] = []
    difference: list[str] = []
    lost: list[str] = []
    failed: list[str] = []


async def carry_out(answers: Answers, order: PageOrder) -> OrderDone:
    """Do what an order says, unless something would be lost and nobody has said yes.

    Raises:
        HoldfastError: it was refused, or has failed; a transaction is undone then.
    """
    if len(order.paths) > MOST_PATHS:
        raise SpecError("dashboard", f"an order is for {MOST_PATHS} actors at most, not {len(order.paths)}")
    match order.verb:
        case "restart" | "kill":
            return await _warned(answers, order, "restart", _restart)
        case "suspend" | "resume" | "stop" | "start" | "remove":
            return await _warned(answers, order, order.verb, _transact)
        case "protect" | "bind" | "unbind":
            return await _transact(answers, order, [])
        case "checkpoint":
            return await _checkpoint(answers, order)
        case "quarantine-retry" | "quarantine-drop":
            return await _settle(answers, order)
        case "repair-approve" | "repair-deny" | "repair-retry" | "repair-set":
            verb: RepairVerb = msgspec.convert(order.verb.removeprefix("repair-"), RepairVerb)
            await answers.ask(OrderRepair(verb, order.words, ONE_RESTART), PATIENCE)
            return OrderDone(said=[f"repair {verb} {' '.join(order.words)}".rstrip()])
        case "apply":
            return await _apply(answers, order)
        case _:
            assert_never(order.verb)


async def _rows(answers: Answers) -> list[ActorRow]:
    return LOOK.decode(await answers.ask(Overview(), PATIENCE)).rows


async def _warned(
    answers: Answers,
    order: PageOrder,
    verb: str,
    do: Callable[[Answers, PageOrder, list[ActorRow]], Awaitable[OrderDone]],
) -> OrderDone:
    """Warn in the words of the command line, or do it."""
    all_rows = await _rows(answers)
    rows = meant(all_rows, order.paths)
    if verb in ("stop", "remove"):
        rows = tops(rows)
    warnings = WARNINGS[verb](rows, all_rows) if verb in WARNINGS else []
    if warnings and not order.is_confirmed and not order.is_dry_run:
        return OrderDone(warnings=warnings)
    return await do(answers, order, rows)


def meant(all_rows: list[ActorRow], paths: tuple[str, ...]) -> list[ActorRow]:
    """The actors at these addresses. Raises NoSuchActor: one is not there. SpecError: there is none."""
    known = {row.path: row for row in all_rows}
    if not paths:
        raise SpecError("dashboard", "the order is for nobody: name an actor")
    for path in paths:
        if path not in known:
            raise NoSuchActor(path)
    return [known[path] for path in dict.fromkeys(paths)]


async def _transact(answers: Answers, order: PageOrder, rows: list[ActorRow]) -> OrderDone:
    change = RemoteChange()
    _collect(change, order, [row.path for row in rows] or list(order.paths))
    told = await answers.ask(Transact(change.operations, order.is_dry_run, PATIENCE), PATIENCE)
    return _told(told)


def _told(told: dict[str, Any]) -> OrderDone:
    steps = [": ".join(filter(None, map(str, step[3:]))) for step in told["steps"]]
    return OrderDone(steps=steps, difference=list(told["difference"]), lost=list(told["lost"]))


def _collect(change: RemoteChange, order: PageOrder, paths: list[str]) -> None:
    match order.verb, order.words:
        case "start", ():
            for path in paths:
                above, _, name = path.rpartition("/")
                change.start(above, name)
        case (("suspend" | "resume" | "stop" | "remove"), ()):
            do = {"suspend": change.suspend, "resume": change.resume, "stop": change.stop, "remove": change.remove}
            for path in paths:
                do[order.verb](path)
        case "protect", names:
            if not all(MECHANISM.fullmatch(name) for name in names):
                raise SpecError("protect", "the page takes mechanisms by name, such as pbr; use the command for a file")
            for path in paths:
                change.protect(path, names or None)
        case "bind", (port, target):
            change.bind(paths[0], port, target)
        case "unbind", (port,):
            change.unbind(paths[0], port)
        case verb, words:
            raise SpecError("dashboard", f"{verb} does not take {' '.join(words) or 'nothing'}")


async def _restart(answers: Answers, order: PageOrder, rows: list[ActorRow]) -> OrderDone:
    """One after another; whoever is behind one that does not come up is left alone."""
    said: list[str] = []
    for row in rows:
        ended = await answers.ask(RestartActor(row.path, ONE_RESTART, order.verb == "kill"), PATIENCE)
        said.append(f"restarted {row.path}: its life was ended by {ended}")
    return OrderDone(said=said)


async def _checkpoint(answers: Answers, order: PageOrder) -> OrderDone:
    for path in order.paths:
        await answers.ask(ControlActor("checkpoint", path, [], ONE_RESTART), PATIENCE)
    return OrderDone(said=[f"saved {path}" for path in order.paths])


async def _settle(answers: Answers, order: PageOrder) -> OrderDone:
    verb: Literal["retry", "drop"] = "retry" if order.verb == "quarantine-retry" else "drop"
    if len(order.paths) != 1 or len(order.words) > 1 or not all(word.isdecimal() for word in order.words):
        raise SpecError("dashboard", f"{order.verb} takes one address, and the number of a message or none")
    (path,), number = order.paths, int(order.words[0]) if order.words else None
    if not order.is_confirmed:
        raw = await answers.ask(AskQuarantined(path), PATIENCE)
        put_aside = [one for one in msgspec.convert(raw, list[PutAside]) if number in (None, one.id)]
        warning = "this is dropped" if verb == "drop" else AGAIN
        if put_aside:
            return OrderDone(warnings=[f"{warning}: {quarantine_line(one)}" for one in put_aside])
    told = await answers.ask(SettleQuarantined(verb, path, number), PATIENCE)
    words = "dropped" if verb == "drop" else "given to its actor again; if that dies of it again, it comes back here"
    done = msgspec.convert(told["done"], list[PutAside])
    return OrderDone(said=[f"{words}: {quarantine_line(one)}" for one in done], failed=list(told["failed"]))


async def _apply(answers: Answers, order: PageOrder) -> OrderDone:
    """As `holdfast plan`, and `holdfast apply` of a tree."""
    planned = await answers.ask(DeclareTree(order.text, TREE, True, PATIENCE), PATIENCE)
    paths = {step[2] for step in planned["steps"] if step[1] in ("remove", "stop")}
    rows = await _rows(answers) if paths else []
    plan = _told(planned)
    lost = [*plan.lost, *lost_by([row for row in rows if row.path in paths], rows)]
    plan = msgspec.structs.replace(plan, lost=lost)
    if order.is_dry_run or not plan.steps:
        return plan
    if lost and not order.is_confirmed:
        return msgspec.structs.replace(plan, warnings=lost)
    return _told(await answers.ask(DeclareTree(order.text, TREE, False, PATIENCE), PATIENCE))
