"""An engine of a user's own that raises what no store should: the actors live on, and nobody is told what is not so."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.checkpoint.journal import Journal, StoreFailed
from tests.checkpoint.one_file import OneFile
from tests.checkpoint.players import Doer, Note, Seen


def fail(name: str) -> None:
    raise ZeroDivisionError(f"in {name}")


class Foreign(OneFile):
    """Raises something that is none of our errors wherever it is told to."""

    def __init__(self, path: Path) -> None:
        self._broken: str | None = None
        super().__init__(path)

    def __getattribute__(self, name: str) -> Any:
        if name[:1] != "_" and vars(self).get("_broken") == name:
            return lambda *args, **named: fail(name)
        return super().__getattribute__(name)

    def break_at(self, name: str | None) -> None:
        vars(self)["_broken"] = name


async def test_a_snapshot_that_an_engine_does_not_take_is_tried_again(tmp_path: Path) -> None:
    engine = Foreign(tmp_path / "my.store")
    async with hf.ActorSystem("app", log=False, store=engine) as system:
        doer = await system.start(hf.child("doer", hf.start(Doer), recovery=hf.hybrid(interval=1000.0)))
        await doer.ask(Note("one"))
        for method in ("cut", "forget_blocks"):
            engine.break_at(method)
            if method == "cut":
                with pytest.raises(hf.HoldfastError, match="ZeroDivisionError: in cut"):
                    await system.checkpoint(doer)
            assert await doer.ask(Note("more")) > 1
        engine.break_at(None)
        await system.checkpoint(doer)
        assert await doer.ask(Seen()) == ["one", "more", "more"]


async def test_after_an_append_that_raised_nothing_is_acknowledged(tmp_path: Path) -> None:
    engine = Foreign(tmp_path / "my.store")
    async with hf.ActorSystem("app", log=False, store=engine) as system:
        told = system.events()
        doer = await system.start(hf.child("doer", hf.start(Doer), recovery=hf.hybrid(interval=1000.0)))
        await doer.ask(Note("one"))
        engine.break_at("append")
        for _ in range(2):
            with pytest.raises(StoreFailed, match="ZeroDivisionError: in append"):
                await doer.ask(Note("lost"))
            engine.break_at(None)  # What it has written nobody knows: it stays refused.
        assert [event for event in told.take() if isinstance(event, hf.events.JournalStopped)]
    async with hf.ActorSystem("app", log=False, store=OneFile(tmp_path / "my.store")) as system:
        doer = await system.start(hf.child("doer", hf.start(Doer), recovery=hf.hybrid(interval=1000.0)))
        assert await doer.ask(Seen()) == ["one"]


@pytest.mark.parametrize("method", ["addresses", "notes", "load"])
async def test_an_engine_that_cannot_be_read_is_an_error_of_the_store(tmp_path: Path, method: str) -> None:
    engine = Foreign(tmp_path / "my.store")
    engine.break_at(method)
    store: Journal = engine
    with pytest.raises(StoreFailed, match=f"ZeroDivisionError: in {method}"):
        await hf.ActorSystem("app", log=False, store=store).__aenter__()
