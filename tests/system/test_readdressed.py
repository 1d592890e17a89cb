"""Actors that a store, or a process, knows by their address are moved to another supervisor."""

from __future__ import annotations

import asyncio
import os
import signal
import time
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from tests.launched import kills_itself
from tests.system.test_transaction_commit import Die
from tests.system.trees import Add, Counter, Stumble, counter, ref

pytestmark = pytest.mark.usefixtures("warm_programs")

IN_TIME = 30.0
RECORDED = hf.hybrid(interval=900.0)


class Draw(hf.Message[float]): ...


class Know(hf.Message[bool]):
    """Keep the address, and watch whoever it is."""

    other: hf.ActorRef[Any]


class Pass(hf.Message[int]):
    """Ask whoever is known to add, and add the same."""

    n: int


class Fall(hf.Message):
    """It ends its process."""


class Hold(hf.Message[bool]):
    """Keep the whole process busy while a file is there, then speak of everything for the first time."""

    file: str
    friend: str


class Work(hf.Message):
    """Have something be computed beside."""


class Ends(hf.Message[list[str]]): ...


class Friend(Counter):
    """Draws, knows somebody by an address in its state, asks it in its turns, and is told of its end."""

    def __init__(self, start: int = 0) -> None:
        super().__init__(start)
        self.other = ""
        self.ends: list[str] = []
        self.drawn: list[float] = []

    @hf.on(Draw)
    def draw(self, message: Draw) -> float:
        self.drawn.append(self.ctx.random.random())
        return self.drawn[-1]

    @hf.on(Know)
    def know(self, message: Know) -> bool:
        self.other = message.other.path
        self.ctx.monitor(message.other)
        return True

    @hf.on(Pass)
    async def hand_on(self, message: Pass) -> int:
        self.count += message.n
        return int(await self.ctx.find(self.other, Friend).ask(Add(message.n), IN_TIME))

    @hf.on(Fall)
    def fall(self, message: Fall) -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    @hf.on(Hold)
    def hold(self, message: Hold) -> bool:
        Path(message.file).touch()
        while Path(message.file).exists():
            time.sleep(0.001)
        friend = self.ctx.find(message.friend, Friend)
        self.ctx.monitor(friend)
        self.ctx.link(friend)
        self.ctx.subscribe("/news")
        friend.tell(Add(1))
        return True

    @hf.on(Work)
    def work(self, message: Work) -> None:
        async def compute() -> int:
            await asyncio.sleep(0.1)
            return 40

        self.ctx.pipe_to_self(compute(), Add)

    @hf.on(Ends, readonly=True)
    def seen(self, message: Ends) -> list[str]:
        return self.ends

    def on_down(self, source: hf.ActorRef[Any], reason: hf.ExitReason, recovering: bool) -> None:
        self.ends.append(source.path)


def friend(name: str, **options: Any) -> hf.ChildSpec:
    return hf.child(name, hf.start(Friend), recovery=RECORDED, **options)


@asynccontextmanager
async def program(store: Path | str, isolation: Any = "task") -> AsyncGenerator[hf.ActorSystem]:
    """`here` has `one`, which knows nobody; `there` is where it goes; `friend` knows it."""
    async with hf.ActorSystem("app", store=f"sqlite:{store}", durability="os", log=False) as system:
        await system.start(hf.supervisor("here", intensity=99, children=[friend("one", isolation=isolation)]))
        await system.start(hf.supervisor("there", intensity=99, children=[friend("friend")]))
        await system.start(hf.supervisor("aside", children=[]))
        yield system


async def moved(system: hf.ActorSystem, to: str = "/app/there", *, of: str = "/app/here/one", then: Any = None) -> None:
    async with system.transaction(timeout=IN_TIME) as change:
        change.move(of, to)
        if then is not None:
            change.step(then)


BOTH = pytest.mark.parametrize("isolation", ["task", "process"])


