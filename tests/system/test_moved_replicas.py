"""Actors that a mechanism protects are moved to another supervisor: their replicas live on, and know where they are."""

from __future__ import annotations

import asyncio
import dataclasses
import os
import signal
import time
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, ClassVar

import pytest

import holdfast as hf
from holdfast.ftm.alarms import ProtectionCostly, StatesDiffer
from holdfast.ftm.bricks.brick_messages import Work
from holdfast.ftm.bricks.bricks import Before
from holdfast.ftm.events import ReplicaLost
from holdfast.ftm.group import probation
from holdfast.ftm.model.mechanism import Mechanism, Role
from holdfast.ftm.sec.authority import CertificationAuthority
from tests.ftm.bad_bricks import Wrong
from tests.launched import kills_itself
from tests.system.test_moved_ties import Heard, Party, Tie, hears_once
from tests.system.test_transaction_commit import Die
from tests.system.trees import counter

pytestmark = pytest.mark.usefixtures("warm_programs")

IN_TIME = 30.0


class Add(hf.Message[int]):
    n: int = 1


class Told(hf.Message[dict[str, Any]]): ...


class Me(hf.Message[str]):
    """Where it is by its own ref."""


class Ring(hf.Message):
    """Told by a timer."""


class Wake(hf.Message[bool]):
    seconds: float


class Break(hf.Message[int]): ...


class Compute(hf.Message[bool]):
    """Have something be computed beside, while a file is there, and then be added."""

    file: str


class Speak(hf.Message[bool]):
    """When a file is there, keep the whole process busy until it is not, and then tell of something."""

    file: str


class Dawdle(hf.Message[int]):
    """Keep one of the replicas busy while a file is there."""

    pid: int
    file: str


class Resident(hf.Actor):
    """Counts, and notes the address at which it did."""

    def __init__(self) -> None:
        self.count = self.rung = 0
        self.at: list[str] = []

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.count += message.n
        self.at.append(self.ctx.path)
        return self.count

    @hf.on(Me, readonly=True)
    def myself(self, message: Me) -> str:
        return self.ctx.ref.path

    @hf.on(Wake)
    def wake(self, message: Wake) -> bool:
        self.ctx.tell_after(message.seconds, Ring())
        return True

    @hf.on(Ring)
    def ring(self, message: Ring) -> None:
        self.rung += 1

    @hf.on(Compute)
    def compute(self, message: Compute) -> bool:
        async def beside() -> int:
            while Path(message.file).exists():
                await asyncio.sleep(0.001)
            return 40

        self.ctx.pipe_to_self(beside(), Add)
        return True

    @hf.on(Speak)
    def speak(self, message: Speak) -> bool:
        file, loop = Path(message.file), asyncio.get_running_loop()

        def look() -> None:
            if not file.exists():
                loop.call_later(0.001, look)
                return
            file.with_suffix(".begun").touch()
            while file.exists():
                time.sleep(0.001)
            self.ctx._cell.node.emit(ProtectionCostly(self.ctx.path, "", 1.0, 1))

        look()
        return True

    @hf.on(Dawdle)
    async def dawdle(self, message: Dawdle) -> int:
        if os.getpid() == message.pid:
            Path(f"{message.file}.begun").touch()
            while Path(message.file).exists():
                await asyncio.sleep(0.001)
        self.count += 1
        self.at.append(self.ctx.path)
        return self.count

    @hf.on(Break)
    def fails(self, message: Break) -> int:
        raise RuntimeError("on purpose")

    @hf.on(Told, readonly=True)
    def told(self, message: Told) -> dict[str, Any]:
        return {"count": self.count, "at": self.at, "rung": self.rung}


def is_counted(reply: Any) -> bool:
    """The assertion of A&D."""
    return not isinstance(reply, int) or reply < 10**9


STACKS: dict[str, Any] = {
    "PBR": hf.ftm.PBR(),
    "LFR": hf.ftm.LFR(),
    "LFR+TR": (hf.ftm.LFR(), hf.ftm.TR()),
    "A&D": (hf.ftm.AD(assertions=(is_counted,)), hf.ftm.LFR()),
    "SEC+PBR": (hf.ftm.SEC("/app/ca"), hf.ftm.PBR()),
}


class HoldsBack(Before):
    """Keeps what has come to a follower while a file is there."""

    async def before(self, work: Work) -> Work:
        assert isinstance(self.mechanism, Late)
        while work.requests and Path(self.mechanism.file).exists():
            await asyncio.sleep(0.001)
        return work


