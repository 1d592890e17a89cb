"""Whatever a turn that waits has been through, it is left at once: behind lives that ended, and changes given up.

`HOLDFAST_LEFT=all python -m pytest tests/effects/test_left_after_changes.py` is the campaign: each change, given up in
each way at several moments, whatever the turn waits for, behind each history; `HOLDFAST_LEFT=500` takes so many of
these, drawn by `HOLDFAST_SEED`. Otherwise a selection is run.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import os
import random
import signal
import time
from collections.abc import Iterator, Sequence
from typing import Any

import pytest

import holdfast as hf
from holdfast.ftm import LFR, PBR, TR
from tests.effects.clerk import IN_TIME
from tests.effects.patient import Call, Go, Patient
from tests.effects.test_long_waits import end_of, waits
from tests.ftm.bad_bricks import Wrong

SEED = int(os.environ.get("HOLDFAST_SEED", "20261128"))
AT_ONCE = 3.0
"""Seconds within which a turn that waits is left, also on a busy machine; it waits for much longer than that."""


class Slow(hf.Message[None]): ...


async def pause() -> None:
    await asyncio.sleep(0.1)


class Clinic(hf.Actor):
    """Takes its time to answer."""

    def __init__(self) -> None:
        self.count = 0

    @hf.on(Slow)
    async def slow(self, message: Slow) -> None:
        await pause()


class Waiting(Patient):
    """Its turns have an effect or an ask out, before they wait."""

    clinic: hf.Binding[Clinic]

    @hf.on(Go)
    async def go(self, message: Go) -> str | hf.ReplyHandle[str]:
        if message.file == "effect":
            await self.ctx.effect(pause)
        if message.file == "ask":
            await self.clinic.ask(Slow())
        return await super().go(message)


class Newer(Waiting): ...


def as_it_was(state: dict[str, Any]) -> dict[str, Any]:
    return dict(state)


def not_this(state: dict[str, Any]) -> dict[str, Any]:
    raise ValueError("not this state")


BEFORE: dict[str, Any] = {"unprotect": LFR(), "exchange": LFR()}
"""The mechanism that the actor has before, by what is to be changed."""
CHANGES = (
    "protect", "protect with tr", "unprotect", "exchange", "isolate", "move", "suspend", "replace_state",
    "replace_code",
)  # fmt: skip
WAYS = ("other", "brick", "time", "cancel", "kill")
MOMENTS = (0.002, 0.02, 0.05, 0.1, 0.3)
WAITS = ("call", "sleep", "effect", "ask")
HISTORIES = ("none", "waited", "ended", "changed")
Case = tuple[str, str, float, str, str]
SELECTED: tuple[Case, ...] = (
    ("isolate", "other", 0.0, "call", "waited"),
    ("move", "other", 0.0, "sleep", "changed"),
    ("suspend", "cancel", 0.0, "call", "ended"),
    ("replace_code", "other", 0.0, "effect", "waited"),
    ("protect", "kill", 0.05, "call", "changed"),
)


def product() -> Iterator[Case]:
    for change, way, wait, history in itertools.product(CHANGES, WAYS, WAITS, HISTORIES):
        if way == "brick" and change not in ("protect", "protect with tr", "exchange"):
            continue
        for moment in (0.0,) if way in ("other", "brick") else MOMENTS:
            yield change, way, moment, wait, history


def cases() -> Sequence[Case]:
    wanted = os.environ.get("HOLDFAST_LEFT")
    if wanted is None:
        return SELECTED
    every = list(product())
    return every if wanted == "all" else random.Random(SEED).sample(every, int(wanted))


def collect(change: Any, what: str, ref: Any, *, bad: bool) -> None:
    """The step of a transaction that is to be given up; `bad`: with a brick that raises."""
    stacks = {"protect": (LFR(),), "protect with tr": (PBR(), TR()), "exchange": (PBR(),), "unprotect": ()}
    match what:
        case "isolate":
            change.isolation(ref, "process")
        case "move":
            change.move(ref, "/app/ward")
        case "suspend":
            change.suspend(ref)
        case "replace_state":
            change.replace_state(ref, as_it_was)
        case "replace_code":
            change.replace_code(ref, Newer)
        case _:
            change.protect(ref, (*stacks[what], Wrong(when="init", late=False)) if bad else stacks[what] or None)


async def give_up(system: hf.ActorSystem, ref: Any, case: Case) -> None:
    """Begin the change, and have it given up; it may have come about before that."""
    what, way, moment, _, _ = case
    within = moment if way == "time" else 0.3 if what == "move" else IN_TIME  # A move waits for the end of the turn.

    async def changed() -> None:
        async with system.transaction(timeout=within) as change:
            collect(change, what, ref, bad=way == "brick")
            if way == "other":
                change.replace_state("/app/clinic", not_this)

    work = asyncio.create_task(changed())
    if way in ("cancel", "kill"):
        await asyncio.sleep(moment)
        if way == "cancel":
            work.cancel()
        else:
            kill(system, ref)
    with contextlib.suppress(hf.HoldfastError, asyncio.CancelledError):
        await work
        if what == "suspend":  # It has come about.
            await system.resume(ref, timeout=IN_TIME)


def kill(system: hf.ActorSystem, ref: Any) -> None:
    """End a replica, if there is one by now; else the life itself."""
    for path in (f"{ref.path}/ftm/r1", ref.path):
        with contextlib.suppress(hf.HoldfastError):
            pid = system.pid_of(system.ref(path, hf.Actor))
            if pid == os.getpid():
                ref.kill()
            else:
                os.kill(pid, signal.SIGKILL)
            return


async def has_waited(system: hf.ActorSystem, ref: Any, history: str) -> None:
    """An earlier turn has waited."""
    if history == "none":
        return
    asked = ref.ask(Go(["c"]), IN_TIME)
    await waits(system, ref.path)
    if history == "ended":
        kill(system, ref)
    elif history == "changed":
        await system.set_isolation(ref, "process")
        await waits(system, ref.path)
        await system.set_isolation(ref, "task")
    await ref.ask(Call("a"), IN_TIME)
    assert await asked == "call a"


async def are_left(system: hf.ActorSystem, ref: Any) -> None:
    """Each of what an operator may want leaves the turn."""
    if (await system.protection(ref)).stack:
        async with system.transaction(timeout=IN_TIME) as change:
            change.protect(ref, None)
        await waits(system, ref.path)
    with contextlib.suppress(hf.AskFailed):  # It was killed, and that is only seen now.
        await system.suspend(ref, timeout=AT_ONCE)
    await system.suspend(ref, timeout=AT_ONCE)  # Twice is once.
    await system.resume(ref)
    await waits(system, ref.path)
    there: Any = "task" if system.pid_of(ref) != os.getpid() else "process"
    async with system.transaction(timeout=IN_TIME) as change:  # It may be the first process.
        change.isolation(ref, there)
    await waits(system, ref.path)


@pytest.mark.parametrize("case", cases(), ids=lambda case: "-".join(map(str, case)))
async def test_a_turn_that_waits_is_left_behind_a_change_that_was_given_up(case: Case) -> None:
    what, _, _, wait, history = case
    async with hf.ActorSystem("app", log=False, intensity=99) as system:
        before = BEFORE.get(what) if history != "changed" else None
        clinic = await system.start(hf.child("clinic", hf.start(Clinic), recovery=hf.hybrid(interval=1000.0)))
        spec = hf.child(
            "patient", hf.start(Waiting), recovery=hf.hybrid(interval=1000.0), mechanism=before,
            bindings={"clinic": clinic.path},
        )  # fmt: skip
        ref: Any = await system.start(spec)
        await system.start(hf.supervisor("ward", children=[]))
        await has_waited(system, ref, history)
        if what in BEFORE and before is None:
            async with system.transaction(timeout=IN_TIME) as change:
                change.protect(ref, BEFORE[what])
        asked = asyncio.ensure_future(ref.ask(Go(["s600"] if wait == "sleep" else ["c"], wait), IN_TIME))
        if wait in ("call", "sleep"):
            await waits(system, ref.path)
        await give_up(system, ref, case)
        with contextlib.suppress(hf.errors.NoSuchActor):
            ref = system.ref("/app/ward/patient", Waiting)
        await waits(system, ref.path)
        await are_left(system, ref)
        if wait != "sleep":
            await ref.ask(Call("b"), IN_TIME)
            assert await asked == "call b"
            asked = asyncio.ensure_future(ref.ask(Go(["c"]), IN_TIME))
            await waits(system, ref.path)
        begin = time.monotonic()
    assert time.monotonic() - begin < AT_ONCE
    asked.cancel()


@pytest.mark.parametrize("isolation", ["task", "process"])
@pytest.mark.parametrize("steps", [["c"], ["s0.001"], ["s0.001", "c"]], ids="-".join)
async def test_an_earlier_turn_that_has_waited_is_no_reason_not_to_leave_this_one(
    isolation: Any, steps: list[str]
) -> None:
    """In a replay both come at once."""
    async with hf.ActorSystem("app", log=False, intensity=99) as system:
        spec = hf.child("patient", hf.start(Patient), isolation=isolation, recovery=hf.hybrid(interval=1000.0))
        ref = await system.start(spec)
        first = ref.ask(Go(steps), IN_TIME)
        ref.tell(Call("a"))
        await first
        asked = ref.ask(Go(["c"]), IN_TIME)
        await waits(system)
        await end_of(system, isolation)
        await waits(system)
        seen = await system.get_state(ref, timeout=AT_ONCE)
        assert len(seen["seen"]) == 1 + ("c" not in steps), "a state is looked at beside the turn"
        await system.suspend(ref, timeout=AT_ONCE)
        await system.resume(ref)
        ref.tell(Call("b"))
        assert await asked == "call b"