@BOTH
async def test_what_is_recorded_of_it_comes_back_at_its_new_address(tmp_path: Path, isolation: Any) -> None:
    async with program(tmp_path / "store", isolation) as system:
        one = ref(system, "/app/here/one")
        assert await one.ask(Add(7)) == 7
        drawn = [await one.ask(Draw()) for _ in range(3)]
        await moved(system)
        assert one.path == "/app/there/one"
        assert await one.ask(Add(1)) == 8
        drawn += [await one.ask(Draw()) for _ in range(3)]
        one.kill()  # What it has drawn at its new address is drawn again.
        assert await one.ask(Add(1), IN_TIME) == 9
        assert await system.get_state(one) == {"count": 9, "other": "", "ends": [], "drawn": drawn}
    async with program(tmp_path / "store", isolation) as system:
        assert system._node.find("/app/there/one") is not None
        assert await ref(system, "/app/there/one").ask(Add(1)) == 10
        assert await ref(system, "/app/here/one").ask(Add(1)) == 11  # Who knows only its old address finds it.


@BOTH
async def test_it_knows_its_address_and_lives_on_in_its_process(tmp_path: Path, isolation: Any) -> None:
    async with program(tmp_path / "store", isolation) as system:
        one = ref(system, "/app/here/one")
        process, life = system.pid_of(one), one._cell.life
        for above in ("/app/there", "/app/here", "/app/there"):
            await moved(system, above, of=one.path)
            assert one.path == f"{above}/one"
            assert await one.ask(Know(one))
        assert (system.pid_of(one), one._cell.life) == (process, life)
        other = ref(system, "/app/there/friend")
        assert await other.ask(Know(one))
        assert await other.ask(Pass(5)) == 5


@BOTH
async def test_who_comes_to_live_at_an_address_that_was_left_has_a_journal_of_its_own(
    tmp_path: Path, isolation: Any
) -> None:
    async with program(tmp_path / "store", isolation) as system:
        assert await ref(system, "/app/here/one").ask(Add(7)) == 7
        async with system.transaction(timeout=IN_TIME) as change:
            change.move("/app/here/one", "/app/there")
            change.add("/app/here", friend("one"))
        assert await ref(system, "/app/here/one").ask(Add(100)) == 100
        assert await ref(system, "/app/there/one").ask(Add(1)) == 8
    for more in range(1, 3):
        async with program(tmp_path / "store", isolation) as system:
            assert await ref(system, "/app/here/one").ask(Add(1)) == 100 + more
            assert await ref(system, "/app/there/one").ask(Add(1)) == 8 + more
    async with program(tmp_path / "store", isolation) as system:
        async with system.transaction(timeout=IN_TIME) as change:
            change.remove("/app/there/one")
        await moved(system)
        assert await ref(system, "/app/there/one").ask(Add(1)) == 103
    async with program(tmp_path / "store", isolation) as system:
        assert await ref(system, "/app/there/one").ask(Add(1)) == 104


async def test_two_exchange_their_addresses(tmp_path: Path) -> None:
    for _ in range(2):
        async with program(tmp_path / "store") as system:
            if system._node.find("/app/there/one") is None:
                async with system.transaction(timeout=IN_TIME) as change:
                    change.add("/app/there", friend("one"))
                await ref(system, "/app/here/one").ask(Add(1))
                await ref(system, "/app/there/one").ask(Add(20))
            before = [await ref(system, f"/app/{at}/one").ask(Add(0)) for at in ("here", "there")]
            async with system.transaction(timeout=IN_TIME) as change:
                change.move("/app/here/one", "/app/aside")
                change.move("/app/there/one", "/app/here")
                change.move("/app/aside/one", "/app/there")
            after = [await ref(system, f"/app/{at}/one").ask(Add(0)) for at in ("here", "there")]
            assert after == before[::-1]
    async with program(tmp_path / "store") as system:
        assert [await ref(system, f"/app/{at}/one").ask(Add(0)) for at in ("here", "there")] == [1, 20]


