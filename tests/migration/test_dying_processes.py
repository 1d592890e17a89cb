"""A process that dies while its actor is to leave it: the move hears of that from the process itself, and at once."""

from __future__ import annotations

import asyncio
import os
import signal

import pytest

import holdfast as hf
from holdfast.actors.kernel.lifecycle import LOCAL
from holdfast.actors.migration.here import ToHere
from holdfast.actors.migration.move import Move
from holdfast.actors.migration.worker import FromWorker
from tests.migration.travellers import Add, Seen, Traveller

IN_TIME = 60.0


async def test_a_move_ends_with_a_process_that_dies_before_its_actor_is_at_rest() -> None:
    """The process is stopped, so that it never says that its actor is at rest; whose life has ended is told later."""
    async with hf.ActorSystem("app", log=False) as system:
        one = await system.start(hf.child("one", hf.start(Traveller), isolation="process"))
        await one.ask(Add(1), IN_TIME)
        pid, cell = system.pid_of(one), one._cell
        worker = system._workers.by_cell[cell]
        os.kill(pid, signal.SIGSTOP)
        leaving = asyncio.ensure_future(Move(cell, FromWorker(worker), ToHere(LOCAL), timeout=24 * 3600.0).run())
        while not worker.movers:
            assert not leaving.done(), leaving
            await asyncio.sleep(0)
        os.kill(pid, signal.SIGKILL)
        async with asyncio.timeout(IN_TIME):
            with pytest.raises(hf.errors.CannotMove, match=r"its process has died \(SIGKILL\)"):
                await leaving
            while True:
                try:
                    assert (await one.ask(Seen(), IN_TIME))["added"] == []
                    break
                except (hf.AskFailed, hf.ActorStopped):  # The supervisor has not started it again yet.
                    await asyncio.sleep(0)
        assert system.pid_of(one) not in (pid, os.getpid())
