"""Metrics of a system under kills: what a scrape says, what it costs, and that nobody pays without one."""

import asyncio
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from prometheus_client import CollectorRegistry, generate_latest

import holdfast as hf
from holdfast.actors.kernel import mailbox
from holdfast.actors.kernel.context import ActorContext
from holdfast.actors.kernel.loop import run_turns
from holdfast.actors.kernel.ref import ActorRef
from holdfast.console.telemetry import survey
from holdfast.console.telemetry.families import FAMILIES
from holdfast.console.telemetry.metrics import Metrics
from holdfast.console.telemetry.series import Labels, Spread
from tests.telemetry.scrapes import Scrape, scraped, until
from tests.telemetry.shop import Account, Add, Boom, Careless, Deny, Hire, Waste

DOCS = Path(__file__).parents[2] / "docs" / "metrics-and-traces.md"


async def test_a_scrape_tells_of_kills_and_of_what_waits(tmp_path: Path) -> None:
    async with hf.ActorSystem("app", log=False, store=f"sqlite:{tmp_path}/app.db") as system:
        metrics = Metrics(system, addresses=["/app/bob"])
        alice = await system.start(hf.child("alice", hf.start(Account), isolation="process", recovery=hf.hybrid()))
        bob = await system.start(hf.child("bob", hf.start(Account)))
        await system.statistics(alice, True)
        for _ in range(20):
            await alice.ask(Add())
        with system.events() as events:
            os.kill(system.pid_of(alice), 9)
            assert await alice.ask(Add()) == 21
            recovered = await until(events, hf.events.Recovered)
        await system.suspend(bob)
        waiting = [bob.ask(Add()) for _ in range(3)]
        found = await scraped(metrics)
        assert found.value("holdfast_restarts_total", supervisor="/app", reason="Signal") == 1
        assert found.value("holdfast_recovery_seconds_count") == 1
        assert found.value("holdfast_replayed_turns_total") == recovered.replayed > 0
        assert found.value("holdfast_events_total", event="ProcessDied") == 1
        assert found.value("holdfast_actor_mailbox_messages", address="/app/bob") == 3 + 1  # and what holds them
        assert found.value("holdfast_asks_outstanding") == 3
        assert found.value("holdfast_actor_turn_seconds_count", address="/app/alice") == 1  # of this life
        assert found.value("holdfast_actors", place="process", state="running") == 1
        assert found.value("holdfast_recorded_actors") == 1
        assert found.value("holdfast_store_seconds_count", operation="append") > 20
        assert found.value("holdfast_store_bytes", file="database") > 0
        assert found.value("holdfast_store_state") == 1
        assert found.value("holdfast_process_resident_memory_bytes", process="/app/alice") > 1e6
        assert found.value("holdfast_process_cpu_seconds_total", process="/app") > 0
        await system.resume(bob)
        await asyncio.gather(*waiting)


async def test_crashes_refusals_and_letters_are_counted() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        metrics = Metrics(system)
        bob = await system.start(hf.child("bob", hf.start(Account)))
        before = await scraped(metrics)
        assert before.value("holdfast_events_total", event="SupervisorGaveUp") == 0  # from 0 on: alerts see an increase
        with pytest.raises(hf.errors.RemoteCrash):
            await bob.ask(Boom())
        bob.tell(Deny())
        await bob.ask(Add())
        gone = system.spawn(hf.start(Account))
        await system.stop(gone)
        gone.tell(Add())
        found = await scraped(metrics)
        assert found.value("holdfast_crashes_total", error="ValueError") == 1
        assert found.value("holdfast_restarts_total", supervisor="/app", reason="Crash") == 1
        assert found.value("holdfast_refused_total", what="message") == 1
        assert found.value("holdfast_dead_letters_total") == 1


