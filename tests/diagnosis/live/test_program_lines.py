"""What a program prints for an actor is a topic: when it falls silent the program is named, and none of its readers."""

import asyncio
import os
import signal

import pytest

import holdfast as hf
from holdfast import diagnosis
from holdfast.diagnosis.engine import State
from holdfast.diagnosis.observers import Manner, flow
from holdfast.diagnosis.repair import Caution, Policy, RepairTold
from tests.supervision.programs import info, python

BEATS = "import time\nwhile True:\n    print('beat', flush=True)\n    time.sleep(0.02)"
STARTS = "import time\ntime.sleep(0.3)\nfor n in range(40): print(n, flush=True); time.sleep(0.008)\ntime.sleep(99)"


class Reading(hf.Message): ...


class Base(hf.Actor):
    """Publishes what its driver prints."""

    @hf.on(hf.supervision.ProgramLine)
    async def read(self, line: hf.supervision.ProgramLine) -> None:
        await self.ctx.publish("/odom", Reading())


class Localisation(hf.Actor):
    @hf.subscribe("/odom")
    @hf.on(Reading)
    def take(self, message: Reading) -> None: ...


async def test_a_driver_that_falls_silent_is_named_and_restarted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flow, "STEADY", 0.5)
    async with hf.ActorSystem("t", log=False, intensity=1000) as system:
        await system.start(hf.child("localisation", hf.start(Localisation)))
        system.register("the base", await system.start(hf.child("base", hf.start(Base))))
        await system.start(python(BEATS, id="driver", lines_to="the base", shutdown=0.4))
        await system.start(python(STARTS, id="logger", lines_to="/t/base", log_lines=False))
        manner, quick = Manner(every=0.1, time_to_live=2.0), Policy(settle=0.1, caution=Caution(confirm=0.1))
        watching = await diagnosis.watch(system, repair="on", policy=quick, seconds=1.0, window=0.5, manner=manner)
        assert watching.generated is not None
        wiring = watching.generated.wiring
        assert wiring["driver"].publishes == ("/t/driver.lines",)
        assert set(wiring["base"].subscribes) == {"/t/driver.lines", "/t/logger.lines"}
        pid = (await info(system, "/t/driver")).pid
        with system.events() as events:
            os.kill(pid, signal.SIGSTOP)
            said = list[str]()
            async with asyncio.timeout(60.0):
                async for event in events:
                    if isinstance(event, RepairTold):
                        said.append(event.text)
                        if event.what == "Repaired":
                            break
        assert said[0] == "driver is suspected, because not ok(/t/driver.lines) was observed."
        assert said[-1].startswith("The symptoms went by restart_child(driver)")
        assert (await info(system, "/t/driver")).pid != pid
        assert (await watching.diagnosis()).state is State.HEALTHY
