"""What was put aside and is put back behind a mechanism: handled once, in order, before all else, whatever dies."""

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
from holdfast.ftm.alarms import Objected
from holdfast.ftm.mechanisms.rb import NotAccepted
from tests.ftm.accounts import Add, Counter, Tags
from tests.ftm.test_failover import group_of, is_complete, pid_of, two_again

# Processes do not care which event loop the root has.
pytestmark = pytest.mark.asyncio(loop_factories=["uvloop"])

SEED = int(os.environ.get("HOLDFAST_SEED", "20261125"))
OTHER = "/app/other"
IN_TIME = 60.0


class Meet(hf.Message[int]):
    """Answered with how many have met somebody before, when the house is open for this kind of guest."""

    tag: int
    kind: str


class Open(hf.Message[None]):
    kind: str


class Close(hf.Message[None]): ...


class Host(Counter):
    """Puts guests aside while it is closed for their kind. Each guest that may come in has it ask somebody, or not."""

    def __init__(self) -> None:
        super().__init__()
        self.is_open: set[str] = set()

    @hf.on(Meet)
    async def meet(self, message: Meet) -> int:
        if message.kind not in self.is_open:
            self.ctx.stash()
            return 0
        self.tags.append(message.tag)
        if message.kind == "asks":
            await self.ctx.find(OTHER, Counter).ask(Add(message.tag), timeout=IN_TIME)
        return len(self.tags)

    @hf.on(Open)
    async def open(self, message: Open) -> None:
        self.is_open.add(message.kind)
        self.ctx.unstash()

    @hf.on(Close)
    def close(self, message: Close) -> None:
        self.is_open.clear()


class Fatal(hf.Message[int]):
    """A guest who kills the first host that lets it in; the note says that there was one."""

    note: str


class Mortal(Host):
    """Dies of its first fatal guest."""

    @hf.on(Fatal)
    async def meet_once(self, message: Fatal) -> int:
        if not self.is_open:
            self.ctx.stash()
            return 0
        if not Path(message.note).exists():
            Path(message.note).touch()
            await asyncio.sleep(0.3)  # Its heir has the state meanwhile, or has not: both must do.
            os.kill(os.getpid(), signal.SIGKILL)
        return len(self.tags)


class Rude(hf.Message[int]):
    """A guest at whom the host raises when it is let in."""


class Touchy(Host):
    """Raises at rude guests."""

    @hf.on(Rude)
    def let_in(self, message: Rude) -> int:
        if not self.is_open:
            self.ctx.stash()
            return 0
        raise ValueError("rude")


class Welcome(hf.Message[bool]):
    """Answered with whether it has opened the house for all."""


class Forgetful(Host):
    """Says that it has opened nothing, and has not."""

    @hf.on(Welcome)
    def welcome(self, message: Welcome) -> bool:
        return False


class Attentive(Forgetful):
    """The same house, run better."""

    @hf.on(Welcome)
    def welcome(self, message: Welcome) -> bool:
        self.is_open.update(("asks", "says"))
        self.ctx.unstash()
        return True


def is_not_false(reply: Any) -> bool:
    return reply is not False


class Sworn(Host):
    """Keeps what it has put aside through a restart, and takes it back when it is there again."""

    async def on_start(self, restored: bool) -> None:
        if restored:
            self.is_open.update(("asks", "says"))
            self.ctx.unstash()


MECHANISMS: dict[str, Any] = {
    "none": lambda: None,
    "pbr": hf.ftm.PBR,
    "lfr": hf.ftm.LFR,
    "tr": hf.ftm.TR,
    "tmr": hf.ftm.TMR,
    "tr+pbr": lambda: hf.ftm.compose(hf.ftm.PBR(), hf.ftm.TR()),
    "tr+lfr": lambda: hf.ftm.compose(hf.ftm.LFR(), hf.ftm.TR()),
}


def script(rng: random.Random, length: int) -> list[Any]:
    """Guests come, and the house opens and closes; at the end it is open for all."""
    tags = iter(range(1, length + 1))
    made: list[Any] = []
    for _ in range(length):
        kind = rng.choice(("asks", "says"))
        made.append(rng.choices((Meet(next(tags), kind), Add(100), Open(kind), Close()), (6, 1, 2, 1))[0])
    return [*made, Open("says"), Open("asks")]


