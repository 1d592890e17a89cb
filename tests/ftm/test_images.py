"""States as images in blocks: what differs is sent, checked, and applied whole or not at all (T8b)."""

from __future__ import annotations

import os
import random
import signal
import zlib
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.errors import DamagedValue
from holdfast.actors.values import encode_value
from holdfast.ftm.alarms import Masked
from holdfast.ftm.bricks.brick_messages import ServerState, StateDelta
from holdfast.ftm.bricks.entry_rows import Rows
from holdfast.ftm.bricks.state_images import BLOCK, Image, Misfit, Patch, cut, image_from, patch
from holdfast.ftm.mechanisms.pbr import Checkpoint
from holdfast.ftm.mechanisms.tmr import TMR
from holdfast.ftm.replica import rewind_points
from tests.ftm.replicated import pair
from tests.ftm.test_failover import group_of, pid_of, two_again
from tests.ftm.warehouse import KINDS, Break, Ledger, Resize, Sum, Touch, Warehouse


class Heard:
    """What a backup is told, before it takes it."""

    def __init__(self, driver: Any, name: str = "r2") -> None:
        self.said: list[ServerState | StateDelta] = []
        self.spoil: Any = lambda state: None
        brick = driver.brick(name, "after")
        take = brick.from_peer

        async def from_peer(message: Checkpoint) -> Any:
            self.said.append(message.state)
            self.spoil(message.state)
            return await take(message)

        brick.from_peer = from_peer

    def take(self) -> list[ServerState | StateDelta]:
        """What was said since the last look."""
        said, self.said = self.said, []
        return said


def point(driver: Any, name: str) -> ServerState:
    found: ServerState = driver.standing(name).server.points.point
    return found


def blocks(change: ServerState | StateDelta) -> int:
    """How many blocks were sent."""
    assert isinstance(change, StateDelta)
    assert change.patch is not None
    return sum(len(piece.blocks) for piece in change.patch.pieces)


async def warehouse(system: hf.ActorSystem, *kinds: str) -> tuple[Any, Heard]:
    """A pair whose backup has the state of a warehouse, and is about to be sent differences only."""
    driver = await pair(system, hf.start(Warehouse, *kinds))
    heard = Heard(driver)
    await driver.ask(Touch(kinds[0], 0))  # From here on it is known to be large.
    heard.take()
    return driver, heard


async def test_only_the_blocks_that_differ_are_sent_of_any_kind_of_variable(system: hf.ActorSystem) -> None:
    driver, heard = await warehouse(system, *KINDS)
    await driver.ask(Touch("list", 0))
    heard.take()
    for kind in KINDS:
        for at in (5, 1500):
            await driver.ask(Touch(kind, at))
        assert max(map(blocks, heard.take())) <= 4, kind
        assert point(driver, "r2").data == point(driver, "r1").data
    seen = await driver.ask(Sum())
    await driver.stop_replica("r1")
    await driver.fail_over("r2")
    assert await driver.ask(Sum()) == seen


async def test_variables_appear_and_disappear_grow_and_shrink(system: hf.ActorSystem) -> None:
    driver, heard = await warehouse(system, "list", "array")
    for what, entries in (("dict", 2000), ("dict", 0), ("array", 10), ("array", 5000), ("list", 0), ("bytes", 4000)):
        await driver.ask(Resize(what, entries))
        assert [type(one) for one in heard.take()] == [StateDelta]
        assert point(driver, "r2").data == point(driver, "r1").data
    seen = await driver.ask(Sum())
    await driver.stop_replica("r1")
    await driver.fail_over("r2")
    assert await driver.ask(Sum()) == seen