@pytest.mark.parametrize("recovery", [None, hf.hybrid()], ids=["plain", "recorded"])
@pytest.mark.parametrize("place", ["task", "process", "subtree", "pbr", "lfr"])
async def test_letters_are_counted_once_wherever_they_become_dead(place: str, recovery: Any) -> None:
    """Also in a storm, of which the history and the log tell but a part."""
    protected = {"pbr": hf.ftm.PBR(), "lfr": hf.ftm.LFR()}
    own: dict[str, Any] = {"isolation": "process"} if place == "process" else {}
    careless = hf.child("one", hf.start(Careless), recovery=recovery, mechanism=protected.get(place), **own)
    async with hf.ActorSystem("app", log=False) as system:
        metrics = Metrics(system)
        above = hf.supervisor("above", children=[careless], isolation="process" if place == "subtree" else "task")
        await system.start(above)
        one = system.ref("/app/above/one", Careless)
        await one.ask(Hire(), timeout=30.0)
        for _ in range(3):
            await one.ask(Waste(1_000), timeout=30.0)
        await one.ask(Hire(), timeout=30.0)  # Behind all that it has told itself.
        assert system.dead_letters == 3_000
        assert (await scraped(metrics)).value("holdfast_dead_letters_total") == 3_000


@pytest.mark.parametrize("recovery", [None, hf.hybrid()])
@pytest.mark.parametrize("overflow", ["reject", "drop_newest", "drop_oldest"])
async def test_shed_load_is_counted_by_class(recovery: Any, overflow: Any) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        metrics = Metrics(system)
        template = hf.child(None, hf.start(Account))
        some = await system.start(hf.dynamic("some", template=template, max_children=1))
        await some.ask(hf.StartChild())
        with pytest.raises(hf.errors.MaxChildren):
            await some.ask(hf.StartChild())
        mailbox = hf.bounded(2, overflow=overflow)
        bob = await system.start(hf.child("bob", hf.start(Account), recovery=recovery, mailbox=mailbox))
        await system.suspend(bob)
        asked = [bob.ask(Add()) for _ in range(5)]
        await asyncio.sleep(0.1)
        await system.resume(bob)
        ends = await asyncio.gather(*asked, return_exceptions=True)
        refused = sum(isinstance(end, hf.MailboxFull) for end in ends)
        assert refused in (2, 3)  # A recorded actor has one in hand besides.
        found = await scraped(metrics)
        name = f"{Account.__module__}.{Account.__qualname__}"
        assert found.value("holdfast_no_room_total", **{"where": "mailbox", "class": name}) == refused
        assert found.value("holdfast_no_room_total", **{"where": "children", "class": name}) == 1


async def test_protected_actors_are_whole_or_not() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        metrics = Metrics(system)
        alice = await system.start(hf.child("alice", hf.start(Account), mechanism=hf.ftm.PBR()))
        with system.events() as events:
            os.kill(system.pid_of(alice), 9)
            assert await alice.ask(Add()) == 1
            await until(events, hf.events.FailedOver)
        found = await scraped(metrics)
        assert found.value("holdfast_failover_seconds_count") == 1
        whole = [sample.value for sample in found.of("holdfast_protected_actors")]
        assert whole == [1.0]
        assert found.value("holdfast_actors", place="replicas", state="running") == 1


def code_of_sends() -> list[Any]:
    sends = (ActorRef.tell, ActorRef.ask, ActorRef.send, ActorContext._tell, ActorContext._ask, ActorContext._send)
    return [one.__code__ for one in (*sends, mailbox.admit_queue, run_turns)]


async def test_who_measures_leaves_the_way_of_messages_alone() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        bob = await system.start(hf.child("bob", hf.start(Account)))
        await bob.ask(Add())
        cell = bob._cell
        before = (code_of_sends(), cell.admit, cell.table, type(cell.ctx), type(system._node.deadlines))
        metrics = Metrics(system, addresses=["/app/bob"])
        await scraped(metrics)
        await bob.ask(Add())
        assert (code_of_sends(), cell.admit, cell.table, type(cell.ctx), type(system._node.deadlines)) == before


