"""From the power board's wire to the diagnosis: a device without power is named."""

import holdfast as hf
from holdfast.diagnosis import DIAGNOSIS, observer, tree
from holdfast.diagnosis.board import Board, BoardActor, BoardSimulator, GetBoard
from holdfast.diagnosis.engine import Diagnosis, State
from holdfast.diagnosis.model import System
from holdfast.diagnosis.observers import Channel, HardwareObserver, Manner
from holdfast.testing import probe

LONG = 20.0  # seconds that nothing here takes, unless something is wrong


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
        found = await heard.fish(Diagnosis, timeout=LONG)
        assert [one.bad for one in found.candidates] == [("base",)]
        async with Board(url) as client:
            await client.switch(0, True)
            await heard.fish(lambda one: one.state is State.HEALTHY, timeout=LONG)
            await client.switch(1, False)
        found = await heard.fish(Diagnosis, timeout=LONG)
        assert [one.bad for one in found.candidates] == [("pc",)]
        await system.stop(simulator)
        found = await heard.fish(Diagnosis, timeout=LONG)
        assert found.state is State.BLIND  # T50: a board that is silent says nothing
