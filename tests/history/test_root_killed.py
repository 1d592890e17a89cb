"""What is known after the root was killed: the next one has the history of the one before, from the store."""

import asyncio
import signal
import sys
from pathlib import Path

import holdfast as hf
from holdfast.system.history.past_event import PastEvent
from holdfast.system.history.shelf import EventShelf
from holdfast.system.history.writer import prefix, stored
from tests.history.conftest import ROOT
from tests.history.players import Do, Worker

PROGRAM = "import sys, holdfast; from tests.history.players import root; holdfast.run(root(sys.argv[1]))"


async def killed_root(path: Path) -> None:
    """Run a root whose actor has crashed, and kill it with SIGKILL."""
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-c", PROGRAM, str(path), stdout=asyncio.subprocess.PIPE, cwd=ROOT
    )
    assert process.stdout is not None
    assert await asyncio.wait_for(process.stdout.readline(), 60.0) == b"ready\n"
    process.send_signal(signal.SIGKILL)
    assert await process.wait() == -signal.SIGKILL


async def test_the_next_root_knows_what_was_before_the_kill(tmp_path: Path) -> None:
    path = tmp_path / "app.db"
    await killed_root(path)
    async with hf.ActorSystem("app", store=f"sqlite:{path}", log=False) as system:
        crashed = system.history(kinds=["ActorCrashed"]).events
        assert [one.address for one in crashed] == ["/app/worker"]
        assert "nothing to divide" in str(crashed[0].fields["traceback"])
        [started] = [one for one in system.history(kinds=["SystemStarted"]).events if one.number > crashed[0].number]
        assert started.fields["why"] == "the process of the root was killed"
        lives = system.lives("/app/worker")
        assert [life.reason_kind for life in lives] == ["Crash", "RootKilled"]
        text = " ".join(await system.why("/app/worker"))
        assert "because the process of the root was killed; what it had in hand was cut off." in text
        worker = await system.start(hf.child("worker", hf.start(Worker), recovery=hf.hybrid()))
        assert await worker.ask(Do("well")) == 2
        assert [life.is_over for life in system.lives(worker)] == [True, True, False]
        assert "the process of the root was killed" in " ".join(await system.why(worker))
        last = system.history().next
    async with hf.ActorSystem("app", store=f"sqlite:{path}", log=False) as system:
        page = system.history()
        assert page.next > last
        numbers = [one.number for one in page.events]
        assert numbers == sorted(set(numbers))
        [*_, started] = system.history(kinds=["SystemStarted"]).events
        assert started.fields["why"] == "the process of the root ended"
        assert system.lives("/app/worker")[-1].reason_kind in ("Shutdown", "SystemStopped")


async def test_after_an_orderly_restart_of_the_program_an_actor_is_well(tmp_path: Path) -> None:
    """What has ended with the program is not told as an end that its supervisor has called for."""
    path = tmp_path / "app.db"
    template = hf.child(None, hf.start(Worker), recovery=hf.hybrid())
    for life in (1, 2):
        async with hf.ActorSystem("app", store=f"sqlite:{path}", log=False) as system:
            worker = hf.child("worker", hf.start(Worker), recovery=hf.hybrid())
            north = await system.start(hf.supervisor("north", children=[worker, hf.child("other", hf.start(Worker))]))
            many = await system.start(hf.dynamic("many", template=template, journal=True))
            if life == 1:
                await many.ask(hf.StartChild(id="one"))
            addresses = ("/app/north/worker", "/app/north/other", "/app/many/one", north.path, many.path)
            for at in addresses[:3]:
                assert await system.ref(at, Worker).ask(Do("well")) == (1 if at == "/app/north/other" else life)
            for at in addresses:
                (said,) = await system.why(at)
                assert said.startswith(f"{at} is running, in life "), said
            if life == 1:
                continue
            assert [one.reason_kind for one in system.lives("/app/north/worker")] == ["SystemStopped", ""]
            await system.stop(north)
            assert system.lives("/app/north/worker")[-1].because == "its supervisor has ended"


def test_an_event_that_was_written_twice_is_there_once() -> None:
    """A store that has failed in the middle of a write is given the same events again."""
    notes: dict[str, bytes] = {}
    shelf = EventShelf(prefix("others"), {}, lambda name, value: notes.update({name: value or b""}), 50_000)
    events = [PastEvent(number, 1.0, "HookFailed", "/app", {}) for number in (1, 2, 3)]
    shelf.put(events[:2])
    shelf.put(events)

    class Store:
        def note(self, key: str, value: bytes | None) -> None:
            raise AssertionError("nothing is written")

        def notes(self, prefix: str) -> dict[str, bytes]:
            return {key: value for key, value in notes.items() if key.startswith(prefix)}

    assert [one.number for one in stored(Store())] == [1, 2, 3]
