"""The bounded mailbox of a recorded actor, over the end of its life."""

from __future__ import annotations

from pathlib import Path

import holdfast as hf
from tests.checkpoint.players import Do, Doer, Seen, start
from tests.checkpoint.strikes import NEVER


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