async def played(system: hf.ActorSystem, ref: hf.ActorRef[Any], messages: list[Any]) -> tuple[list[Any], list[int]]:
    """The replies to a script, and the order in which guests and others have been handled."""
    asks = [asyncio.ensure_future(ref.ask(one, timeout=IN_TIME)) for one in messages]
    replies = await asyncio.gather(*asks)
    return replies, await ref.ask(Tags(), timeout=IN_TIME)


async def expected(system: hf.ActorSystem, messages: list[Any]) -> tuple[list[Any], list[int]]:
    """What an actor that nothing protects makes of it."""
    plain = await system.start(hf.child("plain", hf.start(Host)))
    found = await played(system, plain, messages)
    await system.terminate(plain)
    return found


def numbers(messages: list[Any]) -> list[int]:
    return sorted(one.tag for one in messages if isinstance(one, Meet) and one.kind == "asks")


@pytest.mark.pairs
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("method", ["without recovery", "hybrid"])
@pytest.mark.parametrize("mechanism", MECHANISMS)
async def test_what_is_put_back_is_handled_as_without_a_mechanism(
    system: hf.ActorSystem, mechanism: str, method: str, seed: int
) -> None:
    messages = script(random.Random(f"{SEED} {seed}"), 40)
    print(f"HOLDFAST_SEED={SEED}, script {seed}")
    other = await system.start(hf.child("other", hf.start(Counter)))
    want = await expected(system, messages)
    assert sorted(await other.ask(Tags())) == numbers(messages)
    recovery = hf.hybrid(interval=0.05) if method == "hybrid" else None
    spec = hf.child("host", hf.start(Host), mechanism=MECHANISMS[mechanism](), recovery=recovery)
    ref = await system.start(spec)
    assert await played(system, ref, messages) == want
    assert sorted(await other.ask(Tags())) == sorted(2 * numbers(messages))


@pytest.mark.parametrize("seed", [0, 1, 2, 3, "101", "103", "110"])
@pytest.mark.parametrize("mechanism", ["pbr", "lfr", "tmr", "tr+pbr"])
@pytest.mark.some(12)
async def test_whoever_leads_dies_while_what_was_put_back_is_handled(
    system: hf.ActorSystem, mechanism: str, seed: int | str
) -> None:
    """Those that are texts have shown faults, at some instants."""
    rng = random.Random(f"{seed} killed" if isinstance(seed, str) else f"{SEED} killed {seed}")
    messages = script(rng, 60)
    print(f"HOLDFAST_SEED={SEED}, script {seed}")
    other = await system.start(hf.child("other", hf.start(Counter)))
    want = await expected(system, messages)
    spec = hf.child("host", hf.start(Host), mechanism=MECHANISMS[mechanism](), recovery=hf.hybrid(interval=0.05))
    ref = await system.start(spec)
    await two_again(ref)
    kills = sorted(rng.sample(range(len(messages)), 3))
    asks = list[asyncio.Future[Any]]()
    for number, message in enumerate(messages):
        asks.append(asyncio.ensure_future(ref.ask(message, timeout=IN_TIME)))
        if number in kills:
            await asyncio.sleep(rng.random() * 0.004)  # Anywhere in between: which step that is, the seed decides.
            if is_complete(ref):
                primary = group_of(ref).membership.primary
                assert primary is not None
                with contextlib.suppress(ProcessLookupError):  # It was struck a moment ago, and nobody knows yet.
                    os.kill(pid_of(system, ref, primary), signal.SIGKILL)
    replies = await asyncio.gather(*asks)
    assert (replies, await ref.ask(Tags(), timeout=IN_TIME)) == want
    assert sorted(await other.ask(Tags())) == sorted(2 * numbers(messages))


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("mechanism", MECHANISMS)
@pytest.mark.some(6)
async def test_all_that_have_the_state_die_and_what_was_put_back_is_replayed_for_both_of_its_turns(
    system: hf.ActorSystem, mechanism: str, seed: int
) -> None:
    """No snapshot stands behind any of it."""
    rng = random.Random(f"{SEED} replay {seed}")
    print(f"HOLDFAST_SEED={SEED}, script {seed}")
    messages = script(rng, 30)
    other = await system.start(hf.child("other", hf.start(Counter)))
    want = await expected(system, messages)
    spec = hf.child(
        "host",
        hf.start(Host),
        mechanism=MECHANISMS[mechanism](),
        isolation="process",
        recovery=hf.hybrid(interval=3600.0),
    )
    ref = await system.start(spec)
    await both_halves(system, ref, messages, rng.randrange(10, 30), want)
    assert sorted(await other.ask(Tags())) == sorted(2 * numbers(messages))


