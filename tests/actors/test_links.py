"""Links, monitors and watches, by Erlang's rules (otp.md 1.13, one test per line of it)."""

import asyncio
from collections.abc import Callable
from typing import Any

import pytest

import holdfast as hf


class Do(hf.Message[Any]):
    work: Any


class Peer(hf.Actor):
    """Runs what it is sent and notes every EXIT and DOWN."""

    def __init__(self, trap: bool = False) -> None:
        self.ctx.trap_exits = trap
        self.heard: list[Any] = []

    @hf.on(Do)
    def do(self, message: Do) -> Any:
        return message.work(self)

    def on_exit(self, source: hf.ActorRef[Any], reason: hf.ExitReason) -> None:
        self.heard.append(("EXIT", source.path, reason))

    def on_down(self, source: hf.ActorRef[Any], reason: hf.ExitReason, recovering: bool) -> None:
        self.heard.append(("DOWN", source.path, reason))


Ref = hf.ActorRef[Peer]
Spawn = Callable[..., Ref]


@pytest.fixture
def spawn(system: hf.ActorSystem) -> Spawn:
    return lambda name=None, trap=False: system.spawn(hf.start(Peer, trap), name)


def boom(_: Any) -> None:
    raise ValueError("boom")


async def crash(ref: Ref) -> None:
    with pytest.raises(hf.RemoteCrash):
        await ref.ask(Do(boom))


async def heard(ref: Ref) -> list[Any]:
    await ref._cell.node.settled()
    return await ref.ask(Do(lambda actor: list(actor.heard)))


async def is_alive(ref: Ref) -> bool:
    await ref._cell.node.settled()
    return not ref._cell.is_dead


def link(one: Ref, other: Ref) -> Any:
    return one.ask(Do(lambda actor: actor.ctx.link(other)))


# -- links -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("first_to_die", [0, 1])
async def test_a_link_works_both_ways(spawn: Spawn, first_to_die: int) -> None:
    pair = [spawn(), spawn()]
    await link(*pair)
    await crash(pair[first_to_die])
    assert not await is_alive(pair[1 - first_to_die])


async def test_there_is_at_most_one_link_per_pair(spawn: Spawn) -> None:
    one, other = spawn(trap=True), spawn("other")
    for _ in range(3):
        await link(one, other)
        await link(other, one)
    await crash(other)
    assert len(await heard(one)) == 1


async def test_unlink_removes_the_link_from_both_sides(spawn: Spawn) -> None:
    one, other = spawn(), spawn()
    await link(one, other)
    await other.ask(Do(lambda actor: actor.ctx.unlink(one)))
    await crash(other)
    assert await is_alive(one)


@pytest.mark.parametrize("trap", [False, True])
async def test_no_exit_arrives_after_unlink_not_even_a_queued_one(spawn: Spawn, trap: bool) -> None:
    one, other = spawn(trap=trap), spawn()
    await link(one, other)
    other.tell(Do(boom))  # its EXIT is queued behind the next message
    one.tell(Do(lambda actor: actor.ctx.unlink(other)))
    order = [other._cell, one._cell]
    assert list(one._cell.node.ready) == order
    assert await heard(one) == []


@pytest.mark.parametrize("trap", [False, True])
async def test_a_link_to_a_dead_actor_is_an_exit_with_noproc(spawn: Spawn, system: hf.ActorSystem, trap: bool) -> None:
    one, dead = spawn(trap=trap), spawn("dead")
    await system.stop(dead)
    ended = one._cell.ended()
    await link(one, dead)
    if trap:
        assert await heard(one) == [("EXIT", "/t/dead", hf.NOPROC)]
    else:
        assert await ended == hf.NOPROC


async def test_a_link_to_oneself_changes_nothing(spawn: Spawn) -> None:
    one = spawn()
    await one.ask(Do(lambda actor: actor.ctx.link(actor.ctx.ref)))
    assert await is_alive(one)


async def test_normal_is_ignored_by_who_does_not_trap_and_told_to_who_does(spawn: Spawn) -> None:
    plain, trapping, ending = spawn(), spawn(trap=True), spawn("ending")
    await link(plain, ending)
    await link(trapping, ending)
    await ending.ask(Do(lambda actor: actor.ctx.stop()))
    assert await is_alive(plain)
    assert await heard(trapping) == [("EXIT", "/t/ending", hf.NORMAL)]


