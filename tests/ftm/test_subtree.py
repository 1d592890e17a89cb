"""Protected actors below a supervisor with a process of its own: the replicas are the root's, the decisions are there."""

from __future__ import annotations

import asyncio
import os
import random
import signal
from typing import Any

import pytest

import holdfast as hf
from holdfast.ftm.mechanisms.pbr import PBR
from holdfast.ftm.subtree import SubtreeGroup
from tests.ftm.accounts import Add, Counter, Load, Tags
from tests.ftm.test_failover import METHODS, SEED, group_of, pid_of, two_again

RECOVERIES = ("without recovery", "hybrid")


def bank(*children: hf.ChildSpec, **options: Any) -> hf.ChildSpec:
    inner = hf.supervisor("inner", children=[protected("deep")], intensity=1000)
    return hf.supervisor(
        "bank", isolation="process", intensity=1000, children=children or (protected("alice"), inner), **options
    )


def protected(name: str, recipe: Any = None, **options: Any) -> hf.ChildSpec:
    return hf.child(name, recipe or hf.start(Counter), **{"mechanism": PBR(), **options})


def at(system: hf.ActorSystem, name: str) -> hf.ActorRef[Any]:
    """By address, also while nobody lives there."""
    return system.node.cell_at(f"/app/bank/{name}").ref


def bank_pid(system: hf.ActorSystem) -> int:
    return system.pid_of(system.ref("/app/bank", hf.Supervisor))


async def test_its_replicas_are_processes_of_the_root(system: hf.ActorSystem) -> None:
    await system.start(bank())
    for name in ("alice", "inner/deep"):
        ref = at(system, name)
        assert [await ref.ask(Add(tag)) for tag in range(3)] == [1, 2, 3]
        assert isinstance(ref._cell.host, SubtreeGroup)
        assert len({bank_pid(system), os.getpid(), *(pid_of(system, ref, one) for one in ("r1", "r2"))}) == 4
        assert f"/app/bank/{name}/ftm/r2/server" in system.tree()
    children = await system.ref("/app/bank", hf.Supervisor).ask(hf.WhichChildren())
    assert [(one.id, one.state) for one in children] == [("alice", "running"), ("inner", "running")]
