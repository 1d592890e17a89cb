"""Protected actors below a supervisor with a process of its own: it decides, and the replicas are the root's."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import os
import random
import signal
from pathlib import Path
from typing import Any

import msgspec
import pytest

import holdfast as hf
from holdfast.actors.exit_reasons import KILLED, pack_exit
from holdfast.checkpoint.places.far_parent import FarParent
from holdfast.checkpoint.protocol import Closed
from holdfast.ftm.group.group_place import GroupPlace
from holdfast.ftm.mechanisms.pbr import PBR
from holdfast.ftm.migration.subtree_groups import known
from holdfast.ftm.model.mechanism import Code, Description, MechanismRefused
from tests.ftm.accounts import Account, Add, Counter, Load, Pay, Purse, Tags
from tests.ftm.test_failover import METHODS, SEED, group_of, pid_of, two_again

RECOVERIES = ("without recovery", "hybrid")


def bank(*children: hf.ChildSpec, **options: Any) -> hf.ChildSpec:
    inner = hf.supervisor("inner", children=[protected("deep")], intensity=1000)
    return hf.supervisor(
        "bank", isolation="process", intensity=1000, children=children or (protected("alice"), inner), **options
    )


def protected(name: str, recipe: Any = None, **options: Any) -> hf.ChildSpec:
    return hf.child(name, recipe or hf.start(Counter), mechanism=PBR(), **options)


def at(system: hf.ActorSystem, name: str) -> hf.ActorRef[Any]:
    """By address, also while nobody lives there."""
    return system._node.cell_at(f"/app/bank/{name}").ref


def bank_pid(system: hf.ActorSystem) -> int:
    return system.pid_of(system.ref("/app/bank", hf.Supervisor))


async def test_its_replicas_are_processes_of_the_root(system: hf.ActorSystem) -> None:
    await system.start(bank())
    for name in ("alice", "inner/deep"):
        ref = at(system, name)
        assert [await ref.ask(Add(tag)) for tag in range(3)] == [1, 2, 3]
        assert isinstance(ref._cell.host.place, GroupPlace)
        assert len({bank_pid(system), os.getpid(), *(pid_of(system, ref, one) for one in ("r1", "r2"))}) == 4
        assert f"/app/bank/{name}/ftm/r2/server" in system.tree()
    children = await system.ref("/app/bank", hf.Supervisor).ask(hf.WhichChildren())
    assert [(one.id, one.state) for one in children] == [("alice", "running"), ("inner", "running")]


@pytest.mark.parametrize("method", RECOVERIES)
async def test_nothing_is_lost_or_doubled_whichever_replica_dies(system: hf.ActorSystem, method: str) -> None:
    """And its supervisor hears of none of it: the child lives on, in its first life."""
    rng = random.Random(SEED)
    await system.start(bank(protected("alice", recovery=METHODS[method]())))
    ref = at(system, "alice")
    load = Load(ref)
    for _ in range(4):
        await load.reached(rng.randrange(5, 60))
        group = group_of(ref)
        await two_again(ref)
        primary = group.membership.primary
        victim = primary if rng.random() < 0.6 else next(one for one in group.membership.names if one != primary)
        os.kill(pid_of(system, ref, victim or ""), signal.SIGKILL)
    await load.reached(30)
    await load.stop()
    load.check(await ref.ask(Tags()))
    assert ref._cell.life == 1


class Ask(hf.Message[int]):
    tag: int


class Client(hf.Actor):
    """A sibling in the same process."""

    @hf.on(Ask)
    async def go(self, message: Ask) -> int:
        alice = self.ctx.find("/app/bank/alice", Counter)
        alice.tell(Add(message.tag))
        return await alice.ask(Add(message.tag + 1))


async def test_siblings_in_the_process_reach_it_in_order(system: hf.ActorSystem) -> None:
    await system.start(bank(protected("alice"), hf.child("client", hf.start(Client))))
    client = at(system, "client")
    assert await asyncio.gather(*(client.ask(Ask(2 * number)) for number in range(10))) == list(range(2, 21, 2))
    assert await at(system, "alice").ask(Tags()) == list(range(20))


async def ended(pids: set[int]) -> None:
    """Wait until none of these processes is there any more."""
    async with asyncio.timeout(10):
        while any(os.path.exists(f"/proc/{pid}") for pid in pids):
            await asyncio.sleep(0.005)


def pids_of(system: hf.ActorSystem, ref: hf.ActorRef[Any]) -> set[int]:
    return {pid_of(system, ref, one) for one in group_of(ref).membership.names}


@pytest.mark.parametrize("method", RECOVERIES)
async def test_the_group_ends_with_the_process_of_the_subtree_and_begins_with_the_next(
    system: hf.ActorSystem, method: str
) -> None:
    await system.start(bank(protected("alice", recovery=METHODS[method]()), protected("bob")))
    alice, bob = at(system, "alice"), at(system, "bob")
    for tag in range(5):
        await asyncio.gather(alice.ask(Add(tag)), bob.ask(Add(tag)))
    replicas = pids_of(system, alice) | pids_of(system, bob)
    os.kill(bank_pid(system), signal.SIGKILL)
    await ended(replicas)
    assert await alice.ask(Add(99), timeout=30.0) == (6 if method == "hybrid" else 1)
    assert await alice.ask(Tags()) == ([0, 1, 2, 3, 4, 99] if method == "hybrid" else [99])
    assert await bob.ask(Tags(), timeout=30.0) == []
    await two_again(alice)
    os.kill(pid_of(system, alice, group_of(alice).membership.primary or ""), signal.SIGKILL)
    assert await alice.ask(Add(100), timeout=30.0) == (7 if method == "hybrid" else 2)


async def test_with_recovery_nothing_is_lost_when_anything_dies(system: hf.ActorSystem) -> None:
    rng = random.Random(SEED)
    await system.start(bank(protected("alice", recovery=hf.hybrid(interval=0.05))))
    ref = at(system, "alice")
    load = Load(ref)
    for what in rng.sample(["subtree", "primary", "subtree", "both"], 4):
        await load.reached(rng.randrange(5, 60))
        await two_again(ref)
        if what != "primary":
            os.kill(bank_pid(system), signal.SIGKILL)
            await asyncio.sleep(rng.random() * 0.02)
        if what != "subtree":
            pid = system._workers.processes().get(f"{ref.path}/ftm/r1")
            if pid is not None:  # Else the group has ended already, or is not up again.
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
    await load.reached(30)
    await load.stop()
    load.check(await ref.ask(Tags()))


async def test_all_replicas_dead_the_supervisor_in_the_process_starts_it_again(system: hf.ActorSystem) -> None:
    await system.start(bank(protected("alice", recovery=hf.hybrid()), protected("bob")))
    alice, bob, pid = at(system, "alice"), at(system, "bob"), bank_pid(system)
    for ref in (alice, bob):
        await asyncio.gather(*(ref.ask(Add(tag)) for tag in range(5)))
        for one in pids_of(system, ref):
            os.kill(one, signal.SIGKILL)
    assert await alice.ask(Add(5), timeout=30.0) == 6
    assert await bob.ask(Add(5), timeout=30.0) == 1
    assert (alice._cell.life, bob._cell.life, bank_pid(system)) == (2, 2, pid)


async def test_the_tree_stopped_and_started_again(system: hf.ActorSystem) -> None:
    await system.start(bank(protected("alice", recovery=hf.hybrid()), protected("bob")))
    alice, bob = at(system, "alice"), at(system, "bob")
    await asyncio.gather(alice.ask(Add(0)), bob.ask(Add(0)))
    pids = pids_of(system, alice) | pids_of(system, bob) | {bank_pid(system)}
    root = system.ref("/app", hf.Supervisor)
    await root.ask(hf.TerminateChild("bank"))
    await ended(pids)
    assert not [path for path in system.tree() if path.startswith("/app/bank")]
    with pytest.raises(hf.errors.NoSuchActor):
        system.ref("/app/bank/alice", Counter)
    await root.ask(hf.RestartChild("bank"), timeout=30.0)
    assert await at(system, "alice").ask(Add(1)) == 2
    assert await at(system, "bob").ask(Add(1)) == 1


async def test_its_supervisor_stops_restarts_and_deletes_it(system: hf.ActorSystem) -> None:
    await system.start(bank(protected("alice", recovery=hf.hybrid())))
    house, alice = system.ref("/app/bank", hf.Supervisor), at(system, "alice")
    await alice.ask(Add(0))
    pids = pids_of(system, alice)
    await house.ask(hf.TerminateChild("alice"))
    await ended(pids)
    with pytest.raises(hf.ActorStopped):
        await alice.ask(Add(1))
    await house.ask(hf.RestartChild("alice"), timeout=30.0)
    assert await at(system, "alice").ask(Add(1)) == 2
    await house.ask(hf.StartChild(protected("carol")), timeout=30.0)
    assert await at(system, "carol").ask(Add(1)) == 1
    await house.ask(hf.TerminateChild("alice"))
    await house.ask(hf.DeleteChild("alice"))
    with pytest.raises(hf.errors.NoSuchActor):
        system.ref("/app/bank/alice", Counter)
    assert not system._homes.knows("/app/bank/alice")


class Watch(hf.Message[None]):
    how: str


class Heard(hf.Message[list[str]]): ...


class Watcher(hf.Actor):
    def __init__(self) -> None:
        self.heard: list[str] = []

    @hf.on(Watch)
    def watch(self, message: Watch) -> None:
        alice = self.ctx.find("/app/bank/alice", Counter)
        self.ctx.trap_exits = True
        getattr(self.ctx, message.how)(alice)

    def on_down(self, source: Any, reason: hf.ExitReason, recovering: bool) -> None:
        self.heard.append(f"down {recovering}")

    def on_exit(self, source: Any, reason: hf.ExitReason) -> None:
        self.heard.append("exit")

    @hf.on(Heard, readonly=True)
    def said(self, message: Heard) -> list[str]:
        return self.heard


@pytest.mark.parametrize("where", ["/app", "/app/bank"])
async def test_who_watches_it_hears_of_its_end_and_not_of_a_replica(system: hf.ActorSystem, where: str) -> None:
    watchers = [hf.child("watcher", hf.start(Watcher)), hf.child("linked", hf.start(Watcher))]
    inside = where == "/app/bank"
    await system.start(bank(protected("alice"), *(watchers if inside else ())))
    for spec in () if inside else watchers:
        await system.start(spec)
    watcher, linked = (system._node.cell_at(f"{where}/{name}").ref for name in ("watcher", "linked"))
    alice = at(system, "alice")
    await watcher.ask(Watch("monitor"))
    await linked.ask(Watch("link"))
    assert await alice.ask(Add(0)) == 1
    os.kill(pid_of(system, alice, group_of(alice).membership.primary or ""), signal.SIGKILL)
    assert await alice.ask(Add(1)) == 2
    await two_again(alice)
    assert (await watcher.ask(Heard()), await linked.ask(Heard())) == ([], [])
    for pid in pids_of(system, alice):
        os.kill(pid, signal.SIGKILL)
    assert await alice.ask(Add(0), timeout=30.0) == 1
    assert (await watcher.ask(Heard()), await linked.ask(Heard())) == (["down True"], [])
    await system.terminate(alice)
    assert await alice.ask(Add(0), timeout=30.0) == 1
    house = system.ref("/app/bank", hf.Supervisor)
    await house.ask(hf.TerminateChild("alice"))
    assert await linked.ask(Heard()) == ["exit"]
    assert (await watcher.ask(Heard()))[-1] == "down False"


async def test_its_bindings_are_those_of_its_replicas(system: hf.ActorSystem) -> None:
    """Also of what was bound later, and for a replica that is started again."""
    purse = hf.child("purse", hf.start(Purse), mechanism=PBR(), bindings={"account": "/app/bank/account"})
    await system.start(bank(hf.child("account", hf.start(Account, 5)), purse))
    other = await system.start(hf.child("other", hf.start(Account, 100)))
    ref = at(system, "purse")
    assert await ref.ask(Pay(3)) == 8
    system.bind(ref, "account", other)
    assert await ref.ask(Pay(3)) == 103
    await two_again(ref)
    os.kill(pid_of(system, ref, group_of(ref).membership.primary or ""), signal.SIGKILL)
    assert await ref.ask(Pay(3)) == 106


async def test_a_child_of_a_dynamic_supervisor(system: hf.ActorSystem) -> None:
    template = hf.child(None, hf.start(Counter), mechanism=PBR(), mailbox=hf.bounded(2))
    await system.start(hf.dynamic("pool", template=template, isolation="process"))
    pool = system.ref("/app/pool", hf.Supervisor)
    one = await pool.ask(hf.StartChild(id="one"), timeout=30.0)
    assert await asyncio.gather(*(one.ask(Add(tag)) for tag in range(6))) == [1, 2, 3, 4, 5, 6]
    with pytest.raises(hf.TransactionRefused, match="no recipe here has its spec"):
        async with system.transaction() as change:
            change.protect(one, "lfr")


class Never(Counter):
    def __init__(self) -> None:
        raise RuntimeError("not today")


async def test_what_cannot_start_fails_the_start_of_the_subtree_with_the_reason(system: hf.ActorSystem) -> None:
    with pytest.raises(hf.StartFailed, match="not today"):
        await system.start(bank(protected("alice", hf.start(Never))))
    with pytest.raises(hf.StartFailed, match="needs a store"):
        await system.start(bank(protected("alice", recovery=hf.hybrid(durability="fsync"))))
    assert not [path for path in system.tree() if path.startswith("/app/bank")]
    await system.start(bank(protected("alice")))
    house = system.ref("/app/bank", hf.Supervisor)
    with pytest.raises(hf.HoldfastError, match="not today"):
        await house.ask(hf.StartChild(protected("bob", hf.start(Never))), timeout=30.0)
    assert await at(system, "alice").ask(Add(0)) == 1


async def test_a_start_that_is_given_up_just_as_it_ends_leaves_nothing(system: hf.ActorSystem) -> None:
    """What both sides say may cross: the life is up, and nobody wants it."""
    await system.start(bank(protected("alice")))
    alice = at(system, "alice")
    parent, pids = alice._cell.host.parent, pids_of(system, alice)
    assert isinstance(parent, FarParent)
    assert parent.worker is not None
    parent.hear(parent.worker, Closed(parent.number, pack_exit(KILLED)))
    await ended(pids)
    os.kill(bank_pid(system), signal.SIGKILL)  # The supervisor there has not said so.
    assert await alice.ask(Add(0), timeout=30.0) == 1


async def test_the_root_loads_nothing_that_an_actor_process_names(tmp_path: Path) -> None:
    """What comes from there is data: a mechanism has to be known at the root already."""
    trace = tmp_path / "ran"
    file = tmp_path / "other.py"
    file.write_text(f"open({str(trace)!r}, 'w').close()\n")
    file.chmod(0o600)
    name = f"other_{tmp_path.name}:Other"
    with pytest.raises(MechanismRefused, match="loads nothing that an actor process names"):
        known(Description(name, {}, str(file), hashlib.sha256(file.read_bytes()).hexdigest()))
    with pytest.raises(MechanismRefused, match="loads nothing"):
        known(msgspec.structs.replace(PBR().describe(), bricks=(("primary", "after", Code(name, str(file))),)))
    assert not trace.exists()
    assert known(PBR(window=3).describe()) == PBR(window=3)


async def test_stopped_while_it_starts_leaves_nothing(system: hf.ActorSystem) -> None:
    """Its supervisor gives the start up: replicas that are just coming up are ended."""
    await system.start(bank(protected("alice")))
    house = system.ref("/app/bank", hf.Supervisor)
    starting = asyncio.ensure_future(house.ask(hf.StartChild(protected("bob")), timeout=30.0))
    async with asyncio.timeout(10):
        while "/app/bank/bob/ftm" not in system.tree():
            await asyncio.sleep(0.001)
    await house.ask(hf.TerminateChild("bob"))
    with pytest.raises(hf.HoldfastError, match="stopped while it started"):
        await starting
    async with asyncio.timeout(10):
        while [path for path in (*system.tree(), *system._workers.processes()) if path.startswith("/app/bank/bob")]:
            await asyncio.sleep(0.005)
    assert await at(system, "alice").ask(Add(0)) == 1
