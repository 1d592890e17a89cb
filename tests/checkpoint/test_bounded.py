"""The bounded mailbox of a recorded actor, over the end of its life."""

from __future__ import annotations

import asyncio
import tracemalloc
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from tests.checkpoint.players import Do, Doer, Note, Seen, start, until
from tests.checkpoint.strikes import NEVER, home


async def test_what_was_in_hand_when_it_died_is_handled_again(store: str | None, tmp_path: Path) -> None:
    """Where a policy may drop what waits, the life gets one message at a time; the next life the same one."""
    async with hf.ActorSystem("app", log=False, intensity=1000, store=store) as system:
        options = {"recovery": hf.hybrid(interval=NEVER), "mailbox": hf.bounded(3, overflow="drop_oldest")}
        ref = await start(system, "process", "doer", hf.start(Doer), **options)
        first = ref.ask(Do([f"once {tmp_path / 'died'}", "add first"]), timeout=60.0)
        second = ref.ask(Do(["add second"]), timeout=60.0)
        await first
        await second
        assert await ref.ask(Seen(), timeout=60.0) == ["first", "second"]


async def test_what_was_put_aside_does_not_count_after_a_restart_of_the_root(tmp_path: Path) -> None:
    options = {"recovery": hf.hybrid(interval=NEVER), "mailbox": hf.bounded(1, overflow="reject")}

    def running() -> hf.ActorSystem:
        return hf.ActorSystem("app", log=False, store=f"sqlite:{tmp_path / 'app.db'}")

    async with running() as system:
        ref = await start(system, "task", "doer", hf.start(Doer), **options)
        for _ in range(2):
            ref.tell(Do(["stash"]))
            assert await ref.ask(Seen()) == []
    async with running() as system:
        ref = await start(system, "task", "doer", hf.start(Doer), **options)
        assert await ref.ask(Do(["add open"])) == "1"


@pytest.mark.parametrize("overflow", ["reject", "drop_oldest"])
async def test_what_waits_counts_after_a_restart_of_the_root_and_what_was_dropped_is_gone(
    tmp_path: Path, overflow: Any
) -> None:
    options = {
        "recovery": hf.hybrid(interval=NEVER), "mailbox": hf.bounded(3, overflow=overflow), "shutdown": "brutal_kill",
    }  # fmt: skip
    gate = tmp_path / "gate"

    def running() -> hf.ActorSystem:
        return hf.ActorSystem("app", log=False, store=f"sqlite:{tmp_path / 'app.db'}")

    async with running() as system:
        ref = await start(system, "task", "doer", hf.start(Doer), **options)
        ref.tell(Do([f"gate {gate}"]))
        await until(gate.exists)
        for number in range(3 if overflow == "reject" else 4):
            ref.tell(Note(f"{number}"))
    gate.unlink()
    async with running() as system:
        ref = await start(system, "task", "doer", hf.start(Doer), **options)
        await until(gate.exists)
        if overflow == "reject":
            with pytest.raises(hf.MailboxFull):
                ref.tell(Note("3"))
        gate.with_suffix(".open").touch()
        expected = ["0", "1", "2"] if overflow == "reject" else ["1", "2", "3"]
        async with asyncio.timeout(20):
            while len(seen := (await system.get_state(ref))["seen"]) < 3:  # It passes ahead, and does not count.
                pass
        assert seen == expected


async def test_a_message_that_comes_before_the_start_is_the_one_in_hand(tmp_path: Path) -> None:
    gate = tmp_path / "gate"
    async with hf.ActorSystem("app", log=False) as system:
        options: Any = {"recovery": hf.hybrid(interval=NEVER), "mailbox": hf.bounded(2, overflow="drop_oldest")}
        starting = asyncio.ensure_future(system.start(hf.child("doer", hf.start(Doer), isolation="process", **options)))
        await until(lambda: "/app/doer" in system.tree())
        ref = system.ref("/app/doer", Doer)
        ref.tell(Do([f"gate {gate}"]))
        await starting
        await until(gate.exists)
        for number in range(4):
            ref.tell(Note(f"{number}"))
        gate.with_suffix(".open").touch()
        async with asyncio.timeout(20):
            while len(seen := (await system.get_state(ref))["seen"]) < 2:
                pass
        assert seen == ["2", "3"]


async def test_what_comes_after_a_poisonous_message_is_handled_once(tmp_path: Path) -> None:
    """The life gets one message at a time; the next life begins with the second one, which is put aside."""
    gate = tmp_path / "gate"
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        options = {"recovery": hf.hybrid(max_deliveries=1), "mailbox": hf.bounded(9, overflow="drop_oldest")}
        ref = await start(system, "process", "doer", hf.start(Doer), **options)
        poison = ref.ask(Do([f"gate {gate}", f"die {tmp_path / 'deaths'}"]), timeout=60.0)
        await until(gate.exists)
        ref.tell(Do(["stash put aside"]))
        ref.tell(Note("next"))
        gate.with_suffix(".open").touch()
        with pytest.raises(hf.Quarantined):
            await poison
        await ref.ask(Do(["unstash"]), timeout=60.0)
        assert await ref.ask(Seen(), timeout=60.0) == ["next", "open", "put aside"]
        assert (await system.get_status(ref)).life == 2


async def test_memory_of_what_is_dropped_is_given_back_while_the_turn_still_runs(tmp_path: Path) -> None:
    gate, size = tmp_path / "gate", 1_000_000
    async with hf.ActorSystem("app", log=False) as system:
        mailbox = hf.bounded(2, overflow="drop_oldest")
        ref = await start(system, "process", "doer", hf.start(Doer), recovery=hf.hybrid(), mailbox=mailbox)
        ref.tell(Do([f"gate {gate}"]))
        await until(gate.exists)
        tracemalloc.start()
        try:
            for _ in range(20):
                ref.tell(Note("x" * size))
            held, _ = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
        assert held < 5 * size
        gate.with_suffix(".open").touch()


async def test_who_waits_for_room_is_released_when_the_supervisor_has_ended(tmp_path: Path) -> None:
    """What is queued stays for the next life, so there is no room; the address is another life's."""
    gate = tmp_path / "gate"
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        spec = hf.child(
            "doer", hf.start(Doer), recovery=hf.hybrid(interval=NEVER), mailbox=hf.bounded(1), shutdown="brutal_kill"
        )
        team = await system.start(hf.supervisor("team", children=[spec]))
        ref = system.ref("/app/team/doer", Doer)
        ref.tell(Do([f"gate {gate}"]))
        await until(gate.exists)
        ref.tell(Note("queued"))
        sending = asyncio.ensure_future(ref.send(Note("late")))
        await until(lambda: bool(home(ref).intake.bound.senders))
        team.kill()
        with pytest.raises(hf.ActorStopped):
            await asyncio.wait_for(sending, 60.0)
        gate.with_suffix(".open").touch()
