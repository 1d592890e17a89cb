"""What the diagnosis that runs in a system says now, as plain data for those who ask from outside."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec

from ..actors.process.open_asks import open_asks
from ..diagnosis.diagnoser import DiagnoserActor
from ..diagnosis.engine import Diagnosis
from ..diagnosis.generate import replicas_of
from ..diagnosis.messages import Explained, GetDiagnosis, GetExplanation
from ..diagnosis.observers import NodeObserver, ReplicaObserver
from ..diagnosis.repair import (
    Approve,
    CaseStories,
    Deny,
    GetRepairStatus,
    GetStories,
    NobodyWaits,
    Repairer,
    RepairStatus,
    RetryRepair,
    SetStance,
)
from ..diagnosis.repair.ping import looked_at
from .overview import SLICE, Found, walk
from .wire import BadRequest, NotDiagnosed

LOOK: Final = 1.0
"""Seconds in which a suspect's process has to say how it is."""

MOST: Final = 10_000
"""Cells and mailbox items that are looked at for asks between processes."""
MOST_NAMES: Final = 5
"""Actors that wait for a suspect that are named."""

if TYPE_CHECKING:
    from ..system.system import ActorSystem


async def diagnosed(system: ActorSystem, path: str | None, timeout: float) -> list[dict[str, Any]]:
    """Ask every diagnoser of a system what it says now; one answer for each, as plain data.

    Args:
        system: the system.
        path: only suspects at this address and below it; None means all.
        timeout: seconds in which each of them has to answer.

    Raises:
        NotDiagnosed: no diagnosis runs, or none has a component at `path`. HoldfastError: one does not answer.
    """
    diagnosers, repairers, addresses = await _parts(system)
    if not diagnosers:
        raise NotDiagnosed(
            f"no diagnosis of {system.name} runs: start one in the program, "
            "by `await holdfast.diagnosis.watch(system)` (docs/diagnosis.md)"
        )
    near = {name: where for name, where in addresses.items() if path is None or is_at(where, path)}
    if path is not None and not near:
        raise NotDiagnosed(f"no component of the diagnosis is at {path}: `holdfast diagnose` without it shows all")
    answers: list[dict[str, Any]] = []
    for one in diagnosers:
        beside = [each for each in repairers if each.rpartition("/")[0] == one.rpartition("/")[0]]
        repair = await _told(system, beside[0], timeout) if beside else None
        said = await _said(system, one, addresses, None if path is None else near, timeout, repair)
        answers.append({**said, "repair": repair})
    return answers


async def order_repair(system: ActorSystem, verb: str, words: tuple[str, ...], timeout: float) -> list[dict[str, Any]]:
    """Give an order to whoever repairs a system, and ask how each of them stands then.

    Args:
        system: the system.
        verb: "status", "approve", "deny", "retry" or "set".
        words: the case and why, the components, or the stance.
        timeout: seconds in which each of them has to answer.

    Raises:
        NotDiagnosed: no repair runs. BadRequest: words are missing. NobodyWaits, BadStance: as the repairer says.
    """
    _, repairers, _ = await _parts(system)
    if not repairers:
        raise NotDiagnosed(
            f"no repair of {system.name} runs: start it in the program, "
            'by `await holdfast.diagnosis.watch(system, repair="advise")` (docs/diagnosis.md)'
        )
    order = _order(verb, words)
    refusal: NobodyWaits | None = None
    done = 0
    for path in repairers:
        if order is None:
            break
        try:
            await system.ref(path, Repairer).ask(order, timeout=timeout)
            done += 1
        except NobodyWaits as error:  # It is a case of another repairer, if there is one.
            refusal = error
    if refusal is not None and not done:
        raise refusal
    return [await _told(system, path, timeout) for path in repairers]


def _order(verb: str, words: tuple[str, ...]) -> Approve | Deny | RetryRepair | SetStance | None:
    match verb, words:
        case "approve", (case,) if case.isdecimal():
            return Approve(int(case))
        case "deny", (case, *why) if case.isdecimal():
            return Deny(int(case), " ".join(why) or "an operator said no")
        case "retry", _:
            return RetryRepair(words)
        case "set", (stance,):
            return SetStance(stance)
        case "status", ():
            return None
        case _:
            raise BadRequest(f"repair {verb} does not take {' '.join(words) or 'nothing'}")


async def _parts(system: ActorSystem) -> tuple[list[str], list[str], dict[str, str]]:
    """The addresses of the diagnosers, of the repairers, and of the components that are observed."""
    diagnosers: list[str] = []
    repairers: list[str] = []
    addresses: dict[str, str] = {}
    for number, one in enumerate(walk(Found(f"/{system.name}", system._root, None, os.getpid()), parts=False), 1):
        start = one.child.spec.start if one.child is not None else None
        if start is not None and start.kind is DiagnoserActor:
            diagnosers.append(one.path)
        elif start is not None and start.kind is Repairer:
            repairers.append(one.path)
        elif start is not None and start.kind is NodeObserver:
            addresses |= start.args[0]
        elif start is not None and start.kind is ReplicaObserver:
            addresses |= {replicas_of(name): where for name, where in start.args[0].items()}
        if number % SLICE == 0:
            await asyncio.sleep(0)
    return diagnosers, repairers, addresses


async def _told(system: ActorSystem, path: str, timeout: float) -> dict[str, Any]:
    """How one repairer stands, and what it has told of its last cases, as plain data."""
    ref = system.ref(path, Repairer)
    status: RepairStatus = await ref.ask(GetRepairStatus(), timeout=timeout)
    told: CaseStories = await ref.ask(GetStories(), timeout=timeout)
    return {"repairer": path, **msgspec.structs.asdict(status), "stories": msgspec.to_builtins(told.stories)}


