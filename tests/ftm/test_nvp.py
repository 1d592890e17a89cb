"""N-version programming: a minority of versions that is wrong is outvoted."""

from __future__ import annotations

from typing import Any

import pytest

import holdfast as hf
from holdfast.ftm.alarms import Masked
from holdfast.ftm.mechanisms.nvp import NVP
from holdfast.ftm.mechanisms.pbr import PBR
from holdfast.ftm.model.mechanism import MechanismRefused, find, revive
from holdfast.ftm.votes.voters import Exact, Majority, Median, NoMajority, Tolerance, custom
from tests.ftm import versions
from tests.ftm.replicated import Add, Back, Closed, Fail, Fetch, Put, Read, Say, Total, pair
from tests.ftm.versions import FAULTY

GOOD: Any = (versions.Second, versions.Third)


async def test_versions_that_agree_go_through(system: hf.ActorSystem) -> None:
    driver = await pair(system, Total, NVP(GOOD), others=())
    with system.events() as events:
        keys = driver.send(Add(1), Fetch(2), Say(3), Fail(4), Add(5))
        with pytest.raises(hf.RemoteCrash, match="no 4"):
            await driver.reply(keys[3])
        assert await driver.reply(keys[4]) == 11
        assert [one for one in events.take() if isinstance(one, Masked)] == []
    assert await driver.ask(Read()) == [1, -2, 4, 3, 5]
    assert sorted(out.verb for out in driver.released.values()) == ["ask", "tell"]


@pytest.mark.parametrize("bad", [versions.BadAtThirteen, versions.BadState, versions.Crashing, versions.Curious])
@pytest.mark.parametrize("place", [0, 1, 2])
async def test_one_bad_version_is_outvoted_wherever_it_stands(system: hf.ActorSystem, bad: Any, place: int) -> None:
    """Curious asks for more than the others do: as the protected class its ask leaves, and it is outvoted."""
    all_of_them: list[Any] = [Total, versions.Second]
    all_of_them.insert(place, bad)
    driver = await pair(system, all_of_them[0], NVP(tuple(all_of_them[1:])), others=())
    with system.events() as events:
        keys = driver.send(Add(1), Add(13), Add(2))
        assert [await driver.reply(key) for key in keys] == [1, 14, 16]
        assert any(isinstance(one, Masked) for one in events.take())
    assert await driver.ask(Add(3)) == 19
    assert await driver.ask(Read()) == [1, 13, 2, 3]


async def test_faults_of_different_versions_in_one_batch_are_told_apart(system: hf.ActorSystem) -> None:
    """No majority for the batch as a whole, one for each request but those on which too many are wrong."""
    driver = await pair(system, versions.BadAtThirteen, NVP((versions.BadAtSeven, versions.Second)), others=())
    keys = driver.send(Add(1), Add(7), Add(2), Add(13), Add(3))
    with pytest.raises(NoMajority, match="groups of 1, 1, 1"):
        await driver.reply(keys[3])
    assert [await driver.reply(keys[at]) for at in (0, 1, 2, 4)] == [1, 8, 10, 13]
    assert await driver.ask(Read()) == [1, 7, 2, 3]
    assert [end.turn for end in driver.order] == list(range(len(driver.order)))


async def test_near_answers_agree_if_the_voter_says_so(system: hf.ActorSystem) -> None:
    near = NVP((versions.Rounded, versions.Rounded), voter=Tolerance(abs=1, integers=True))
    driver = await pair(system, Total, near, others=())
    assert await driver.ask(Add(5)) == 5
    strict = NVP((versions.Rounded, versions.Second), voter=Exact())
    assert strict.voter == Exact()


async def test_a_strict_voter_fails_where_one_dissents(system: hf.ActorSystem) -> None:
    driver = await pair(system, Total, NVP((versions.Rounded, versions.Second), voter=Exact()), others=())
    with pytest.raises(NoMajority):
        await driver.ask(Add(5))
    assert await driver.ask(Read()) == []


async def test_messages_that_were_put_aside_come_back(system: hf.ActorSystem) -> None:
    driver = await pair(system, versions.BadAtThirteen, NVP(GOOD), others=())
    keys = driver.send(Put(4), Add(13))
    keys += driver.send(Back(), Add(1))
    assert await driver.reply(keys[3]) in (14, 18)
    assert await driver.reply(keys[0]) in (17, 18)
    assert sorted(await driver.ask(Read())) == [1, 4, 13]


async def test_a_transient_fault_of_one_run_is_masked(system: hf.ActorSystem) -> None:
    for_once = FAULTY(what="state", skip=1)
    driver = await pair(system, Total, NVP(GOOD), for_once, others=())
    assert await driver.ask(Add(1)) == 1
    assert await driver.ask(Add(2)) == 3
    assert await driver.ask(Read()) == [1, 2]


async def test_the_version_in_the_middle_is_taken_with_its_state(system: hf.ActorSystem) -> None:
    """T44: also when it is not the protected class, which comes to something else each time."""
    driver = await pair(system, versions.Low, NVP((versions.High, Total), voter=Median()), others=())
    assert [await driver.ask(Add(10)) for _ in range(3)] == [10, 20, 30]
    assert await driver.ask(Read()) == [10, 10, 10]


async def test_if_no_version_is_in_the_middle_there_is_no_majority(system: hf.ActorSystem) -> None:
    driver = await pair(system, versions.Low, NVP((versions.High, versions.Swaying), voter=Median()), others=())
    with pytest.raises(NoMajority, match="in the middle"):
        await driver.ask(Add(10))


async def test_a_voter_of_ones_own_says_which_run_is_taken(system: hf.ActorSystem) -> None:
    driver = await pair(system, versions.Low, NVP((versions.High, Total), voter=custom(versions.last)), others=())
    assert await driver.ask(Add(10)) == 10


async def test_below_passive_replication_the_backup_has_what_was_voted_for(system: hf.ActorSystem) -> None:
    driver = await pair(system, versions.BadState, PBR(), NVP(GOOD))
    assert await driver.ask(Add(13)) == 13
    await driver.stop_replica("r1")
    await driver.fail_over("r2")
    assert await driver.ask(Add(13)) == 26
    assert await driver.ask(Read()) == [13, 13]


def test_what_cannot_work_is_refused_with_the_reason() -> None:
    class Random(Total):
        deterministic = False

    NVP(GOOD).check(Total)
    with pytest.raises(MechanismRefused, match="state_access = False"):
        NVP(GOOD).check(Closed)
    with pytest.raises(MechanismRefused, match="deterministic = False"):
        NVP(GOOD).check(Random)
    with pytest.raises(ValueError, match="at least two"):
        NVP(versions.Second)
    with pytest.raises(ValueError, match="a voter is one such as"):
        NVP(GOOD, voter=Median)
    made: Any = revive(NVP(GOOD, voter=Majority(need=3)).describe())
    assert made == NVP(GOOD, voter=Majority(need=3))
    assert find("nvp") is NVP