@BOTH
async def test_who_knows_it_by_its_old_address_still_does_behind_a_restart_of_the_root(
    tmp_path: Path, isolation: Any
) -> None:
    async with program(tmp_path / "store", isolation) as system:
        other = ref(system, "/app/there/friend")
        assert await other.ask(Know(ref(system, "/app/here/one")))
        assert await other.ask(Pass(1)) == 1
        await moved(system)
        assert await other.ask(Pass(1)) == 2
        other.kill()  # It asks nobody twice.
        assert await other.ask(Add(0), IN_TIME) == 2
        assert await ref(system, "/app/there/one").ask(Add(0)) == 2
    async with program(tmp_path / "store", isolation) as system:
        other = ref(system, "/app/there/friend")
        assert await other.ask(Pass(1)) == 3
        async with system.transaction(timeout=IN_TIME) as change:
            change.remove("/app/there/one")
        async with asyncio.timeout(IN_TIME):
            while await other.ask(Ends()) != ["/app/there/one"]:
                await asyncio.sleep(0.005)


async def test_what_is_in_quarantine_goes_with_it(tmp_path: Path) -> None:
    method = hf.hybrid(interval=900.0, max_deliveries=1)
    spec = hf.child("one", hf.start(Friend), recovery=method, isolation="process")
    for root in range(2):
        async with hf.ActorSystem("app", store=f"sqlite:{tmp_path / 'store'}", durability="os", log=False) as system:
            await system.start(hf.supervisor("here", intensity=99, children=[spec]))
            await system.start(hf.supervisor("there", intensity=99, children=[]))
            if not root:
                one = ref(system, "/app/here/one")
                one.tell(Fall())
                async with asyncio.timeout(IN_TIME):
                    while not system.quarantined(one):
                        await asyncio.sleep(0.005)
                await one.ask(Add(0), IN_TIME)
                await moved(system)
            (held,) = system.quarantined(ref(system, "/app/there/one"))
            assert (held.address, held.message) == ("/app/there/one", Fall())
            assert len(system.quarantined()) == 1


async def test_the_children_of_a_dynamic_supervisor_are_known_where_it_is_now(tmp_path: Path) -> None:
    for root in range(3):
        async with hf.ActorSystem("app", store=f"sqlite:{tmp_path / 'store'}", durability="os", log=False) as system:
            await system.start(
                hf.supervisor("here", intensity=99, children=[hf.dynamic("pool", intensity=9, journal=True)])
            )
            await system.start(hf.supervisor("there", intensity=99, children=[]))
            if not root:
                await ref(system, "/app/here/pool").ask(hf.StartChild(friend("f")))
                await ref(system, "/app/here/pool/f").ask(Add(5))
                await moved(system, of="/app/here/pool")
            assert await ref(system, "/app/there/pool/f").ask(Add(1)) == 6 + root


@BOTH
async def test_its_code_and_its_state_are_replaced_as_it_goes(tmp_path: Path, isolation: Any) -> None:
    async with program(tmp_path / "store", isolation) as system:
        one = ref(system, "/app/here/one")
        assert await one.ask(Add(7)) == 7
        async with system.transaction(timeout=IN_TIME) as change:
            change.replace_state(one, more)
            change.move(one, "/app/there")
        assert await one.ask(Add(1)) == 1008
        one.kill()
        assert await one.ask(Add(1), IN_TIME) == 1009
    async with program(tmp_path / "store", isolation) as system:
        assert await ref(system, "/app/there/one").ask(Add(1)) == 1010


def more(state: dict[str, Any]) -> dict[str, Any]:
    return {**state, "count": state["count"] + 1000}


@BOTH
async def test_a_move_that_is_given_up_leaves_it_at_work(tmp_path: Path, isolation: Any) -> None:
    async with program(tmp_path / "store", isolation) as system:
        one = ref(system, "/app/here/one")
        for number in range(3):
            with pytest.raises(hf.TransactionFailed, match="there was a stone"):
                await moved(system, then=Stumble())
            assert one.path == "/app/here/one"
            assert await one.ask(Add(1)) == number + 1
        await moved(system)
        assert await one.ask(Add(1)) == 4


