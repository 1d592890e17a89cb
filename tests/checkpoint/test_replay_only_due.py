"""An actor that is never saved costs the checkpoint handler nothing, and says so who asks (R72)."""

import pytest

import holdfast as hf
from tests.checkpoint.players import Do, Doer, Seen


async def test_replay_only_is_not_looked_at_and_refuses_a_checkpoint() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        ref = await system.start(hf.child("doer", hf.start(Doer), recovery=hf.replay_only()))
        saved = await system.start(hf.child("saved", hf.start(Doer), recovery=hf.hybrid(interval=0.01)))
        for word in ("one", "two"):
            await ref.ask(Do([f"add {word}"]))
            await saved.ask(Do([f"add {word}"]))
        await system.checkpoint(saved)
        with pytest.raises(hf.SpecError, match="keeps no snapshots"):
            await system.checkpoint(ref)
        ref.kill()
        assert await ref.ask(Seen()) == ["one", "two"]
