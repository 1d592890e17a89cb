"""What the hooks of a protected actor set up or say is there once, whoever leads."""

from __future__ import annotations

import asyncio
import os
import signal
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.ftm.alarms import StatesDiffer
from tests.checkpoint.players import until
from tests.ftm.accounts import Boom
from tests.ftm.test_failover import group_of, pid_of, two_again


class Tick(hf.Message): ...


class Count(hf.Message[int]): ...


class Ticking(hf.Actor):
    def __init__(self) -> None:
        self.count = 0

    def on_start(self, restored: bool) -> None:
        self.ctx.every(3600.0, Tick())
        self.ctx.subscribe("/topic")

    @hf.on(Tick)
    def tick(self, message: Tick) -> None:
        self.count += 1

    @hf.on(Count)
    def add(self, message: Count) -> int:
        self.count += 1
        return self.count


@pytest.mark.parametrize("recovery", [None, hf.hybrid(interval=3600.0)], ids=["fresh", "hybrid"])
async def test_a_timer_of_on_start_is_there_once_after_failovers(recovery: hf.Method | None) -> None:
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        spec = hf.child("ticking", hf.start(Ticking), recovery=recovery, mechanism=hf.ftm.PBR())
        ref = await system.start(spec)
        host: Any = ref._cell.host.place
        assert await ref.ask(Count(), timeout=30.0) == 1
        for count in (2, 3, 4):
            await until(lambda: len(host.group.membership.members) > 1)
            primary = host.group.membership.primary
            os.kill(system.pid_of(system.ref(f"/app/ticking/ftm/{primary}", hf.Actor)), signal.SIGKILL)
            assert await ref.ask(Count(), timeout=60.0) == count
            assert [interval for *_, interval in host.home.switch.timers.saved().values()] == [3600.0]


class Halt(hf.Message[None]): ...


class Holding(Ticking):
    """Keeps the handle that it is given for the timer of its first life, once."""

    def __init__(self) -> None:
        super().__init__()
        self.timer: Any = None

    def on_start(self, restored: bool) -> None:
        if self.timer is None:
            timer = self.ctx.every(3600.0, Tick())
            self.timer = timer if restored else None

    @hf.on(Halt)
    def halt(self, message: Halt) -> None:
        self.timer.cancel()


async def test_a_handle_of_on_start_is_good_after_a_failover_and_a_restart_of_the_root(tmp_path: Path) -> None:
    store = f"sqlite:{tmp_path / 'app.db'}"
    spec = hf.child("it", hf.start(Holding), recovery=hf.hybrid(interval=3600.0), mechanism=hf.ftm.PBR())
    async with hf.ActorSystem("app", log=False, intensity=1000, store=store) as system:
        ref = await system.start(spec)
        host: Any = ref._cell.host.place
        assert await ref.ask(Count(), timeout=30.0) == 1
        await until(lambda: len(host.group.membership.members) > 1)
        os.kill(system.pid_of(system.ref(f"/app/it/ftm/{host.group.membership.primary}", hf.Actor)), signal.SIGKILL)
        assert await ref.ask(Count(), timeout=60.0) == 2
    async with hf.ActorSystem("app", log=False, intensity=1000, store=store) as system:
        ref = await system.start(spec)
        home: Any = ref._cell.host.home
        assert len(home.switch.timers.saved()) == 1
        await ref.ask(Halt(), timeout=60.0)
        assert home.switch.timers.saved() == {}


class Word(hf.Message):
    text: str


class Words(hf.Message[list[str]]): ...


class Listener(hf.Actor):
    def __init__(self) -> None:
        self.heard: list[str] = []

    @hf.on(Word)
    def hear(self, message: Word) -> None:
        self.heard.append(message.text)

    @hf.on(Words)
    def read(self, message: Words) -> list[str]:
        return self.heard


class Polite(hf.Actor):
    """Takes its time to say goodbye."""

    async def on_stop(self, reason: hf.ExitReason) -> None:
        listener = self.ctx.find("/app/listener", Listener)
        listener.tell(Word("I go"))
        await asyncio.sleep(0.1)
        listener.tell(Word("I am gone"))


async def test_what_a_protected_actor_says_when_it_stops_is_heard() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        listener = await system.start(hf.child("listener", hf.start(Listener)))
        ref = await system.start(hf.child("polite", hf.start(Polite), mechanism=hf.ftm.PBR()))
        await system.stop(ref)
        assert await listener.ask(Words()) == ["I go", "I am gone"]


class Lives(hf.Message[tuple[int, int]]):
    """Answered with how much was counted, and how often this actor has come back."""


