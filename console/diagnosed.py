"""What the diagnosis that runs in a system says now, as plain data for those who ask from outside."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

import msgspec

from ..diagnosis.diagnoser import DiagnoserActor
from ..diagnosis.engine import Diagnosis
from ..diagnosis.messages import Explained, GetDiagnosis, GetExplanation
from ..diagnosis.observers import NodeObserver
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
        said = await _said(system, one, addresses, None if path is None else near, timeout)
        beside = [each for each in repairers if each.rpartition("/")[0] == one.rpartition("/")[0]]
        said["repair"] = await _told(system, beside[0], timeout) if beside else None
        answers.append(said)
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
        return f"`{address}` has been in one turn ({status.turn}{where}) for {status.turn_seconds:.1f} s{waits}"
    return f"`{address}` runs{waits}" if waits else ""


async def _said(
    system: ActorSystem, path: str, addresses: Mapping[str, str], near: Mapping[str, str] | None, timeout: float
) -> dict[str, Any]:
    """What one diagnoser says; with `near`, of the suspects only those components."""
    ref = system.ref(path, DiagnoserActor)
    found: Diagnosis = await ref.ask(GetDiagnosis(), timeout=timeout)
    why: Explained = await ref.ask(GetExplanation(), timeout=timeout)
    suspects = [name for name in found.suspects if near is None or name in near]
    return {
        "diagnoser": path,
        "state": found.state.value,
        "text": str(found),
        "suspects": [
            {
                "component": name,
                "address": addresses.get(name),
                "is_certain": name in found.certain,
                "now": await _seen(system, addresses.get(name)),
            }
            for name in suspects
        ],
        "candidates": [{"bad": list(one.bad), "probability": one.probability} for one in found.candidates],
        "symptoms": list(map(str, found.symptoms)),
        "contradictions": list(map(str, found.contradictions)),
        "truncated": list(found.truncated),
        "why": why.text,
        "next_best": [{"atom": str(one.atom), "gain_bits": one.gain} for one in why.next_best],
        "refused": list(why.refused),
        "components": len(found.components) if near is None else len(near),
    }
