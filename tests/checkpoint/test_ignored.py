"""A recorded actor may say in `on_start` that it does not want to live; and how a supervisor ends that cannot start."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from tests.checkpoint.players import Note, Seen
from tests.checkpoint.trees import running, seen, top, tree


class Moody(hf.Actor):
    """Does not want to start while there is such a file; with a number in it, only when it is restored or not."""

    def __init__(self, mood: str) -> None:
        self.words: list[str] = []
        self._mood = mood

    def on_start(self, restored: bool) -> None:
        path = Path(self._mood)
        if path.exists() and path.read_text() in ("always", str(restored)):
            raise hf.Ignore("not today")

    @hf.on(Note)
    def note(self, message: Note) -> int:
        self.words.append(message.text)
        return len(self.words)

    @hf.on(Seen)
    def read(self, message: Seen) -> list[str]:
        return list(self.words)


def moody(isolation: str, mood: Path, **options: Any) -> hf.ChildSpec:
    own: Any = "process" if isolation == "process" else "task"
    recovery = hf.hybrid(interval=3600.0)
    return hf.child("doer", hf.start(Moody, str(mood)), isolation=own, recovery=recovery, **options)


async def states(system: hf.ActorSystem) -> dict[str, str]:
    return {one.id: one.state for one in await top(system).ask(hf.WhichChildren(), timeout=20.0)}


async def test_ignore_in_the_first_on_start_is_an_ignored_start(
    store: str | None, isolation: str, tmp_path: Path
) -> None:
    mood = tmp_path / "mood"
    mood.write_text("always")
    async with running(store) as system:
        with system.events() as stream:
            await system.start(tree(isolation, moody(isolation, mood), intensity=0))
            assert await states(system) == {"doer": "stopped"}
            assert await top(system).ask(hf.RestartChild("doer"), timeout=20.0) is None
            mood.unlink()
            await top(system).ask(hf.RestartChild("doer"), timeout=20.0)
            assert await seen(system) == []
            told = stream.take()
        assert not [
            one
            for one in told
            if isinstance(one, (hf.events.RecoveryFailed, hf.events.ActorCrashed, hf.events.ChildStartFailed))
        ]


async def test_ignore_in_the_on_start_of_a_restored_actor_keeps_what_it_has(
    store: str | None, isolation: str, tmp_path: Path
) -> None:
    mood = tmp_path / "mood"
    async with running(store) as system:
        await system.start(tree(isolation, moody(isolation, mood), intensity=0))
        await system.ref("/app/top/doer", hf.Actor).ask(Note("kept"), timeout=20.0)
        await top(system).ask(hf.TerminateChild("doer"), timeout=20.0)
        mood.write_text("True")
        assert await top(system).ask(hf.RestartChild("doer"), timeout=20.0) is None
        assert await states(system) == {"doer": "stopped"}
        mood.unlink()
        await top(system).ask(hf.RestartChild("doer"), timeout=20.0)
        assert await seen(system) == ["kept"]


class Stubborn(hf.Actor):
    def __init__(self) -> None:
        raise OSError("never")


@pytest.mark.parametrize("late", [False, True])
async def test_a_supervisor_whose_child_does_not_start_ends_with_shutdown_and_has_not_crashed(late: bool) -> None:
    """otp 1.2: (error, (shutdown, (failed_to_start_child, id, reason)))."""
    async with running(None) as system:
        kind: Any = Stubborn
        spec = hf.supervisor("top", children=[hf.child("bad", hf.start(kind))], isolation="process" if late else "task")
        with system.events() as stream:
            with pytest.raises(hf.StartFailed, match=r"bad could not be started.*never"):
                await system.start(spec)
            told = stream.take()
        assert not [one for one in told if isinstance(one, hf.events.ActorCrashed) and one.address == "/app/top"]


async def test_the_end_of_a_supervisor_that_cannot_start_is_a_shutdown(tmp_path: Path) -> None:
    mood = tmp_path / "there"
    async with running(None) as system:
        bad = hf.child("bad", hf.start(Late, str(mood)))
        await system.start(hf.supervisor("top", children=[bad], intensity=0))
        cell = top(system)._cell
        mood.touch()
        top(system).kill()
        with system.events() as stream:
            async for one in stream:
                if isinstance(one, hf.events.ChildStartFailed) and one.address == "/app/top":
                    assert cell.extra().reason == hf.SHUTDOWN
                    break
        mood.unlink()


class Late(hf.Actor):
    def __init__(self, mood: str) -> None:
        if Path(mood).exists():
            raise OSError("not now")
