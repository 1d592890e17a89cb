"""Messages that kill again and again are kept outside the actor, until somebody decides (T16, R45)."""

from __future__ import annotations

from pathlib import Path

import pytest

import holdfast as hf
from holdfast.checkpoint.inputs import Batch
from tests.checkpoint.players import Do, Doer, Note, Seen, Sink, start

RECOVERY = hf.hybrid(interval=1000.0, max_deliveries=2)


@pytest.fixture(params=["process", "subtree"])
def isolation(request: pytest.FixtureRequest) -> str:
    return str(request.param)  # In the process of the test nobody can die of a message but the test.


async def poisoned(system: hf.ActorSystem, isolation: str, deaths: Path) -> hf.ActorRef[Doer]:
    """An actor that has put aside one message of two steps, and has handled another before and behind it."""
    doer = await start(system, isolation, "doer", hf.start(Doer), recovery=RECOVERY)
    await doer.ask(Do(["add before"]))
    with pytest.raises(hf.Quarantined):
        await doer.ask(Do(["add poison", f"die {deaths}"]), timeout=30.0)
    await doer.ask(Do(["add behind"]), timeout=30.0)
    return doer


def running(store: str | None) -> hf.ActorSystem:
    return hf.ActorSystem("app", log=False, intensity=1000, store=store)


async def test_what_kills_again_and_again_is_listed_with_how_often_and_since_when(
    isolation: str, store: str | None, tmp_path: Path
) -> None:
    async with running(store) as system:
        system._node.clock.wall = lambda: 1234.5
        doer = await poisoned(system, isolation, tmp_path / "deaths")
        (one,) = system.quarantined()
        assert one == system.quarantined(doer)[0] == system.quarantined(doer.path)[0]
        assert (one.address, one.attempts, one.since, one.sender, one.kind) == (doer.path, 2, 1234.5, None, "message")
        assert isinstance(one.message, Do)
        assert one.message.steps[0] == "add poison"
        assert system.quarantined("/app/other") == []
        assert await doer.ask(Seen()) == ["before", "behind"]


async def test_a_second_try_is_handled_once_or_put_aside_again(
    isolation: str, store: str | None, tmp_path: Path
) -> None:
    async with running(store) as system:
        doer = await start(system, isolation, "doer", hf.start(Doer), recovery=RECOVERY)
        sink = system.spawn(hf.start(Sink), "sink")
        bad = Do([f"die {tmp_path / 'deaths'}"])
        with pytest.raises(hf.Quarantined):
            await doer.ask(bad, timeout=30.0)
        (one,) = system.quarantined()
        system.retry(one)
        with pytest.raises(hf.errors.NotQuarantined):
            system.retry(one)
        await doer.ask(Do(["add next"], sink), timeout=30.0)
        (again,) = system.quarantined()
        assert again.attempts == 2
        assert again.id > one.id
        assert (tmp_path / "deaths").read_text() == "xxxx"
        with system.events() as letters:
            system.drop(again)
            assert system.quarantined() == []
            await system._homes.settled()
        assert [type(one.message) for one in letters.take() if isinstance(one, hf.events.DeadLetter)] == [Do]


async def test_a_second_try_that_goes_well_is_an_ordinary_message(isolation: str, tmp_path: Path) -> None:
    store = f"sqlite:{tmp_path / 'app.db'}"
    async with running(store) as system:
        doer = await start(
            system, isolation, "doer", hf.start(Doer), recovery=hf.hybrid(interval=1000.0, max_deliveries=1)
        )
        with pytest.raises(hf.Quarantined):
            await doer.ask(Do([f"once {tmp_path / 'fuse'}", "add mended"]), timeout=30.0)
        system.retry(system.quarantined(doer)[0])
        assert await doer.ask(Note("last"), timeout=30.0) == 2
    async with running(store) as system:  # All of it is replayed as it was.
        doer = await start(
            system, isolation, "doer", hf.start(Doer), recovery=hf.hybrid(interval=1000.0, max_deliveries=1)
        )
        assert await doer.ask(Seen(), timeout=30.0) == ["mended", "last"]
        assert system.quarantined() == []


async def test_it_survives_restarts_of_the_root_and_so_does_its_end(isolation: str, tmp_path: Path) -> None:
    store = f"sqlite:{tmp_path / 'app.db'}"
    async with running(store) as system:
        await poisoned(system, isolation, tmp_path / "deaths")
        before = system.quarantined()
    async with running(store) as system:
        (one,) = system.quarantined()
        assert isinstance(one.message, hf.Message) is False  # Its class is not known before its actor is.
        with pytest.raises(hf.errors.NoSuchActor):
            system.retry(one)
        doer = await start(system, isolation, "doer", hf.start(Doer), recovery=RECOVERY)
        assert system.quarantined() == before
        assert await doer.ask(Seen(), timeout=30.0) == ["before", "behind"]
        system.drop(one)
    async with running(store) as system:
        assert system.quarantined() == []


async def test_it_goes_with_what_is_erased(tmp_path: Path) -> None:
    store = f"sqlite:{tmp_path / 'app.db'}"
    async with running(store) as system:
        await poisoned(system, "process", tmp_path / "deaths")
    async with running(store) as system:
        await system.start(hf.child("doer", hf.start(Doer), isolation="process", recovery=RECOVERY), fresh=True)
        assert system.quarantined() == []


async def test_many_that_have_come_and_gone_take_no_room(tmp_path: Path) -> None:
    store = f"sqlite:{tmp_path / 'app.db'}"
    async with running(store) as system:
        doer = await poisoned(system, "process", tmp_path / "deaths")
        home = system._homes.at(doer.path)
        assert home is not None
        (first,) = system.quarantined()
        for _ in range(150):
            system._homes.quarantine.hold(home, home.record("message", "x:Y", b"", None), batch := Batch())
            batch.commit(home.journal)
            system.drop(system.quarantined()[1])
            await system._homes.settled()
        assert len(system._homes.journal.load("quarantine").entries) < 200
        assert system.quarantined() == [first]
    async with running(store) as system:
        assert len(system.quarantined()) == 1