async def both_halves(
    system: hf.ActorSystem, ref: hf.ActorRef[Any], messages: list[Any], middle: int, want: tuple[list[Any], list[int]]
) -> None:
    """Play a script in two halves, and kill all that have the state behind each."""
    replies = list[asyncio.Future[Any]]()
    for part in (messages[:middle], messages[middle:]):
        replies += [asyncio.ensure_future(ref.ask(one, timeout=IN_TIME)) for one in part]
        await ref.ask(Tags(), timeout=IN_TIME)
        for path, pid in system._workers.processes().items():
            if path == ref.path or path.startswith(f"{ref.path}/"):
                os.kill(pid, signal.SIGKILL)
    assert await ref.ask(Tags(), timeout=IN_TIME) == want[1]
    assert await asyncio.gather(*replies) == want[0]


@pytest.mark.parametrize("others", [0, 1], ids=["alone", "behind one that asks"])
@pytest.mark.parametrize("mechanism", ["pbr", "lfr", "tr"])
async def test_who_dies_of_what_was_put_back_leaves_it_in_no_batch_and_its_heir_handles_it(
    system: hf.ActorSystem, mechanism: str, others: int, tmp_path: Path
) -> None:
    """Home knows that it was put aside, and the heir's state that it was put back."""
    await system.start(hf.child("other", hf.start(Counter)))
    spec = hf.child("host", hf.start(Mortal), mechanism=MECHANISMS[mechanism](), recovery=hf.hybrid(interval=0.05))
    ref = await system.start(spec)
    if mechanism != "tr":
        await two_again(ref)
    before = [asyncio.ensure_future(ref.ask(Meet(1, "asks"), timeout=25.0)) for _ in range(others)]
    guest = asyncio.ensure_future(ref.ask(Fatal(str(tmp_path / "killed")), timeout=25.0))
    await ref.ask(Open("asks"), timeout=IN_TIME)
    assert await guest == others
    assert await asyncio.gather(*before) == [1] * others
    assert (tmp_path / "killed").exists()


@pytest.mark.parametrize("method", ["without recovery", "hybrid"])
@pytest.mark.parametrize("mechanism", [name for name in MECHANISMS if name != "none"])
async def test_what_was_put_back_and_raises_fails_once_and_all_behind_it_is_handled(
    system: hf.ActorSystem, mechanism: str, method: str
) -> None:
    other = await system.start(hf.child("other", hf.start(Counter)))
    recovery = hf.hybrid(interval=0.05) if method == "hybrid" else None
    spec = hf.child("host", hf.start(Touchy), mechanism=MECHANISMS[mechanism](), recovery=recovery)
    ref = await system.start(spec)
    guests = (Meet(1, "asks"), Rude(), Meet(2, "asks"), Rude())
    asks = [asyncio.ensure_future(ref.ask(one, timeout=60.0)) for one in guests]
    await ref.ask(Open("asks"), timeout=60.0)
    assert await ref.ask(Meet(3, "asks"), timeout=60.0) == 3
    first, rude, second, last = await asyncio.gather(*asks, return_exceptions=True)
    assert (first, second, await other.ask(Tags())) == (1, 2, [1, 2, 3])
    assert type(rude) is type(last) is hf.RemoteCrash


