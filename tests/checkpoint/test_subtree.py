"""Recorded actors that share a process with their supervisor: their homes are at the root (DESIGN 4, T18)."""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import signal
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.supervision.admin import DeleteChild, RestartChild, TerminateChild
from tests.checkpoint.players import Do, Doer, Note, Notes, Seen, Sink, until

NEVER = 3600.0


def team(**options: Any) -> hf.ChildSpec:
    """A process with a supervisor, two recorded actors, one that is not, and a recorded one two levels down."""
    recovery = hf.hybrid(interval=NEVER)
    children = [
        hf.child("one", hf.start(Doer), recovery=recovery, shutdown=8.0),
        hf.child("two", hf.start(Doer), recovery=recovery),
        hf.child("plain", hf.start(Sink)),
        hf.supervisor("inner", children=[hf.child("deep", hf.start(Doer), recovery=recovery)], intensity=1000),
    ]
    return hf.supervisor("team", isolation="process", intensity=1000, children=children, **options)


def at(system: hf.ActorSystem, name: str, kind: type[Any] = Doer) -> hf.ActorRef[Any]:
    return system.ref(f"/app/team/{name}", kind)


def kill_process(system: hf.ActorSystem) -> None:
    os.kill(system.pid_of(system.ref("/app/team", hf.Supervisor)), signal.SIGKILL)


async def test_every_home_survives_the_process(system: hf.ActorSystem) -> None:
    await system.start(team())
    names = ("one", "two", "inner/deep")
    refs = [at(system, name) for name in names]
    assert {system.pid_of(ref) for ref in refs} == {system.pid_of(system.ref("/app/team", hf.Supervisor))}
    for round_ in range(3):
        for ref in refs:
            ref.tell(Note(f"{round_}"))
        kill_process(system)
        for ref in refs:
            ref.tell(Note(f"{round_} sent while nobody lived there"))
        assert [await ref.ask(Note("asked"), timeout=30.0) for ref in refs] == [3 * round_ + 3] * 3
    for ref, name in zip(refs, names, strict=True):
        assert await ref.ask(Seen()) == await at(system, name).ask(Seen()), "old refs and new ones reach the same"


async def test_what_is_sent_by_address_while_the_tree_is_down_arrives(system: hf.ActorSystem, tmp_path: Path) -> None:
    """The supervisors above the receiver are gone with their process; its home is not."""
    await system.start(team())
    outside = await system.start(hf.child("outside", hf.start(Doer), isolation="process", recovery=hf.hybrid()))
    deep = at(system, "inner/deep")
    gate = tmp_path / "gate"
    sending = outside.ask(Do([f"gate {gate}", "tell while down", "ask while down"], deep), timeout=30.0)
    await until(gate.exists)
    kill_process(system)
    Path(f"{gate}.open").touch()
    await sending
    assert await outside.ask(Seen()) == ["while down:2"]
    assert await deep.ask(Seen()) == ["while down", "while down"]


async def test_siblings_send_and_ask_through_their_homes(system: hf.ActorSystem) -> None:
    await system.start(team())
    one, two, plain = at(system, "one"), at(system, "two"), at(system, "plain", Sink)
    assert await one.ask(Do(["ask first", "send second", "tell third", "flush"], two), timeout=30.0) == "1"
    assert await one.ask(Do(["ask to-plain", "send again"], plain), timeout=30.0) == "2"
    kill_process(system)
    assert await two.ask(Seen(), timeout=30.0) == ["first", "second", "third"]
    assert await one.ask(Seen(), timeout=30.0) == ["first:1", "to-plain:1"]
    assert await at(system, "plain", Sink).ask(Notes()) == [], "what is not recorded starts from nothing"


async def test_a_crash_ends_one_and_its_siblings_go_on(system: hf.ActorSystem) -> None:
    await system.start(team())
    one, two = at(system, "one"), at(system, "two")
    pid = system.pid_of(one)
    await one.ask(Note("kept"))
    await two.ask(Note("kept"))
    with pytest.raises(hf.RemoteCrash, match="no luck"):
        await one.ask(Do(["add lost", "raise no luck"]))
    assert await one.ask(Note("after"), timeout=30.0) == 2
    assert await two.ask(Note("after")) == 2
    assert system.pid_of(one) == pid
    assert (one._cell.life, two._cell.life) == (2, 1)