@dataclasses.dataclass(frozen=True)
class Late(Mechanism):
    """Its follower is late."""

    name: ClassVar[str] = "late"
    layer: ClassVar[str] = "assertion"
    roles: ClassVar[dict[str, Role]] = {"leader": Role(), "follower": Role(before=HoldsBack)}

    file: str = ""


KINDS: dict[str, Any] = {
    "plain": None,
    "recorded": hf.hybrid(interval=900.0),
    "checkpointed": hf.checkpoint_only(interval=0.1),
}
STACK = pytest.mark.parametrize("stack", list(STACKS))
KIND = pytest.mark.parametrize("kind", list(KINDS))
THERE_IN = pytest.mark.parametrize("there", ["task", "process"])
HERE, THERE = "/app/here/one", "/app/there/one"
TROUBLE = (hf.events.Diverged, hf.events.FailedOver, ReplicaLost, StatesDiffer, hf.events.TrustBreached)


@asynccontextmanager
async def program(
    stack: str | None, kind: str, store: Path | None = None, there: Any = "task"
) -> AsyncGenerator[hf.ActorSystem]:
    """`here` has `one`, which is protected; `there` is where it goes, with a process of its own or without."""
    kept: dict[str, Any] = {} if store is None else {"store": f"sqlite:{store}", "durability": "os"}
    async with hf.ActorSystem("app", log=False, intensity=1000, **kept) as system:
        mechanism = None if stack is None else STACKS[stack]
        await system.start(hf.child("ca", hf.start(CertificationAuthority)))
        one = hf.child("one", hf.start(Resident), mechanism=mechanism, recovery=KINDS[kind])
        await system.start(hf.supervisor("here", intensity=1000, children=[one]))
        await system.start(hf.supervisor("there", isolation=there, intensity=1000, children=[]))
        yield system


def resident(system: hf.ActorSystem, path: str = HERE) -> hf.ActorRef[Resident]:
    return system.ref(path, Resident)


async def moved(system: hf.ActorSystem, to: str = "/app/there", of: str = HERE, then: Any = None) -> None:
    async with system.transaction(timeout=IN_TIME) as change:
        change.move(of, to)
        if then is not None:
            change.step(then)


def group_of(ref: hf.ActorRef[Any]) -> Any:
    place: Any = ref._cell.host.place
    return place.group


def kill_replicas(ref: hf.ActorRef[Any], whom: str) -> None:
    """Kill the processes of the "leader", of the "follower", or of "all"."""
    primary = group_of(ref).membership.primary
    for name, pid in pids(ref).items():
        if whom == "all" or (name == primary) is (whom == "leader"):
            os.kill(pid, signal.SIGKILL)


def pids(ref: hf.ActorRef[Any]) -> dict[str, int]:
    replicas = group_of(ref).replicas
    workers = {name: replicas.worker_of(name) for name in group_of(ref).membership.names}
    return {name: worker.pid for name, worker in workers.items() if worker is not None}


async def whole(ref: hf.ActorRef[Any]) -> None:
    """All replicas are up, one leads, and all others could."""
    async with asyncio.timeout(IN_TIME):
        while (group := group_of(ref)) is None or not group.replicas.whole_since()[0]:
            await asyncio.sleep(0.005)


async def fail_over(ref: hf.ActorRef[Any]) -> None:
    """The one that leads is killed, and another one has taken over."""
    await whole(ref)
    group = group_of(ref)
    epoch = group.membership.epoch
    os.kill(pids(ref)[group.membership.primary], signal.SIGKILL)
    async with asyncio.timeout(IN_TIME):
        while group.membership.epoch == epoch or group.membership.primary is None:
            await asyncio.sleep(0.005)


class Stream:
    """Asks one after another, until it is stopped."""

    def __init__(self, ref: hf.ActorRef[Resident]) -> None:
        self._ref, self._stops, self.answers = ref, False, list[int]()
        self._task = asyncio.create_task(self._ask())

    async def _ask(self) -> None:
        while not self._stops:
            self.answers.append(await self._ref.ask(Add(), IN_TIME))

    async def goes_on(self, more: int = 20) -> None:
        wanted = len(self.answers) + more
        async with asyncio.timeout(IN_TIME):
            while len(self.answers) < wanted and not self._task.done():
                await asyncio.sleep(0.002)

    async def stop(self) -> int:
        self._stops = True
        await self._task
        assert self.answers == list(range(1, len(self.answers) + 1))
        return len(self.answers)