@pytest.mark.parametrize("reason", [hf.SHUTDOWN, hf.Shutdown("because"), hf.Hung(3.0), hf.KILLED], ids=str)
async def test_any_other_reason_ends_the_peer_with_the_same_reason(spawn: Spawn, reason: hf.ExitReason) -> None:
    one, two, other = spawn(), spawn(), spawn()
    await link(one, two)
    await link(two, other)
    ended = [one._cell.ended(), two._cell.ended()]
    await other.ask(Do(lambda actor: actor.ctx.stop(reason)))
    assert [await end for end in ended] == [reason, reason]  # over two links


async def test_a_crash_ends_the_peer_with_the_same_crash(spawn: Spawn) -> None:
    one, other = spawn(), spawn()
    await link(one, other)
    ended = one._cell.ended()
    await crash(other)
    reason = await ended
    assert isinstance(reason, hf.Crash)
    assert (reason.type_name, reason.text) == ("ValueError", "boom")


async def test_a_kill_cannot_be_trapped_and_its_peers_see_killed(spawn: Spawn) -> None:
    victim, plain, trapping = spawn("victim", trap=True), spawn(), spawn(trap=True)
    await link(plain, victim)
    await link(trapping, victim)
    ended = plain._cell.ended()
    victim.kill()
    assert await ended == hf.KILLED
    assert not await is_alive(victim)
    assert await heard(trapping) == [("EXIT", "/t/victim", hf.KILLED)]


async def test_an_exit_that_is_not_trapped_cuts_a_life_off_without_its_hook(
    spawn: Spawn, system: hf.ActorSystem
) -> None:
    told: list[hf.ExitReason] = []

    class Polite(Peer):
        def on_stop(self, reason: hf.ExitReason) -> None:
            told.append(reason)

    victim, polite = spawn(), system.spawn(hf.start(Polite))
    await link(polite, victim)
    victim.kill()
    assert not await is_alive(polite)
    assert told == []


async def test_a_link_ends_with_the_lives_it_links(spawn: Spawn, system: hf.ActorSystem) -> None:
    one, other = spawn(trap=True), await system.start(hf.child("other", hf.start(Peer)))
    await link(one, other)
    await crash(other)
    await crash(other)  # its second life is not linked
    assert len(await heard(one)) == 1


# -- links and the lives that follow each other at an address ----------------------------------------------------------


async def start_late(system: hf.ActorSystem, name: str, isolation: Any = "task") -> hf.ActorRef[Any]:
    """Start an actor whose next life begins a while after the last one."""
    seconds = 0.5 if isolation == "task" else 2.0  # Time enough for a message to another process to be there meanwhile.
    backoff = hf.Backoff(initial=seconds, factor=1.0, jitter=0.0)
    return await system.start(hf.child(name, hf.start(Answers), isolation=isolation, backoff=backoff))


class Fail(hf.Message[None]):
    pass


class LinkWith(hf.Message[None]):
    path: str


class Heard(hf.Message[list[str]]):
    pass


class Answers(hf.Actor):
    """As a peer, for a process of its own: what it is sent can be encoded."""

    def __init__(self) -> None:
        self.ctx.trap_exits = True
        self.heard: list[str] = []

    @hf.on(Fail)
    def fail(self, message: Fail) -> None:
        raise ValueError("boom")

    @hf.on(LinkWith)
    def link(self, message: LinkWith) -> None:
        self.ctx.link(self.ctx.find(message.path, Answers))

    @hf.on(Heard)
    def tell(self, message: Heard) -> list[str]:
        return self.heard

    def on_exit(self, source: hf.ActorRef[Any], reason: hf.ExitReason) -> None:
        self.heard.append(f"{source.path}: {reason}")


@pytest.mark.parametrize("trap", [False, True])
async def test_between_two_lives_nobody_is_there_to_be_linked_with(
    spawn: Spawn, system: hf.ActorSystem, trap: bool
) -> None:
    one, other = spawn("one", trap=trap), await start_late(system, "other")
    with system.events() as events:
        with pytest.raises(hf.RemoteCrash):
            await other.ask(Fail())
        await link(one, other)
        if trap:
            assert await heard(one) == [("EXIT", "/t/other", hf.NOPROC)]
            await system.stop(one)
        else:
            assert not await is_alive(one)
        await events.until(hf.events.ChildRestarted, timeout=60.0)
        assert await other.ask(Heard()) == []  # The next life knows nothing of whoever ended before it began.


