"""What background work brings reaches home behind the turns that it stood behind, whoever has died in between."""

from __future__ import annotations

import asyncio
import os
import random
import signal
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.checkpoint.home.switch import Switch
from holdfast.checkpoint.protocol import PipeDone
from holdfast.ftm.bricks.brick_messages import Done
from holdfast.ftm.group.group import KEPT_TURNS, Group
from holdfast.ftm.group.group_place import GroupPlace
from holdfast.ftm.mechanisms.lfr import LFR
from holdfast.ftm.mechanisms.pbr import PBR
from tests.ftm.accounts import Add, Boom, Counter, Tags
from tests.ftm.test_failover import SEED, group_of, pid_of, two_again

BROUGHT = 1_000


class Begin(hf.Message[int]):
    """Have something done in the background, as long as there is a file `work`; `done` is there when it is over."""

    folder: str


class Halt(hf.Message[int]):
    """A turn that never ends in one process, and lasts as long as there is a file `gate` in all others."""

    folder: str
    pid: int


class Mark(hf.Message[int]):
    """Make a file `computed`, in all processes but one."""

    folder: str
    pid: int


class Worker(Counter):
    @hf.on(Begin)
    def begin(self, message: Begin) -> int:
        self.ctx.pipe_to_self(work(Path(message.folder)), lambda _: Add(BROUGHT))
        return self.total

    @hf.on(Halt)
    async def halt(self, message: Halt) -> int:
        if os.getpid() == message.pid:
            await asyncio.Event().wait()
        await until_gone(Path(message.folder, "gate"))
        return self.total

    @hf.on(Mark)
    def mark(self, message: Mark) -> int:
        if os.getpid() != message.pid:
            Path(message.folder, "computed").touch()
        return self.total


class Call(hf.Message[int]):
    """Ask the other one in the middle of a turn."""


class Asking(Worker):
    @hf.on(Call)
    async def call(self, message: Call) -> int:
        return await self.ctx.find("/app/other", Counter).ask(Add(0), timeout=25.0)


class Leave(hf.Message[int]):
    """Ask the other one, and do not wait for the answer: it comes as a message."""


class Leaving(Counter):
    @hf.on(Leave)
    def ask_and_go_on(self, message: Leave) -> int:
        asked = self.ctx.find("/app/other", Counter).ask(Add(0), timeout=25.0)
        self.ctx.pipe_to_self(asked, lambda _: Add(BROUGHT))
        return self.total


class LeavingSecond(Leaving):
    """Another version of it."""


class LeavingThird(Leaving):
    """One more."""


class Runner(Counter):
    """Each run of its turn begins work that lasts as long as a file of its own is there."""

    def __init__(self) -> None:
        super().__init__()
        self._runs = 0

    @hf.on(Begin)
    def begin(self, message: Begin) -> int:
        self._runs += 1
        self.ctx.pipe_to_self(self.last(Path(message.folder), self._runs), lambda _: Add(BROUGHT))
        return self.total

    async def last(self, folder: Path, run: int) -> None:
        await until_gone(folder / f"work{run}")
        (folder / f"done{run}").touch()


class Apart(Counter):
    """Its work lasts as long as the process has a file of its own; there is another one when it is over."""

    @hf.on(Begin)
    def begin(self, message: Begin) -> int:
        self.ctx.pipe_to_self(self.last(Path(message.folder)), lambda _: Add(BROUGHT))
        return self.total

    async def last(self, folder: Path) -> None:
        await until_gone(folder / f"work{os.getpid()}")
        (folder / f"done{os.getpid()}").touch()


class Noting(Worker):
    """Each process that begins work writes its number."""

    @hf.on(Begin)
    def begin(self, message: Begin) -> int:
        self.ctx.pipe_to_self(note_pid(Path(message.folder)), lambda _: Add(BROUGHT))
        return self.total


async def note_pid(folder: Path) -> None:
    with (folder / "begun").open("a") as file:
        file.write(f"{os.getpid()}\n")


async def work(folder: Path) -> None:
    await until_gone(folder / "work")
    (folder / "done").touch()


async def until_gone(path: Path) -> None:
    while path.exists():
        await asyncio.sleep(0.002)


async def until_there(path: Path) -> None:
    async with asyncio.timeout(30):
        while not path.exists():
            await asyncio.sleep(0.002)


def watched(switch: Switch) -> list[str]:
    """What comes home ahead of the turn that has begun it."""
    early: list[str] = []
    take: Any = switch.from_life

    def seen(record: Any) -> None:
        if isinstance(record, PipeDone) and record.turn > switch.turn:
            early.append(f"the outcome of work of turn {record.turn}, after turn {switch.turn}")
        take(record)

    switch.from_life = seen  # type: ignore[method-assign]
    return early


