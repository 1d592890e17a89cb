"""A replica that does not say that it follows is started again, but not while its state may be the reason."""

from __future__ import annotations

import os
import signal
from typing import Any

import pytest

import holdfast as hf
from holdfast.ftm.group import join
from holdfast.ftm.group.join import Joiner
from holdfast.ftm.group.membership import LookAgain
from holdfast.ftm.group.replicas import Replicas
from holdfast.ftm.mechanisms.pbr import PBR
from tests.actors.process.waiting import until
from tests.ftm.accounts import Add, Counter
from tests.ftm.test_failover import group_of, other, pid_of


@pytest.mark.parametrize("at_work", [0.0, 60.0])
async def test_a_silent_joiner_is_replaced_unless_its_state_may_be_the_reason(
    system: hf.ActorSystem, monkeypatch: pytest.MonkeyPatch, at_work: float
) -> None:
    monkeypatch.setattr(join, "FOLLOWED_WITHIN", 0.02)
    monkeypatch.setattr(Replicas, "at_work", lambda replicas, name: at_work)
    told, tell = [0], Joiner._tell_to_follow

    async def counted(joiner: Joiner, name: str, life: int, epoch: int) -> None:
        told[0] += 1
        await tell(joiner, name, life, epoch)

    monkeypatch.setattr(Joiner, "_tell_to_follow", counted)
    ref: Any = await system.start(hf.child("c", hf.start(Counter), mechanism=PBR()))
    group = group_of(ref)
    await until(lambda: len(group.membership.members) == 2)
    name = other(group)
    life, pid = group.replicas.life_of(name), pid_of(system, ref, name)
    os.kill(pid, signal.SIGSTOP)
    told[0] = 0
    group.replicas.lost(name, "it is to catch up again")
    group.replicas.tell("join", LookAgain())
    await until(lambda: told[0] >= 4 or group.replicas.life_of(name) != life)
    if group.replicas.life_of(name) == life:
        os.kill(pid, signal.SIGCONT)
    await until(lambda: name in group.membership.members)
    assert (group.replicas.life_of(name) == life) == (at_work > 0)
    assert await ref.ask(Add(1)) == 1