async def test_a_scrape_of_many_actors_gives_the_loop_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(survey, "SLICE", 0.0)  # Each look at the clock finds that it has been long enough.
    async with hf.ActorSystem("app", log=False) as system:
        for _ in range(1_600):
            system.spawn(hf.start(Account))
        walk = asyncio.ensure_future(survey.survey(system._root_ref()._cell, system._homes, Labels(1), ()))
        passes = 0
        while not walk.done():
            passes += 1
            await asyncio.sleep(0)
        assert sum(walk.result().actors.values()) > 1_600
        assert passes > 1_600 / survey.STRIDE


async def test_on_the_loop_a_scrape_takes_the_last_look() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        metrics = Metrics(system)
        first = Scrape(generate_latest(metrics).decode())  # nothing is known yet, and nothing is waited for
        assert not first.of("holdfast_actors")
        while metrics._next is not None:
            await asyncio.sleep(0)
        assert Scrape(generate_latest(metrics).decode()).value("holdfast_actors", place="task", state="running") >= 1
        while metrics._next is not None:
            await asyncio.sleep(0)


async def test_a_scrape_of_a_loop_that_is_held_gets_the_last_look() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        metrics = Metrics(system, timeout=0.05)
        await scraped(metrics)
        last = metrics._last
        with ThreadPoolExecutor(1) as pool:
            text = pool.submit(generate_latest, metrics).result().decode()  # The loop waits for it: nobody reads.
        assert Scrape(text).value("holdfast_actors", place="task", state="running") >= 1
        assert metrics._last is last


async def test_registering_looks_at_nothing_and_names_do_not_collide() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        registry = CollectorRegistry(auto_describe=True)
        metrics = Metrics(system)
        registry.register(metrics)
        assert metrics._last is None
        with pytest.raises(ValueError, match="Duplicated"):
            registry.register(Metrics(system))
        assert {family.name for family in metrics.describe()} == {name.removesuffix("_total") for name in FAMILIES}


async def test_an_asgi_app_serves_them() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        app, sent = Metrics(system).asgi(), list[Any]()

        async def send(message: Any) -> None:
            sent.append(message)

        async def receive() -> Any:
            raise AssertionError("nothing is read")

        await app({"type": "http", "headers": [(b"accept", b"text/plain")]}, receive, send)
        assert sent[0]["status"] == 200
        assert dict(sent[0]["headers"])[b"content-type"].startswith(b"text/plain")
        assert Scrape(sent[1]["body"].decode()).value("holdfast_processes") >= 1
        with pytest.raises(hf.errors.HoldfastError, match="over http"):
            await app({"type": "websocket"}, receive, send)


def test_labels_are_bounded() -> None:
    labels = Labels(2, ("/app/alice",))
    assert [labels.of(one) for one in ("a", "b", "a", "/app/alice")] == ["a", "other", "a", "/app/alice"]


def test_a_spread_counts_up_to_each_bound() -> None:
    spread = Spread((0.1, 1.0))
    for value in (0.1, 0.5, 7.0):
        spread.add(value)
    assert spread.buckets() == ([("0.1", 1), ("1.0", 2), ("+Inf", 3)], 7.6)


def test_names_follow_the_conventions() -> None:
    for name, family in FAMILIES.items():
        assert name.startswith("holdfast_")
        assert name.endswith("_total") == (family.kind == "counter"), name
        assert family.kind != "histogram" or name.endswith(("_seconds", "_bytes")), name
        assert not name.endswith(("_ms", "_milliseconds", "_kilobytes")), name


def test_the_page_has_the_table() -> None:
    page = DOCS.read_text()
    for name, family in FAMILIES.items():
        assert f"| `{name}` | {family.kind} | {', '.join(f'`{one}`' for one in family.labels)} |" in page
