"""Whatever is in a transaction, and wherever it fails: the tree is just as it was (T39)."""

import asyncio
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import holdfast as hf
from tests.system.trees import Counter, Double, Stumble, counter, picture, plant

NAMES = st.sampled_from("abcdefgh")
ABOVE = st.sampled_from(["/app/left", "/app/right", "/app/pool", "/app/left/sub"])
PLACES = st.one_of(st.builds("{}/{}".format, ABOVE, NAMES), ABOVE, st.just("/app/right/client"))

TIME_LIMIT = 15.0
Step = tuple[str, tuple[Any, ...]]


def plus_one(state: dict[str, Any]) -> dict[str, Any]:
    return {"count": state["count"] + 1}


def step(verb: str, *args: st.SearchStrategy[Any]) -> st.SearchStrategy[Step]:
    return st.tuples(st.just(verb), st.tuples(*args))


SPECS = st.one_of(
    st.builds(counter, NAMES), st.builds(lambda name: hf.supervisor("sub", children=[counter(name)]), NAMES)
)
STEPS = st.lists(
    st.one_of(
        step("add", ABOVE, SPECS),
        step("add", st.just("/app/pool"), st.just(hf.start(Counter))),
        step("remove", PLACES),
        step("move", PLACES, ABOVE),
        step("reorder", ABOVE, st.lists(NAMES, max_size=4)),
        step("strategy", ABOVE, st.sampled_from(["one_for_one", "one_for_all", "rest_for_one"])),
        step("intensity", ABOVE, st.integers(0, 9), st.floats(0.5, 9.0)),
        step("bind", st.just("/app/right/client"), st.just("peer"), PLACES),
        step("register", NAMES, PLACES),
        step("unregister", st.sampled_from(["first", "second", "a", "b"])),
        step("suspend", PLACES),
        step("resume", PLACES),
        step("replace_state", PLACES, st.just(plus_one)),
        step("replace_code", PLACES, st.just(Double)),
    ),
    min_size=1,
    max_size=8,
)


async def possible(system: hf.ActorSystem, steps: list[Step]) -> list[Step]:
    """The steps that can be done one after the other; each is tried by a dry run behind those before it."""
    good: list[Step] = []
    for one in steps:
        try:
            async with system.transaction(dry_run=True) as change:
                collect(change, [*good, one])
        except hf.TransactionRefused:
            continue
        good.append(one)
    return good


def collect(change: hf.system.Change, steps: list[Step]) -> None:
    for verb, args in steps:
        getattr(change, verb)(*args)


def run(scenario: Callable[[hf.ActorSystem], Any]) -> None:
    async def main() -> None:
        async with hf.ActorSystem("app", log=False, intensity=1000) as system:
            await plant(system)
            async with asyncio.timeout(TIME_LIMIT):
                await scenario(system)

    asyncio.run(main())


@settings(max_examples=150)
@given(steps=STEPS, place=st.integers(0, 8))
def test_a_failure_anywhere_leaves_the_tree_exactly_as_before(steps: list[Step], place: int) -> None:
    async def scenario(system: hf.ActorSystem) -> None:
        before = picture(system)
        good = await possible(system, steps)
        assert picture(system) == before
        at = min(place, len(good))
        with pytest.raises(hf.TransactionFailed) as failed:  # noqa: PT012  # it ends with the block
            async with system.transaction() as change:
                collect(change, good[:at])
                change.step(Stumble())
                collect(change, good[at:])
        assert (failed.value.step, failed.value.kept) == ("stumble over a stone", ())
        assert picture(system) == before

    run(scenario)


@settings(max_examples=100)
@given(steps=STEPS)
def test_what_passes_its_checks_is_done_and_the_tree_is_as_was_told(steps: list[Step]) -> None:
    async def scenario(system: hf.ActorSystem) -> None:
        good = await possible(system, steps)
        async with system.transaction() as change:
            collect(change, good)
        told = change.difference
        async with system.transaction(dry_run=True) as nothing:
            pass
        assert nothing.difference == ()
        added = {line[2:].split(":")[0] for line in told if line.startswith("+ ")}
        gone = {line[2:].split(":")[0] for line in told if line.startswith("- ")} - added
        there = set(system.tree())
        stopped = {path for path in added if path.endswith("/e")}  # It has a spec, and no life.
        assert added - stopped <= there
        assert not gone & there

    run(scenario)
