"""Each life that begins at a receiver's address while it has to be safe is told so (T26), and nobody else of the end.

It does not matter how that life comes about, nor where it is lived.
"""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from tests.checkpoint.guards import Faint, Halt, Planner, Resume, Wheels, over, running, words
from tests.checkpoint.players import until
from tests.checkpoint.strikes import NEVER, strike

pytestmark = pytest.mark.usefixtures("warm_programs")

PLAYER = Path(__file__).with_name("safe_state_player.py")
WHEELS, PLANNER = "/app/top/wheels", "/app/top/planner"

PLACES: dict[str, dict[str, Any]] = {
    "task": {},
    "bounded": {"mailbox": hf.bounded(1)},
    "process": {"isolation": "process"},
    "bounded process": {"isolation": "process", "mailbox": hf.bounded(1)},
    "recorded": {"recovery": hf.hybrid(interval=NEVER)},
    "recorded process": {"recovery": hf.hybrid(interval=NEVER), "isolation": "process"},
    "checkpoint only": {"recovery": hf.checkpoint_only(interval=NEVER)},
}


class Recovering:
    """A planner whose recovery waits before its release until it is let go on."""

    def __init__(self) -> None:
        self.go_on, self.waiting = asyncio.Event(), 0
        self.hooks = hf.checkpoint.recovery_hooks(before={"release": self._wait}, timeout=30.0)

    async def _wait(self, step: hf.checkpoint.RecoveryStep) -> None:
        if step.address.endswith("/planner"):  # A recorded receiver is recovered, too.
            self.waiting += 1
            await self.go_on.wait()

    async def begins(self, system: hf.ActorSystem, path: str = PLANNER) -> None:
        before = self.waiting
        strike(system, system.ref(path, hf.Actor))
        await until(lambda: self.waiting > before)


def planner(state: Any = WHEELS) -> hf.ChildSpec:
    return hf.child("planner", hf.start(Planner), recovery=hf.hybrid(interval=NEVER, safe_state=state))


def receiver(place: str) -> hf.ChildSpec:
    return hf.child("wheels", hf.start(Wheels), **PLACES[place])


async def above(system: hf.ActorSystem, recovering: Recovering) -> None:
    """The planner's crash ends the supervisor above both, which begins both anew."""
    await recovering.begins(system)


async def alone(system: hf.ActorSystem, recovering: Recovering) -> None:
    await recovering.begins(system)
    await words(system.ref(WHEELS, Wheels))
    await ends(system)


async def ends(system: hf.ActorSystem) -> None:
    """The receiver's life ends, and the next one begins."""
    ref = system.ref(WHEELS, Wheels)
    life = ref._cell.life
    strike(system, ref)
    await until(lambda: ref._cell.life > life)


async def twice(system: hf.ActorSystem, recovering: Recovering) -> None:
    await alone(system, recovering)
    await ends(system)


async def before(system: hf.ActorSystem, recovering: Recovering) -> None:
    """It is struck just before the planner is: its new life begins while the recovery does."""
    strike(system, system.ref(WHEELS, Wheels))
    await recovering.begins(system)


async def replaced(system: hf.ActorSystem, recovering: Recovering) -> None:
    """A transaction takes it away; a later one puts another one there, which has no journal of the first."""
    await recovering.begins(system)
    spec = system.ref(WHEELS, Wheels)._cell.spec
    async with system.transaction() as change:
        change.remove(WHEELS)
    async with system.transaction() as change:
        change.add("/app/top", spec)


