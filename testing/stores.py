"""The conformance suite for store engines of your own.

    from holdfast.testing.stores import conformance

    class TestMyStore(conformance(lambda path: MyJournal(path / "my.store"))):
        pass

`factory(path)` opens the store in that folder, which is empty the first time. A second call with the same folder comes
after the first engine was closed, or while it is open (which one of the two must then refuse to go on), or, with
`crash=`, for a folder as a kill leaves it. What is checked stands in `store_model/`, one function for each promise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from ..checkpoint.journal import DamagedStore, Saved
from .store_model.accidents import ACCIDENTS, KILLS
from .store_model.bench import Bench, Crash, Factory, Fail
from .store_model.comparing import expect, refused
from .store_model.contents import BOUNDS, CONTENTS
from .store_model.sequences import agrees_with_the_model
from .store_model.watching import full_disk

__all__ = ["SEEDS", "Crash", "Factory", "Fail", "StoreConformance", "conformance", "full_disk"]

Promise = Callable[[Bench], None]
SEEDS = 10
"""Sequences of operations that are drawn."""


def conformance(factory: Factory, *, crash: Crash | None = None, fail: Fail = full_disk) -> type[StoreConformance]:
    """A class of tests for the engine that `factory` opens; derive from it in a module that pytest collects.

    Args:
        factory: opens the engine in a folder.
        crash: given an engine and its folder, makes another folder as a kill of the process would leave it at this
            moment, which may be in the middle of a call or of an opening (then the engine is that of the opening
            before). For an engine on plain files it copies the folder. An engine whose `safe_at` is "sync" need not
            have kept what was not synced. Left out, nothing is tested of kills.
        fail: given the folder, a context in which it takes no more bytes. Left out, no file of the process can grow
            meanwhile; give one if the engine keeps its data elsewhere.
    """
    made: dict[str, Any] = {"factory": staticmethod(factory), "fail": staticmethod(fail)}
    if crash is not None:
        made["crash"] = staticmethod(crash)
    return type("Conformance", (StoreConformance,), made)


def _words(promise: Promise) -> str:
    return promise.__name__.replace("_", " ")


class StoreConformance:
    """The suite. An engine that is not `durable` is held to less: what it reads back is empty.

    Attributes:
        factory: see `conformance`, as for `crash` and `fail`.
        seeds: how many sequences of operations are drawn.
    """

    factory: Factory
    crash: Crash | None = None
    fail: Fail = staticmethod(full_disk)
    seeds: int = SEEDS

    @pytest.fixture
    def bench(self, tmp_path: Path) -> Iterator[Bench]:
        """Where stores are opened, in folders of their own."""
        bench = Bench(self.factory, self.crash, tmp_path, self.fail)
        yield bench
        bench.remove()

    @pytest.fixture
    def durable(self, bench: Bench) -> Bench:
        """The same, for an engine that keeps anything."""
        if not bench.open().journal.durable:
            pytest.skip("it keeps nothing")
        bench.close()
        return bench

    @pytest.mark.parametrize("promise", [*CONTENTS, *BOUNDS], ids=_words)
    def test_it_holds_what_it_was_given(self, durable: Bench, promise: Promise) -> None:
        promise(durable)

    @pytest.mark.parametrize("promise", KILLS, ids=_words)
    def test_it_survives_kills(self, durable: Bench, promise: Promise) -> None:
        if self.crash is None:
            pytest.skip("nothing is known of kills")
        promise(durable)

    @pytest.mark.parametrize("promise", ACCIDENTS, ids=_words)
    def test_it_survives_failures_and_other_owners(self, durable: Bench, promise: Promise) -> None:
        promise(durable)

    def test_it_agrees_with_the_model(self, durable: Bench) -> None:
        """Any sequence of operations, kills, failures and openings loads as dictionaries of lists do."""
        for seed in range(self.seeds):
            agrees_with_the_model(durable, seed)

    def test_what_keeps_nothing_says_so(self, bench: Bench) -> None:
        """An engine that is not durable hands out positions, keeps notes while it lives, and loads nothing."""
        journal = bench.open().journal
        if journal.durable:
            pytest.skip("it keeps what it is given")
        a, b = "/app/a", "/app/b"
        positions = [
            *journal.append([(a, ("in", 1)), (b, ("in", 2))]),
            *journal.append([(a, ("in", 3))]),
            *journal.append([]),
        ]
        assert len(positions) == 3
        assert positions == sorted(set(positions))
        journal.sync()
        journal.cut(a, b"state", positions[:1], turn=1)
        journal.keep_blocks(a, 7, [(0, memoryview(b"block"))], False)
        refused(lambda: journal.read_blocks(a, 7, [(0, 5)]), "read_blocks of what keeps nothing", DamagedStore)
        assert journal.packs(a) == set()
        journal.forget_blocks(a, [7])
        assert journal.load(a) == Saved(None, 0, [])
        assert journal.addresses() == []
        for key, value in (("child b", b"1"), ("child a", b""), ("other", b"3"), ("child b", b"4"), ("other", None)):
            journal.note(key, value)
        expect(dict(journal.notes("child ")), {"child a": b"", "child b": b"4"}, "notes('child ')")
        assert (journal.noted("child b"), journal.noted("other")) == (b"4", None)
        journal.erase(a)
        assert journal.epoch >= 1
        journal.close()
        journal.close()