def changes(at: list[str]) -> list[str]:
    """The addresses in order, each once where it begins."""
    return [one for index, one in enumerate(at) if index == 0 or at[index - 1] != one]


@pytest.mark.pairs
@STACK
@KIND
@THERE_IN
@pytest.mark.some(8)
async def test_it_lives_on_in_its_replicas_at_another_address(there: str, stack: str, kind: str) -> None:
    async with program(stack, kind, there=there) as system:
        one = resident(system)
        await whole(one)
        stream, before = Stream(one), pids(one)
        await stream.goes_on()
        with system.events() as events:
            await moved(system)
            assert one.path == THERE
            await stream.goes_on()
            await moved(system, "/app/here", THERE)
            await stream.goes_on()
            await moved(system)
            await stream.goes_on()
            assert not [event for event in events.take() if isinstance(event, TROUBLE)]
        assert pids(one) == before
        assert await one.ask(Me(), IN_TIME) == THERE
        await fail_over(one)
        await stream.goes_on()
        assert await one.ask(Me(), IN_TIME) == THERE
        await fail_over(one)  # To one that has joined at the new address.
        await stream.goes_on()
        count = await stream.stop()
        told = await one.ask(Told(), IN_TIME)
        assert (told["count"], changes(told["at"])) == (count, [HERE, THERE, HERE, THERE])
        assert await resident(system).ask(Add(), IN_TIME) == count + 1  # By the address that it has left.


@KIND
async def test_it_is_taken_out_of_its_replicas_behind_the_move_and_protected_again(kind: str) -> None:
    async with program("PBR", kind) as system:
        one = resident(system)
        assert await one.ask(Add(), IN_TIME) == 1
        await moved(system)
        async with system.transaction(timeout=IN_TIME) as change:
            change.protect(one, None)
        assert await one.ask(Add(), IN_TIME) == 2
        await system.set_isolation(one, "process", timeout=IN_TIME)
        async with system.transaction(timeout=IN_TIME) as change:
            change.protect(one, hf.ftm.LFR())
        await moved(system, "/app/here", THERE)  # It is on probation.
        await fail_over(one)
        assert await one.ask(Add(), IN_TIME) == 3
        assert changes((await one.ask(Told(), IN_TIME))["at"]) == [HERE, THERE, HERE]


@pytest.mark.parametrize("stack", ["PBR", "LFR"])
async def test_who_comes_to_live_at_the_old_address_is_not_taken_for_it(stack: str) -> None:
    async with program(stack, "plain") as system:
        one = resident(system)
        await whole(one)
        assert await one.ask(Add(), IN_TIME) == 1
        assert await one.ask(Wake(0.3), IN_TIME)
        await moved(system)
        async with system.transaction(timeout=IN_TIME) as change:
            change.add("/app/here", counter("one", 50))
        for count in (2, 3):
            await fail_over(one)
            assert await one.ask(Add(), IN_TIME) == count
        async with asyncio.timeout(IN_TIME):
            while not (await one.ask(Told(), IN_TIME))["rung"]:
                await asyncio.sleep(0.01)
        assert await system.get_state(system.ref(HERE, hf.Actor)) == {"count": 50}
        async with system.transaction(timeout=IN_TIME) as change:
            change.protect(system.ref(HERE, hf.Actor), hf.ftm.PBR())
        await whole(system.ref(HERE, hf.Actor))
        assert await one.ask(Add(), IN_TIME) == 4


@pytest.mark.parametrize("stack", ["LFR", "LFR+TR"])
async def test_turns_are_run_again_as_they_were_when_one_of_them_crashes_the_life(stack: str) -> None:
    async with program(stack, "plain") as system:
        one = resident(system)
        await whole(one)
        for count in (1, 2, 3):
            assert await one.ask(Add(), IN_TIME) == count
        await moved(system)
        assert await one.ask(Add(), IN_TIME) == 4
        with pytest.raises(hf.RemoteCrash):
            await one.ask(Break(), IN_TIME)
        await fail_over(one)
        assert (await one.ask(Told(), IN_TIME))["at"] in ([HERE] * 3 + [THERE], [])


