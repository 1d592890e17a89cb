"""Recovery blocks: what the acceptance test refuses is rolled back, and an alternate computes it."""

from __future__ import annotations

from typing import Any

import pytest

import holdfast as hf
from holdfast.ftm.alarms import Objected
from holdfast.ftm.mechanisms.pbr import PBR
from holdfast.ftm.mechanisms.rb import RB, NotAccepted
from holdfast.ftm.model.mechanism import MechanismRefused, find, revive
from tests.ftm import versions
from tests.ftm.replicated import Add, Closed, Fail, Fetch, Read, Total, pair


async def test_a_fault_of_the_primary_version_is_masked(system: hf.ActorSystem) -> None:
    layer = RB(alternates=(versions.Second,), test=(versions.is_positive,))
    driver = await pair(system, versions.BadAtThirteen, layer, others=())
    with system.events() as events:
        keys = driver.send(Add(1), Add(13), Add(2), Fetch(3), Add(13), Add(4))
        assert [await driver.reply(key) for key in keys] == [1, 14, 16, 19, 32, 36]
        told = [one for one in events.take() if isinstance(one, Objected)]
    assert [one.by for one in told] == ["tests.ftm.versions:Second"] * 2
    assert await driver.ask(Read()) == [1, 13, 2, -3, 6, 13, 4]
    assert len(driver.released) == 1


@pytest.mark.parametrize("kind", [versions.Crashing, versions.BadState])
async def test_a_crash_and_a_wrong_state_are_masked(system: hf.ActorSystem, kind: Any) -> None:
    layer = RB(alternates=versions.add_again, test=versions.keeps_its_word)
    driver = await pair(system, kind, layer, others=())
    keys = driver.send(Add(1), Add(13), Add(2))
    assert [await driver.reply(key) for key in keys] == [1, 14, 16]
    assert await driver.ask(Read()) == [1, 13, 2]


async def test_alternates_are_tried_in_their_order(system: hf.ActorSystem) -> None:
    layer = RB(alternates=(versions.BadAtSeven, versions.Curious, versions.Third), test=(versions.is_positive,))
    driver = await pair(system, versions.BadAtThirteen, layer, others=())
    with system.events() as events:
        assert await driver.ask(Add(13)) == 13
        (told,) = [one for one in events.take() if isinstance(one, Objected)]
    assert told.by == "tests.ftm.versions:Third"
    assert "has asked what the first run has not asked" in told.why
    assert await driver.ask(Add(7)) == 20
    assert await driver.ask(Read()) == [13, 7]


async def test_if_none_is_accepted_the_ask_fails_and_nothing_is_changed(system: hf.ActorSystem) -> None:
    layer = RB(alternates=(versions.BadAtSeven,), test=(versions.is_positive,))
    driver = await pair(system, versions.BadAtThirteen, layer, others=())
    keys = driver.send(Add(1), Add(13), Add(2), Fail(9), Add(7))
    with pytest.raises(NotAccepted, match="is_positive does not hold"):
        await driver.reply(keys[1])
    with pytest.raises(NotAccepted, match="it has crashed"):
        await driver.reply(keys[3])
    assert await driver.reply(keys[4]) == 10
    assert await driver.ask(Read()) == [1, 2, 7]


async def test_below_passive_replication_the_backup_has_what_was_accepted(system: hf.ActorSystem) -> None:
    layers = PBR(), RB(alternates=(versions.Second,), test=(versions.is_positive,))
    driver = await pair(system, versions.BadAtThirteen, *layers)
    assert await driver.ask(Add(13)) == 13
    await driver.stop_replica("r1")
    await driver.fail_over("r2")
    assert await driver.ask(Add(13)) == 26
    assert await driver.ask(Read()) == [13, 13]


def test_what_cannot_work_is_refused_with_the_reason() -> None:
    good: dict[str, Any] = {"alternates": (versions.Second,), "test": (versions.is_positive,)}
    RB(**good).check(Total)
    with pytest.raises(MechanismRefused, match="state_access = False"):
        RB(**good).check(Closed)
    with pytest.raises(MechanismRefused, match=r"no handler for .*Add"):
        RB(**dict(good, alternates=versions.Deaf)).check(Total)
    with pytest.raises(MechanismRefused, match="cannot be imported"):
        RB(**dict(good, alternates="tests.ftm.versions:Nobody")).check(Total)
    with pytest.raises(MechanismRefused, match="it may take reply, message and state"):
        RB(**dict(good, test=versions.odd_name)).check(Total)
    with pytest.raises(ValueError, match="at least one"):
        RB(alternates=(versions.Second,))
    with pytest.raises(ValueError, match="define it in a module"):
        RB(**dict(good, test=lambda reply: True))
    assert revive(RB(**good).describe()) == RB(**good)
    assert find("rb") is RB