@pytest.mark.parametrize("more", [0, 8], ids=["nothing comes", "more comes"])
async def test_what_an_alternate_has_put_back_is_in_no_batch_and_is_handled(system: hf.ActorSystem, more: int) -> None:
    """Also if home sends more while the first of them waits for whom it has asked."""
    other = await system.start(hf.child("other", hf.start(Counter)))
    blocks = hf.ftm.RB(alternates=(Attentive,), test=(is_not_false,))
    ref = await system.start(hf.child("host", hf.start(Forgetful), mechanism=blocks))
    guests = [asyncio.ensure_future(ref.ask(Meet(tag, "asks"), timeout=25.0)) for tag in range(1, 9)]
    assert await ref.ask(Welcome(), timeout=25.0)
    guests += [asyncio.ensure_future(ref.ask(Meet(tag, "asks"), timeout=25.0)) for tag in range(9, 9 + more)]
    assert await asyncio.gather(*guests) == [*range(1, 9 + more)]
    assert await other.ask(Tags()) == [*range(1, 9 + more)]
    assert await ref.ask(Tags(), timeout=25.0) == [*range(1, 9 + more)]


@pytest.mark.parametrize("spins", range(0, 60, 6))
async def test_whoever_leads_dies_as_soon_as_it_has_handled_what_home_has_not_heard_of(
    system: hf.ActorSystem, spins: int
) -> None:
    """The follower has handled all of it. Home asks again in the order in which it was sent, one after the other."""
    spec = hf.child("host", hf.start(Host), mechanism=hf.ftm.LFR(), recovery=hf.hybrid(interval=0.05))
    ref = await system.start(spec)
    await two_again(ref)
    messages = [Meet(1, "says"), Meet(2, "says"), Open("says"), Close(), Meet(3, "says"), Open("says")]
    asks = [asyncio.ensure_future(ref.ask(one, timeout=25.0)) for one in messages]
    for _ in range(spins):
        await asyncio.sleep(0)
    primary = group_of(ref).membership.primary
    assert primary is not None
    os.kill(pid_of(system, ref, primary), signal.SIGKILL)
    assert await asyncio.gather(*asks) == [1, 2, None, None, 3, None]
    assert await ref.ask(Tags(), timeout=IN_TIME) == [1, 2, 3]


@pytest.mark.parametrize("mechanism", ["pbr", "lfr", "tr"])
async def test_a_life_that_takes_back_in_its_start_handles_it_without_being_asked_for_more(
    system: hf.ActorSystem, mechanism: str
) -> None:
    """No batch has it: whoever leads next handles it by itself."""
    other = await system.start(hf.child("other", hf.start(Counter)))
    spec = hf.child("host", hf.start(Sworn), mechanism=MECHANISMS[mechanism](), recovery=hf.hybrid(interval=0.05))
    ref = await system.start(spec)
    if mechanism != "tr":
        await two_again(ref)
    guests = [asyncio.ensure_future(ref.ask(Meet(tag, "asks"), timeout=IN_TIME)) for tag in (1, 2, 3)]
    assert await ref.ask(Add(100), timeout=IN_TIME) == 1
    await system.checkpoint(ref)
    for name in ("r1",) if mechanism == "tr" else ("r1", "r2"):
        os.kill(pid_of(system, ref, name), signal.SIGKILL)
    assert await asyncio.gather(*guests) == [2, 3, 4]
    assert await other.ask(Tags()) == [1, 2, 3]