async def test_a_child_is_stopped_restarted_and_deleted_by_its_supervisor(system: hf.ActorSystem) -> None:
    await system.start(team())
    house, one = system.ref("/app/team", hf.Supervisor), at(system, "one")
    await one.ask(Note("kept"))
    await house.ask(TerminateChild("one"))
    with pytest.raises(hf.ActorStopped):
        await one.ask(Seen())
    await house.ask(RestartChild("one"))
    assert await at(system, "one").ask(Seen()) == ["kept"]
    await house.ask(TerminateChild("one"))
    await house.ask(DeleteChild("one"))
    with pytest.raises(hf.errors.NoSuchActor):
        at(system, "one")


async def test_monitors_and_links_across_the_border_of_the_process(system: hf.ActorSystem) -> None:
    """DESIGN 5: DOWN says that it is being recovered; a link fires only when recovery is over."""
    await system.start(team())
    watcher = await system.start(hf.child("watcher", hf.start(Doer), recovery=hf.hybrid()))
    one = at(system, "one")
    await watcher.ask(Do(["monitor", "link"], one))
    kill_process(system)
    assert await one.ask(Note("back"), timeout=30.0) == 1
    assert await watcher.ask(Seen()) == ["down True"]
    assert watcher._cell.life == 1, "the link has not fired"


async def test_a_message_that_kills_the_process_is_quarantined_and_its_neighbours_are_not(
    system: hf.ActorSystem, tmp_path: Path
) -> None:
    """T16: each life has a place of its own on the page that outlives the process."""
    await system.start(team())
    one, two = at(system, "one"), at(system, "two")
    await two.ask(Note("before"))
    with pytest.raises(hf.Quarantined):
        await one.ask(Do([f"die {tmp_path}/deaths"]), timeout=15.0)
    assert (tmp_path / "deaths").read_text() == "x" * 3
    assert await one.ask(Note("after"), timeout=30.0) == 1
    assert await two.ask(Note("after"), timeout=30.0) == 2


async def test_a_turn_that_only_waits_when_a_sibling_ends_the_process_is_not_blamed(
    system: hf.ActorSystem, tmp_path: Path
) -> None:
    """However often it is in hand: who was at work is told apart from who waits."""
    await system.start(team())
    one, two = at(system, "one"), at(system, "two")
    begun = tmp_path / "gate"
    waiting = two.ask(Do([f"gate {begun}", "add through"]), timeout=60.0)
    for death in range(7):
        await until(begun.exists)
        begun.unlink()
        assert await one.ask(Do([f"once {tmp_path}/fuse{death}", f"add {death}"]), timeout=30.0) == str(death + 1)
    Path(f"{begun}.open").touch()
    assert await waiting == "1"
    assert system.quarantined() == []


async def test_turns_that_wait_are_blamed_if_nobody_was_at_work(system: hf.ActorSystem, tmp_path: Path) -> None:
    """What they wait for may be what has ended the process: a thread, or memory."""
    await system.start(team())
    two, begun = at(system, "two"), tmp_path / "gate"
    waiting = asyncio.ensure_future(two.ask(Do([f"gate {begun}"]), timeout=60.0))
    while True:  # Five times, and once more if it hits another in the middle of its start.
        await until(lambda: begun.exists() or waiting.done())
        if waiting.done():
            break
        begun.unlink()
        kill_process(system)
    with pytest.raises(hf.Quarantined):
        await waiting


async def test_turns_that_wait_are_blamed_for_what_a_sibling_without_recovery_does(
    system: hf.ActorSystem, tmp_path: Path
) -> None:
    """A limit: of an actor that has no home nobody knows whether it was at work."""
    children = [hf.child("one", hf.start(Doer)), hf.child("two", hf.start(Doer), recovery=hf.hybrid(interval=NEVER))]
    await system.start(hf.supervisor("team", isolation="process", intensity=1000, children=children))
    two, begun = at(system, "two"), tmp_path / "gate"
    waiting = two.ask(Do([f"gate {begun}"]), timeout=60.0)
    for death in range(3):
        await until(begun.exists)
        begun.unlink()
        at(system, "one").tell(Do([f"once {tmp_path}/fuse{death}"]))
    with pytest.raises(hf.Quarantined):
        await waiting