def deafen(group: Group) -> None:
    """What whoever leads says from now on is lost when it dies: home has not heard of any of it."""
    epoch, take = group.membership.epoch, group.take_done

    def heard(done: Done) -> None:
        if done.epoch > epoch:
            take(done)

    group.take_done = heard  # type: ignore[method-assign]


STEPS = ["before", "depose", "epoch", "kill", "lead", "bind", "drained"]


@pytest.mark.parametrize("recovery", [hf.hybrid(interval=3600.0), None], ids=["recorded", "plain"])
@pytest.mark.parametrize("step", STEPS)
async def test_it_comes_home_behind_the_turns_before_it(
    system: hf.ActorSystem, tmp_path: Path, step: str, recovery: Any
) -> None:
    """The leader dies with requests in hand that its follower has handled; the work ends at some step of the failover.

    All of the requests are answered once, and what the work has brought comes once, too.
    """
    draw = random.Random(f"{SEED} {step}")
    before, between, behind = (draw.randrange(1, 20) for _ in range(3))
    print(f"seed {SEED}: {before} {between} {behind}")
    for name in ("work", "gate"):
        (tmp_path / name).touch()
    ref = await system.start(hf.child("alice", hf.start(Worker), mechanism=LFR(), recovery=recovery))
    await two_again(ref)
    group, host = group_of(ref), ref._cell.host.place
    assert isinstance(host, GroupPlace)
    assert group.membership.primary is not None
    pid = pid_of(system, ref, group.membership.primary)
    early = watched(group.switch)
    deafen(group)
    folder = str(tmp_path)
    first = [Add(tag) for tag in range(before)]
    second = [Add(tag) for tag in range(before, before + between)]
    third = [Add(tag) for tag in range(before + between, before + between + behind)]
    messages: list[hf.Message[int]] = [*first, Begin(folder), *second, Mark(folder, pid), Halt(folder, pid), *third]
    asked = [asyncio.ensure_future(ref.ask(one, timeout=60.0)) for one in messages]
    await until_there(tmp_path / "computed")
    if step != "drained":
        (tmp_path / "gate").unlink()
    ending: list[asyncio.Task[None]] = []

    async def end() -> None:
        (tmp_path / "work").unlink()
        await until_there(tmp_path / "done")
        (tmp_path / "gate").unlink(missing_ok=True)

    def struck(name: str) -> None:
        if name == ("bind" if step == "drained" else step) and not ending:
            ending.append(asyncio.create_task(end()))

    host.on_step = struck
    if step == "before":
        await end()
    os.kill(pid, signal.SIGKILL)
    await asyncio.gather(*asked)
    await asyncio.gather(*ending)
    async with asyncio.timeout(20):
        while BROUGHT not in (tags := await ref.ask(Tags())):
            await asyncio.sleep(0.005)
    assert early == []
    assert sorted(tags) == [*range(before + between + behind), BROUGHT]
    assert [tag for tag in tags if tag != BROUGHT] == list(range(before + between + behind))


@pytest.mark.parametrize("recovery", [hf.hybrid(interval=3600.0), None], ids=["recorded", "plain"])
async def test_work_of_a_turn_that_only_the_backup_has_is_begun_again_or_said_to_be_lost(
    system: hf.ActorSystem, tmp_path: Path, recovery: Any
) -> None:
    """The primary dies when its backup has the turn that has begun the work, and home has not heard of it."""
    (tmp_path / "work").touch()
    ref = await system.start(hf.child("alice", hf.start(Worker), mechanism=PBR(), recovery=recovery))
    await two_again(ref)
    events, group = system.events(), group_of(ref)
    assert group.membership.primary is not None
    pid, take = pid_of(system, ref, group.membership.primary), group.take_done

    def dies(done: Done) -> None:
        if done.epoch > 1 or not done.ends:
            take(done)
        else:
            os.kill(pid, signal.SIGKILL)

    assert group.membership.epoch == 1
    group.take_done = dies  # type: ignore[method-assign]
    asked = [ref.ask(one, timeout=60.0) for one in (Add(0), Begin(str(tmp_path)), Add(1))]
    assert await asyncio.gather(*asked) == [1, 1, 2]
    (tmp_path / "work").unlink()
    if recovery is not None:
        async with asyncio.timeout(20):
            while BROUGHT not in await ref.ask(Tags(), timeout=20.0):
                await asyncio.sleep(0.005)
    tags, lost = await ref.ask(Tags()), [one for one in events.take() if isinstance(one, hf.events.BackgroundWorkLost)]
    events.close()
    assert tags == ([0, 1, BROUGHT] if recovery is not None else [0, 1])
    assert [one.count for one in lost] == ([] if recovery is not None else [1])