@pytest.mark.parametrize("stack", ["LFR", "LFR+TR"])
async def test_a_follower_that_is_behind_runs_what_was_handled_as_it_was(tmp_path: Path, stack: str) -> None:
    async with program(stack, "plain") as system:
        one, files = resident(system), [tmp_path / "first", tmp_path / "second"]
        await whole(one)
        primary = group_of(one).membership.primary
        (follower,) = (pid for name, pid in pids(one).items() if name != primary)
        for count, file in enumerate(files, 1):
            file.touch()
            assert await one.ask(Dawdle(follower, str(file)), IN_TIME) == count
        assert await one.ask(Add(), IN_TIME) == 3
        moving = asyncio.ensure_future(moved(system))
        for file in files:
            async with asyncio.timeout(IN_TIME):
                while not file.with_suffix(".begun").exists():
                    await asyncio.sleep(0.005)
            await asyncio.wait((moving,), timeout=0.3)
            assert one.path == HERE
            file.unlink()
        await moving
        os.kill(pids(one)[primary], signal.SIGKILL)
        assert await one.ask(Add(), IN_TIME) == 4
        assert (await one.ask(Told(), IN_TIME))["at"] == [HERE] * 3 + [THERE]


async def test_a_follower_whose_bricks_are_behind_runs_what_was_handled_as_it_was(tmp_path: Path) -> None:
    file = tmp_path / "busy"
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        child = hf.child("one", hf.start(Resident), mechanism=(Late(str(file)), hf.ftm.LFR()))
        await system.start(hf.supervisor("here", children=[child], intensity=1000))
        await system.start(hf.supervisor("there"))
        one = resident(system)
        await whole(one)
        assert await one.ask(Add(), IN_TIME) == 1
        file.touch()
        assert await one.ask(Add(), IN_TIME) == 2
        moving = asyncio.ensure_future(moved(system))
        await asyncio.wait((moving,), timeout=0.5)
        assert one.path == HERE
        file.unlink()
        await moving
        await fail_over(one)
        assert await one.ask(Add(), IN_TIME) == 3
        assert (await one.ask(Told(), IN_TIME))["at"] == [HERE, HERE, THERE]


@pytest.mark.parametrize("kind", ["plain", "recorded"])
@pytest.mark.parametrize("stack", ["LFR", "SEC+PBR"])
async def test_two_that_are_protected_exchange_their_addresses(stack: str, kind: str) -> None:
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        await system.start(hf.child("ca", hf.start(CertificationAuthority)))
        for above in ("here", "there"):
            child = hf.child("one", hf.start(Resident), mechanism=STACKS[stack], recovery=KINDS[kind])
            await system.start(hf.supervisor(above, children=[child], intensity=1000))
        one, other = resident(system), resident(system, THERE)
        assert await one.ask(Add(), IN_TIME) == 1
        assert await other.ask(Add(10), IN_TIME) == 10
        async with system.transaction(timeout=IN_TIME) as change:
            change.move(HERE, "/app")
            change.move(THERE, "/app/here")
            change.move("/app/one", "/app/there")
        assert (one.path, other.path) == (THERE, HERE)
        for _ in range(2):
            assert [await ref.ask(Me(), IN_TIME) for ref in (one, other)] == [THERE, HERE]
            await fail_over(one)
            await fail_over(other)
        assert [await ref.ask(Add(), IN_TIME) for ref in (one, other)] == [2, 11]


@pytest.mark.parametrize("stack", ["PBR", "LFR"])
async def test_what_is_computed_beside_comes_in_at_the_new_address(tmp_path: Path, stack: str) -> None:
    file = tmp_path / "busy"
    file.touch()
    async with program(stack, "plain") as system:
        one = resident(system)
        await whole(one)
        assert await one.ask(Compute(str(file)), IN_TIME)
        await moved(system)
        assert await one.ask(Add(), IN_TIME) == 1
        file.unlink()
        async with asyncio.timeout(IN_TIME):
            while (await one.ask(Told(), IN_TIME))["count"] != 41:
                await asyncio.sleep(0.005)
        await fail_over(one)
        assert (await one.ask(Told(), IN_TIME))["at"] == [THERE, THERE]


async def test_one_that_is_suspended_is_moved_and_stays_so() -> None:
    async with program("PBR", "recorded") as system:
        one = resident(system)
        await whole(one)
        await system.suspend(one)
        asked = one.ask(Add(), IN_TIME)
        await moved(system)
        await fail_over(one)
        assert not asked.done()
        await system.resume(one)
        assert await asked == 1
        assert (await one.ask(Told(), IN_TIME))["at"] == [THERE]


