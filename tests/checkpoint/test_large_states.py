"""Large states come back by mapping: what is mapped is the life's own, and nothing is left behind (T10, T17, T28)."""

from __future__ import annotations

import asyncio
import contextlib
import mmap
import os
import random
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import holdfast
import holdfast as hf
from holdfast.actors.errors import HoldfastError, NoSuchActor
from holdfast.actors.values import ByteParts, adopt_value, encode_value, in_one, walked_pieces
from holdfast.checkpoint.protocol import Lent, Shared, Snapshot
from holdfast.checkpoint.snapshot.mapped_image import map_image
from holdfast.checkpoint.snapshot.shared_blocks import BLOCK, PAGE, Segment
from tests.checkpoint.image_player import CELLS, MANY, Canvas, Digest, Paint, Spoil, Turns, digest_of
from tests.checkpoint.players import start, until
from tests.checkpoint.strikes import NEVER

pytestmark = pytest.mark.usefixtures("warm_programs")

SEED = 20_261_126
SCRIPT = Path(__file__).with_name("large_root.py")
PATHS = os.pathsep.join(
    filter(None, (str(Path(holdfast.__file__).parents[1]), str(SCRIPT.parents[2]), os.environ.get("PYTHONPATH")))
)
REMOTE = ["process", "subtree"]


def model(cells: int) -> Any:
    made: Any = Canvas.__new__(Canvas)
    Canvas.__init__(made, cells)
    return made


async def canvas(
    system: hf.ActorSystem, where: str, cells: int, name: str = "canvas", **options: Any
) -> hf.ActorRef[Canvas]:
    recovery = hf.hybrid(interval=NEVER, max_deliveries=1000)
    return await start(system, where, name, hf.start(Canvas, cells), **{"recovery": recovery, **options})


async def painted(system: hf.ActorSystem, ref: hf.ActorRef[Canvas], want: Any, first: int, count: int = 9) -> None:
    want.paint(Paint(first, count))
    await ref.ask(Paint(first, count), timeout=25.0)


def end(system: hf.ActorSystem, ref: hf.ActorRef[Canvas]) -> None:
    """Kill the process of an actor, if there is one just now, or the actor."""
    pid = process_of(system, ref)
    if pid != os.getpid():
        with contextlib.suppress(ProcessLookupError):  # It has just ended.
            os.kill(pid, signal.SIGKILL)
    elif ref.path in system.tree():
        ref.kill()


def process_of(system: hf.ActorSystem, ref: hf.ActorRef[Canvas]) -> int:
    """The process that an actor lives in; this one if it is between two lives."""
    try:
        return system.pid_of(ref)
    except NoSuchActor:
        return os.getpid()


def memory_files(pid: int | str = "self") -> list[str]:
    """The segments that a process holds; those that are gone while we look are none."""
    found: list[str] = []
    for name in os.listdir(f"/proc/{pid}/fd"):
        try:
            target = os.readlink(f"/proc/{pid}/fd/{name}")
        except OSError:
            continue
        if target.startswith("/memfd:holdfast "):
            found.append(target)
    return found


# -- it comes back --------------------------------------------------------------------------------------------------


