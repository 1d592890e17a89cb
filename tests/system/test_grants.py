"""Actors that give orders in the program itself, and go into a process: the change says so, or it is refused."""

from __future__ import annotations

import asyncio

import pytest

import holdfast as hf
from holdfast.console.endpoint import control_endpoint
from holdfast.console.remote import RemoteSystem

SESSIONS = "/app/sessions"


class Login(hf.Message[str]):
    user: str
    asks: bool = True


class Session(hf.Actor):
    gate: hf.Binding[hf.Actor]


class Gate(hf.Actor):
    """Finds the supervisor of its sessions, which grants it nothing in a process."""

    sessions: hf.Binding[hf.supervision.DynamicSupervisor]

    def __init__(self) -> None:
        self.known: list[str] = []

    @hf.on(Login)
    async def login(self, message: Login) -> str:
        found = self.ctx.find(SESSIONS, hf.supervision.DynamicSupervisor)
        if message.asks:
            await found.ask(hf.StartChild(id=message.user))
        else:
            found.tell(hf.StartChild(id=message.user))
        self.known.append(message.user)
        return message.user


class BoundGate(Gate):
    """Orders by its binding."""

    @hf.on(Login)
    async def login(self, message: Login) -> str:
        await self.sessions.ask(hf.StartChild(id=message.user))
        return message.user


class End(hf.Message[None]):
    path: str


class Ender(hf.Actor):
    @hf.on(End)
    def end(self, message: End) -> None:
        self.ctx.find(message.path, Session).kill()


PLACES = ("task", "hybrid")
RECOVERY = {"task": None, "hybrid": hf.hybrid()}
INTO = {
    "pbr": lambda change, gate: change.protect(gate, "pbr"),
    "process": lambda change, gate: change.isolation(gate, "process"),
    "move": lambda change, gate: change.move(gate, "/app/away"),
}


async def begin(system: hf.ActorSystem, place: str = "hybrid", kind: type[Gate] = Gate) -> hf.ActorRef[Gate]:
    await system.start(hf.dynamic("sessions", template=hf.child(None, hf.start(Session))))
    bindings = {"sessions": SESSIONS} if kind is BoundGate else {}
    return await system.start(hf.child("gate", hf.start(kind), recovery=RECOVERY[place], bindings=bindings))


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("into", INTO)
async def test_who_has_given_orders_to_others_stays_where_it_is(into: str, place: str) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        gate = await begin(system, place)
        await system.start(hf.supervisor("away", isolation="process"))
        assert await gate.ask(Login("ann")) == "ann"
        for dry_run in (True, False):
            with pytest.raises(hf.TransactionFailed, match=f"given orders to {SESSIONS}, which a process may not"):
                async with system.transaction(timeout=30.0, dry_run=dry_run) as change:
                    INTO[into](change, gate)
        assert await gate.ask(Login("bob")) == "bob"
        with pytest.raises(hf.errors.CannotMove, match=f"given orders to {SESSIONS}"):
            await system.set_isolation(gate, "process")


@pytest.mark.parametrize("into", INTO)
async def test_a_dry_run_says_to_whom_it_may_give_orders_there(into: str) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        gate = await begin(system)
        await system.start(hf.supervisor("away", isolation="process"))
        async with system.transaction(timeout=30.0, dry_run=True) as change:
            INTO[into](change, gate)
        home = "/app/away" if into == "move" else gate.path if gate.path != "/app/away/gate" else "/app/away"
        assert f"may give orders to nobody but those below {home}; all other orders are refused" in change.describe()
        async with system.transaction(timeout=30.0, dry_run=True) as change:
            change.bind(gate, "sessions", SESSIONS)
            INTO[into](change, gate)
        assert (
            f"may give orders to {SESSIONS} and those below these, and to those below {home};" in change.steps[1].note
        )
        assert change.steps[0].note == ""


async def test_whoever_is_bound_goes_and_gives_its_orders_there() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        gate = await begin(system, kind=BoundGate)
        assert await gate.ask(Login("ann")) == "ann"
        async with system.transaction(timeout=30.0) as change:
            change.isolation(gate, "process")
        assert await gate.ask(Login("bob"), timeout=20.0) == "bob"
        async with system.transaction(timeout=30.0) as change:
            change.protect(gate, "pbr")
        assert await gate.ask(Login("cleo"), timeout=20.0) == "cleo"


async def test_who_has_ended_others_stays_where_it_is() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        sessions = await system.start(hf.dynamic("sessions", template=hf.child(None, hf.start(Session))))
        one = await sessions.ask(hf.StartChild(id="ann"))
        ender = await system.start(hf.child("ender", hf.start(Ender)))
        await ender.ask(End(one.path))
        with pytest.raises(hf.TransactionFailed, match=f"given orders to {one.path}"):
            async with system.transaction() as change:
                change.protect(ender, "pbr")


@pytest.mark.parametrize("asks", [True, False])
async def test_a_mechanism_behind_which_an_order_is_refused_is_taken_back(asks: bool) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        gate = await begin(system)
        async with system.transaction(timeout=30.0) as change:
            change.protect(gate, "pbr")
        if asks:
            with pytest.raises(hf.RemoteCrash, match="may not order"):
                await gate.ask(Login("ann"), timeout=20.0)
        else:
            gate.tell(Login("ann", asks=False))
        (settled,) = await asyncio.wait_for(change.settled(), 60.0)
        assert not settled.is_kept
        assert f"orders that a process may not give: {gate.path} may not order {SESSIONS}" in settled.why
        assert not (await system.protection(gate)).is_protected
        assert await gate.ask(Login("bob"), timeout=20.0) == "bob"


async def test_the_control_endpoint_tells_it_too(tmp_path: object) -> None:
    async with hf.ActorSystem("app", log=False) as system, control_endpoint(system, f"{tmp_path}/s"):
        gate = await begin(system)

        async def described() -> str:
            with RemoteSystem(f"{tmp_path}/s") as remote:
                async with remote.transaction(dry_run=True) as change:
                    change.protect(gate.path, "pbr")
                return change.describe()

        said = await asyncio.to_thread(asyncio.run, described())
        assert "1. protect /app/gate by PBR\n   in a process /app/gate may give orders to nobody but" in said
