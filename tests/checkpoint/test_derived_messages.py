"""A handler takes what derives from its message, too: wherever its actor lives, and when a journal is read again."""

import asyncio
import json
from pathlib import Path
from typing import Any, cast

import pytest

import holdfast as hf
from tests.checkpoint import derived_player
from tests.checkpoint.derived_player import NOTICES, ORDERS, Clerk, Express, Gather, Ledger, Show
from tests.launched import kills_itself, python

pytestmark = pytest.mark.usefixtures("warm_programs")

SHOWN = [repr(order) for order in ORDERS]
PLACES: dict[str, dict[str, Any]] = {
    "task": {},
    "process": {"isolation": "process"},
    "recorded": {"recovery": hf.hybrid()},
    "recorded process": {"recovery": hf.hybrid(), "isolation": "process"},
    "protected": {"recovery": hf.hybrid(), "mechanism": hf.ftm.PBR()},
    "repeated": {"recovery": hf.hybrid(), "mechanism": hf.ftm.TR()},
}


@pytest.mark.parametrize("place", PLACES)
async def test_what_derives_is_handled(place: str) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        ledger = await system.start(hf.child("ledger", hf.start(Ledger), **PLACES[place]))
        for number, order in enumerate(ORDERS, 1):
            assert await ledger.ask(order) == number
        assert await ledger.ask(Show()) == SHOWN
        ledger.tell(ORDERS[1])
        await ledger.send(ORDERS[2])
        assert await ledger.ask(Show()) == [*SHOWN, *SHOWN[1:]]


@pytest.mark.parametrize("when", ["before", "meanwhile"])
@pytest.mark.parametrize("place", [place for place, options in PLACES.items() if "recovery" in options])
async def test_what_derives_is_waited_for(place: str, when: str) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        clerk = await system.start(hf.child("clerk", hf.start(Clerk), **PLACES[place]))
        gathered = asyncio.ensure_future(clerk.ask(Gather(len(NOTICES)), timeout=60.0))
        await system.get_status(clerk)  # Behind the ask.
        if when == "before":  # The clerk comes to them one after another.
            for notice in NOTICES:
                clerk.tell(notice)
        else:
            for notice in NOTICES:
                while "wait_for" not in (await system.get_status(clerk)).turn_at:
                    await asyncio.sleep(0)
                await clerk.ask(notice, timeout=60.0)
                clerk.kill()
        assert await gathered == [repr(notice) for notice in NOTICES]


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_what_derives_moves_in_the_mailbox(isolation: Any) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        ledger = await system.start(hf.child("ledger", hf.start(Ledger), isolation=isolation))
        await system.suspend(ledger)
        for order in ORDERS:
            ledger.tell(order)
        await system.set_isolation(ledger, "process" if isolation == "task" else "task")
        await system.resume(ledger)
        assert await ledger.ask(Show()) == SHOWN


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_the_next_program_reads_what_derives(isolation: str, tmp_path: Path) -> None:
    store = tmp_path / "app.db"
    await kills_itself(derived_player.__file__, store, isolation, "killed")
    again = await python(derived_player.__file__, store, isolation, "read")
    assert again.returncode == 0, again.stderr
    assert json.loads(again.stdout) == SHOWN


@pytest.mark.parametrize("place", PLACES)
async def test_what_is_of_no_class_that_is_handled_is_refused(place: str) -> None:
    class Strange(hf.Message[int]):
        number: int

    async with hf.ActorSystem("app", log=False) as system:
        ledger = await system.start(hf.child("ledger", hf.start(Ledger), **PLACES[place]))
        await ledger.ask(ORDERS[1])
        strange, wrong = cast("Any", Strange(1)), Express(cast("Any", "two"), "air")
        with pytest.raises(hf.UnknownMessage, match=r"^/app/ledger has no handler for .*Strange"):
            await ledger.ask(strange)
        if place != "task":
            with pytest.raises(hf.errors.BadMessage, match=r"Express to /app/ledger: Expected `int`, got `str`"):
                await ledger.ask(wrong)
        await asyncio.wait_for(ledger.ask(Express(4, "sea")), 10)
