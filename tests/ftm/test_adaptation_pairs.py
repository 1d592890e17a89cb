"""Each mechanism is attached, exchanged for each other, composed, updated and detached while requests flow (A76)."""

from __future__ import annotations

import asyncio
import itertools
import sys
from asyncio.subprocess import PIPE, STDOUT
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.console.endpoint import control_endpoint
from holdfast.ftm.group.reconfiguration import STEPS
from holdfast.ftm.model.change_model import nesting_problems
from holdfast.ftm.model.mechanism import BUILT_IN, Mechanism, code_of, find
from holdfast.ftm.model.mechanism_declaration import LAYERS
from holdfast.ftm.sec.authority import CertificationAuthority
from tests.ftm.accounts import Counter, Load, Tags
from tests.ftm.test_adaptation import stack, transition
from tests.ftm.test_adaptation_trouble import fails, struck
from tests.ftm.test_failover import group_of, two_again
from tests.ftm.versions import SETTINGS

# Processes do not care which event loop the root has.
pytestmark = pytest.mark.asyncio(loop_factories=["uvloop"])

Stack = tuple[str, ...]


def made(names: Stack) -> tuple[Mechanism, ...]:
    return tuple(find(name)(**SETTINGS.get(name, {})) for name in names)


def valid_stacks() -> list[Stack]:
    """All compositions that the change model calls valid, small ones first."""
    sorts = [[name for name in BUILT_IN if find(name).layer == layer] for layer in LAYERS]
    found = (tuple(name for name in chosen if name) for chosen in itertools.product(*([*one, ""] for one in sorts)))
    return sorted((one for one in found if one and not nesting_problems(made(one))), key=len)


STACKS = valid_stacks()
ALONE = [*(one for one in STACKS if len(one) == 1), ("ad", "pbr"), ("ad", "lfr")]
"""Each mechanism by itself, as far as it can stand so."""


def tour(stacks: list[Stack]) -> list[Stack]:
    """A way that goes from each to each other one, once, and ends where it began."""
    left = {one: [other for other in stacks if other != one] for one in stacks}
    way, found = [stacks[0]], list[Stack]()
    while way:
        if left[way[-1]]:
            way.append(left[way[-1]].pop())
        else:
            found.append(way.pop())
    return found[::-1]


@pytest.fixture
async def office(system: hf.ActorSystem) -> hf.ActorSystem:
    """With a certification authority."""
    await system.start(hf.child("ca", hf.start(CertificationAuthority)))
    return system


async def change_to(system: hf.ActorSystem, ref: hf.ActorRef[Any], load: Load, wanted: Stack) -> None:
    before = stack(ref)
    try:
        await transition(system, ref, made(wanted))
        assert stack(ref) == wanted
        assert len(group_of(ref).membership.names) == max(one.replicas for one in made(wanted))
        await load.reached(3)
    except BaseException as error:
        error.add_note(f"from {before} to {wanted}")
        raise


async def test_there_are_as_many_as_the_model_says() -> None:
    """With and without SEC: A&D over PBR or LFR, each way to keep replicas, each way to repeat."""
    assert len(STACKS) == 2 * (1 + 3 + 2) * 4 - 1
    way = tour(ALONE)
    assert len(way) == len(ALONE) * (len(ALONE) - 1) + 1
    assert len(set(itertools.pairwise(way))) == len(way) - 1


async def test_each_is_exchanged_for_each_other_one(office: hf.ActorSystem) -> None:
    way = tour([one for one in ALONE if one != ("ad", "lfr")])
    ref = await office.start(hf.child("alice", hf.start(Counter), mechanism=made(way[0])))
    load = Load(ref, clients=2)
    await load.reached(3)
    for wanted in way[1:]:
        await change_to(office, ref, load, wanted)
    await load.stop()
    load.check(await ref.ask(Tags()))
    assert ref._cell.life == 1


async def test_each_composition_is_changed_to(office: hf.ActorSystem) -> None:
    """Those of more than one layer; in an order in which replicas seldom have to be started."""
    several = [one for one in STACKS if one not in ALONE]
    several.sort(key=lambda names: ("sec" in names, max(one.replicas for one in made(names))))
    ref = await office.start(hf.child("alice", hf.start(Counter), mechanism=made(STACKS[0])))
    load = Load(ref, clients=2)
    for wanted in several:
        await change_to(office, ref, load, wanted)
    await load.stop()
    load.check(await ref.ask(Tags()))
    assert ref._cell.life == 1


def brick_of(mechanism: Mechanism) -> tuple[str, str, str]:
    """One brick that is its own: role, part, the name of its class."""
    for role, one in mechanism.roles.items():
        for part in ("after", "before"):
            kind = getattr(one, part)
            if kind is not None:
                return role, part, code_of(kind).kind
    raise AssertionError(f"{mechanism.name} has none")


async def test_each_is_attached_updated_composed_and_detached(office: hf.ActorSystem, tmp_path: Path) -> None:
    """The new code comes from files that the system has never seen."""
    ref = await office.start(hf.child("alice", hf.start(Counter)))
    load = Load(ref, clients=2)
    for names in ALONE:
        try:
            await come_and_go(office, ref, load, names, tmp_path / f"newer_{names[0]}.py")
        except BaseException as error:
            error.add_note(f"with {names}")
            raise
    await load.stop()
    load.check(await ref.ask(Tags()))
    assert (ref._cell.spec.mechanism, ref._cell.life) == (None, 1)