async def test_one_that_joins_again_gets_all_and_then_differences(system: hf.ActorSystem) -> None:
    driver, _ = await warehouse(system, "list", "array")
    seen = b""
    for leads, joins in (("r2", "r1"), ("r1", "r2"), ("r2", "r1")):
        for at in range(3):
            await driver.ask(Touch("array", at))
        seen = await driver.ask(Sum())
        await driver.stop_replica(joins)
        await driver.fail_over(leads)
        assert await driver.ask(Sum()) == seen
        await driver.add(joins)
        await driver.join(joins)
        heard = Heard(driver, joins)
        await driver.ask(Touch("list", 7))
        await driver.ask(Touch("list", 8))
        assert [blocks(one) <= 2 for one in heard.take()] == [True, True]
        assert point(driver, joins).data == point(driver, leads).data


async def test_processes_that_are_killed_leave_the_identical_state_to_the_other(system: hf.ActorSystem) -> None:
    start = hf.start(Warehouse, "list", "array", "dict")
    ref = await system.start(hf.child("alice", start, mechanism=hf.ftm.PBR()))
    await two_again(ref)
    for at in range(6):
        await ref.ask(Touch(("list", "array", "dict")[at % 3], at))
    seen = await ref.ask(Sum())
    for _ in range(2):
        group = group_of(ref)
        os.kill(pid_of(system, ref, group.membership.primary or ""), signal.SIGKILL)
        assert await ref.ask(Sum()) == seen
        await ref.ask(Touch("list", 99))
        seen = await ref.ask(Sum())
        await two_again(ref)
    assert await ref.ask(Touch("list", 5)) == 9


async def test_a_damaged_difference_changes_nothing_and_all_of_it_is_sent(system: hf.ActorSystem) -> None:
    """Without the checksum the backup would keep a state that never was."""
    driver, heard = await warehouse(system, "list")

    def spoil(state: ServerState | StateDelta) -> None:
        if isinstance(state, StateDelta) and state.patch is not None:
            piece = next(one for one in state.patch.pieces if one.blocks)
            piece.blocks[0] = piece.blocks[0][:-1] + bytes([piece.blocks[0][-1] ^ 1])

    heard.spoil = spoil
    assert await driver.ask(Touch("list", 9)) == 2
    assert [type(one) for one in heard.take()] == [StateDelta, ServerState]
    heard.spoil = lambda state: None
    assert await driver.ask(Touch("list", 10)) == 3
    assert [type(one) for one in heard.take()] == [StateDelta]
    seen = await driver.ask(Sum())
    await driver.stop_replica("r1")
    await driver.fail_over("r2")
    assert await driver.ask(Sum()) == seen
    assert await driver.ask(Touch("list", 11)) == 4


async def test_differences_to_another_state_than_the_one_that_is_here_are_not_applied(system: hf.ActorSystem) -> None:
    driver, heard = await warehouse(system, "array", "dict")
    old = point(driver, "r2")
    await driver.ask(Touch("array", 1))
    now = point(driver, "r2")
    driver.standing("r2").server.install(ServerState(now.turn, old.data, [], [], [], True))  # It has slept, say.
    heard.take()
    await driver.ask(Touch("dict", 1))
    assert [type(one) for one in heard.take()] == [StateDelta, ServerState]
    assert point(driver, "r2").data == point(driver, "r1").data


async def test_a_state_that_was_damaged_where_it_is_kept_never_leads(system: hf.ActorSystem) -> None:
    driver, _ = await warehouse(system, "list")
    piece = point(driver, "r2").data.pieces[-1]
    block = piece.blocks[1]
    piece.blocks[1] = block[:-1] + bytes([block[-1] ^ 64])  # In the middle of an entry: it could be decoded.
    await driver.stop_replica("r1")
    with pytest.raises(hf.HoldfastError):
        await driver.lead("r2")


async def test_damaged_deltas_are_not_applied(system: hf.ActorSystem) -> None:
    driver = await pair(system, Ledger)
    heard = Heard(driver)
    await driver.ask(Touch("", 1))

    def spoil(state: ServerState | StateDelta) -> None:
        if isinstance(state, StateDelta):
            state.deltas[:] = [state.deltas[0].replace(b"\x01", b"\x02")]

    heard.spoil = spoil
    heard.take()
    await driver.ask(Touch("", 1))
    assert [type(one) for one in heard.take()] == [StateDelta, ServerState]
    seen = await driver.ask(Sum())
    await driver.stop_replica("r1")
    await driver.fail_over("r2")
    assert await driver.ask(Sum()) == seen


