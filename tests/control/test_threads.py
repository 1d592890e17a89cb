"""Blocking handlers run in worker threads, one turn at a time (W11, T33)."""

from __future__ import annotations

import asyncio
import contextvars
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from tests.control.conftest import Starter
from tests.control.players import Account, Add, Total, until_there

SEEN: contextvars.ContextVar[str] = contextvars.ContextVar("seen", default="nothing")


class Do(hf.Message[Any]):
    work: Any


class Block(hf.Message[int]):
    """Block the thread until the file is there."""

    path: str


class Hand(hf.Message):
    to: hf.ActorRef[Any]
    n: int


class Now(hf.Message[int]): ...


class No(hf.Refusal): ...


class Blocks(hf.Actor):
    def __init__(self) -> None:
        self.turns = 0

    @hf.on(Do, to_thread=True)
    def do(self, message: Do) -> Any:
        return message.work(self)

    @hf.on(Block, to_thread=True)
    def block(self, message: Block) -> int:
        Path(f"{message.path}.begun").touch()
        while not Path(message.path).exists():
            time.sleep(0.005)
        self.turns += 1
        return self.turns

    @hf.on(Hand, to_thread=True)
    def hand(self, message: Hand) -> None:
        message.to.tell(Add(message.n))
        self.ctx.tell_after(0.0, Now())
        self.turns += 1

    @hf.on(Now)
    def now(self, message: Now) -> int:
        return self.turns


async def test_a_blocking_handler_blocks_only_its_actor(
    system: hf.ActorSystem, start_one: Starter, tmp_path: Path
) -> None:
    one, gate = await start_one(hf.start(Blocks)), tmp_path / "gate"
    blocked = one.ask(Block(str(gate)), timeout=30.0)
    await until_there(tmp_path / "gate.begun")
    other = await system.start(hf.child("other", hf.start(Account)))
    assert await other.ask(Add(1)) == 1  # the loop goes on
    assert (await system.get_status(one)).turn == "tests.control.test_threads.Block"  # that of its process too
    after = one.ask(Now(), timeout=30.0)
    done, _ = await asyncio.wait([after], timeout=0.05)
    assert not done  # one turn at a time
    gate.touch()
    assert await blocked == 1
    assert await after == 1


async def test_what_a_thread_does_through_refs_and_ctx_works(system: hf.ActorSystem, start_one: Starter) -> None:
    one = await start_one(hf.start(Blocks))
    sink = await system.start(hf.child("sink", hf.start(Account)))
    for n in range(3):
        one.tell(Hand(sink, n))
    assert await one.ask(Now(), timeout=30.0) == 3
    async with asyncio.timeout(30.0):
        while await sink.ask(Total()) != 3:
            await asyncio.sleep(0.005)


@pytest.mark.parametrize("way", ["recorded task", "recorded process"])
async def test_a_recorded_turn_in_a_thread_comes_back_after_a_kill(system: hf.ActorSystem, start_one: Starter) -> None:
    one = await start_one(hf.start(Blocks))
    sink = await system.start(hf.child("sink", hf.start(Account)))
    for _ in range(3):
        one.tell(Hand(sink, 1))
    assert await one.ask(Now(), timeout=30.0) == 3
    one.kill()
    assert await one.ask(Now(), timeout=30.0) == 3
    async with asyncio.timeout(30.0):
        while await sink.ask(Total()) != 3:
            await asyncio.sleep(0.005)
    assert await sink.ask(Total()) == 3  # nothing was sent twice


@pytest.fixture
def one(system: hf.ActorSystem) -> hf.ActorRef[Blocks]:
    return system.spawn(hf.start(Blocks), "one")


def refuse(actor: Blocks) -> None:
    raise No


def crash(actor: Blocks) -> None:
    raise ValueError("told to")


async def test_refusals_and_crashes_are_as_in_any_turn(system: hf.ActorSystem, one: hf.ActorRef[Blocks]) -> None:
    with pytest.raises(No):
        await one.ask(Do(refuse))
    assert await one.ask(Do(lambda actor: threading.get_ident())) != threading.get_ident()
    gone = one._cell.ended()
    with pytest.raises(hf.RemoteCrash, match="ValueError: told to"):
        await one.ask(Do(crash))
    assert isinstance(await gone, hf.Crash)