@pytest.mark.parametrize("supervisor", [hf.supervisor, hf.dynamic])
async def test_it_comes_back_with_its_new_supervisor(supervisor: Any) -> None:
    async with program("PBR", "recorded") as system:
        await system.start(supervisor("aside", intensity=1000))
        one = resident(system)
        assert await one.ask(Add(), IN_TIME) == 1
        await moved(system, "/app/aside")
        assert await one.ask(Add(), IN_TIME) == 2
        one.kill()
        assert await one.ask(Add(), IN_TIME) == 3
        if supervisor is hf.supervisor:
            system.ref("/app/aside", hf.Actor).kill()
            async with asyncio.timeout(IN_TIME):
                while (found := system._node.find("/app/aside/one")) is None or found is one._cell:
                    await asyncio.sleep(0.005)
            one = resident(system, "/app/aside/one")
            assert await one.ask(Add(), IN_TIME) == 4
        assert changes((await one.ask(Told(), IN_TIME))["at"]) == [HERE, "/app/aside/one"]


@pytest.mark.parametrize("stack", ["PBR", "SEC+PBR"])
async def test_a_supervisor_is_moved_with_those_that_are_protected_below_it(stack: str) -> None:
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        await system.start(hf.child("ca", hf.start(CertificationAuthority)))
        children = [hf.child(name, hf.start(Resident), mechanism=STACKS[stack]) for name in ("one", "two")]
        await system.start(hf.supervisor("here", children=[hf.supervisor("team", children=children, intensity=99)]))
        await system.start(hf.supervisor("there"))
        one, two = (resident(system, f"/app/here/team/{name}") for name in ("one", "two"))
        before = pids(one), pids(two)
        await moved(system, of="/app/here/team")
        assert (one.path, two.path) == ("/app/there/team/one", "/app/there/team/two")
        for ref in (one, two):
            assert await ref.ask(Add(), IN_TIME) == 1
        assert (pids(one), pids(two)) == before
        for ref in (one, two):
            await fail_over(ref)
            assert (await ref.ask(Told(), IN_TIME))["at"] == [ref.path]


@pytest.mark.pairs
@pytest.mark.parametrize("kind", ["plain", "recorded"])
@pytest.mark.parametrize("verb", ["monitor", "link"])
@pytest.mark.parametrize("who", ["watcher", "target", "both"])
async def test_ties_follow_it(who: str, verb: str, kind: str) -> None:
    """Whoever is protected is moved, when it is tied."""
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        protected: dict[str, Any] = {"mechanism": hf.ftm.PBR(), "recovery": KINDS[kind]}
        children = [
            hf.child(name, hf.start(Party), **(protected if who in (name, "both") else {}))
            for name in ("watcher", "target")
        ]
        await system.start(hf.supervisor("here", children=children, intensity=99))
        await system.start(hf.supervisor("there"))
        one, other = system.ref("/app/here/watcher", Party), system.ref("/app/here/target", Party)
        assert await one.ask(Tie(verb, other.path), IN_TIME)
        async with system.transaction(timeout=IN_TIME) as change:
            if who != "target":
                change.move(one, "/app/there")
            if who != "watcher":
                change.move(other, "/app/there")
        assert await other.ask(Heard(), IN_TIME) == []
        for ref in (one, other):
            if ref._cell.spec.mechanism is not None:
                await fail_over(ref)
        async with system.transaction(timeout=IN_TIME) as change:
            change.remove(other)
        await hears_once(one, "exit" if verb == "link" else "down")


class Refuse(hf.system.Operation):
    """A step that is never ready, and then has failed."""

    verb = "refuse"

    def __init__(self) -> None:
        super().__init__("now")

    async def check(self, system: hf.ActorSystem, draft: Any) -> None: ...

    async def prepare(self, system: hf.ActorSystem) -> None:
        raise hf.errors.ControlFailed("/app", "refuse", "on purpose")