@pytest.mark.parametrize("recovery", [None, hf.hybrid(interval=3600.0)], ids=["plain", "hybrid"])
@pytest.mark.parametrize("mechanism", ["pbr", "tmr", "tr+pbr"])
async def test_the_next_leader_takes_back_in_its_start_and_all_runs_of_what_follows_agree(
    system: hf.ActorSystem, mechanism: str, recovery: hf.Method | None
) -> None:
    """What its hook has put back is where each run of the turns behind it begins."""
    events = system.events()
    other = await system.start(hf.child("other", hf.start(Counter)))
    spec = hf.child("host", hf.start(Sworn), mechanism=MECHANISMS[mechanism](), recovery=recovery)
    ref = await system.start(spec)
    await two_again(ref)
    guests = [asyncio.ensure_future(ref.ask(Meet(tag, "asks"), timeout=IN_TIME)) for tag in (1, 2, 3)]
    assert await ref.ask(Add(100), timeout=IN_TIME) == 1
    primary = group_of(ref).membership.primary
    assert primary is not None
    os.kill(pid_of(system, ref, primary), signal.SIGKILL)
    assert isinstance(await ref.ask(Add(101), timeout=IN_TIME), int)
    assert await asyncio.gather(*guests) == [2, 3, 4]
    assert await ref.ask(Tags(), timeout=IN_TIME) == [100, 1, 2, 3, 101]
    assert await other.ask(Tags()) == [1, 2, 3]
    assert not [one for one in events.take() if isinstance(one, hf.events.Masked | hf.events.Diverged)]


@pytest.mark.parametrize("mechanism", [name for name in MECHANISMS if name != "none"])
async def test_who_comes_when_the_house_has_just_opened_waits_for_those_who_were_put_back(
    system: hf.ActorSystem, mechanism: str
) -> None:
    """The message that opens it has been answered before they are handled."""
    other = await system.start(hf.child("other", hf.start(Counter)))
    ref = await system.start(hf.child("host", hf.start(Host), mechanism=MECHANISMS[mechanism]()))
    want = list[int]()
    for first in range(0, 100, 10):
        await ref.ask(Close(), timeout=IN_TIME)
        guests = [asyncio.ensure_future(ref.ask(Meet(first + more, "asks"), timeout=IN_TIME)) for more in range(4)]
        await ref.ask(Open("asks"), timeout=IN_TIME)
        guests += [asyncio.ensure_future(ref.ask(Meet(first + more, "asks"), timeout=IN_TIME)) for more in range(4, 6)]
        assert await asyncio.gather(*guests) == [*range(len(want) + 1, len(want) + 7)]
        want += range(first, first + 6)
    assert await ref.ask(Tags(), timeout=IN_TIME) == await other.ask(Tags()) == want


class Second(Host): ...


class Third(Host): ...


class Doubtful(Host):
    """Is wrong about some guests, and cannot open its doors to those who only say something."""

    @hf.on(Meet)
    async def meet(self, message: Meet) -> int:
        await super().meet(message)
        if message.kind in self.is_open and message.tag % 3 == 0:
            self.tags.append(-1)
            return -1
        return len(self.tags)

    @hf.on(Open)
    async def open(self, message: Open) -> None:
        if message.kind == "says":
            raise ValueError("the door is stuck")
        await super().open(message)


def is_no_error(reply: Any) -> bool:
    return reply != -1


DECIDING: dict[str, Any] = {
    "rb": lambda: hf.ftm.RB(alternates=(Second,), test=(is_no_error,)),
    "nvp": lambda: hf.ftm.NVP(versions=(Second, Third)),
    "rb+pbr": lambda: hf.ftm.compose(hf.ftm.PBR(), hf.ftm.RB(alternates=(Second,), test=(is_no_error,))),
    "rb+lfr": lambda: hf.ftm.compose(hf.ftm.LFR(), hf.ftm.RB(alternates=(Second,), test=(is_no_error,))),
    "nvp+pbr": lambda: hf.ftm.compose(hf.ftm.PBR(), hf.ftm.NVP(versions=(Second, Third))),
    "nvp+lfr": lambda: hf.ftm.compose(hf.ftm.LFR(), hf.ftm.NVP(versions=(Second, Third))),
}