async def test_many_deltas_become_a_state_of_which_only_what_differs_is_sent(
    system: hf.ActorSystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rewind_points, "MOST_DELTAS", 4)
    driver = await pair(system, Ledger)
    heard = Heard(driver)
    for at in range(16):
        await driver.ask(Touch("", at))
    said = heard.take()
    patched = [one for one in said if isinstance(one, StateDelta) and one.patch is not None]
    assert len(patched) >= 3
    assert all(blocks(one) <= 2 for one in patched[1:]), "the first one is in another form than what came before"
    assert all(isinstance(one, StateDelta) for one in said[1:])
    assert len(point(driver, "r2").deltas) <= 4
    seen = await driver.ask(Sum())
    await driver.stop_replica("r1")
    await driver.fail_over("r2")
    assert await driver.ask(Sum()) == seen


async def test_a_turn_that_fails_leaves_the_state_it_found(system: hf.ActorSystem) -> None:
    driver, _ = await warehouse(system, *KINDS)
    seen = await driver.ask(Sum())
    with pytest.raises(hf.RemoteCrash, match="broken"):
        await driver.ask(Break())
    assert await driver.ask(Sum()) == seen
    await driver.stop_replica("r1")
    await driver.fail_over("r2")
    assert await driver.ask(Sum()) == seen


async def test_a_large_state_computed_twice_is_the_same_image_twice(system: hf.ActorSystem) -> None:
    driver = await pair(system, hf.start(Warehouse, "list", "dict", "array"), hf.ftm.PBR(), hf.ftm.TR())
    with system.events() as events:
        for at in range(4):
            for kind in ("array", "dict", "list"):
                await driver.ask(Touch(kind, at))
        assert [one for one in events.take() if isinstance(one, Masked)] == []
    seen = await driver.ask(Sum())
    await driver.stop_replica("r1")
    await driver.fail_over("r2")
    assert await driver.ask(Sum()) == seen


async def test_of_three_any_goes_on_with_the_large_state(system: hf.ActorSystem) -> None:
    driver = await pair(system, hf.start(Warehouse, "list", "array"), TMR(), others=("r2", "r3"))
    for at in range(3):
        await driver.ask(Touch("array", at))
        await driver.ask(Touch("list", at))
    seen = await driver.ask(Sum())
    await driver.stop_replica("r1")
    await driver.fail_over("r3")
    assert await driver.ask(Sum()) == seen
    await driver.stop_replica("r3")
    await driver.fail_over("r2")
    assert await driver.ask(Sum()) == seen


@pytest.mark.parametrize("seed", range(20))
def test_a_patch_leads_to_just_the_image_that_it_was_made_for(seed: int) -> None:
    dice = random.Random(seed)
    names = [("", 0), ("a", 1), ("b", 1), ("b", 2)]

    def random_pieces() -> dict[tuple[str, int], bytearray]:
        chosen = dice.sample(names, dice.randint(1, 4))
        return {key: bytearray(dice.randbytes(dice.choice((0, 10, BLOCK, 3 * BLOCK + 1)))) for key in chosen}

    first = random_pieces()
    before = cut(first.items())
    second = random_pieces() | {key: bytearray(value) for key, value in first.items() if dice.random() < 0.7}
    for value in second.values():
        for _ in range(dice.randint(0, 2) if value else 0):
            value[dice.randrange(len(value))] ^= 255
    now = cut(second.items(), before)
    change = patch(before, now)
    assert change.applied(before) == now == cut(second.items())
    assert now.whole() == b"".join(second.values())
    with pytest.raises(Misfit):
        change.applied(cut([(("", 0), b"another")]))
    for piece in change.pieces:
        for index, block in enumerate(piece.blocks):
            at = dice.randrange(len(block))
            piece.blocks[index] = block[:at] + bytes([block[at] ^ 16]) + block[at + 1 :]
            with pytest.raises(Misfit):
                change.applied(before)
            piece.blocks[index] = block
        if piece.at:
            places, piece.at = piece.at, [*piece.at[:-1], piece.count]
            with pytest.raises(Misfit):
                change.applied(before)
            piece.at = places
    if len(change.pieces) > 1:
        with pytest.raises(Misfit):
            Patch(change.base, change.digest, change.pieces[1:]).applied(before)