async def test_the_subtree_stopped_and_started_again_has_its_state(system: hf.ActorSystem) -> None:
    await system.start(team())
    await at(system, "inner/deep").ask(Note("kept"))
    root = system.ref("/app", hf.Supervisor)
    await root.ask(TerminateChild("team"))
    with pytest.raises(hf.errors.NoSuchActor):
        at(system, "inner/deep")
    await root.ask(RestartChild("team"))
    assert await at(system, "inner/deep").ask(Seen()) == ["kept"]


async def test_a_new_root_takes_the_subtree_up_from_the_store(tmp_path: Path) -> None:
    store = f"sqlite:{tmp_path}/store.db"
    async with hf.ActorSystem("app", log=False, store=store) as system:
        await system.start(team())
        for name in ("one", "inner/deep"):
            await at(system, name).ask(Note(name))
    async with hf.ActorSystem("app", log=False, store=store) as system:
        await system.start(team())
        for name in ("one", "inner/deep"):
            assert await at(system, name).ask(Seen()) == [name]


@pytest.mark.parametrize("seed", range(4))
async def test_nothing_is_lost_or_doubled_however_the_process_dies(system: hf.ActorSystem, seed: int) -> None:
    """Kills at random moments while requests flow: every ask is answered once, in order."""
    rng = random.Random(seed)
    await system.start(team())
    names = ("one", "two", "inner/deep")
    sent: dict[str, list[str]] = {name: [] for name in names}
    asks: list[Any] = []
    for step in range(120):
        name = rng.choice(names)
        text = f"{step}"
        sent[name].append(text)
        asks.append(at_any(system, name).ask(Note(text), timeout=20.0))
        if rng.random() < 0.06:
            with contextlib.suppress(hf.errors.NoSuchActor, ProcessLookupError):  # It is between two lives already.
                kill_process(system)
        await asyncio.sleep(rng.random() * 0.004)
    await asyncio.gather(*asks)
    for name in names:
        assert await at_any(system, name).ask(Seen(), timeout=20.0) == sent[name], f"seed {seed}"


def at_any(system: hf.ActorSystem, name: str) -> hf.ActorRef[Any]:
    """By address, also while nobody lives there."""
    return system._node.cell_at(f"/app/team/{name}").ref


@pytest.mark.parametrize("above", ["task", "process"])
@pytest.mark.parametrize("own", ["with its supervisor", "own process", "pbr"])
async def test_who_asks_a_child_that_nobody_starts_again_does_not_wait_for_it(
    system: hf.ActorSystem, above: Any, own: str, tmp_path: Path
) -> None:
    """A dynamic supervisor without a journal begins without its children; somebody may start that id again."""
    places: dict[str, dict[str, Any]] = {
        "with its supervisor": {},
        "own process": {"isolation": "process"},
        "pbr": {"mechanism": hf.ftm.PBR()},
    }
    template = hf.child(None, hf.start(Doer), recovery=hf.hybrid(interval=NEVER), **places[own])
    await system.start(hf.supervisor("team", children=[hf.dynamic("crowd", template=template)], isolation=above))
    crowd = at(system, "crowd", hf.Supervisor)

    async def come() -> None:
        await crowd.ask(hf.StartChild(id="a"), timeout=30.0)

    async def go() -> None:
        """The supervisors end, and are there again."""
        if above == "process":
            kill_process(system)
        else:
            system.ref("/app/team", hf.Supervisor).kill()
        async with asyncio.timeout(30.0):
            while True:
                with contextlib.suppress(hf.HoldfastError):
                    if await crowd.ask(hf.WhichChildren(), timeout=30.0) == []:
                        return
                await asyncio.sleep(0)

    await come()
    someone = at(system, "crowd/a")
    await someone.ask(Note("kept"))
    asking = asyncio.ensure_future(someone.ask(Do([f"gate {tmp_path}/gate"]), timeout=60.0))
    await until((tmp_path / "gate").exists)
    for number in range(2):
        await go()
        with pytest.raises(hf.ActorStopped, match="may start it again"):
            await someone.ask(Seen(), timeout=60.0)
        someone.tell(Note(f"told {number}"))
    with pytest.raises(hf.AskFailed):
        await asking
    (tmp_path / "gate.open").touch()
    await come()
    assert (await someone.ask(Seen(), timeout=30.0))[-2:] == ["told 0", "told 1"]