@pytest.mark.parametrize("whose", ["linker", "linked"])
async def test_a_link_with_somebody_between_two_lives_is_none_over_the_border_of_a_process(
    system: hf.ActorSystem, whose: str
) -> None:
    one = await start_late(system, "one", "process" if whose == "linker" else "task")
    other = await start_late(system, "other", "process" if whose == "linked" else "task")
    with system.events() as events:
        with pytest.raises(hf.RemoteCrash):
            await other.ask(Fail())
        await events.until(hf.events.ChildTerminated)
        await one.ask(LinkWith("/t/other"))
        while not (told := await one.ask(Heard())):
            await asyncio.sleep(0)
        assert told == [f"/t/other: {hf.NOPROC}"]
        await events.until(hf.events.ChildRestarted, timeout=60.0)
        with pytest.raises(hf.RemoteCrash):
            await one.ask(Fail())
        assert await other.ask(Heard()) == []


async def test_who_links_again_in_on_exit_does_not_take_the_link_into_its_next_life(system: hf.ActorSystem) -> None:
    class Watcher(Answers):
        def on_start(self, restored: bool) -> None:
            self.ctx.link(self.ctx.find("/t/two/first", Answers))

        def on_exit(self, source: hf.ActorRef[Any], reason: hf.ExitReason) -> None:
            super().on_exit(source, reason)
            if len(self.heard) < 5:
                self.ctx.link(source)

    children = [hf.child("first", hf.start(Answers)), hf.child("second", hf.start(Watcher))]
    await system.start(hf.supervisor("two", strategy="rest_for_one", children=children))
    with system.events() as events:
        with pytest.raises(hf.RemoteCrash):
            await system.ref("/t/two/first", Answers).ask(Fail())
        while (await events.until(hf.events.ActorStarted)).address != "/t/two/second":
            pass
        assert await system.ref("/t/two/second", Watcher).ask(Heard()) == []
        assert [event for event in events.take() if isinstance(event, hf.events.SupervisorGaveUp)] == []


async def test_a_life_that_does_not_begin_leaves_no_link_to_the_next_one(spawn: Spawn, system: hf.ActorSystem) -> None:
    one, tries = spawn("one", trap=True), list[int]()

    class Late(Answers):
        def __init__(self) -> None:
            super().__init__()
            tries.append(self.ctx.life)
            if self.ctx.life == 2:
                self.ctx.link(one)
                raise ValueError("not yet")

    late = await system.start(hf.child("late", hf.start(Late)))
    with system.events() as events:
        late.tell(Fail())
        await events.until(hf.events.ChildRestarted)
        assert (await late.ask(Heard()), tries) == ([], [1, 2, 3])
        assert [(path, reason.text) for _, path, reason in await heard(one)] == [("/t/late", "not yet")]
        await system.stop(one)
        assert await late.ask(Heard()) == []


# -- monitors --------------------------------------------------------------------------------------------------------


async def test_a_monitor_only_informs_and_only_one_side(spawn: Spawn) -> None:
    watcher, target = spawn("watcher"), spawn("target")
    await watcher.ask(Do(lambda actor: actor.ctx.monitor(target) and None))
    await crash(target)
    [(kind, path, reason)] = await heard(watcher)
    assert (kind, path, reason.text) == ("DOWN", "/t/target", "boom")


async def test_the_end_of_the_watcher_is_nothing_to_the_target(spawn: Spawn) -> None:
    watcher, target = spawn(), spawn()
    await watcher.ask(Do(lambda actor: actor.ctx.monitor(target) and None))
    await crash(watcher)
    assert await heard(target) == []


async def test_monitors_stack(spawn: Spawn) -> None:
    watcher, target = spawn(), spawn("target")
    for _ in range(3):
        await watcher.ask(Do(lambda actor: actor.ctx.monitor(target) and None))
    target.kill()
    assert await heard(watcher) == [("DOWN", "/t/target", hf.KILLED)] * 3


@pytest.mark.parametrize("how", ["monitor", "watch"])
async def test_monitoring_a_dead_actor_gives_down_with_noproc_at_once(
    spawn: Spawn, system: hf.ActorSystem, how: str
) -> None:
    watcher, dead = spawn(), spawn("dead")
    await system.stop(dead)
    await watcher.ask(Do(lambda actor: getattr(actor.ctx, how)(dead) and None))
    assert await heard(watcher) == [("DOWN", "/t/dead", hf.NOPROC)]