async def test_the_context_goes_along(system: hf.ActorSystem, one: hf.ActorRef[Blocks]) -> None:
    token = SEEN.set("outside")
    try:
        async with hf.ActorSystem("inner", log=False) as inner:
            ref = inner.spawn(hf.start(Blocks))
            assert await ref.ask(Do(lambda actor: SEEN.get())) == "outside"
    finally:
        SEEN.reset(token)


async def test_a_handle_from_a_thread_answers_later(system: hf.ActorSystem, one: hf.ActorRef[Blocks]) -> None:
    handles: list[Any] = []

    def later(actor: Blocks) -> Any:
        handles.append(actor.ctx.reply_handle())
        return handles[0]

    asked = one.ask(Do(later))
    assert await one.ask(Now()) == 0
    handles[0].reply(7)
    assert await asked == 7


async def test_ctx_is_the_actors_own_again_after_the_turn(system: hf.ActorSystem, one: hf.ActorRef[Blocks]) -> None:
    cell = one._cell
    assert await one.ask(Do(lambda actor: actor.ctx.path)) == "/app/one"
    assert cell.actor is not None
    assert cell.actor.ctx is cell.ctx


@pytest.mark.parametrize(
    "work",
    [
        lambda actor: actor.ctx.ref.ask(Now()),
        lambda actor: actor.ctx.ref.send(Now()),
        lambda actor: actor.ctx.publish("/topic", Now()),
        lambda actor: actor.ctx.create_task(None),
    ],
)
async def test_what_has_to_be_awaited_is_refused_with_the_reason(
    system: hf.ActorSystem, one: hf.ActorRef[Blocks], work: Callable[[Blocks], Any]
) -> None:
    def attempt(actor: Blocks) -> str:
        try:
            result = work(actor)
        except hf.HoldfastError as error:
            return str(error)
        if asyncio.iscoroutine(result):  # `send` is a coroutine function: it says no when it is begun
            try:
                result.send(None)
            except hf.HoldfastError as error:
                return str(error)
        return "allowed"

    assert "a blocking handler cannot" in await one.ask(Do(attempt))


async def test_a_killed_life_does_not_wait_for_its_thread(
    system: hf.ActorSystem, one: hf.ActorRef[Blocks], tmp_path: Path
) -> None:
    gate, result = threading.Event(), []
    sink = system.spawn(hf.start(Account))

    def stay(actor: Blocks) -> None:
        (tmp_path / "begun").touch()
        gate.wait(30.0)
        try:
            sink.tell(Add(1))
        except hf.HoldfastError as error:
            result.append(type(error))

    asked = one.ask(Do(stay), timeout=30.0)
    await until_there(tmp_path / "begun")
    gone = one._cell.ended()
    one.kill()
    assert await gone == hf.KILLED
    with pytest.raises(hf.AskFailed):
        await asked
    gate.set()
    async with asyncio.timeout(30.0):
        while not result:
            await asyncio.sleep(0.005)
    assert result == [hf.ActorStopped]
    assert await sink.ask(Total()) == 0


class Busy:
    """How many threads are in it, until it is opened."""

    def __init__(self) -> None:
        self.gate, self._lock = threading.Event(), threading.Lock()
        self.now = self.most = 0

    def stay(self, actor: Blocks) -> None:
        with self._lock:
            self.now += 1
            self.most = max(self.most, self.now)
        self.gate.wait(60.0)
        with self._lock:
            self.now -= 1


async def test_threads_that_killed_lives_have_left_count_among_the_forty(system: hf.ActorSystem) -> None:
    """And what waits for one is done when there is one."""
    busy = Busy()
    children = [hf.child(f"one{number}", hf.start(Blocks)) for number in range(30)]
    await system.start(hf.supervisor("all", children=children, intensity=1000))
    actors = [system.ref(f"/app/all/one{number}", Blocks) for number in range(30)]
    killed = [actor.ask(Do(busy.stay), timeout=60.0) for actor in actors]
    async with asyncio.timeout(60.0):
        while busy.now < 30:
            await asyncio.sleep(0.005)
    for actor in actors:
        actor.kill()
    assert {type(one) for one in await asyncio.gather(*killed, return_exceptions=True)} == {hf.AskFailed}
    waiting = [actor.ask(Do(busy.stay), timeout=60.0) for actor in actors]
    async with asyncio.timeout(60.0):
        while busy.now < 40 or not all([(await system.get_status(actor)).turn for actor in actors]):
            await asyncio.sleep(0.005)
    busy.gate.set()
    await asyncio.gather(*waiting)
    assert busy.most == 40


