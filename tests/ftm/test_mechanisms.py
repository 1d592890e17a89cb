"""Mechanisms: found, loaded from files, woven, and exchanged by their bricks while the actor lives on."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.ftm.bricks.bricks import After
from holdfast.ftm.bricks.replica_orders import Abort, Commit, PrepareStack
from holdfast.ftm.mechanisms.lfr import LFR
from holdfast.ftm.mechanisms.pbr import PBR
from holdfast.ftm.mechanisms.tr import TR
from holdfast.ftm.model.composition import check_stack
from holdfast.ftm.model.mechanism import (
    BUILT_IN,
    Description,
    Mechanism,
    MechanismRefused,
    compose,
    find,
    load,
    revive,
)
from holdfast.ftm.replica.replica import weave
from tests.ftm import versions
from tests.ftm.driver import Driver
from tests.ftm.replicated import Add, Closed, Fail, Fetch, Read, Total, pair

FILE = Path(__file__).parent / "masked_sum.py"


SETTINGS: dict[str, dict[str, Any]] = {  # of those that do not go without
    "ad": {"assertions": (versions.is_positive,)},
    "rb": {"alternates": (versions.Second,), "test": (versions.is_positive,)},
    "nvp": {"versions": (versions.Second, versions.Third)},
    "sec": {"authority": "/app/authority"},
}


def own_copy(folder: Path, text: str | None = None) -> Path:
    path = folder / "noting.py"
    path.write_text(FILE.read_text() if text is None else text)
    path.chmod(0o600)
    return path


@pytest.mark.parametrize("name", BUILT_IN)
def test_built_in_ones_are_found_by_name_and_travel(name: str) -> None:
    kind = find(name)
    assert kind.name == name
    assert kind.__doc__
    made = kind(**SETTINGS.get(name, {}))
    assert revive(made.describe()) == made


def test_settings_travel() -> None:
    assert revive(PBR(acknowledge=False, window=3).describe()) == PBR(acknowledge=False, window=3)


class Family:
    class Member(PBR):
        class Branch(PBR): ...


def test_classes_within_classes_travel() -> None:
    assert revive(Family.Member.Branch().describe()) == Family.Member.Branch()


def test_what_is_not_there_or_no_mechanism_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MechanismRefused, match="no mechanism of that name"):
        find("nothing")
    with pytest.raises(MechanismRefused, match="cannot be read"):
        load(tmp_path / "none.py")
    with pytest.raises(MechanismRefused, match="one Mechanism, this one: none"):
        load(own_copy(tmp_path, "x = 1"))
    with pytest.raises(MechanismRefused, match="ZeroDivisionError"):
        load(own_copy(tmp_path, "1 / 0"))
    with pytest.raises(MechanismRefused, match="takes mechanisms"):
        compose(PBR(), ["tr"])  # type: ignore[list-item]
    with pytest.raises(MechanismRefused, match="unexpected keyword"):
        revive(Description("holdfast.ftm.mechanisms.pbr:PBR", {"none": 1}))


@pytest.mark.parametrize(
    ("declared", "why"),
    [
        ({"name": ""}, "must declare a name"),
        ({"replicas": 0}, "at least one replica, not 0"),
        ({"tolerates": frozenset({"crsh"})}, "unknown faults crsh; known: crash"),
        ({"needs": frozenset({"luck"})}, "unknown needs luck"),
        ({"layer": "cellar"}, "unknown layers cellar; known: link"),
        ({"bandwidth": "some"}, "unknown levels of bandwidth some"),
    ],
)
def test_a_declaration_that_means_nothing_is_refused_before_it_is_attached(declared: Any, why: str) -> None:
    kind: Any = type("Own", (PBR,), declared)
    with pytest.raises(MechanismRefused, match=why):
        check_stack((kind(),), None, "/app/alice")


def test_a_file_that_others_may_write_or_that_has_changed_is_refused(tmp_path: Path) -> None:
    path = own_copy(tmp_path)
    described = load(path)().describe()
    path.chmod(0o666)
    with pytest.raises(MechanismRefused, match="nobody else may be able to write"):
        load(path)
    path.chmod(0o600)
    path.write_text(path.read_text() + "# changed\n")
    with pytest.raises(MechanismRefused, match="has changed"):
        revive(described)


@pytest.mark.skipif(os.getuid() != 0, reason="only root can give a file to others")
def test_a_file_of_root_is_trusted_and_one_of_another_user_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = own_copy(tmp_path)
    me, another = 1000, 1
    monkeypatch.setattr(os, "getuid", lambda: me)
    for trusted in (0, me):
        os.chown(path, trusted, trusted)
        assert load(path).name == "noting"
    os.chown(path, another, another)
    with pytest.raises(MechanismRefused, match="must belong to this user"):
        load(path)


def test_one_slot_is_one_brick() -> None:
    places = weave((PBR(), TR()), leads=True)
    assert [place.name for place in places.values()] == [
        "protocol", "before", "after", "tr.protocol", "tr.before", "tr.after", "proceed",
    ]  # fmt: skip
    with pytest.raises(MechanismRefused, match="twice"):
        weave((TR(), TR()), leads=True)


async def test_a_mechanism_from_a_file_that_was_never_seen_is_woven_in(system: hf.ActorSystem, tmp_path: Path) -> None:
    """A3."""
    kind: Any = load(own_copy(tmp_path))
    driver = await pair(system, Total, kind(word="heard"), PBR())
    seen: list[str] = sys.modules[kind.__module__].SEEN
    seen.clear()
    keys = driver.send(Add(1), Add(2))
    assert await driver.reply(keys[1]) == 3
    assert "2 out" in seen[seen.index("heard single 2 in") :]  # What stands behind the start may come out before it.
    await driver.stop_replica("r1")
    await driver.fail_over("r2")
    assert await driver.ask(Read()) == [1, 2]


async def exchange(driver: Driver, *layers: Mechanism, names: tuple[str, ...] = ("r1", "r2")) -> None:
    """As the adaptation engine does it: nothing is inside, both replicas prepare, then both commit."""
    driver.config += 1
    refs = [driver.protocol(name) for name in names]
    described = [one.describe() for one in layers]
    for ref in refs:
        await ref.ask(PrepareStack(driver.config, described))
    for ref in reversed(refs):
        await ref.ask(Commit(driver.config))
        await ref.ask(Commit(driver.config))  # Twice is once.


def lives(driver: Driver, name: str) -> dict[str, Any]:
    """The bricks of a replica, as objects."""
    children = driver.system._node.cell_at(driver.path(name)).children or {}
    return {key: cell.actor for key, cell in children.items()}


@pytest.mark.parametrize("seed", range(3))
async def test_transitions_keep_state_log_and_stash(system: hf.ActorSystem, seed: int) -> None:
    """A76, A82: PBR to LFR and back, composed with TR and not, and a failover behind each."""
    driver = await pair(system, Total, PBR())
    stacks: list[tuple[Mechanism, ...]] = [(LFR(),), (LFR(), TR()), (PBR(), TR()), (PBR(),), (LFR(),), (PBR(),)]
    sent, names = list[int](), ["r1", "r2"]
    driver.layers = (PBR(),)
    for step, stack in enumerate(stacks):
        before = lives(driver, names[0])
        keys = driver.send(*(Add(100 * step + n) for n in range(5)), Fetch(100 * step + 7), Fail(1))
        for key in keys:
            await driver.until(key)
        sent += [*(100 * step + n for n in range(5)), -(100 * step + 7), 2 * (100 * step + 7)]
        await exchange(driver, *stack, names=tuple(names))
        driver.layers = stack
        assert lives(driver, names[0])["protocol"] is before["protocol"]
        assert await driver.ask(Read()) == sent
        if step % 2 == seed % 2:
            await driver.stop_replica(names[0])
            names.reverse()
            await driver.fail_over(names[0])
            assert await driver.ask(Read()) == sent
            driver.setting["config"] = driver.config
            await driver.add(names[1])
            await driver.join(names[1])
    assert driver.doubled == []


async def test_only_bricks_that_differ_are_touched(system: hf.ActorSystem) -> None:
    """A5."""
    driver = await pair(system, Total, PBR())
    await driver.ask(Add(1))
    before = lives(driver, "r1")
    await exchange(driver, PBR(), TR())
    composed = lives(driver, "r1")
    assert all(composed[name] is before[name] for name in before)
    assert set(composed) - set(before) == {"tr.protocol", "tr.before", "tr.after"}
    await exchange(driver, PBR())
    assert lives(driver, "r1") == before
    await exchange(driver, PBR(acknowledge=False))
    assert {name for name, one in lives(driver, "r1").items() if one is not before.get(name)} == {"after@3"}
    assert await driver.ask(Read()) == [1]


async def test_what_was_prepared_can_be_dropped_and_what_cannot_be_had_is_refused(system: hf.ActorSystem) -> None:
    driver = await pair(system, Closed, LFR())
    replica = driver.protocol("r1")
    before = lives(driver, "r1")
    await replica.ask(PrepareStack(1, [LFR().describe(), *()]))
    await replica.ask(Abort(1))
    assert lives(driver, "r1") == before
    with pytest.raises(MechanismRefused, match="state_access = False"):
        await replica.ask(PrepareStack(2, [PBR().describe()]))
    with pytest.raises(MechanismRefused, match="was not prepared"):
        await replica.ask(Commit(2))
    assert lives(driver, "r1") == before
    assert await driver.ask(Add(1)) == 1
    assert issubclass(type(before["after"]), After)
