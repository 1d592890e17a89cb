"""From the power board's wire to the diagnosis: a device without power is named."""

from collections.abc import Callable

import pytest

import holdfast as hf
from holdfast.diagnosis import DIAGNOSIS, observer, tree
from holdfast.diagnosis.board import Board, BoardActor, BoardSimulator, GetBoard
from holdfast.diagnosis.engine import Diagnosis, State
from holdfast.diagnosis.model import System
from holdfast.diagnosis.observers import Channel, HardwareObserver, Manner
from holdfast.testing import probe

LONG = 60.0  # seconds that nothing here takes, unless something is wrong


def blames(name: str) -> Callable[[Diagnosis], bool]:
    return lambda one: [candidate.bad for candidate in one.candidates] == [(name,)]


@pytest.mark.asyncio(loop_factories=["uvloop"])
async def test_a_device_that_is_switched_off_is_the_diagnosis() -> None:
    # D12, D24
    robot = System()
    robot.hardware("base", "pc")
    manner = Manner(every=0.1, time_to_live=1.0)
    async with hf.ActorSystem("t", log=False) as system:
        heard = probe(system)
        heard.subscribe(DIAGNOSIS)
        simulator = system.spawn(hf.start(BoardSimulator), name="simulator")
        url = (await simulator.ask(GetBoard())).url
        devices = [Channel("base", 0, least=100), Channel("pc", 1)]
        watch = observer("power", hf.start(HardwareObserver, *devices, manner=manner))
        board = hf.child("board", hf.start(BoardActor, url, interval=0.05))
        await system.start(tree(robot, [watch], others=[board]))
        await heard.fish(blames("base"), timeout=LONG)
        async with Board(url) as client:
            await client.switch(0, True)
            await heard.fish(lambda one: one.state is State.HEALTHY, timeout=LONG)
            await client.switch(1, False)
        await heard.fish(blames("pc"), timeout=LONG)
        await system.stop(simulator)
        # T50: a board that is silent says nothing.
        await heard.fish(lambda one: one.state is State.BLIND, timeout=LONG)