async def test_it_waits_for_nobody_who_waits_for_it(tmp_path: Path) -> None:
    """A recorded actor asks it again and again: it is moved between two of these asks, and none is lost."""
    async with program(tmp_path / "store") as system:
        other, one = ref(system, "/app/there/friend"), ref(system, "/app/here/one")
        assert await other.ask(Know(one))
        answers: list[int] = []

        async def asking() -> None:
            for _ in range(200):
                answers.append(await other.ask(Pass(1), IN_TIME))
                await asyncio.sleep(0.002)

        task = asyncio.ensure_future(asking())
        await moved(system)
        assert one.path == "/app/there/one"
        await task
        assert answers == list(range(1, 201))


async def test_it_answers_whoever_asks_while_it_rests(tmp_path: Path) -> None:
    """What the other one has sent has to be saved before addresses change, and its turn ends with this answer only."""
    async with program(tmp_path / "store") as system:
        other, one = ref(system, "/app/there/friend"), ref(system, "/app/here/one")
        assert await other.ask(Know(one))
        await moved(system, "/app/aside")  # All that was sent is saved now, so it can rest at once.
        asked: list[asyncio.Future[int]] = []

        async def ask(system: hf.ActorSystem) -> None:
            asked.append(asyncio.ensure_future(other.ask(Pass(1), IN_TIME)))
            while (await system.get_status(other)).turn is None:
                assert not asked[0].done(), "it did not rest"
                await asyncio.sleep(0.001)

        await moved(system, of="/app/aside/one", then=Stumble(ask))
        assert one.path == "/app/there/one"
        assert await asked[0] == 1


async def test_it_goes_past_recorded_actors_that_are_suspended(tmp_path: Path) -> None:
    async with program(tmp_path / "store") as system:
        one, other = ref(system, "/app/here/one"), ref(system, "/app/there/friend")
        assert await other.ask(Know(one))
        assert await other.ask(Pass(1)) == 1
        for suspended in (other, one):
            await system.suspend(suspended)
        await moved(system)
        waiting = one.ask(Add(1), IN_TIME)
        await system.resume(other)
        assert (await system.get_status(one)).state == "suspended"
        await system.resume(one)
        assert await waiting == 2


async def test_it_waits_for_the_background_work_of_the_actor(tmp_path: Path) -> None:
    async with program(tmp_path / "store") as system:
        one = ref(system, "/app/here/one")
        await one.ask(Work())
        moving = asyncio.ensure_future(moved(system))
        async with asyncio.timeout(IN_TIME):
            while await one.ask(Add(0)) != 40:
                await asyncio.sleep(0.005)
        await moving
        assert await one.ask(Add(1)) == 41


async def test_it_has_moved_though_the_store_has_refused_to_note_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with program(tmp_path / "store") as system:
        one = ref(system, "/app/here/one")
        assert await one.ask(Add(7)) == 7

        def refuse(names: Any) -> None:
            raise hf.HoldfastError("the disk is gone")

        with monkeypatch.context() as broken, system.events() as events:
            broken.setattr(system._homes.addresses, "moved", refuse)
            await moved(system)
            (event,) = (event for event in events.take() if isinstance(event, hf.events.TransactionCommitted))
        assert "the disk is gone" in event.problems[0]
        assert await one.ask(Add(1)) == 8
        one.kill()
        assert await ref(system, "/app/there/one").ask(Add(1), IN_TIME) == 9


async def test_without_snapshots_all_turns_would_be_repeated_under_another_address(tmp_path: Path) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        spec = hf.child("one", hf.start(Friend), recovery=hf.replay_only())
        await system.start(hf.supervisor("here", children=[spec]))
        await system.start(hf.supervisor("there", children=[]))
        with pytest.raises(hf.TransactionRefused, match=r"takes no snapshots.*use hybrid"):
            await moved(system)


