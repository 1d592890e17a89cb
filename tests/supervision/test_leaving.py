"""What an actor's code raises ends that life, and nothing else: also what would end a program."""

import asyncio
from typing import Any

import pytest

import holdfast as hf
from holdfast.ftm.mechanisms.pbr import PBR
from tests.supervision.family import refused
from tests.supervision.leavers import LEAVING, PHASES, Go, GoNow, Leaver

SECONDS = 60.0  # of real time, far more than any of it takes
PLACES: dict[str, dict[str, Any]] = {
    "task": {},
    "process": {"isolation": "process"},
    "recorded": {"recovery": hf.hybrid()},
    "recorded process": {"recovery": hf.hybrid(), "isolation": "process"},
    "below a process": {},
    "recorded below a process": {"recovery": hf.hybrid()},
    "protected": {"mechanism": PBR()},
}


async def crashed(events: hf.events.EventStream, path: str, error: str) -> None:
    """Wait until it is told that the life at an address has crashed with this."""
    async for event in events:
        if isinstance(event, hf.events.ActorCrashed) and event.address == path and error in str(event.reason):
            return


IN_THE_PROCESS = ("task", "recorded", "below a process", "recorded below a process")
CASES = [
    (place, error) for error in LEAVING for place in PLACES if place in IN_THE_PROCESS or error == "KeyboardInterrupt"
]


@pytest.mark.holdfast(exceptions=True)  # That what leaves is told is the point.
@pytest.mark.parametrize(("place", "error"), CASES)
async def test_what_would_end_the_program_ends_one_life(place: str, error: str) -> None:
    """In every place and phase: a start fails, an asker is told, the supervisor restarts, a stop comes to its end."""
    isolation: Any = "process" if "below" in place else "task"
    async with hf.ActorSystem(log=False) as system:
        with system.events() as events:
            top = await system.start(hf.supervisor("top", isolation=isolation, children=[], intensity=len(PHASES)))
            for phase in PHASES:
                if place == "protected" and phase.endswith(("task", "pipe")):
                    continue  # Its background work is that of a replica: not tried here.
                spec = hf.child("x", hf.start(Leaver, phase, error), **PLACES[place])
                started = top.ask(hf.StartChild(spec, fresh=True), SECONDS)
                if phase.startswith(("__init__", "on_start")):
                    assert error in str(await refused(started)), phase
                    continue
                await started
                ref = system.ref("/app/top/x", Leaver)
                if "turn" in phase:
                    asked = ref.ask(GoNow() if phase == "def turn" else Go(), SECONDS)
                    assert error in str(await refused(asked)), phase
                elif phase == "pipe" or (phase == "task" and error != "CancelledError"):  # Tasks may be cancelled.
                    assert await ref.ask(Go(), SECONDS) == "still here"
                    await crashed(events, "/app/top/x", error if error != "CancelledError" else "cancelled")
                elif phase.startswith("ended"):  # What is raised when it is cancelled with its life.
                    assert await ref.ask(Go(), SECONDS) == "still here"
                assert await ref.ask(GoNow() if phase != "def turn" else Go(), SECONDS) == "still here"
                await top.ask(hf.TerminateChild("x"), SECONDS)
                await top.ask(hf.DeleteChild("x"), SECONDS)
        task = asyncio.current_task()
        assert task is not None
        assert not task.cancelling()