@pytest.mark.pairs
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("method", ["without recovery", "hybrid"])
@pytest.mark.parametrize("mechanism", DECIDING)
async def test_what_is_put_back_by_blocks_and_votes_is_handled_as_without_faults(
    system: hf.ActorSystem, mechanism: str, method: str, seed: int
) -> None:
    messages = script(random.Random(f"{SEED} {seed}"), 40)
    print(f"HOLDFAST_SEED={SEED}, script {seed}")
    other = await system.start(hf.child("other", hf.start(Counter)))
    want = await expected(system, messages)
    recovery = hf.hybrid(interval=0.05) if method == "hybrid" else None
    spec = hf.child("host", hf.start(Doubtful), mechanism=DECIDING[mechanism](), recovery=recovery)
    assert await played(system, await system.start(spec), messages) == want
    assert sorted(await other.ask(Tags())) == sorted(2 * numbers(messages))


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("mechanism", DECIDING)
@pytest.mark.some(6)
async def test_what_is_put_back_by_blocks_and_votes_is_replayed_as_it_was(
    system: hf.ActorSystem, mechanism: str, seed: int
) -> None:
    """All that have the state die, twice; the replay itself ends with a snapshot."""
    messages = script(random.Random(f"{SEED} {seed}"), 40)
    print(f"HOLDFAST_SEED={SEED}, script {seed}")
    other = await system.start(hf.child("other", hf.start(Counter)))
    want = await expected(system, messages)
    spec = hf.child("host", hf.start(Doubtful), mechanism=DECIDING[mechanism](), recovery=hf.hybrid(interval=3600.0))
    await both_halves(system, await system.start(spec), messages, 20, want)
    assert sorted(await other.ask(Tags())) == sorted(2 * numbers(messages))


@pytest.mark.parametrize("mechanism", DECIDING)
async def test_no_snapshot_is_taken_of_what_blocks_and_votes_have_not_decided_on(
    system: hf.ActorSystem, mechanism: str
) -> None:
    """The state that is rejected would come back at the next crash."""
    spec = hf.child("host", hf.start(Doubtful), mechanism=DECIDING[mechanism](), recovery=hf.hybrid(every=1))
    ref = await system.start(spec)
    await system.start(hf.child("other", hf.start(Counter)))
    await ref.ask(Open("asks"), timeout=IN_TIME)
    want = list[int]()
    for first in range(0, 90, 30):
        tags = range(first, first + 30, 3)  # The host is wrong about all of them.
        want += tags
        await asyncio.gather(*(ref.ask(Meet(tag, "asks"), timeout=IN_TIME) for tag in tags))
        for path, pid in system._workers.processes().items():
            if path.startswith(f"{ref.path}/"):
                os.kill(pid, signal.SIGKILL)
        assert await ref.ask(Tags(), timeout=IN_TIME) == want


class Unwelcome(hf.Message[bool]):
    """A guest for whom nothing that the host does is right: it waits for ever, or is not what was wanted."""

    waits: bool


class Helpless(Forgetful):
    @hf.on(Unwelcome)
    async def let_in_unwelcome(self, message: Unwelcome) -> bool:
        if not self.is_open:
            self.ctx.stash()
            return True
        if message.waits:
            await asyncio.get_running_loop().create_future()
        return False


class Attending(Attentive, Helpless):
    """The same house, run better, and as helpless."""


@pytest.mark.parametrize("waits", [True, False], ids=["hangs", "is refused"])
async def test_what_an_alternate_has_put_back_and_no_block_handles_fails_once_and_all_behind_it_is_handled(
    system: hf.ActorSystem, waits: bool
) -> None:
    await system.start(hf.child("other", hf.start(Counter)))
    watched = hf.ftm.Detection(interval=0.02, watch_turns=0.5)
    blocks = hf.ftm.RB(alternates=(Attending,), test=(is_not_false,), detection=watched)
    ref = await system.start(hf.child("host", hf.start(Helpless), mechanism=blocks))
    unwelcome = asyncio.ensure_future(ref.ask(Unwelcome(waits), timeout=25.0))
    guests = [asyncio.ensure_future(ref.ask(Meet(tag, "asks"), timeout=25.0)) for tag in (1, 2)]
    with system.events() as stream:
        assert await ref.ask(Welcome(), timeout=25.0)
        assert await asyncio.gather(*guests) == [1, 2]
        with pytest.raises(hf.Quarantined if waits else NotAccepted):
            await unwelcome
        assert await ref.ask(Tags(), timeout=25.0) == [1, 2]
        tried = [one for one in stream.take() if isinstance(one, Objected) and not one.by]
    assert len(tried) == 1
