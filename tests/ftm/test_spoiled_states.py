"""What hooks leave and nobody can save is told as such, and ends neither the group nor an ask without a word."""

from __future__ import annotations

import asyncio
import os
import signal
import threading
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.errors import UnsavableValue
from tests.actors.process.waiting import next_event
from tests.ftm.test_failover import group_of, pid_of, two_again

IN_TIME = 25.0
MECHANISMS: dict[str, Any] = {
    "pbr": hf.ftm.PBR(),
    "lfr": hf.ftm.LFR(),
    "tr": hf.ftm.TR(),
    "tmr": hf.ftm.TMR(),
    "pbr+tr": hf.ftm.compose(hf.ftm.PBR(), hf.ftm.TR()),
}


class Count(hf.Message[int]): ...


class Locking(hf.Actor):
    """Puts a lock into its state when it comes back, as long as there is a file."""

    def __init__(self, note: str) -> None:
        self.note, self.count = note, 0
        self.lock: Any = None

    def on_recovered(self) -> None:
        self.lock = threading.Lock() if Path(self.note).exists() else None

    @hf.on(Count)
    def add(self, message: Count) -> int:
        self.count += 1
        return self.count


class Silent(Locking):
    """Cannot say what its state is, from when it has come back with such a file."""

    is_silent = False

    def on_recovered(self) -> None:
        self.is_silent = Path(self.note).exists()

    def get_state(self) -> int:
        if self.is_silent:
            raise ValueError("the lock is stuck")
        return self.count

    def set_state(self, state: int) -> None:
        self.count = state


async def told(events: hf.events.EventStream) -> None:
    async with asyncio.timeout(IN_TIME):
        async for event in events:
            if isinstance(event, hf.events.SnapshotFailed):
                assert "lock" in event.reason
                return


@pytest.mark.pairs
@pytest.mark.parametrize("kind", [Locking, Silent])
@pytest.mark.parametrize(
    ("name", "how"),
    [
        *((name, "all die") for name in MECHANISMS),
        *(
            (name, how)
            for name in ("pbr", "pbr+tr")
            for how in ("the leader dies", "the leader dies, and nothing is kept")
        ),
    ],
)
@pytest.mark.some(5)
async def test_a_state_that_a_hook_leaves_and_nobody_can_save(
    tmp_path: Path, name: str, how: str, kind: type[Locking]
) -> None:
    note, mechanism = tmp_path / "note", MECHANISMS[name]
    recovery = None if "nothing" in how else hf.hybrid(interval=3600.0)
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        spec = hf.child("it", hf.start(kind, str(note)), recovery=recovery, mechanism=mechanism)
        ref = await system.start(spec)
        await two_again(ref)
        assert await ref.ask(Count(), timeout=IN_TIME) == 1
        note.touch()

        async def strike() -> None:
            primary = group_of(ref).membership.primary
            assert primary is not None
            if how == "all die":
                ref.kill()
            else:
                os.kill(pid_of(system, ref, primary), signal.SIGKILL)

        with system.events() as events:
            await strike()
            for count in (2, 3):
                if name == "lfr":
                    assert await ref.ask(Count(), timeout=IN_TIME) == count
                else:
                    with pytest.raises((UnsavableValue, hf.RemoteCrash), match="lock"):
                        await ref.ask(Count(), timeout=IN_TIME)
            await told(events)
            if recovery is not None:
                with pytest.raises(hf.errors.CheckpointFailed, match="lock"):
                    await system.checkpoint(ref)
            assert not [
                one
                for one in events.take()
                if isinstance(one, (hf.events.Masked, hf.events.Diverged, hf.events.RecoveryFailed))
            ]
        if name != "lfr":
            note.unlink()
            await two_again(ref)
            await strike()
            assert await ref.ask(Count(), timeout=IN_TIME) == 2


class Early(Locking):
    """Does so before it handles again what it had handled."""

    def on_start(self, restored: bool) -> None:
        if restored:
            self.on_recovered()


@pytest.mark.parametrize("name", [name for name in MECHANISMS if name != "lfr"])
async def test_a_recovery_that_begins_with_what_nobody_can_save_fails(tmp_path: Path, name: str) -> None:
    """None of the turns that are replayed has left it so: none of them fails of it, and none is tried for ever."""
    note = tmp_path / "note"
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        spec = hf.child(
            "it", hf.start(Early, str(note)), recovery=hf.hybrid(interval=3600.0), mechanism=MECHANISMS[name]
        )
        ref = await system.start(spec)
        assert await ref.ask(Count(), timeout=IN_TIME) == 1
        await system.checkpoint(ref)
        assert [await ref.ask(Count(), timeout=IN_TIME) for _ in range(2)] == [2, 3]
        note.touch()
        with system.events() as events:
            ref.kill()
            assert "Early.lock" in (await next_event(events, hf.events.RecoveryFailed)).reason
        note.unlink()
        assert await ref.ask(Count(), timeout=IN_TIME) == 4