HANGING = """
import threading
import holdfast as hf

class Go(hf.Message): ...

class Hangs(hf.Actor):
    @hf.on(Go, to_thread=True)
    def go(self, message: Go) -> None:
        begun.set()
        threading.Event().wait()

async def main():
    async with hf.ActorSystem("app", log=False) as system:
        hangs = system.spawn(hf.start(Hangs))
        hangs.tell(Go())
        jobs = hf.supervision.Tasks(await system.start(hf.supervision.tasks("jobs")))
        try:
            await jobs.run(threading.Event().wait, timeout=0.1)
        except hf.AskTimeout:
            await jobs.run(begun.wait)
            hangs.kill()

begun = threading.Event()
if __name__ == "__main__":
    hf.run(main())
    print("over")
"""


def test_a_thread_that_hangs_does_not_keep_the_program_alive(tmp_path: Path) -> None:
    script = tmp_path / "hanging.py"
    script.write_text(HANGING)
    ended = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=120, check=False)
    assert (ended.stdout, ended.returncode) == ("over\n", 0), ended.stderr


def test_a_thread_does_not_wait_for_a_loop_that_was_closed() -> None:
    """What it wants done came when the loop had taken its last step."""
    loop = asyncio.new_event_loop()
    begun, go_on, outcomes = threading.Event(), threading.Event(), queue.SimpleQueue[str]()

    def work(actor: hf.Actor) -> None:
        begun.set()
        go_on.wait()
        try:
            actor.ctx.now()
        except hf.HoldfastError as error:
            outcomes.put(str(error))

    async def main() -> None:
        async with hf.ActorSystem("inner", log=False) as inner:
            one = await inner.start(hf.child("one", hf.start(Blocks), shutdown=0.05))
            one.tell(Do(work))
            await loop.run_in_executor(None, begun.wait)

    loop.run_until_complete(main())
    hand_over = loop.call_soon_threadsafe

    def closing(*args: Any, **kwargs: Any) -> Any:
        handle = hand_over(*args, **kwargs)
        loop.close()
        return handle

    loop.call_soon_threadsafe = closing  # type: ignore[assignment]
    go_on.set()
    assert "the system has ended" in outcomes.get(timeout=60.0)


def test_only_a_plain_def_can_block() -> None:
    with pytest.raises(TypeError, match="`async def`: to_thread is for handlers that block"):

        class Wrong(hf.Actor):
            @hf.on(Now, to_thread=True)
            async def now(self, message: Now) -> int:
                return 1


class Peer(hf.Actor):
    @hf.on(Do)
    def do(self, message: Do) -> Any:
        return message.work(self)


class Traps(Blocks):
    def on_exit(self, source: hf.ActorRef[hf.Actor], reason: hf.ExitReason) -> None:
        self.heard = str(reason)


async def test_what_a_thread_sets_on_its_ctx_is_set_on_the_actor_s() -> None:
    """Trapping exits, say: the next life of the attribute would be that of the turn."""

    def trap(actor: hf.Actor) -> None:
        actor.ctx.trap_exits = True

    async with hf.ActorSystem(log=False) as system:
        peer, traps = system.spawn(hf.start(Peer)), system.spawn(hf.start(Traps))
        await traps.ask(Do(trap))
        await traps.ask(Do(lambda actor: actor.ctx.link(peer)))
        peer.kill()
        assert await traps.ask(Do(lambda actor: actor.ctx.trap_exits)) is True
        while not await traps.ask(Do(lambda actor: getattr(actor, "heard", ""))):
            pass
        assert await traps.ask(Do(lambda actor: actor.heard)) == "killed"