WAYS: dict[str, tuple[int, Callable[[hf.ActorSystem, Recovering], Awaitable[None]]]] = {
    "above": (0, above),
    "alone": (1000, alone),
    "twice": (1000, twice),
    "before": (1000, before),
    "replaced": (1000, replaced),
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("place", PLACES)
async def test_a_new_life_is_told_once_and_hears_of_the_end(place: str, way: str) -> None:
    intensity, happens = WAYS[way]
    recovering = Recovering()
    async with running(recovery_hooks=recovering.hooks) as system:
        children = [receiver(place), planner()]
        await system.start(hf.supervisor("top", children=children, intensity=intensity, period=60.0))
        await happens(system, recovering)
        ref = system.ref(WHEELS, Wheels)
        told = await words(ref)
        if place == "checkpoint only":  # What it had not begun is kept, so it may hear of one beginning twice.
            told = [*dict.fromkeys(told)]
        assert told == ["safe"]
        told = await words(ref)
        recovering.go_on.set()
        await over(system)
        assert await words(ref) == [*told, "free"]


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_it_is_told_also_if_it_is_below_another_supervisor_that_is_restarted(isolation: Any) -> None:
    recovering = Recovering()
    async with running(recovery_hooks=recovering.hooks) as system:
        own = hf.supervisor("own", children=[hf.child("wheels", hf.start(Wheels))], isolation=isolation)
        await system.start(own)
        await system.start(hf.supervisor("top", children=[planner("/app/own/wheels")], intensity=1000))
        await recovering.begins(system)
        assert await words(system.ref("/app/own/wheels", Wheels)) == ["safe"]
        cell = system.ref("/app/own/wheels", Wheels)._cell
        strike(system, system.ref("/app/own", hf.Actor))
        await until(lambda: system._node.find("/app/own/wheels") not in (None, cell))
        ref = system.ref("/app/own/wheels", Wheels)
        assert await words(ref) == ["safe"]
        recovering.go_on.set()
        await over(system)
        assert await words(ref) == ["safe", "free"]


async def test_who_comes_to_an_address_where_nobody_lived_is_told() -> None:
    recovering = Recovering()
    async with running(recovery_hooks=recovering.hooks) as system:
        await system.start(hf.supervisor("top", children=[planner()], intensity=1000))
        with system.events() as stream:
            await recovering.begins(system)
            async with system.transaction() as change:
                change.add("/app/top", receiver("task"))
            ref = system.ref(WHEELS, Wheels)
            assert await words(ref) == ["safe"]
            recovering.go_on.set()
            await over(system)
            assert await words(ref) == ["safe", "free"]
            kinds = (hf.events.SafeStateMissed, hf.events.SafeStateEntered, hf.events.SafeStateLeft)
            assert [type(one) for one in stream.take() if isinstance(one, kinds)] == [*kinds]


async def test_of_two_recoveries_a_new_life_hears_one_beginning_and_one_end() -> None:
    recovering = Recovering()
    async with running(recovery_hooks=recovering.hooks) as system:
        await system.start(hf.supervisor("top", children=[receiver("task"), planner()], intensity=1000))
        await system.start(hf.supervisor("other", children=[planner()], intensity=1000))
        await recovering.begins(system)
        await recovering.begins(system, "/app/other/planner")
        await ends(system)
        ref = system.ref(WHEELS, Wheels)
        assert await words(ref) == ["safe"]
        recovering.go_on.set()
        await over(system)
        assert await words(ref) == ["safe", "free"]


async def test_a_new_life_is_told_with_messages_before_what_waits() -> None:
    recovering = Recovering()
    async with running(recovery_hooks=recovering.hooks) as system:
        state = hf.checkpoint.safe_state(WHEELS, enter=Halt(0.5), leave=Resume())
        top = hf.supervisor("top", children=[receiver("bounded"), planner(state)], intensity=1000)
        await system.start(top)
        await recovering.begins(system)
        ref = system.ref(WHEELS, Wheels)
        assert await words(ref) == ["halt 0.5"]
        ref.tell(Faint())
        await until(lambda: ref._cell.life == 2)
        recovering.go_on.set()
        await over(system)
        assert await words(ref) == ["halt 0.5", "resume"]


async def test_who_was_not_told_of_the_beginning_is_not_told_of_the_end() -> None:
    """The life that was told is over, and the next one begins only when the recovery is over, too."""
    recovering = Recovering()
    async with running(recovery_hooks=recovering.hooks) as system:
        await system.start(hf.supervisor("top", children=[receiver("task"), planner()], intensity=1000))
        await recovering.begins(system)
        ref = system.ref(WHEELS, Wheels)
        assert await words(ref) == ["safe"]
        async with system.transaction() as change:
            change.remove(WHEELS)
        recovering.go_on.set()
        await over(system)
        async with system.transaction() as change:
            change.add("/app/top", receiver("task"))
        assert await words(system.ref(WHEELS, Wheels)) == []


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(PLAYER), *map(str, arguments)]
    paths = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    return subprocess.run(command, capture_output=True, text=True, timeout=100, env=paths)


@pytest.mark.parametrize("order", ["wheels,planner", "planner,wheels"])
@pytest.mark.parametrize("place", ["task", "recorded", "recorded process", "checkpoint only"])
def test_the_next_program_tells_of_the_end(tmp_path: Path, place: str, order: str) -> None:
    """The whole program is killed in the middle of a recovery: what a journal has of its beginning needs an end."""
    store = tmp_path / "app.db"
    first = run(store, place, order, "killed")
    assert first.returncode == -signal.SIGKILL, first.stderr
    last = run(store, place, order, "last")
    assert last.returncode == 0, last.stderr
    told = last.stdout.split()
    if place == "checkpoint only":  # What it is told of the beginning may be lost with it, or told anew.
        told = ["safe", *told[-1:]]
    assert told == ([] if place == "task" else ["safe", "free"]), last.stderr


@pytest.mark.parametrize("order", ["wheels,planner", "planner,wheels"])
def test_a_program_that_is_killed_in_that_recovery_too_leaves_it_to_the_next_one(tmp_path: Path, order: str) -> None:
    store = tmp_path / "app.db"
    for _ in range(2):
        killed = run(store, "recorded", order, "killed")
        assert killed.returncode == -signal.SIGKILL, killed.stderr
    last = run(store, "recorded", order, "last")
    assert (last.returncode, last.stdout.split()) == (0, ["safe", "free"]), last.stderr
