"""What the diagnosis that runs in a system says now, as plain data for those who ask from outside."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from ..diagnosis.diagnoser import DiagnoserActor
from ..diagnosis.engine import Diagnosis
from ..diagnosis.messages import Explained, GetDiagnosis, GetExplanation
from ..diagnosis.observers import NodeObserver
from .overview import SLICE, Found, walk
from .wire import NotDiagnosed

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
    diagnosers: list[str] = []
    addresses: dict[str, str] = {}
    for number, one in enumerate(walk(Found(f"/{system.name}", system._root, None, os.getpid()), parts=False), 1):
        start = one.child.spec.start if one.child is not None else None
        if start is not None and start.kind is DiagnoserActor:
            diagnosers.append(one.path)
        elif start is not None and start.kind is NodeObserver:
            addresses |= start.args[0]
        if number % SLICE == 0:
            await asyncio.sleep(0)
    if not diagnosers:
        raise NotDiagnosed(
            f"no diagnosis of {system.name} runs: start one in the program, "
            "by `await holdfast.diagnosis.watch(system)` (docs/diagnosis.md)"
        )
    near = {name: where for name, where in addresses.items() if path is None or is_at(where, path)}
    if path is not None and not near:
        raise NotDiagnosed(f"no component of the diagnosis is at {path}: `holdfast diagnose` without it shows all")
    return [await _said(system, one, addresses, None if path is None else near, timeout) for one in diagnosers]


def is_at(where: str, path: str) -> bool:
    """Whether an address is another one, or below it.

    >>> is_at("/app/bank/alice", "/app/bank"), is_at("/app/banker", "/app/bank")
    (True, False)
    """
    return where == path or where.startswith(f"{path.rstrip('/')}/")


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
            {"component": name, "address": addresses.get(name), "is_certain": name in found.certain}
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