@pytest.mark.parametrize("recovery", [None, RECORDED])
async def test_what_a_process_says_before_it_has_heard_of_its_address_is_meant_so(
    tmp_path: Path, recovery: Any
) -> None:
    file = tmp_path / "busy"
    async with hf.ActorSystem("app", log=False) as system:
        spec = hf.child("one", hf.start(Friend), recovery=recovery, isolation="process")
        await system.start(hf.supervisor("here", children=[spec]))
        await system.start(hf.supervisor("there", children=[hf.child("friend", hf.start(Friend))]))
        one, other = ref(system, "/app/here/one"), ref(system, "/app/there/friend")
        process = system.pid_of(one)
        with system.events() as events:
            held = one.ask(Hold(str(file), other.path), IN_TIME)
            async with asyncio.timeout(IN_TIME):
                while not file.exists():
                    await asyncio.sleep(0.005)
            moving = asyncio.ensure_future(moved(system))
            if recovery is None:
                await moving
                assert one.path == "/app/there/one"
                async with system.transaction(timeout=IN_TIME) as change:  # Nobody else is taken for it.
                    change.add("/app/here", counter("one", 50))
            file.unlink()
            assert await held
            await moving
            assert await other.ask(Add(0)) == 1
            (watch,) = other._cell.extra().ties.monitors
            assert watch.watcher is one._cell
            assert list(other._cell.extra().ties.links) == [one._cell]
            assert not [event for event in events.take() if isinstance(event, hf.events.TrustBreached)]
        assert system.pid_of(one) == process
        assert await one.ask(Add(1)) == 1


# -- killed meanwhile -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(8))
async def test_a_process_that_is_killed_at_any_instant_of_the_move_loses_nothing(tmp_path: Path, seed: int) -> None:
    async with program(tmp_path / "store", "process") as system:
        one = ref(system, "/app/here/one")
        answers = [await one.ask(Add(1))]
        moving = asyncio.ensure_future(moved(system))
        for _ in range(seed * 6):
            await asyncio.sleep(0)
        os.kill(system.pid_of(one), signal.SIGKILL)
        answers.append(await one.ask(Add(1), IN_TIME))
        await moving
        answers.append(await one.ask(Add(1), IN_TIME))
        assert answers == [1, 2, 3]
        assert one.path == "/app/there/one"


async def killed(store: str, when: str, isolation: str) -> None:
    """The root is killed by a step in the middle of the move."""
    async with program(store, isolation) as system:
        await ref(system, "/app/here/one").ask(Add(7))
        await ref(system, "/app/there/friend").ask(Know(ref(system, "/app/here/one")))
        async with system.transaction(timeout=IN_TIME) as change:
            if when == "finish":
                change.step(Die(when))
            change.move("/app/here/one", "/app/there")
            change.step(Die(when))


PROGRAM = """
import asyncio, sys
from tests.system.test_readdressed import killed


if __name__ == "__main__":
    asyncio.run(killed(*sys.argv[1:]))
"""


@BOTH
@pytest.mark.parametrize("when", ["prepare", "commit", "finish"])
async def test_a_root_that_is_killed_has_it_at_one_of_the_two_with_its_state(
    tmp_path: Path, when: str, isolation: str
) -> None:
    (tmp_path / "program.py").write_text(PROGRAM)
    await kills_itself(tmp_path / "program.py", tmp_path / "store", when, isolation)
    async with program(tmp_path / "store", isolation) as system:
        at, empty = ("there", "here") if when == "finish" else ("here", "there")
        assert "one" in (ref(system, f"/app/{at}")._cell.children or {})
        assert "one" not in (ref(system, f"/app/{empty}")._cell.children or {})
        assert await ref(system, f"/app/{at}/one").ask(Add(1)) == 8
        assert await ref(system, "/app/there/friend").ask(Pass(1)) == 9