class Returning(hf.Actor):
    """Counts its returns: what its hooks do to the state is done once for each life."""

    def __init__(self) -> None:
        self.count = self.returns = 0

    def on_recovered(self) -> None:
        self.returns += 1

    @hf.on(Count)
    def add(self, message: Count) -> int:
        self.count += 1
        return self.count

    @hf.on(Boom)
    def boom(self, message: Boom) -> None:
        raise ValueError("boom")

    @hf.on(Lives)
    def lives(self, message: Lives) -> tuple[int, int]:
        return self.count, self.returns


class ReturningSecond(Returning):
    """Another version of it."""


class ReturningThird(Returning):
    """One more."""


def who_compares() -> dict[str, Any]:
    return {
        "tr": hf.ftm.TR(),
        "lfr": hf.ftm.LFR(compare_every=0.0),
        "tmr": hf.ftm.TMR(),
        "nvp": hf.ftm.NVP(versions=(ReturningSecond, ReturningThird)),
        "pbr+tr": hf.ftm.compose(hf.ftm.PBR(), hf.ftm.TR()),
    }


@pytest.mark.parametrize("fails", [False, True], ids=["well", "failed"])
@pytest.mark.parametrize("name", sorted(who_compares()))
async def test_a_hook_that_changes_the_state_is_no_difference_and_counts_once_for_a_life(
    name: str, fails: bool
) -> None:
    """Also when the last turn has failed: its number is used, though it is not replayed."""
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        events = system.events()
        recovery = hf.hybrid(interval=3600.0)
        ref = await system.start(hf.child("it", hf.start(Returning), recovery=recovery, mechanism=who_compares()[name]))
        await two_again(ref)
        assert await ref.ask(Count(), timeout=25.0) == 1
        assert await ref.ask(Lives(), timeout=25.0) == (1, 0)
        if fails:
            with pytest.raises(hf.RemoteCrash):
                await ref.ask(Boom(), timeout=25.0)
        ref.kill()
        assert await ref.ask(Count(), timeout=25.0) == 2
        await two_again(ref)
        for count in (3, 4):
            assert await ref.ask(Count(), timeout=25.0) == count
        # The life behind the failed turn has come back too. What its hook has done was saved before the kill, or not.
        assert await ref.ask(Lives(), timeout=25.0) in ([(4, 1), (4, 2)] if fails else [(4, 1)])
        assert (await system.get_status(ref)).life == 2
        told = hf.events.Masked, hf.events.Diverged, StatesDiffer
        assert [event for event in events.take() if isinstance(event, told)] == []


class Greeting(Returning):
    """Counts them in its first hook too."""

    def on_start(self, restored: bool) -> None:
        if restored:
            self.returns += 100


@pytest.mark.pairs
@pytest.mark.parametrize("kind", [Returning, Greeting])
@pytest.mark.parametrize("recovery", [None, hf.hybrid(interval=3600.0)], ids=["plain", "hybrid"])
@pytest.mark.parametrize("name", [*sorted(who_compares()), "pbr"])
async def test_what_the_hooks_of_the_next_leader_change_is_where_all_runs_of_its_turns_begin(
    kind: type[Returning], recovery: hf.Method | None, name: str
) -> None:
    """Whoever leads next began a life, or has one: no run is masked, and no ask fails for want of a majority."""
    mechanism = {**who_compares(), "pbr": hf.ftm.PBR()}[name]
    if recovery is None and name in ("tr", "nvp"):
        recovery = hf.hybrid(interval=0.05)  # There is one replica, which is killed: without recovery it begins afresh.
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        events = system.events()
        ref = await system.start(hf.child("it", hf.start(kind), recovery=recovery, mechanism=mechanism))
        await two_again(ref)
        counts = iter(range(1, 100))
        for _ in range(3):
            assert await ref.ask(Count(), timeout=25.0) == next(counts)
            primary = group_of(ref).membership.primary
            assert primary is not None
            os.kill(pid_of(system, ref, primary), signal.SIGKILL)
            assert await ref.ask(Count(), timeout=25.0) == next(counts)
            await two_again(ref)
            for _ in range(3):
                assert await ref.ask(Count(), timeout=25.0) == next(counts)
        told = hf.events.Masked, hf.events.Diverged, StatesDiffer
        assert [event for event in events.take() if isinstance(event, told)] == []


class Trip(hf.Message):
    """Have the life end outside of any turn."""