@pytest.mark.parametrize("method", ["without recovery", "hybrid"])
@pytest.mark.parametrize("first", [1, 2])
async def test_what_two_runs_of_a_turn_have_begun_comes_once_however_late_the_second_is(
    system: hf.ActorSystem, method: str, first: int, tmp_path: Path
) -> None:
    """The home of an actor without recovery has forgotten the turn by then."""
    for run in (1, 2):
        (tmp_path / f"work{run}").touch()
    recovery = hf.hybrid() if method == "hybrid" else None
    ref = await system.start(hf.child("alice", hf.start(Runner), mechanism=hf.ftm.TR(), recovery=recovery))
    await ref.ask(Begin(str(tmp_path)))
    for run in (first, 3 - first):
        (tmp_path / f"work{run}").unlink()
        async with asyncio.timeout(30):
            while not (tmp_path / f"done{run}").exists():
                await asyncio.sleep(0.002)
        for _ in range(KEPT_TURNS + 50):
            await ref.ask(Add(1))
    assert (await ref.ask(Tags())).count(BROUGHT) == 1


@pytest.mark.parametrize("mechanism", [PBR(), LFR(), hf.ftm.TR(), hf.ftm.TMR()], ids=["pbr", "lfr", "tr", "tmr"])
async def test_what_takes_long_counts_though_home_has_forgotten_its_turn(
    system: hf.ActorSystem, mechanism: Any, tmp_path: Path
) -> None:
    """The home of an actor without recovery forgets turns as they come, also those whose work is out."""
    (tmp_path / "work").touch()
    ref = await system.start(hf.child("alice", hf.start(Worker), mechanism=mechanism))
    await ref.ask(Begin(str(tmp_path)))
    count = KEPT_TURNS + 50
    for tag in range(count):
        await ref.ask(Add(tag))
    (tmp_path / "work").unlink()
    async with asyncio.timeout(25):
        while BROUGHT not in (tags := await ref.ask(Tags())):
            await asyncio.sleep(0.005)
    assert sorted(tags) == [*range(count), BROUGHT]


async def test_what_came_before_the_snapshot_does_not_come_again_behind_a_turn_that_failed(
    system: hf.ActorSystem, tmp_path: Path
) -> None:
    """A replica of LFR that goes back behind a failed turn handles again what it has handled, and begins its work."""
    ref = await system.start(hf.child("alice", hf.start(Worker), mechanism=LFR(), recovery=hf.hybrid(interval=3600.0)))
    await two_again(ref)
    for count in (1, 2):
        await ref.ask(Begin(str(tmp_path)), timeout=25.0)
        async with asyncio.timeout(25):
            while len(await ref.ask(Tags())) < count:
                await asyncio.sleep(0.002)
        await system.checkpoint(ref)
        with pytest.raises(hf.RemoteCrash):
            await ref.ask(Boom(), timeout=25.0)
    assert await ref.ask(Add(0), timeout=25.0) == 3
    assert await ref.ask(Tags()) == [BROUGHT, BROUGHT, 0]


async def test_what_the_next_leader_still_does_is_not_wanted_if_the_snapshot_has_what_came_of_it(
    system: hf.ActorSystem, tmp_path: Path
) -> None:
    """A follower of LFR has begun the work as well, and is slower."""
    ref = await system.start(hf.child("alice", hf.start(Apart), mechanism=LFR(), recovery=hf.hybrid(interval=3600.0)))
    await two_again(ref)
    group = group_of(ref)
    first, pids = group.membership.primary, [pid_of(system, ref, name) for name in group.membership.names]
    assert first is not None
    leads = pid_of(system, ref, first)
    [follows] = [pid for pid in pids if pid != leads]
    for pid in pids:
        (tmp_path / f"work{pid}").touch()
    await ref.ask(Begin(str(tmp_path)), timeout=25.0)
    (tmp_path / f"work{leads}").unlink()
    async with asyncio.timeout(25):
        while BROUGHT not in await ref.ask(Tags()):
            await asyncio.sleep(0.002)
    await system.checkpoint(ref)
    os.kill(leads, signal.SIGKILL)
    await ref.ask(Add(0), timeout=25.0)
    assert group.membership.primary != first
    (tmp_path / f"work{follows}").unlink()
    await until_there(tmp_path / f"done{follows}")
    assert await ref.ask(Add(1), timeout=25.0) == 3
    assert await ref.ask(Add(2), timeout=25.0) == 4
    assert await ref.ask(Tags()) == [BROUGHT, 0, 1, 2]


