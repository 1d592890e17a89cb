"""Time redundancy: transient value faults in answers, outputs and state are masked, or said to be there."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.errors import UnsavableValue
from holdfast.ftm.alarms import Masked
from holdfast.ftm.mechanisms.pbr import PBR
from holdfast.ftm.mechanisms.tr import TR
from holdfast.ftm.model.mechanism import MechanismRefused
from holdfast.ftm.votes.voters import NoMajority
from tests.ftm.replicated import Add, Closed, Fail, Fetch, Large, Other, Read, Say, Spoil, Total, pair

STRIKES: list[Any] = []
"""What goes wrong in the next runs of `Struck.add`, one entry for each run."""


class Struck(Total):
    """Is hit by radiation, now and then."""

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.seen.append(message.n)
        strike = STRIKES.pop(0) if STRIKES else None
        match strike:
            case "answer":
                return 666
            case "state":
                self.seen[-1] += 1
                return sum(self.seen) - 1
            case "output":
                self.other.tell(Add(666))
            case "crash":
                raise MemoryError("a bit has flipped")
            case int():
                return strike
        return sum(self.seen)

    @property
    def other(self) -> hf.ActorRef[Any]:
        return self.ctx.find("/app/other", Other)


@pytest.fixture(autouse=True)
def no_strikes() -> None:
    STRIKES.clear()


async def test_all_goes_through_as_before(system: hf.ActorSystem) -> None:
    driver = await pair(system, Total, TR(), others=())
    keys = driver.send(Add(1), Fetch(2), Say(3), Fail(4), Add(5))
    with pytest.raises(hf.RemoteCrash, match="no 4"):
        await driver.reply(keys[3])
    assert await driver.reply(keys[4]) == 11
    assert await driver.ask(Read()) == [1, -2, 4, 3, 5]
    assert sorted(out.verb for out in driver.released.values()) == ["ask", "tell"]


@pytest.mark.parametrize("kind", ["answer", "state", "output", "crash"])
@pytest.mark.parametrize("run", [0, 1, 2])
async def test_one_fault_is_masked_in_whatever_run(system: hf.ActorSystem, kind: str, run: int) -> None:
    """A38, T43, T44: two of three."""
    driver = await pair(system, Struck, TR(), others=())
    assert await driver.ask(Add(1)) == 1
    with system.events() as events:
        STRIKES.extend([None] * run + [kind])
        assert await driver.ask(Add(2)) == 3
        STRIKES.clear()
        masked = [one for one in events.take() if isinstance(one, Masked)]
    assert [one.turns for one in masked] == ([] if run == 2 else ["2"])
    assert await driver.ask(Add(3)) == 6
    assert await driver.ask(Read()) == [1, 2, 3]
    assert driver.released == {}


async def test_without_a_majority_the_ask_fails_and_nothing_is_changed(system: hf.ActorSystem) -> None:
    driver = await pair(system, Struck, TR(), others=())
    assert await driver.ask(Add(1)) == 1
    STRIKES.extend([7, 8, 9])
    with pytest.raises(NoMajority):
        await driver.ask(Add(2))
    assert await driver.ask(Add(3)) == 4
    assert await driver.ask(Read()) == [1, 3]


async def test_one_with_deltas(system: hf.ActorSystem) -> None:
    driver = await pair(system, Large, PBR(), TR())
    keys = driver.send(Add(1), Add(1), Fail(2), Add(3))
    assert await driver.reply(keys[3]) == 1
    assert await driver.ask(Read()) == [1, 1, 3]
    await driver.stop_replica("r1")
    await driver.fail_over("r2")
    assert await driver.ask(Read()) == [1, 1, 3]


async def test_below_passive_replication_the_backup_gets_what_was_agreed_on(system: hf.ActorSystem) -> None:
    """A65: composed, both faults are masked: a wrong value, and the crash of the replica."""
    driver = await pair(system, Struck, PBR(), TR())
    STRIKES.extend(["state"])
    assert await driver.ask(Add(2)) == 2
    STRIKES.extend([None, "answer"])
    keys = driver.send(Add(3))
    assert await driver.reply(keys[0]) == 5
    STRIKES.extend([1, 2, 3])
    with pytest.raises(NoMajority):
        await driver.ask(Add(9))
    await driver.stop_replica("r1")
    await driver.fail_over("r2")
    assert await driver.ask(Add(4)) == 9
    assert await driver.ask(Read()) == [2, 3, 4]
    names = {cell.name for cell in (system._node.cell_at(driver.path("r2")).children or {}).values()}
    assert names >= {"protocol", "before", "tr.protocol", "tr.before", "proceed", "tr.after", "server", "state"}


def test_it_is_refused_without_state_access_or_determinism() -> None:
    class Random(Total):
        deterministic = False

    with pytest.raises(MechanismRefused, match="state_access = False"):
        TR().check(Closed)
    with pytest.raises(MechanismRefused, match="deterministic = False"):
        TR().check(Random)
    TR().check(Total)


@pytest.mark.parametrize("together", [False, True])
@pytest.mark.parametrize("layers", [(TR(),), (PBR(), TR())], ids=["tr", "pbr+tr"])
async def test_a_turn_that_leaves_an_unsavable_state_fails(
    system: hf.ActorSystem, layers: tuple[Any, ...], together: bool
) -> None:
    """In the second run as in the first: the replica must not die of it, for its successor would too."""
    driver = await pair(system, Total, *layers, others=("r2",) if len(layers) > 1 else ())
    said = (Add(1), Spoil(2), Add(3))
    keys = driver.send(*said) if together else [driver.send(one)[0] for one in said]
    assert [await driver.reply(keys[at]) for at in (0, 2)] == [1, 4]
    with pytest.raises(UnsavableValue, match="spoilt"):
        await driver.reply(keys[1])
    assert await driver.ask(Read()) == [1, 3]


class Slow(Total):
    """Takes longer than whoever asks waits."""

    @hf.on(Add)
    async def add(self, message: Add) -> int:  # type: ignore[override]
        self.seen.append(message.n)
        await asyncio.sleep(1.0)
        return sum(self.seen)


async def test_what_was_begun_in_time_is_not_dropped_by_the_other_runs(system: hf.ActorSystem) -> None:
    """The second run begins when the deadline is over; that is no difference between the runs."""
    driver = await pair(system, Slow, TR(), others=())
    with system.events() as events:
        (key,) = driver.send(Add(1), deadline=system._node.loop.time() + 0.5)
        assert await driver.reply(key) == 1
        assert not [one for one in events.take() if isinstance(one, Masked)]
    assert await driver.ask(Read()) == [1]


class Disordered(Total):
    """Has a set that is gone through in another order each time it is made of what it was gone through before."""

    def __init__(self) -> None:
        super().__init__()
        self.among = set[int]()

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.among.update((7, 15))  # Both belong into the same place of eight: the first one gets it.
        self.seen.append(message.n)
        return len(self.seen)


async def test_the_order_in_which_a_set_is_gone_through_is_no_difference(system: hf.ActorSystem) -> None:
    events = system.events()
    ref = await system.start(hf.child("it", hf.start(Disordered), mechanism=TR()))
    for count in range(1, 6):
        assert await ref.ask(Add(1), timeout=25.0) == count
    assert [one for one in events.take() if isinstance(one, Masked)] == []