class Falling(Returning):
    """Has a state that is told to the other replica as a patch, and falls when it is told to."""

    def __init__(self) -> None:
        super().__init__()
        self.ballast = bytes(200_000)

    @hf.on(Trip)
    def trip(self, message: Trip) -> None:
        self.ctx.create_task(self._fall())

    async def _fall(self) -> None:
        raise RuntimeError("fell")


class Told(Falling):
    """Says itself what has changed."""

    def __init__(self) -> None:
        super().__init__()
        self._counted = self._returned = 0

    def get_delta(self) -> tuple[int, int]:
        delta = self.count - self._counted, self.returns - self._returned
        self._counted, self._returned = self.count, self.returns
        return delta

    def apply_delta(self, delta: tuple[int, int]) -> None:
        self.count += delta[0]
        self.returns += delta[1]


@pytest.mark.parametrize("kind", [Falling, Told])
@pytest.mark.parametrize("name", ["pbr", "tmr", "pbr+tr"])
async def test_what_hooks_change_between_two_turns_comes_to_the_other_replica(kind: type[Falling], name: str) -> None:
    """The life of the leader ends without a turn, and its next one begins at the same turn with another state."""
    mechanism = {**who_compares(), "pbr": hf.ftm.PBR()}[name]
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        ref = await system.start(hf.child("it", hf.start(kind), mechanism=mechanism))
        await two_again(ref)
        assert await ref.ask(Count(), timeout=25.0) == 1
        ref.tell(Trip())
        returns = 0
        while not returns:
            _, returns = await ref.ask(Lives(), timeout=25.0)
        assert await ref.ask(Count(), timeout=25.0) == 2
        await two_again(ref)
        primary = group_of(ref).membership.primary
        assert primary is not None
        os.kill(pid_of(system, ref, primary), signal.SIGKILL)
        assert await ref.ask(Count(), timeout=25.0) == 3
        assert await ref.ask(Lives(), timeout=25.0) == (3, returns + 1)


class Hello(hf.Message[None]):
    by: str


class Heard(hf.Message[list[tuple[str, str]]]): ...


class Hall(hf.Actor):
    """Writes down who has said what."""

    def __init__(self) -> None:
        self.heard: list[tuple[str, str]] = []

    @hf.subscribe("/hello")
    @hf.on(Hello)
    def hello(self, message: Hello) -> None:
        sender = self.ctx.sender
        self.heard.append((message.by, "nobody" if sender is None else sender.path))

    @hf.on(Heard)
    def read(self, message: Heard) -> list[tuple[str, str]]:
        return self.heard


class Saluting(hf.Actor):
    hall: hf.Binding[Hall]

    def __init__(self) -> None:
        self.count = 0

    async def on_start(self, restored: bool) -> None:
        self.hall.tell(Hello("tell"))
        await self.hall.send(Hello("send"))
        await self.hall.ask(Hello("ask"))
        await self.ctx.publish("/hello", Hello("publish"))

    @hf.on(Count)
    def add(self, message: Count) -> int:
        self.count += 1
        return self.count

    @hf.on(Boom)
    def crash(self, message: Boom) -> None:
        raise RuntimeError("as told")


@pytest.mark.parametrize("recovery", [None, hf.hybrid(interval=3600.0)], ids=["fresh", "hybrid"])
@pytest.mark.parametrize("mechanism", [hf.ftm.PBR(), hf.ftm.LFR(), hf.ftm.TR()], ids=["pbr", "lfr", "tr"])
async def test_what_a_hook_says_in_a_later_life_comes_from_the_address_that_is_protected(
    mechanism: Any, recovery: hf.Method | None
) -> None:
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        hall = await system.start(hf.child("hall", hf.start(Hall)))
        await system.start(hf.supervisor("attic"))
        spec = hf.child("a", hf.start(Saluting), bindings={"hall": hall.path}, mechanism=mechanism, recovery=recovery)
        ref = await system.start(spec)
        for how in ("crash", "kill", "move"):
            if recovery is not None:  # Else the first start is handled again, as a turn.
                await system.checkpoint(ref, timeout=60.0)
            before = len(await hall.ask(Heard()))
            if how == "move":
                async with system.transaction(timeout=60.0) as change:
                    change.move(ref, "/app/attic")
            if how == "kill":
                ref.kill()
            else:
                with pytest.raises(hf.RemoteCrash):
                    await ref.ask(Boom(), timeout=60.0)
            assert await ref.ask(Count(), timeout=60.0) >= 1
            heard = (await hall.ask(Heard()))[before:]
            path = "/app/attic/a" if how == "move" else "/app/a"
            assert set(heard) == {(verb, path) for verb in ("tell", "send", "ask", "publish")}, how