@STACK
@KIND
@pytest.mark.some(8)
async def test_a_move_that_is_given_up_leaves_it_as_it_was(stack: str, kind: str) -> None:
    async with program(stack, kind) as system:
        one = resident(system)
        await whole(one)
        stream, before = Stream(one), pids(one)
        await stream.goes_on()
        for _ in range(2):
            with pytest.raises(hf.TransactionFailed, match="on purpose"):
                await moved(system, then=Refuse())
            await stream.goes_on()
        assert (one.path, pids(one)) == (HERE, before)
        await moved(system)
        await stream.goes_on()
        count = await stream.stop()
        told = await one.ask(Told(), IN_TIME)
        assert (told["count"], changes(told["at"])) == (count, [HERE, THERE])


# -- on trial ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("before", [None, "PBR"])
@THERE_IN
async def test_a_mechanism_that_fails_behind_the_move_gives_way_there(there: Any, before: str | None) -> None:
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        mechanism = None if before is None else STACKS[before]
        children = [hf.child("one", hf.start(Resident), mechanism=mechanism, recovery=KINDS["recorded"])]
        await system.start(hf.supervisor("here", intensity=1000, children=children))
        await system.start(hf.supervisor("there", isolation=there))
        one = resident(system)
        assert await one.ask(Add(), IN_TIME) == 1
        bad = Wrong("exit", "message", "before", "leader")
        async with system.transaction(timeout=IN_TIME) as change:
            change.protect(one, (bad, hf.ftm.PBR()))
        await moved(system)
        stream = asyncio.gather(*(one.ask(Add(), IN_TIME) for _ in range(20)))
        async with asyncio.timeout(IN_TIME):
            (outcome,) = await change.settled()
        assert (outcome.is_kept, outcome.address) == (False, THERE)
        assert await stream == list(range(2, 22))
        assert (await system.protection(one)).is_protected is (before is not None)
        assert changes((await one.ask(Told(), IN_TIME))["at"]) == [HERE, THERE]
        await moved(system, "/app/here", THERE)
        assert await one.ask(Add(), IN_TIME) == 22


@pytest.mark.parametrize("stack", ["PBR", None])
async def test_the_next_root_has_the_mechanism_that_it_was_given_at_its_new_address(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stack: str | None
) -> None:
    """`stack`: what its spec declares; it is given LFR."""
    monkeypatch.setattr(probation, "MOST_SECONDS", 0.5)
    async with program(stack, "recorded", tmp_path / "store") as system:
        one = resident(system)
        async with system.transaction(timeout=IN_TIME) as change:
            change.protect(one, hf.ftm.LFR())
        await moved(system)
        async with asyncio.timeout(IN_TIME):
            await change.settled()
        assert await one.ask(Add(), IN_TIME) == 1
    async with program(stack, "recorded", tmp_path / "store") as system:
        one = resident(system, THERE)
        assert one._cell.spec.mechanism == hf.ftm.LFR()
        await fail_over(one)
        assert await one.ask(Add(), IN_TIME) == 2


# -- killed meanwhile -------------------------------------------------------------------------------------------------


@pytest.mark.pairs
@pytest.mark.parametrize("whom", ["leader", "follower"])
@pytest.mark.parametrize("stack", ["PBR", "LFR", "SEC+PBR"])
@pytest.mark.parametrize("seed", range(6))
async def test_a_replica_that_is_killed_at_any_instant_of_the_move_loses_nothing(
    stack: str, whom: str, seed: int
) -> None:
    async with program(stack, "recorded" if seed % 2 else "plain") as system:
        one = resident(system)
        await whole(one)
        stream = Stream(one)
        await stream.goes_on(5)
        primary = group_of(one).membership.primary
        victim = next(pid for name, pid in pids(one).items() if (name == primary) is (whom == "leader"))
        moving = asyncio.ensure_future(moved(system))
        for _ in range(seed * 5):
            await asyncio.sleep(0)
        os.kill(victim, signal.SIGKILL)
        await moving
        await stream.goes_on(5)
        await fail_over(one)
        await stream.goes_on(5)
        count = await stream.stop()
        told = await one.ask(Told(), IN_TIME)
        assert (told["count"], changes(told["at"])) == (count, [HERE, THERE])


class Strike(hf.system.Operation):
    """A step at which something is done, when all before it are ready or in force."""

    verb = "strike"

    def __init__(self, when: str, what: Any) -> None:
        super().__init__("now")
        self._when, self._what = when, what

    def _strike(self, when: str) -> None:
        if when == self._when:
            self._when = ""
            self._what()

    async def check(self, system: hf.ActorSystem, draft: Any) -> None: ...

    async def prepare(self, system: hf.ActorSystem) -> None:
        self._strike("prepare")

    def commit(self, system: hf.ActorSystem) -> None:
        self._strike("commit")

    async def finish(self, system: hf.ActorSystem) -> None:
        self._strike("finish")


