"""The registry against a naive model, while holders die and the registry itself is killed (otp.md 1.14, W16)."""

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

import holdfast as hf
from tests.supervision.test_registry import Do, Holder

HOLDERS = st.sampled_from("abc")
KEYS = st.sampled_from([1, 1.0, True, "k"])
Key = tuple[type, Any]


class RegistryMachine(RuleBasedStateMachine):
    """Three supervised holders; the model is a list of (key, holder, value), without those of ended lives."""

    @initialize(keys=st.sampled_from(["unique", "duplicate"]))
    def begin(self, keys: Any) -> None:
        self.runner = asyncio.Runner()
        self.is_unique = keys == "unique"
        self.model: list[tuple[Key, str, int]] = []
        self.runner.run(self._begin(keys))

    async def _begin(self, keys: Any) -> None:
        self.system = await hf.ActorSystem(log=False, intensity=999).__aenter__()
        self.system._body = None  # It is left in another task than it was entered in.
        self.names: hf.supervision.Registry[Any, int] = hf.supervision.Registry(
            await self.system.start(hf.supervision.registry("names", keys=keys))
        )
        self.holders = {name: await self.system.start(hf.child(name, hf.start(Holder))) for name in "abc"}

    def teardown(self) -> None:
        if hasattr(self, "runner"):
            with self.runner:
                self.runner.run(self.system.shutdown())

    def by(self, holder: str, work: Callable[[], Awaitable[Any]]) -> Any:
        async def call() -> Any:
            return await self.holders[holder].ask(Do(work))

        return self.runner.run(call())

    @rule(holder=HOLDERS, key=KEYS, value=st.integers(0, 3))
    def register(self, holder: str, key: Any, value: int) -> None:
        known = (type(key), key)
        has_it = [name for k, name, _ in self.model if k == known]
        try:
            self.by(holder, lambda: self.names.register(key, value))
        except hf.errors.AlreadyRegistered as no:
            refusal: hf.errors.AlreadyRegistered | None = no
        else:
            refusal = None
            self.model.append((known, holder, value))
        expected = [self.holders[name] for name in has_it] if self.is_unique else []
        assert ([] if refusal is None else [refusal.holder]) == expected

    @rule(holder=HOLDERS, key=KEYS)
    def unregister(self, holder: str, key: Any) -> None:
        left = [row for row in self.model if row[:2] != ((type(key), key), holder)]
        assert self.by(holder, lambda: self.names.unregister(key)) == len(self.model) - len(left)
        self.model = left

    @rule(holder=HOLDERS, key=KEYS, value=st.integers(0, 3))
    def unregister_match(self, holder: str, key: Any, value: int) -> None:
        left = [row for row in self.model if row != ((type(key), key), holder, value)]
        gone = self.by(holder, lambda: self.names.unregister_match(key, lambda found: found == value))
        assert gone == len(self.model) - len(left)
        self.model = left

    @rule(dying=st.sets(st.sampled_from(["a", "b", "c", "names"]), min_size=1))
    def kill(self, dying: set[str]) -> None:
        """In one tick, in any order; nobody waits for anything before he looks."""

        async def strike() -> None:
            for name in sorted(dying):
                (self.names.ref if name == "names" else self.holders[name]).kill()
            await self.names.count()  # A kill is a command: it is over when the actor has been asked something.

        self.runner.run(strike())
        self.model = [row for row in self.model if row[1] not in dying]

    @invariant()
    def both_say_the_same(self) -> None:
        if hasattr(self, "runner"):
            self.runner.run(self._compare())

    async def _compare(self) -> None:
        entries = await self.names.select(lambda entry: True)
        found = [((type(entry.key), entry.key), entry.holder.path[5:], entry.value) for entry in entries]
        assert sorted(found, key=str) == sorted(self.model, key=str)
        for key in (1, 1.0, True, "k"):
            expected = [(name, value) for k, name, value in self.model if k == (type(key), key)]
            assert [(one.holder.path[5:], one.value) for one in await self.names.lookup(key)] == expected
        for name, holder in self.holders.items():
            assert len(await self.names.keys(holder)) == sum(row[1] == name for row in self.model)
        assert await self.names.count() == len(self.model)


TestRegistryMachine = RegistryMachine.TestCase
TestRegistryMachine.settings = settings(max_examples=40, stateful_step_count=25, deadline=None)