@pytest.mark.pairs
@pytest.mark.parametrize("cells", [CELLS, MANY])
@pytest.mark.some(3)
async def test_what_a_life_does_to_its_state_does_not_reach_its_snapshot(
    store: str | None, isolation: str, cells: int
) -> None:
    """The turns since the snapshot are handled again, on the state as it was then: nothing is there twice."""
    want = model(cells)
    async with hf.ActorSystem("app", store=store, log=False, intensity=1000) as system:
        ref = await canvas(system, isolation, cells)
        await painted(system, ref, want, 0, cells)
        await system.checkpoint(ref, timeout=25.0)
        for number in range(4):
            await painted(system, ref, want, number * 1000, cells // 2)
            end(system, ref)
            assert await ref.ask(Digest(), timeout=25.0) == digest_of(want), f"life {number}"


@pytest.mark.parametrize("where", ["task", *REMOTE])
@pytest.mark.some(3)
async def test_what_comes_back_unchanged_is_not_written_again(store: str | None, where: str) -> None:
    want = model(MANY)
    async with hf.ActorSystem("app", store=store, log=False, intensity=1000) as system:
        ref = await canvas(system, where, MANY)
        await painted(system, ref, want, 0, MANY)
        await system.checkpoint(ref, timeout=25.0)
        for number in range(3):
            end(system, ref)
            await painted(system, ref, want, number * 100_000)
            with system.events() as stream:
                await system.checkpoint(ref, timeout=25.0)
                taken = [one for one in stream.take() if isinstance(one, hf.events.SnapshotTaken)][-1]
            assert taken.size_bytes > MANY * 8
            assert taken.written_bytes <= 3 * BLOCK, f"life {number}"
        end(system, ref)
        assert await ref.ask(Digest(), timeout=25.0) == digest_of(want)


async def test_an_image_that_its_life_has_given_up_is_no_failure_but_a_second_one_is(tmp_path: Path) -> None:
    """A stop in good order saves the state in another way, and closes what was under way."""
    async with hf.ActorSystem("app", store=f"sqlite:{tmp_path / 'app.db'}", log=False) as system:
        ref = await canvas(system, "process", CELLS)
        await system.checkpoint(ref, timeout=25.0)
        home = system._homes.at(ref.path)
        assert home is not None
        closed = Shared(number=1 << 40, pid=system.pid_of(ref), file=1 << 20, inode=1, size=BLOCK, places=[])
        with system.events() as stream:

            def failed() -> list[str]:
                return [one.reason for one in stream.take() if isinstance(one, hf.events.SnapshotFailed)]

            home.images.take(Snapshot(0, b"", True, [], 0.0), closed)
            assert failed() == []
            home.images.take(Snapshot(0, b"", True, [], 0.0), closed)
            assert ["gone" in one for one in failed()] == [True]
        await system.checkpoint(ref, timeout=25.0)


async def test_two_come_back_at_once(store: str | None) -> None:
    async with hf.ActorSystem("app", store=store, log=False, intensity=1000) as system:
        wants = [model(MANY), model(MANY)]
        refs = [await canvas(system, "process", MANY, f"canvas-{n}") for n in range(2)]
        for n, (ref, want) in enumerate(zip(refs, wants, strict=True)):
            await painted(system, ref, want, n, MANY // 2)
            await system.checkpoint(ref, timeout=25.0)
        for ref in refs:
            end(system, ref)
        digests = await asyncio.gather(*(ref.ask(Digest(), timeout=25.0) for ref in refs))
        assert digests == [digest_of(want) for want in wants]


@pytest.mark.parametrize("where", REMOTE)
@pytest.mark.some(2)
async def test_a_life_that_is_killed_while_it_comes_back_is_followed_by_another(store: str | None, where: str) -> None:
    moments = random.Random(SEED)
    print(f"seed {SEED}")
    want = model(MANY)
    async with hf.ActorSystem("app", store=store, log=False, intensity=10_000) as system:
        ref = await canvas(system, where, MANY)
        for number in range(4):
            await painted(system, ref, want, number * 50_000, MANY // 3)
            await system.checkpoint(ref, timeout=25.0)
            await painted(system, ref, want, number * 70_000)
            for _ in range(5):
                end(system, ref)
                await asyncio.sleep(moments.uniform(0.0, 0.06))
            assert await ref.ask(Digest(), timeout=25.0) == digest_of(want), f"seed {SEED}, round {number}"


def test_a_root_that_is_killed_while_a_state_comes_back_loses_nothing(tmp_path: Path) -> None:
    moments = random.Random(SEED)
    print(f"seed {SEED}")
    store, done = tmp_path / "app.db", 0
    for _ in range(3):
        fatal = done + moments.randint(2, 6)
        root = subprocess.Popen(
            [sys.executable, str(SCRIPT), str(store)],
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": PATHS},
        )
        assert root.stdout is not None
        with root.stdout as out:
            for line in out:
                done = max(done, int(line) + 1)
                if int(line) == fatal:  # Its child is being killed just now.
                    root.kill()
        assert root.wait() == -9, f"seed {SEED}: it ended by itself"

    async def look() -> tuple[int, str]:
        async with hf.ActorSystem("app", store=f"sqlite:{store}", log=False) as system:
            ref = await canvas(system, "process", MANY)
            return await ref.ask(Turns(), timeout=25.0), await ref.ask(Digest(), timeout=25.0)

    turns, digest = asyncio.run(look())
    assert turns >= done, f"seed {SEED}"
    want = model(MANY)
    for n in range(turns):
        want.paint(Paint(n * 37 % MANY, 40_000))
    assert digest == digest_of(want), f"seed {SEED}"


@pytest.mark.parametrize("cells", [CELLS, MANY])
@pytest.mark.some(3)
async def test_what_was_saved_as_one_value_at_a_stop_comes_back(tmp_path: Path, isolation: str, cells: int) -> None:
    want, store = model(cells), f"sqlite:{tmp_path / 'app.db'}"
    for number in range(3):
        async with hf.ActorSystem("app", store=store, log=False, intensity=1000) as system:
            ref = await canvas(system, isolation, cells)
            assert await ref.ask(Digest(), timeout=25.0) == digest_of(want)
            assert memory_files() == [], "the life has it"
            await painted(system, ref, want, number, 1000)
            end(system, ref)
            assert await ref.ask(Digest(), timeout=25.0) == digest_of(want)


async def test_a_child_with_a_memory_limit_comes_back() -> None:
    """It never has its state twice: it would be ended while it came back, again and again."""
    cells = 15_000_000
    limits = hf.Limits(memory_bytes=370_000_000, watch_interval=0.02)
    async with hf.ActorSystem("app", log=False, intensity=3) as system:
        ref = await canvas(system, "process", cells, limits=limits)
        want = model(cells)
        await painted(system, ref, want, 0, cells)
        await system.checkpoint(ref, timeout=25.0)
        for _ in range(3):
            with system.events() as stream:
                end(system, ref)
                assert await ref.ask(Digest(), timeout=25.0) == digest_of(want)
                ends = [one for one in stream.take() if isinstance(one, hf.events.ProcessDied)]
            assert [one.reason for one in ends if isinstance(one.reason, hf.OutOfMemory)] == []
            assert len(ends) == 1


# -- what is lent ---------------------------------------------------------------------------------------------------


def test_what_is_lent_stays_as_it_is() -> None:
    segment = Segment.of(1, [(0, b"a" * BLOCK), (BLOCK, b"b" * BLOCK)])
    segment.lend()
    with pytest.raises(PermissionError):
        os.pwrite(segment.file, b"x", 0)
    own = os.open(f"/proc/self/fd/{segment.file}", os.O_RDWR)
    try:
        with pytest.raises(PermissionError):
            mmap.mmap(own, BLOCK, mmap.MAP_SHARED, mmap.PROT_READ | mmap.PROT_WRITE)
        with pytest.raises(PermissionError):
            os.ftruncate(own, 0)
    finally:
        os.close(own)
    segment.keep({(0, BLOCK)})
    assert os.pread(segment.file, 4, BLOCK) == b"bbbb", "a life may have it mapped"
    segment.close()


def lent(*segments: Segment, places: list[tuple[int, int, int]]) -> Lent:
    for segment in segments:
        segment.lend()
    return Lent(os.getpid(), [(one.number, one.file, one.inode) for one in segments], places)


def test_an_image_is_put_together_of_blocks_of_several_segments() -> None:
    first = Segment.of(1, [(0, b"a" * BLOCK), (BLOCK, b"b" * 100)])
    second = Segment.of(2, [(0, b"c" * BLOCK)])
    image = map_image(lent(first, second, places=[(1, 0, BLOCK), (2, 0, BLOCK), (1, BLOCK, 100), (1, 0, BLOCK)]))
    assert len(image.data) == 3 * BLOCK + 100
    whole = image.data.take(2 * BLOCK + 100)
    assert isinstance(whole, memoryview), "what follows whole pages lies behind them"
    assert whole[:-100] == b"a" * BLOCK + b"c" * BLOCK
    assert whole[-100:] == b"b" * 100
    whole[0] = 0
    assert bytes(in_one(image.data.take(2))) == b"aa"
    assert os.pread(first.file, 1, 0) == b"a"
    for segment in (first, second, *image.segments.values()):
        segment.close()


@pytest.mark.parametrize(
    "places", [[(1, 0, 2 * BLOCK)], [(1, BLOCK, PAGE)], [(2, 0, PAGE)], [(1, 1, 5)], [(1, -PAGE, 5)], [(1, 0, 0)]]
)
def test_places_that_are_none_are_refused_and_nothing_stays_open(places: list[tuple[int, int, int]]) -> None:
    segment = Segment.of(1, [(0, b"a" * BLOCK)])
    before = os.listdir("/proc/self/fd")
    with pytest.raises((HoldfastError, OSError, ValueError)):
        map_image(lent(segment, places=places))
    assert os.listdir("/proc/self/fd") == before
    segment.close()


def test_another_file_of_that_number_is_refused() -> None:
    segment, other = Segment.of(1, [(0, b"a" * BLOCK)]), Segment.of(2, [(0, b"b" * BLOCK)])
    told = lent(segment, places=[(1, 0, BLOCK)])
    before = os.listdir("/proc/self/fd")
    told.segments[0] = (1, other.file, segment.inode)
    with pytest.raises(HoldfastError):
        map_image(told)
    assert os.listdir("/proc/self/fd") == before
    other.close()
    segment.close()


# -- what is left ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("where", ["task", *REMOTE])
async def test_no_descriptor_is_left_by_recoveries(store: str | None, where: str) -> None:
    want = model(MANY)
    async with hf.ActorSystem("app", store=store, log=False, intensity=1000) as system:
        ref = await canvas(system, where, MANY)
        await painted(system, ref, want, 0, MANY)
        await system.checkpoint(ref, timeout=25.0)
        seen: list[tuple[int, int]] = []
        for number in range(5):
            end(system, ref)
            await painted(system, ref, want, number)
            await system.checkpoint(ref, timeout=25.0)
            seen.append((len(os.listdir("/proc/self/fd")), len(memory_files(process_of(system, ref)))))
        assert seen[-1][0] <= seen[1][0] + 4, f"some number is added by each: {seen}"
        assert seen[-1][1] <= seen[1][1] + 4, seen
    assert memory_files() == []


@pytest.mark.parametrize("where", REMOTE)
async def test_what_the_store_has_takes_no_memory_beside_the_state(tmp_path: Path, where: str) -> None:
    want = model(MANY)
    async with hf.ActorSystem("app", store=f"sqlite:{tmp_path / 'app.db'}", log=False, intensity=1000) as system:
        ref = await canvas(system, where, MANY)
        await painted(system, ref, want, 0, MANY)
        await system.checkpoint(ref, timeout=25.0)
        for number in range(3):
            await painted(system, ref, want, number, MANY // 4)
            await system.checkpoint(ref, timeout=25.0)
            pid = process_of(system, ref)
            await until(lambda: not memory_files() and not memory_files(pid))  # noqa: B023 - called at once
        end(system, ref)
        assert await ref.ask(Digest(), timeout=25.0) == digest_of(want)
        assert memory_files() == [], "what the life has mapped is its own"


async def test_a_restore_that_fails_closes_what_it_has_opened(tmp_path: Path) -> None:
    store = f"sqlite:{tmp_path / 'app.db'}"
    async with hf.ActorSystem("app", store=store, log=False) as system:
        ref = await canvas(system, "task", CELLS)
        await painted(system, ref, model(CELLS), 0)
        await system.checkpoint(ref, timeout=25.0)
        await ref.ask(Spoil(True))  # No snapshot is taken at the end.

    @hf.renamed("tests.checkpoint.image_player:Canvas")
    class Unfit(Canvas):
        schema_version = -1

    async with hf.ActorSystem("app", store=store, log=False) as system:
        counts: list[int] = []
        for _ in range(3):
            spec = hf.child("canvas", hf.start(Unfit, CELLS), recovery=hf.hybrid(interval=NEVER))
            with pytest.raises(hf.StartFailed, match="schema version"):
                await system.start(spec)
            counts.append(len(memory_files()))
        assert len(set(counts)) == 1, counts


# -- damage ---------------------------------------------------------------------------------------------------------


def newest_pack(store: Path) -> Path:
    return max(store.parent.glob("*-packs/*/*.pack"), key=lambda one: one.stat().st_mtime_ns)


@pytest.mark.parametrize("where", REMOTE)
@pytest.mark.parametrize("damage", ["byte", "cut", "missing"])
@pytest.mark.some(3)
async def test_a_snapshot_that_is_damaged_meanwhile_is_passed_over(tmp_path: Path, where: str, damage: str) -> None:
    store, want = tmp_path / "app.db", model(MANY)
    async with hf.ActorSystem("app", store=f"sqlite:{store}", log=False, intensity=1000) as system:
        ref = await canvas(system, where, MANY)
        for number in range(3):
            await painted(system, ref, want, number * 1000, 100_000)
            await system.checkpoint(ref, timeout=25.0)
        await painted(system, ref, want, 7)
        pack = newest_pack(store)
        match damage:
            case "byte":
                with pack.open("r+b") as file:
                    file.seek(-5, os.SEEK_END)
                    file.write(b"\xa5")
            case "cut":
                os.truncate(pack, pack.stat().st_size // 2)
            case _:
                pack.unlink()
        with system.events() as stream:
            end(system, ref)
            want.paint(Paint(5, 5))
            waiting = asyncio.ensure_future(ref.ask(Paint(5, 5), timeout=25.0))
            assert await ref.ask(Digest(), timeout=25.0) == digest_of(want)
            assert await waiting == want.turns
            told = [one for one in stream.take() if isinstance(one, hf.events.SnapshotDamaged)]
        assert [one.address for one in told] == [ref.path]
        await system.checkpoint(ref, timeout=25.0)
        end(system, ref)
        assert await ref.ask(Digest(), timeout=25.0) == digest_of(want)
    async with hf.ActorSystem("app", store=f"sqlite:{store}", log=False) as system:
        ref = await canvas(system, where, MANY)
        assert await ref.ask(Digest(), timeout=25.0) == digest_of(want)


@pytest.mark.parametrize("where", ["task", "process"])
async def test_an_older_snapshot_is_whole(store: str | None, where: str) -> None:
    """The newest one shares blocks with it, and needs some of them no more."""
    want = model(MANY)
    async with hf.ActorSystem("app", store=store, log=False, intensity=1000) as system:
        recovery = hf.hybrid(interval=NEVER, on_escalate="older_snapshot")
        spec = hf.child("canvas", hf.start(Canvas, MANY), isolation=where, recovery=recovery)  # type: ignore[arg-type]
        await system.start(hf.supervisor("top", children=[spec], intensity=0))
        ref = system.ref("/app/top/canvas", Canvas)
        await painted(system, ref, want, 0, MANY)
        await system.checkpoint(ref, timeout=25.0)
        await painted(system, ref, want, 0, 100)
        await system.checkpoint(ref, timeout=25.0)
        await painted(system, ref, model(MANY), MANY // 2, 100)
        await system.checkpoint(ref, timeout=25.0)
        with system.events() as stream:
            end(system, ref)
            async for event in stream:
                if isinstance(event, hf.events.RolledBack):
                    break
        assert await ref.ask(Digest(), timeout=25.0) == digest_of(want)


async def test_an_actor_that_replays_nothing_goes_back_to_the_older_snapshot(tmp_path: Path) -> None:
    store, want = tmp_path / "app.db", model(MANY)
    recovery = hf.checkpoint_only(interval=NEVER)
    async with hf.ActorSystem("app", store=f"sqlite:{store}", log=False, intensity=1000) as system:
        ref = await canvas(system, "process", MANY, recovery=recovery)
        await painted(system, ref, want, 0, 100_000)
        await system.checkpoint(ref, timeout=25.0)
        await painted(system, ref, model(MANY), 1000, 100_000)
        await system.checkpoint(ref, timeout=25.0)
        newest_pack(store).unlink()
        end(system, ref)
        assert await ref.ask(Digest(), timeout=25.0) == digest_of(want)
        await painted(system, ref, want, 3)
        assert await ref.ask(Digest(), timeout=25.0) == digest_of(want)


# -- values that stay where they are ----------------------------------------------------------------------------------


def test_arrays_stay_where_they_lie_if_they_are_large() -> None:
    value = {
        "alike": [np.arange(size, dtype=np.float64) for size in (*range(1, 9), 20_000, 30_000)],
        "rows": [np.full((100, 100), n) for n in range(9)],
        "turned": np.asfortranarray(np.arange(90_000.0).reshape(300, 300)),
        "small": np.arange(5),
        "bytes": bytearray(b"x" * 100_000),
    }
    pieces = [memoryview(bytearray(memoryview(one).cast("B"))) for one in walked_pieces(value, "value")[0]]
    for data in (ByteParts(pieces), memoryview(bytearray(encode_value(value)))):
        read: Any = adopt_value(data)
        assert encode_value(read) == encode_value(value)
        if isinstance(data, ByteParts):  # Else they may lie where no array should.
            assert [one.flags.owndata for one in read["alike"]] == [True] * 8 + [False] * 2
        assert read["small"].flags.owndata
        assert read["turned"].flags.f_contiguous
        assert all(one.flags.writeable for one in (*read["alike"], *read["rows"], read["turned"]))