async def test_what_a_replica_says_before_it_has_heard_of_its_address_is_meant_so(tmp_path: Path) -> None:
    file, begun = tmp_path / "busy", tmp_path / "busy.begun"
    async with program("PBR", "plain") as system:
        one = resident(system)
        await whole(one)
        assert await one.ask(Speak(str(file)), IN_TIME)
        before = pids(one)

        def strike() -> None:
            file.touch()
            while not begun.exists():
                time.sleep(0.001)

        with system.events() as events:
            await moved(system, then=Strike("prepare", strike))
            async with system.transaction(timeout=IN_TIME) as change:
                change.add("/app/here", counter("one", 50))
            file.unlink()
            assert await one.ask(Add(), IN_TIME) == 1
            seen = events.take()
            assert not [event for event in seen if isinstance(event, (hf.events.TrustBreached, hf.events.DeadLetter))]
            assert [event.address for event in seen if isinstance(event, ProtectionCostly)] == [THERE]
        assert pids(one) == before


@KIND
@pytest.mark.parametrize("whom", ["leader", "follower", "all"])
@pytest.mark.parametrize("when", ["prepare", "commit", "finish"])
@THERE_IN
@pytest.mark.some(36)
async def test_replicas_that_are_killed_at_a_step_of_the_move(there: str, when: str, whom: str, kind: str) -> None:
    """When it is at rest; in the step of the loop in which its address changes; behind that."""
    async with program("LFR" if when == "commit" else "PBR", kind, there=there) as system:
        one = resident(system)
        await whole(one)
        for count in (1, 2, 3):
            assert await one.ask(Add(), IN_TIME) == count

        await moved(system, then=Strike(when, lambda: kill_replicas(one, whom)))
        assert one.path == THERE
        begins = await one.ask(Add(), IN_TIME) - 1
        if whom != "all" or kind == "recorded":  # Else it begins afresh, or where it was saved last.
            assert begins == 3
        await fail_over(one)
        assert (await one.ask(Told(), IN_TIME))["at"] == [HERE] * begins + [THERE]


DECLARED = {"declared": "PBR", "on trial": "PBR", "certified": "SEC+PBR"}


async def killed(store: str, when: str, how: str) -> None:
    """The root is killed by a step in the middle of the move; its mechanism stands in its spec, or is on trial."""
    async with program(DECLARED[how], "recorded", Path(store)) as system:
        one = resident(system)
        if how == "on trial":
            async with system.transaction(timeout=IN_TIME) as change:
                change.protect(one, hf.ftm.LFR())
        assert await one.ask(Add(7), IN_TIME) == 7
        async with system.transaction(timeout=IN_TIME) as change:
            if when == "finish":
                change.step(Die(when))
            change.move(HERE, "/app/there")
            change.step(Die(when))


PROGRAM = """
import asyncio, sys
from tests.system.test_moved_replicas import killed


if __name__ == "__main__":
    asyncio.run(killed(*sys.argv[1:]))
"""


@pytest.mark.parametrize("how", list(DECLARED))
@pytest.mark.parametrize("when", ["prepare", "commit", "finish"])
@pytest.mark.some(5)
async def test_a_root_that_is_killed_has_it_at_one_of_the_two(tmp_path: Path, when: str, how: str) -> None:
    (tmp_path / "program.py").write_text(PROGRAM)
    await kills_itself(
        tmp_path / "program.py", tmp_path / "store", when, how, TMPDIR=str(tmp_path)
    )  # It leaves its keys.
    async with program(DECLARED[how], "recorded", tmp_path / "store") as system:
        at, empty = ("there", "here") if when == "finish" else ("here", "there")
        assert "one" not in (system.ref(f"/app/{empty}", hf.Actor)._cell.children or {})
        one = resident(system, f"/app/{at}/one")
        assert one._cell.spec.mechanism == STACKS[DECLARED[how]]
        assert await one.ask(Add(), IN_TIME) == 8
        await fail_over(one)
        assert await one.ask(Add(), IN_TIME) == 9
        assert (await one.ask(Told(), IN_TIME))["at"] == [HERE, one.path, one.path]
