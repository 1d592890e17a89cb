"""Below a supervisor with a process of its own a child has the name of its spec, too: in each life, until each end."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import AsyncIterator, Awaitable
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.kernel.cell import Cell
from tests.control.players import Account, Add, Crash, Total

RECORDED: dict[str, Any] = {"recovery": hf.hybrid(interval=3600.0)}
PLACES: dict[str, tuple[str, dict[str, Any]]] = {
    "task": ("far", {}),
    "recorded task": ("far", RECORDED),
    "process": ("far", {"isolation": "process"}),
    "recorded process": ("far", {**RECORDED, "isolation": "process"}),
    "protected": ("far", {"mechanism": hf.ftm.PBR()}),
    "task, two deep": ("far/mid", {}),
    "recorded task, two deep": ("far/mid", RECORDED),
    "process, two deep": ("far/mid", {"isolation": "process"}),
}
"""Where a child lives: below which supervisor, and how."""


class Where(hf.Message[int]): ...


class Clerk(Account):
    @hf.on(Where, readonly=True)
    def where(self, message: Where) -> int:
        return os.getpid()


def clerk(id: str = "one", **options: Any) -> hf.ChildSpec[Clerk]:
    return hf.child(id, hf.start(Clerk), register="bank", **options)


def trees(place: str) -> list[hf.ChildSpec[Any]]:
    """A tree whose child lives at a place, and other supervisors that have none."""
    above, options = PLACES[place]
    spec = clerk(**options)
    mid = hf.supervisor("mid", intensity=1000, children=[spec] if above == "far/mid" else [])
    far = [mid] if above == "far/mid" else [mid, spec]
    return [
        hf.supervisor("far", intensity=1000, isolation="process", children=far),
        hf.supervisor("away", intensity=1000, isolation="process"),
        hf.supervisor("near", intensity=1000),
    ]


@pytest.fixture
async def system() -> AsyncIterator[hf.ActorSystem]:
    async with hf.ActorSystem("app", log=False, intensity=1000) as running:
        yield running


async def by_name(system: hf.ActorSystem) -> hf.ActorRef[Clerk]:
    """Whoever has the name, once somebody has it and answers: between two lives nobody does."""
    async with asyncio.timeout(30.0):
        while True:
            try:
                ref: hf.ActorRef[Clerk] = system.whereis("bank")
                await ref.ask(Total(), 20)
            except (hf.errors.NoSuchActor, hf.ActorStopped, hf.AskFailed):
                await asyncio.sleep(0.005)
            else:
                return ref


async def has_it(system: hf.ActorSystem, path: str) -> int:
    """Who lives at an address has the name, and answers by it; returns its process."""
    one = await by_name(system)
    assert one.path == path
    return await one.ask(Where(), 20)


def is_free(system: hf.ActorSystem) -> None:
    with pytest.raises(hf.errors.NoSuchActor):
        system.whereis("bank")


def supervisor(system: hf.ActorSystem, above: str) -> hf.ActorRef[hf.Supervisor]:
    return system.ref(f"/app/{above}", hf.Supervisor)


async def killed(system: hf.ActorSystem, pid: int) -> None:
    """Kill a process, and wait until the root knows of its end."""
    with system.events() as events:
        os.kill(pid, signal.SIGKILL)
        async for event in events:
            if isinstance(event, hf.events.ProcessDied) and event.pid == pid:
                return


async def begun(system: hf.ActorSystem, place: str) -> str:
    """The tree runs; returns the address of the child that has the name."""
    for spec in trees(place):
        await system.start(spec)
    path = f"/app/{PLACES[place][0]}/one"
    assert await has_it(system, path)
    return path


@pytest.mark.parametrize("place", PLACES)
async def test_each_life_has_the_name_whatever_the_last_one_has_ended_by(system: hf.ActorSystem, place: str) -> None:
    path = await begun(system, place)
    above, options = PLACES[place]
    one = system.whereis("bank")
    with pytest.raises(hf.RemoteCrash):
        await one.ask(Crash(), 20)
    await has_it(system, path)
    one.kill()
    pid = await has_it(system, path)
    far = system.pid_of(supervisor(system, "far"))
    if "isolation" in options:
        await killed(system, pid)
        assert await has_it(system, path) != pid
    await killed(system, far)
    await has_it(system, path)
    await supervisor(system, above).ask(hf.TerminateChild("one"), 20)
    is_free(system)
    await supervisor(system, above).ask(hf.RestartChild("one"), 20)
    await has_it(system, path)
    if "mechanism" not in options:  # A group masks the crash of a replica: its life goes on.
        system.register("till", system.whereis("bank"))  # Given to one life.
        with pytest.raises(hf.RemoteCrash):
            await system.whereis("till").ask(Crash(), 20)
        await has_it(system, path)
        with pytest.raises(hf.errors.NoSuchActor):
            system.whereis("till")
    await system.stop(supervisor(system, "far"))
    is_free(system)


@pytest.mark.parametrize("place", ["task", "recorded task", "process"])
async def test_a_name_has_one_holder_wherever_others_want_it(system: hf.ActorSystem, place: str) -> None:
    path = await begun(system, place)
    options = PLACES[place][1]
    taken = f"{path} is registered as 'bank' already; free the name, or say another one"
    for above in ("near", "away", "far"):
        with pytest.raises(hf.StartFailed, match=taken):
            await supervisor(system, above).ask(hf.StartChild(clerk("two", **options)), 20)
        assert f"/app/{above}/two" not in system.tree()
    assert await has_it(system, path)
    system.unregister("bank")
    await supervisor(system, "away").ask(hf.StartChild(clerk("two", **options)), 20)
    with system.events() as events:
        system.ref(path).kill()  # Its next lives find the name taken: it is tried again, and counts.
        async for event in events:
            if isinstance(event, hf.events.ChildStartFailed):
                assert "/app/away/two is registered as 'bank' already" in event.reason
                break
    assert await has_it(system, "/app/away/two")
    await supervisor(system, "away").ask(hf.TerminateChild("two"), 20)
    assert await has_it(system, path)


async def test_a_name_ends_with_the_process(system: hf.ActorSystem) -> None:
    far = hf.supervisor("far", intensity=1000, isolation="process", restart="temporary", children=[clerk()])
    await system.start(far)
    await killed(system, system.pid_of(supervisor(system, "far")))
    is_free(system)
    await system.start(clerk())
    await has_it(system, "/app/one")


class Fails(hf.Actor):
    def __init__(self) -> None:
        raise ValueError("no")


class FailsLater(hf.Actor):
    async def on_start(self, restored: bool) -> None:
        raise ValueError("no")


@pytest.mark.parametrize("place", ["task", "recorded task", "process"])
async def test_a_start_that_fails_leaves_the_name_free(system: hf.ActorSystem, place: str) -> None:
    far = await system.start(hf.supervisor("far", intensity=1000, isolation="process"))
    for kind in (Fails, FailsLater):
        bad = hf.child("bad", hf.start(kind), register="bank", **PLACES[place][1])
        with pytest.raises(hf.StartFailed, match="no"):
            await far.ask(hf.StartChild(bad), 20)
        is_free(system)
    await far.ask(hf.StartChild(clerk(**PLACES[place][1])), 20)
    await has_it(system, "/app/far/one")


class Found(hf.Message[str]): ...


class Looks(hf.Actor):
    """Lives at the root, and asks whoever has the name when it is told to."""

    def __init__(self) -> None:
        self.found = ""

    @hf.on(Found)
    def look(self, message: Found) -> str:
        named = self.ctx._cell.node.names.get("bank")
        return "" if named is None else named.path


class Early(Clerk):
    async def on_start(self, restored: bool) -> None:
        self.found = await self.ctx.find("/app/looks", Looks).ask(Found())

    @hf.on(Found)
    def tell(self, message: Found) -> str:
        return self.found


@pytest.mark.parametrize("place", ["task", "recorded task"])
async def test_who_finds_it_is_as_its_spec_says(system: hf.ActorSystem, place: str) -> None:
    far = await system.start(hf.supervisor("far", intensity=1000, isolation="process"))
    options, kind = PLACES[place][1], hf.start(Clerk)
    await far.ask(hf.StartChild(hf.child("one", kind, register="one", scope="fleet", **options)), 20)
    await far.ask(hf.StartChild(hf.child("two", kind, register="two", **options)), 20)
    assert system._node.shown("one").path == "/app/far/one"
    with pytest.raises(hf.errors.NoSuchActor):
        system._node.shown("two")
    assert system.whereis("two").path == "/app/far/two"


@pytest.mark.parametrize("place", ["task", "recorded task", "process"])
async def test_it_has_the_name_when_it_starts(system: hf.ActorSystem, place: str) -> None:
    system.spawn(hf.start(Looks), "looks")
    far = await system.start(hf.supervisor("far", intensity=1000, isolation="process"))
    await far.ask(hf.StartChild(hf.child("one", hf.start(Early), register="bank", **PLACES[place][1])), 20)
    assert await system.ref("/app/far/one", Early).ask(Found(), 20) == "/app/far/one"
    system.ref("/app/far/one").kill()
    await has_it(system, "/app/far/one")
    assert await system.ref("/app/far/one", Early).ask(Found(), 20) == "/app/far/one"


@pytest.mark.parametrize("place", ["task", "recorded task", "process", "protected"])
async def test_the_name_goes_along_to_other_supervisors_and_back(system: hf.ActorSystem, place: str) -> None:
    path = await begun(system, place)
    for above in ("away", "near", "far"):
        async with system.transaction() as change:
            change.move(path, f"/app/{above}")
        path = f"/app/{above}/one"
        assert system.whereis("bank").path == path
        await has_it(system, path)
        system.whereis("bank").kill()
        await has_it(system, path)
    await killed(system, system.pid_of(supervisor(system, "far")))
    await has_it(system, path)


@pytest.mark.parametrize("place", ["task", "recorded task"])
async def test_the_name_stays_when_what_protects_its_actor_changes(system: hf.ActorSystem, place: str) -> None:
    path = await begun(system, place)
    for mechanism in (hf.ftm.PBR(), None):
        async with system.transaction() as change:
            change.protect(path, mechanism)
        assert system.whereis("bank").path == path
        system.whereis("bank").kill()
        await has_it(system, path)


@pytest.mark.parametrize("options", [{}, RECORDED], ids=["task", "recorded task"])
async def test_the_name_goes_along_with_its_supervisor(system: hf.ActorSystem, options: dict[str, Any]) -> None:
    top = await system.start(hf.supervisor("top", intensity=1000, children=[clerk(**options)]))
    for isolation in ("process", "task"):
        await system.set_isolation(top, isolation)
        assert system.whereis("bank").path == "/app/top/one"
        await has_it(system, "/app/top/one")
        system.whereis("bank").kill()
        pid = await has_it(system, "/app/top/one")
        assert (pid == os.getpid()) == (isolation == "task")


class Ready(Clerk):
    """Does not start while there is a file."""

    def __init__(self, path: str) -> None:
        super().__init__()
        self._path = path

    async def on_start(self, restored: bool) -> None:
        if Path(self._path).exists():
            raise ValueError("not yet")


@pytest.mark.parametrize("place", ["task", "recorded task", "process", "recorded process"])
@pytest.mark.parametrize("fails", [False, True], ids=["has ended", "has failed to start"])
async def test_nobody_has_it_between_two_lives(system: hf.ActorSystem, place: str, fails: bool, tmp_path: Path) -> None:
    gate, far = tmp_path / "gate", await system.start(hf.supervisor("far", intensity=1000, isolation="process"))
    waits = hf.Backoff(0.01, 3600.0, factor=360_000.0) if fails else hf.Backoff(3600.0, 3600.0)
    spec = hf.child("one", hf.start(Ready, str(gate)), register="bank", backoff=waits, **PLACES[place][1])
    await far.ask(hf.StartChild(spec), 20)
    await has_it(system, "/app/far/one")
    gate.touch()
    with system.events() as events:
        with pytest.raises(hf.RemoteCrash):
            await system.whereis("bank").ask(Crash(), 20)
        async for event in events:
            if isinstance(event, hf.events.ChildStartFailed if fails else hf.events.ChildTerminated):
                break
    await far.ask(hf.WhichChildren(), 20)  # Its answer comes behind all that it has said.
    is_free(system)


class Sending(dict[str, Cell]):
    """Sends to whoever gets a name, at that very instant."""

    asked: Awaitable[int]

    def __setitem__(self, name: str, cell: Cell) -> None:
        super().__setitem__(name, cell)
        self.asked = cell.ref.ask(Add(5), 20)


async def test_what_is_sent_by_the_name_at_once_waits_for_the_start(system: hf.ActorSystem) -> None:
    """The root has given the name, and the process has not heard so yet."""
    names = system._node.names = Sending()
    far = await system.start(hf.supervisor("far", intensity=1000, isolation="process"))
    await far.ask(hf.StartChild(clerk()), 20)
    assert await names.asked == 5


async def test_transactions_know_of_it(system: hf.ActorSystem) -> None:
    await system.start(hf.supervisor("far", intensity=1000, isolation="process"))
    async with system.transaction() as change:
        change.add("/app/far", clerk())
    assert await has_it(system, "/app/far/one")

    async def add(spec: hf.ChildSpec[Any]) -> None:
        async with system.transaction() as change:
            change.add("/app/far", spec)

    for spec in (clerk("two"), hf.supervisor("mid", children=[clerk("two")])):
        with pytest.raises(hf.TransactionRefused, match="bank exists already"):
            await add(spec)
    assert await has_it(system, "/app/far/one")


async def test_a_program_that_begins_again_gives_the_names_anew(tmp_path: Path) -> None:
    store = f"sqlite:{tmp_path / 'names.db'}"
    books = hf.dynamic("books", isolation="process", journal=True)
    async with hf.ActorSystem("app", log=False, store=store, intensity=1000) as system:
        far = await system.start(books)
        await far.ask(hf.StartChild(clerk(**RECORDED)), 20)
        assert await system.whereis("bank").ask(Add(3), 20) == 3
    async with hf.ActorSystem("app", log=False, store=store, intensity=1000) as system:
        await system.start(books)
        one = await by_name(system)
        assert (one.path, await one.ask(Total(), 20)) == ("/app/books/one", 3)