async def test_no_down_after_a_cancel_not_even_a_queued_one(spawn: Spawn) -> None:
    watcher, target = spawn(), spawn()
    monitors = [await watcher.ask(Do(lambda actor: actor.ctx.monitor(target))) for _ in range(2)]
    monitors[0].cancel()
    watcher.tell(Do(lambda actor: monitors[1].cancel()))
    ended = target._cell.ended()
    watcher._cell.node.ready.rotate()  # whatever the order
    target.stop()
    watcher.tell(Do(lambda actor: monitors[1].cancel()))
    await ended
    assert await heard(watcher) == []


async def test_a_monitor_is_of_one_life_and_a_watch_of_the_address(spawn: Spawn, system: hf.ActorSystem) -> None:
    watcher, target = spawn(), await system.start(hf.child("target", hf.start(Peer)))
    await watcher.ask(Do(lambda actor: actor.ctx.monitor(target) and None))
    await watcher.ask(Do(lambda actor: actor.ctx.watch(target) and None))
    await crash(target)
    await crash(target)
    assert [type(reason) for _, _, reason in await heard(watcher)] == [hf.Crash]  # the monitor's, once
    await system.stop(target)
    assert [reason for _, _, reason in await heard(watcher)][1:] == [hf.SHUTDOWN]  # the watch's, once


async def test_the_watches_of_a_life_end_with_it(system: hf.ActorSystem, spawn: Spawn) -> None:
    watcher, target = await system.start(hf.child("w", hf.start(Peer))), spawn("target")
    for how in ("monitor", "watch"):
        await watcher.ask(Do(lambda actor, how=how: getattr(actor.ctx, how)(target) and None))
    await crash(watcher)
    target.kill()
    assert await heard(watcher) == []


async def test_a_clean_end_is_told_with_its_reason(spawn: Spawn) -> None:
    watcher, target = spawn(), spawn("target")
    await watcher.ask(Do(lambda actor: actor.ctx.monitor(target) and None))
    await target.ask(Do(lambda actor: actor.ctx.stop(hf.Shutdown("done"))))
    assert await heard(watcher) == [("DOWN", "/t/target", hf.Shutdown("done"))]


# -- signal order ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("how", ["link", "monitor"])
async def test_signals_come_after_what_their_sender_sent_before(spawn: Spawn, how: str) -> None:
    watcher, target = spawn(trap=True), spawn("target")
    await watcher.ask(Do(lambda actor: getattr(actor.ctx, how)(target) and None))

    def tell_and_crash(_: Any) -> None:
        for number in range(3):
            watcher.tell(Do(lambda actor, n=number: actor.heard.append(n)))
        raise ValueError

    with pytest.raises(hf.RemoteCrash):
        await target.ask(Do(tell_and_crash))
    *before, signal = await heard(watcher)
    assert before == [0, 1, 2]
    assert signal[0] == {"link": "EXIT", "monitor": "DOWN"}[how]


# -- names -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("how", ["link", "monitor", "watch"])
@pytest.mark.parametrize("end", ["stop", "kill", "crash"])
async def test_a_name_is_free_before_anybody_hears_of_the_end(system: hf.ActorSystem, how: str, end: str) -> None:
    told: asyncio.Future[list[str]] = asyncio.get_running_loop().create_future()

    class Heir(Peer):
        def take(self) -> None:
            system.register("leader", self.ctx.ref)  # NameTaken if it were not free
            system.spawn(hf.start(Peer), "target")
            told.set_result([system.whereis("leader").path])

        def on_exit(self, source: hf.ActorRef[Any], reason: hf.ExitReason) -> None:
            self.take()

        def on_down(self, source: hf.ActorRef[Any], reason: hf.ExitReason, recovering: bool) -> None:
            self.take()

    target, heir = system.spawn(hf.start(Peer), "target"), system.spawn(hf.start(Heir, True), "heir")
    system.register("leader", target)
    await heir.ask(Do(lambda actor: getattr(actor.ctx, how)(target) and None))
    if end == "crash":
        await crash(target)
    else:
        getattr(target, end)()
    assert await told == ["/t/heir"]