async def come_and_go(system: hf.ActorSystem, ref: hf.ActorRef[Any], load: Load, names: Stack, file: Path) -> None:
    await load.reached(3)
    async with system.transaction(timeout=30) as change:
        change.protect(ref, made(names))
    await load.reached(3)

    first = made(names)[0]
    role, part, kind = brick_of(first)
    module, _, name = kind.partition(":")
    file.write_text(f"from {module} import {name}\n\n\nclass Newer({name}): ...\n")
    file.chmod(0o600)
    async with system.transaction(timeout=30) as change:
        change.update(ref, part, file, mechanism=first.name, role=role)
    host: Any = ref._cell.host.place
    assert [brick.__name__ for brick in host.layers[0].exchanged.values()] == ["Newer"]
    await load.reached(3)

    inner = next(one for one in ("tr", "pbr") if (*names, one) in STACKS or (one, *names) in STACKS)
    async with system.transaction(timeout=30) as change:
        more = made((inner,))[0]
        change.protect(ref, (*names, more) if (*names, inner) in STACKS else (more, *names))
    await load.reached(3)
    async with system.transaction(timeout=30) as change:
        change.protect(ref, names)
    assert stack(ref) == names
    await load.reached(3)
    async with system.transaction(timeout=30) as change:
        change.protect(ref, None)


# -- three replicas ---------------------------------------------------------------------------------------------------


async def test_the_engine_dies_with_three_replicas_and_its_next_life_goes_on(system: hf.ActorSystem) -> None:
    """T38-T41: at each step, while a replica comes in, and while it goes again."""
    ref = await system.start(hf.child("alice", hf.start(Counter), mechanism=hf.ftm.PBR()))
    load = Load(ref, clients=2)
    for step, wanted in itertools.product(STEPS, (("tmr",), ("pbr",))):
        await load.reached(3)
        seen = struck(ref, step, fails)
        await change_to(system, ref, load, wanted)
        assert step in seen
        assert await all_again(ref) == wanted, step
    await load.stop()
    load.check(await ref.ask(Tags()))


async def test_a_change_with_three_replicas_that_is_given_up_is_undone(system: hf.ActorSystem) -> None:
    """At each step before there is no way back; the engine dies as well, in the middle of undoing it."""
    ref = await system.start(hf.child("alice", hf.start(Counter), mechanism=hf.ftm.TMR()))
    load = Load(ref, clients=2)
    for step in STEPS[: STEPS.index("commit")]:
        await load.reached(3)
        seen = await given_up(system, ref, step)
        assert "abort" in seen, step
        assert await all_again(ref) == ("tmr",), step
    await load.reached(3)
    await load.stop()
    load.check(await ref.ask(Tags()))


async def given_up(system: hf.ActorSystem, ref: hf.ActorRef[Any], step: str) -> list[str]:
    """Begin a change, want it no more at this step, and strike the engine when it undoes that: the steps."""
    change, seen = asyncio.ensure_future(transition(system, ref, made(("tmr", "tr")))), list[str]()

    def on_step(name: str) -> None:
        seen.append(name)
        if name == step and seen.count(step) == 1:
            change.cancel()
        elif name == "abort" and seen.count("abort") == 1:
            fails()

    host: Any = ref._cell.host.place
    host.on_step = on_step
    with pytest.raises(asyncio.CancelledError):
        await change
    host.on_step = None
    return seen


async def all_again(ref: hf.ActorRef[Any]) -> Stack:
    """The stack, when all replicas are there and have the same."""
    await two_again(ref)
    group, host = group_of(ref), ref._cell.host.place
    assert (group.adaptation.config, group.adaptation.change) == (host.config, None)  # type: ignore[attr-defined]
    assert not group.delivery.is_resting
    assert not group.adaptation.is_changing
    return stack(ref)


# -- elsewhere --------------------------------------------------------------------------------------------------------


SCRIPT = """
import asyncio
import holdfast as hf


async def reconfigure(system):
    for step in (
        lambda change: change.protect("/app/alice", "pbr"),
        lambda change: change.protect("/app/alice", ("pbr", "tr")),
        lambda change: change.update("/app/alice", "after", "newer.py", mechanism="pbr", role="primary"),
        lambda change: change.protect("/app/alice", "pbr"),
    ):
        async with system.transaction(timeout=30.0) as change:
            step(change)
        status = await system.get_status("/app/alice")
        print(status.state)
    async with system.transaction(timeout=30.0, dry_run=True) as change:
        change.protect("/app/alice", None)
"""


async def test_a_script_does_all_of_it_from_another_process(
    system: hf.ActorSystem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`holdfast apply`, over the control endpoint: files are named as the script's user names them."""
    script, newer = tmp_path / "script.py", tmp_path / "newer.py"
    script.write_text(SCRIPT)
    newer.write_text("from holdfast.ftm.mechanisms.pbr import Checkpointing\n\n\nclass Newer(Checkpointing): ...\n")
    for file in (script, newer):
        file.chmod(0o600)
    ref = await system.start(hf.child("alice", hf.start(Counter)))
    load = Load(ref, clients=2)
    await load.reached(3)
    monkeypatch.chdir(tmp_path)
    async with control_endpoint(system, tmp_path / "app.sock") as socket:
        command = [sys.executable, "-m", "holdfast.console.cli", "apply", str(script), "--socket", str(socket)]
        process = await asyncio.create_subprocess_exec(*command, stdout=PIPE, stderr=STDOUT)
        async with asyncio.timeout(60):
            said, _ = await process.communicate()
    assert process.returncode == 0, said.decode()
    assert said.decode().endswith("done\n")
    assert stack(ref) == ("pbr",)
    (brick,) = ref._cell.spec.mechanism.exchanged.values()
    assert brick.__name__ == "Newer"
    await load.reached(3)
    await load.stop()
    load.check(await ref.ask(Tags()))
