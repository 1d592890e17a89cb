"""A turn that fails in the middle of a batch: what the next life's hooks do stands behind all that came before it.

Where a replica ends the parts in which it hands over a batch hangs on how fast it is, which nobody may notice.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.checkpoint.method import Method
from holdfast.checkpoint.protocol import Snapshot
from tests.actors.process.waiting import until
from tests.ftm.test_failover import group_of, other, pid_of, two_again
from tests.ftm.test_random_hooks import IN_TIME, Close, Enter, Entered, Fail, Room, Wait, mechanisms

# Processes do not care which event loop the root has.
pytestmark = pytest.mark.asyncio(loop_factories=["uvloop"])


RECOVERIES: dict[str, Method | None] = {"nothing kept": None, "hybrid": hf.hybrid(interval=3600.0)}


class Returns(hf.Message[tuple[int, bool]]):
    """How often the actor has returned, and whether the door is open."""


class Pause(hf.Message[None]):
    """Have one process take its time over this turn: it goes on when there is such a file."""

    process: int
    file: str


class Spoil(hf.Message[None]):
    """A turn that leaves what nobody can save."""


class Mark(hf.Message[None]):
    """Say in a folder that a process has come to this."""

    folder: str


class Porch(Room):
    @hf.on(Returns)
    def returned(self, message: Returns) -> tuple[int, bool]:
        return self.returns, self.is_open

    @hf.on(Pause)
    def pause(self, message: Pause) -> None:
        end = time.monotonic() + IN_TIME
        while os.getpid() == message.process and not Path(message.file).exists() and time.monotonic() < end:
            time.sleep(0.005)

    @hf.on(Spoil)
    def spoil(self, message: Spoil) -> None:
        self.lock = threading.Lock()

    @hf.on(Mark)
    def mark(self, message: Mark) -> None:
        (Path(message.folder) / str(os.getpid())).touch()


class Consult(hf.Message[int]):
    """A turn that asks somebody else, and waits for that."""

    whom: hf.ActorRef[Any]


class Asking(Porch):
    @hf.on(Consult)
    async def consult(self, message: Consult) -> int:
        return len(await message.whom.ask(Entered(), IN_TIME))


class Telling(Porch):
    """Writes down, for each process, that it has recovered."""

    def __init__(self) -> None:
        super().__init__()
        self.folder = ""

    @hf.on(Mark)
    def mark(self, message: Mark) -> None:
        super().mark(message)
        self.folder = message.folder

    def on_recovered(self) -> None:
        super().on_recovered()
        if self.folder:
            with (Path(self.folder) / str(os.getpid())).open("a") as file:
                file.write("recovered\n")


async def said(ref: hf.ActorRef[Any], messages: Sequence[hf.Message[Any]]) -> list[Any]:
    """What a burst of asks comes to."""
    asked = [asyncio.ensure_future(ref.ask(one, IN_TIME)) for one in messages]
    found = await asyncio.gather(*asked, return_exceptions=True)
    return [type(one).__name__ if isinstance(one, BaseException) else one for one in found]


KEPT = [(name, how) for name in sorted(mechanisms()) for how in RECOVERIES if (name, how) != ("none", "nothing kept")]


@pytest.mark.parametrize(("name", "how"), KEPT)
async def test_what_hooks_do_stands_behind_all_that_came_before_the_failure(name: str, how: str) -> None:
    mechanism, recovery = mechanisms()[name], RECOVERIES[how]
    async with hf.ActorSystem("app", log=False, intensity=100_000) as system:
        ref = await system.start(hf.child("porch", hf.start(Porch), recovery=recovery, mechanism=mechanism))
        if mechanism is not None:
            await two_again(ref)
        burst = [
            Enter(0),
            Enter(1),
            Returns(),
            Close(),
            Wait(2),
            Fail(),
            Returns(),
            Close(),
            Enter(3),
            Fail(),
            Returns(),
        ]
        assert await said(ref, burst) == [
            1, 2, (0, False), None, 3, "RemoteCrash", (1, True), None, 4, "RemoteCrash", (2, True),
        ]  # fmt: skip
        assert await ref.ask(Entered(), IN_TIME) == [0, 1, 2, 3]


@pytest.mark.parametrize("name", ["lfr", "pbr", "tmr"])
async def test_a_life_recovers_once_from_a_failure(name: str, tmp_path: Path) -> None:
    """What came before it in its part is run again for the state alone: `on_recovered` is called behind that."""
    async with hf.ActorSystem("app", log=False, intensity=100_000) as system:
        ref = await system.start(hf.child("porch", hf.start(Telling), mechanism=mechanisms()[name]))
        await two_again(ref)
        leader = group_of(ref).membership.primary
        assert leader is not None
        file = tmp_path / str(pid_of(system, ref, leader))
        await ref.ask(Mark(str(tmp_path)), IN_TIME)
        before = file.read_text()
        await said(ref, [Enter(0), Enter(1), Mark(str(tmp_path)), Fail(), Returns()])
        assert file.read_text() == before + "recovered\n"


@pytest.mark.parametrize("name", sorted(set(mechanisms()) - {"none"}))
async def test_a_turn_that_waits_in_the_middle_of_a_batch_is_no_failure(name: str) -> None:
    """What came before it may be run again for it, in a life that recovers from nothing."""
    async with hf.ActorSystem("app", log=False, intensity=100_000) as system:
        other = await system.start(hf.child("other", hf.start(Room)))
        ref = await system.start(hf.child("porch", hf.start(Asking), mechanism=mechanisms()[name]))
        await two_again(ref)
        burst = [Enter(0), Enter(1), Close(), Consult(other), Enter(2), Consult(other), Returns()]
        assert await said(ref, burst) == [1, 2, None, 0, 3, 0, (0, False)]


@pytest.mark.parametrize(("name", "how"), KEPT)
async def test_what_hooks_put_back_comes_right_behind_the_failure(name: str, how: str) -> None:
    async with hf.ActorSystem("app", log=False, intensity=100_000) as system:
        spec = hf.child("porch", hf.start(Porch), recovery=RECOVERIES[how], mechanism=mechanisms()[name])
        ref = await system.start(spec)
        if name != "none":
            await two_again(ref)
        burst = [Enter(0), Close(), Wait(1), Enter(2), Fail(), Enter(3), Enter(4)]
        assert await said(ref, burst) == [1, None, 3, 2, "RemoteCrash", 4, 5]


@pytest.mark.parametrize("name", ["pbr", "tr", "tmr", "pbr+tr"])
async def test_a_life_recovers_once_from_a_turn_that_leaves_what_nobody_can_save(name: str) -> None:
    async with hf.ActorSystem("app", log=False, intensity=100_000) as system:
        ref = await system.start(hf.child("porch", hf.start(Porch), mechanism=mechanisms()[name]))
        await two_again(ref)
        first, *_, second, returns = await said(ref, [Enter(0), Enter(1), Close(), Spoil(), Enter(2), Returns()])
        assert (first, second, returns) == (1, 3, (1, True))


async def test_a_failure_that_the_follower_alone_has_come_to_is_recorded_with_what_its_hooks_did(
    tmp_path: Path,
) -> None:
    """Else the next life begins without that, and what was answered behind it comes out otherwise."""
    async with hf.ActorSystem("app", log=False, intensity=100_000) as system:
        spec = hf.child("porch", hf.start(Porch), recovery=hf.hybrid(interval=3600.0), mechanism=mechanisms()["lfr"])
        ref = await system.start(spec)
        await two_again(ref)
        group = group_of(ref)
        primary = group.membership.primary
        assert primary is not None
        leader, follower = pid_of(system, ref, primary), pid_of(system, ref, other(group))
        await ref.ask(Enter(0), IN_TIME)
        burst = [Close(), Pause(leader, str(tmp_path / "go on")), Fail(), Wait(1), Fail(), Wait(2), Mark(str(tmp_path))]
        asked = asyncio.ensure_future(said(ref, burst))
        await until((tmp_path / str(follower)).exists)
        with contextlib.suppress(ProcessLookupError):  # It may have been found silent already.
            os.kill(leader, signal.SIGKILL)
        assert await asked == [None, None, "RemoteCrash", 2, "RemoteCrash", 3, None]
        await two_again(ref)
        ref.kill()
        assert await ref.ask(Entered(), IN_TIME) == [0, 1, 2]
        assert await ref.ask(Returns(), IN_TIME) == (3, True)


async def test_a_snapshot_that_comes_behind_a_later_one_is_not_kept() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        ref = await system.start(hf.child("porch", hf.start(Porch), recovery=hf.hybrid(interval=3600.0)))
        for tag in range(3):
            await ref.ask(Enter(tag), IN_TIME)
        await system.checkpoint(ref, timeout=IN_TIME)
        home = system._homes.at("/app/porch")
        assert home is not None
        turn = home.ledger.state_turn
        home.arrival.take(Snapshot(turn - 1, b"", True, [], 0.0))
        assert home.ledger.state_turn == turn
        ref.kill()
        assert await ref.ask(Entered(), IN_TIME) == [0, 1, 2]