async def test_work_whose_result_has_come_is_not_begun_again_behind_a_turn_that_failed(
    system: hf.ActorSystem, tmp_path: Path
) -> None:
    """Each replica of LFR handles again what it has handled since its last point, and begins only what is out."""
    ref = await system.start(hf.child("alice", hf.start(Noting), mechanism=LFR(), recovery=hf.hybrid(interval=3600.0)))
    await two_again(ref)
    group = group_of(ref)
    await ref.ask(Begin(str(tmp_path)), timeout=25.0)
    async with asyncio.timeout(25):
        while BROUGHT not in await ref.ask(Tags()):
            await asyncio.sleep(0.002)
    for _ in range(2):
        with pytest.raises(hf.RemoteCrash):
            await ref.ask(Boom(), timeout=25.0)
        assert await ref.ask(Add(0), timeout=25.0)
    assert group.membership.primary is not None
    await ref.ask(Mark(str(tmp_path), pid_of(system, ref, group.membership.primary)), timeout=25.0)
    await until_there(tmp_path / "computed")
    pids = [pid_of(system, ref, name) for name in group.membership.names]
    assert sorted((tmp_path / "begun").read_text().split()) == sorted(map(str, pids))


@pytest.mark.parametrize("recovery", [hf.hybrid(interval=3600.0), None], ids=["recorded", "plain"])
@pytest.mark.parametrize("mechanism", [PBR(), hf.ftm.TR(), hf.ftm.TMR()], ids=["pbr", "tr", "tmr"])
async def test_work_goes_on_while_turns_of_a_batch_ask_for_the_first_time(
    system: hf.ActorSystem, mechanism: Any, recovery: hf.Method | None, tmp_path: Path
) -> None:
    """Nobody has died, and no turn has failed: it is not lost, and the life is not begun again for it."""
    (tmp_path / "work").touch()
    await system.start(hf.child("other", hf.start(Counter)))
    ref = await system.start(hf.child("alice", hf.start(Asking), mechanism=mechanism, recovery=recovery))
    events = system.events()
    await ref.ask(Begin(str(tmp_path)), timeout=25.0)
    asks = [ref.ask(one, timeout=25.0) for one in (Add(1), Call(), Add(2), Call())]
    assert await asyncio.gather(*asks) == [1, 1, 2, 2]
    (tmp_path / "work").unlink()
    async with asyncio.timeout(25):
        while len(await ref.ask(Tags())) < 3:
            await asyncio.sleep(0.002)
    assert await ref.ask(Tags()) == [1, 2, BROUGHT]
    assert (await system.get_status(ref)).life == 1
    assert [event for event in events.take() if isinstance(event, hf.events.BackgroundWorkLost)] == []


@pytest.mark.parametrize("name", ["nvp", "tmr"])
async def test_a_turn_that_does_not_wait_for_what_it_asks_comes_to_the_same_in_each_run(
    system: hf.ActorSystem, name: str
) -> None:
    mechanism = hf.ftm.TMR() if name == "tmr" else hf.ftm.NVP(versions=(LeavingSecond, LeavingThird))
    await system.start(hf.child("other", hf.start(Counter)))
    events = system.events()
    ref = await system.start(hf.child("alice", hf.start(Leaving), mechanism=mechanism))
    for count in (1, 2):
        await ref.ask(Leave(), timeout=25.0)
        async with asyncio.timeout(25):
            while await ref.ask(Tags()) != count * [BROUGHT]:
                await asyncio.sleep(0.002)
    assert await system.ref("/app/other", Counter).ask(Tags()) == [0, 0]
    assert [event for event in events.take() if isinstance(event, (hf.events.ReplicaLost, hf.events.Masked))] == []


async def test_what_was_said_to_be_lost_does_not_come(system: hf.ActorSystem, tmp_path: Path) -> None:
    """A follower that computes has begun the work as well, but nobody counts on that any more."""
    (tmp_path / "work").touch()
    ref = await system.start(hf.child("alice", hf.start(Worker), mechanism=LFR()))
    await two_again(ref)
    events, group, said = system.events(), group_of(ref), asyncio.Event()
    take = group.take_done

    def taken(done: Done) -> None:
        take(done)
        if any(isinstance(one, PipeDone) for one in done.more):
            said.set()

    group.take_done = taken  # type: ignore[method-assign]
    assert [await ref.ask(one) for one in (Begin(str(tmp_path)), Add(0))] == [0, 1]
    assert group.membership.primary is not None
    os.kill(pid_of(system, ref, group.membership.primary), signal.SIGKILL)
    assert await ref.ask(Add(1), timeout=60.0) == 2
    assert [one.count for one in events.take() if isinstance(one, hf.events.BackgroundWorkLost)] == [1]
    events.close()
    (tmp_path / "work").unlink()
    async with asyncio.timeout(30):
        await said.wait()
    assert await ref.ask(Tags()) == [0, 1]
