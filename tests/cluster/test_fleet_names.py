"""Names that other systems and clients find: one holder at a time, whoever leads."""

from __future__ import annotations

import asyncio

import pytest

import holdfast as hf
from holdfast.actors.errors import NameTaken, NoSuchActor
from tests.cluster.reach import Account, Add, Reach, Total, run


class Ear(hf.Actor):
    """Hears of the end of whoever has a name."""

    def __init__(self, heard: list[str]) -> None:
        self._heard = heard

    @hf.on(Add)
    async def listen(self, message: Add) -> int:
        return message.amount

    def on_down(self, source: hf.ActorRef[hf.Actor], reason: hf.ExitReason, recovering: bool) -> None:
        self._heard.append(source.path)


def test_other_systems_and_clients_find_an_actor_by_its_name_while_it_has_it() -> None:
    async def work(reach: Reach) -> None:
        async with reach.bank() as system, hf.connect("bank") as bank:
            spec = hf.child("teller", hf.start(Account), register="teller", scope="fleet")
            teller = await system.start(spec)
            found = await bank.whereis("teller", Account)
            assert found.path == teller.path
            assert await found.ask(Add(3)) == 3
            system.register("inside", teller)
            for unknown in ("inside", "nobody"):
                with pytest.raises(NoSuchActor, match=unknown):
                    await bank.whereis(unknown)
            system.register("inside", teller, scope="fleet")
            assert (await bank.whereis("inside")).path == teller.path
            with pytest.raises(NameTaken):
                system.register("teller", system.ref("/bank/plain"), scope="fleet")
            with pytest.raises(hf.StartFailed, match="/bank/teller is registered as 'teller' already"):
                await system.start(hf.child("other", hf.start(Account), register="teller", scope="fleet"))
            teller.kill()
            assert await found.ask(Total(), timeout=60.0) == 0  # Its next life.
            assert (await bank.whereis("teller")).path == teller.path
            with pytest.raises(NoSuchActor):
                await bank.whereis("inside")  # It was given to the life that has ended.
            await system.stop(teller)
            with pytest.raises(NoSuchActor, match="teller"):
                await bank.whereis("teller")
            await system.start(hf.child("other", hf.start(Account), register="teller", scope="fleet"))
            assert (await bank.whereis("teller")).path == "/bank/other"

    run(work)


def test_who_has_a_name_is_monitored_as_any_actor_and_the_name_moves_with_it() -> None:
    async def work(reach: Reach) -> None:
        heard: list[str] = []
        async with (
            reach.bank() as system,
            hf.ActorSystem("shop", log=False) as shop,
            hf.connect("bank", within=shop) as bank,
        ):
            await system.start(hf.child("teller", hf.start(Account), register="teller", scope="fleet"))
            await system.start(hf.supervisor("annex", children=[]))
            async with system.transaction() as change:
                change.move("/bank/teller", "/bank/annex")
            found = await bank.whereis("teller")
            assert found.path == "/bank/annex/teller"
            ear = await shop.start(hf.child("ear", hf.start(Ear, heard)))
            ear._cell.actor.ctx.monitor(found)  # type: ignore[union-attr]
            await asyncio.sleep(1.0)
            await system.stop(system.ref(found.path))
            await asyncio.sleep(1.0)
            assert heard == [found.path]

    run(work)


def test_a_scope_without_a_name_or_of_another_kind_is_refused() -> None:
    with pytest.raises(hf.SpecError, match="register='NAME' is missing"):
        hf.child("teller", hf.start(Account), scope="fleet")
    with pytest.raises(hf.SpecError, match="scope"):
        hf.child("teller", hf.start(Account), register="teller", scope="world")  # type: ignore[arg-type]