def is_at(where: str, path: str) -> bool:
    """Whether an address is another one, or below it.

    >>> is_at("/app/bank/alice", "/app/bank"), is_at("/app/banker", "/app/bank")
    (True, False)
    """
    return where == path or where.startswith(f"{path.rstrip('/')}/")


class WaitingActor(NamedTuple):
    """Who waits for an actor: since when its oldest ask has no answer (loop clock), and all who wait in the end."""

    since: float
    actors: tuple[str, ...]


def waiting_for(asks: Sequence[tuple[str, str | None, float]], address: str) -> WaitingActor | None:
    """Who waits for an actor, directly or for another one that does; None: nobody.

    Args:
        asks: of each ask without an answer who is asked, who asks if that is an actor, and since when.
        address: of the actor.

    >>> waiting_for([("/a/c", "/a/b", 2.0), ("/a/b", "/a/a", 1.0)], "/a/c")
    WaitingActor(since=2.0, actors=('/a/b', '/a/a'))
    """
    since = min((made for asked, _, made in asks if asked == address), default=None)
    if since is None:
        return None
    found = dict.fromkeys([address])
    todo = [address]
    for one in todo:  # it grows
        for asked, asker, _ in asks:
            if asked == one and asker is not None and asker not in found:
                found[asker] = None
                todo.append(asker)
    return WaitingActor(since, tuple(found)[1:])


def _open_asks(system: ActorSystem) -> list[tuple[str, str | None, float]]:
    asks = open_asks(system._node, MOST)
    return [(to.path, ask.sender.path if ask.sender else None, ask.deadline - ask.timeout) for to, ask in asks]


def _handled(name: str, repair: Mapping[str, Any] | None) -> dict[str, Any]:
    """What repair would do for a suspect, has done, and may not do, by its newest case that is about it."""
    said: dict[str, Any] = {"would": "", "done": [], "denied": ""}
    if repair is None:
        return said
    if name in repair["denied"]:
        said["denied"] = repair["reasons"].get(name, "")
    about = [[entry for entry in story["entries"] if name in entry["components"]] for story in repair["stories"]]
    for entry in next((entries for entries in reversed(about) if entries), []):
        if entry["what"] == "Planned":
            said["would"] = entry["text"]
        elif entry["what"] in ("ActionEnded", "Undone", "Repaired", "GaveUp"):
            said["done"].append(entry["text"])
    return said


async def _seen(system: ActorSystem, address: str | None) -> str:
    """What is to be seen of a suspect at the moment, in words; empty if there is nothing strange."""
    if address is None:
        return ""
    status = await looked_at(system._node, address, LOOK)
    if status is None:
        return f"`{address}` does not run, or its process has not answered for {LOOK:g} s"
    waits = f"; {status.queued} messages wait for it" if status.queued else ""
    if status.state != "running":
        return f"`{address}` is {status.state}{waits}"
    if status.turn is not None:
        where = f" at {status.turn_at}" if status.turn_at else ""
        rests = f"; it {status.turn_rests}" if status.turn_rests else ""
        return f"`{address}` has been in one turn ({status.turn}{where}) for {status.turn_seconds:.1f} s{rests}{waits}"
    return f"`{address}` runs{waits}" if waits else ""


async def _suspect(
    system: ActorSystem,
    name: str,
    found: Diagnosis,
    address: str | None,
    asks: Sequence[tuple[str, str | None, float]],
    repair: Mapping[str, Any] | None,
) -> dict[str, Any]:
    """All that is to be said of one suspect."""
    waiting = None if address is None else waiting_for(asks, address)
    return {
        "component": name,
        "address": address,
        "is_certain": name in found.certain,
        "now": await _seen(system, address),
        "since": found.since.get(name),
        "unanswered_seconds": None if waiting is None else system._node.loop.time() - waiting.since,
        "waiting": [] if waiting is None else list(waiting.actors[:MOST_NAMES]),
        "waiting_count": 0 if waiting is None else len(waiting.actors),
        "repair": _handled(name, repair),
    }


async def _said(
    system: ActorSystem,
    path: str,
    addresses: Mapping[str, str],
    near: Mapping[str, str] | None,
    timeout: float,
    repair: Mapping[str, Any] | None,
) -> dict[str, Any]:
    """What one diagnoser says; with `near`, of the suspects only those components."""
    ref = system.ref(path, DiagnoserActor)
    found: Diagnosis = await ref.ask(GetDiagnosis(), timeout=timeout)
    why: Explained = await ref.ask(GetExplanation(), timeout=timeout)
    suspects = [name for name in found.suspects if near is None or name in near]
    asks = _open_asks(system) if suspects else []
    return {
        "diagnoser": path,
        "state": found.state.value,
        "text": str(found),
        "suspects": [await _suspect(system, name, found, addresses.get(name), asks, repair) for name in suspects],
        "candidates": [{"bad": list(one.bad), "probability": one.probability} for one in found.candidates],
        "symptoms": list(map(str, found.symptoms)),
        "contradictions": list(map(str, found.contradictions)),
        "truncated": list(found.truncated),
        "unknown": list(found.unknown),
        "crashed_observers": found.crashed_observers,
        "why": why.text,
        "next_best": [{"atom": str(one.atom), "gain_bits": one.gain} for one in why.next_best],
        "refused": list(why.refused),
        "components": len(found.components) if near is None else len(near),
    }