def test_an_image_with_a_block_too_few_or_in_another_place_is_damaged() -> None:
    image = image_from(random.Random(1).randbytes(3 * BLOCK))
    image.check()
    (piece,) = image.pieces
    for spoilt in (piece.blocks[:2], [piece.blocks[1], piece.blocks[0], piece.blocks[2]]):
        one = type(piece)(piece.name, piece.number, spoilt, piece.sums)
        with pytest.raises(DamagedValue):
            Image([one], image.size, image.digest).check()
    with pytest.raises(DamagedValue):
        Image([type(piece)("", 0, piece.blocks[:2], piece.sums[:2])], image.size, image.digest).check()


PLAIN: list[Any] = [
    None, True, False, 0, -1, 127, 128, 2**16, -(2**31), 2**64 - 1, -(2**63), 1.5, float("inf"), "", "\u00fc" * 40,
    b"", b"x" * 300,
]  # fmt: skip


@pytest.mark.parametrize("seed", range(12))
def test_rows_are_encoded_as_the_whole_variable_is(seed: int) -> None:
    dice = random.Random(seed)
    size = dice.choice((64, 65, 100, 5000, 70_000))
    value: Any = [dice.choice(PLAIN) for _ in range(size)]
    if seed % 2:
        value = {key if dice.random() < 0.5 else str(key): one for key, one in enumerate(value)}
    rows = Rows("name", type(value))
    for _ in range(6):
        assert rows.take(value)
        assert b"".join(rows.blocks) == encode_value({"name": value})
        assert rows.sums == list(map(zlib.crc32, rows.blocks))
        for _ in range(dice.randrange(3)):
            key = dice.choice(list(value)) if seed % 2 else dice.randrange(len(value))
            value[key] = dice.choice(PLAIN)
        if dice.random() < 0.3 and len(value) > 70:
            value.popitem() if seed % 2 else value.pop(dice.randrange(len(value)))


@pytest.mark.parametrize("odd", [2**64, "\udc80", [], (1,), object()])
def test_what_is_not_plain_is_no_row(odd: Any) -> None:
    rows = Rows("name", list)
    plain: list[Any] = list(range(200))
    assert rows.take(plain)
    assert not rows.take([*plain[:150], odd, *plain[150:]])
    assert rows.take(plain)
    assert b"".join(rows.blocks) == encode_value({"name": plain})


async def test_two_variables_that_are_one_list_stay_one(system: hf.ActorSystem) -> None:
    driver, _ = await warehouse(system, "list", "array")
    actor = driver.standing("r1").server.life.cell.actor
    actor.other = {"also": actor.list}
    await driver.ask(Touch("list", 3))
    await driver.stop_replica("r1")
    await driver.fail_over("r2")
    await driver.ask(Touch("list", 4))
    actor = driver.standing("r2").server.life.cell.actor
    assert actor.other["also"] is actor.list


async def test_after_a_turn_that_was_taken_back_only_new_deltas_are_sent(system: hf.ActorSystem) -> None:
    driver = await pair(system, Ledger)
    heard = Heard(driver)
    for at in range(5):
        await driver.ask(Touch("", at))
    with pytest.raises(hf.RemoteCrash):
        await driver.ask(Break())
    heard.take()
    await driver.ask(Touch("", 9))
    (said,) = heard.take()
    assert isinstance(said, StateDelta)
    assert len(said.deltas) == 1
    seen = await driver.ask(Sum())
    await driver.stop_replica("r1")
    await driver.fail_over("r2")
    assert await driver.ask(Sum()) == seen
