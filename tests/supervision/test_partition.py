"""Partition supervisors (otp.md 1.14 PartitionSupervisor)."""

import os
import subprocess
import sys
from typing import Any

import pytest

import holdfast as hf
from tests.supervision.family import Boom, refused


class Add(hf.Message[int]):
    n: int = 0


class Where(hf.Message[str]): ...


class Counter(hf.Actor):
    def __init__(self, start: int = 0, number: int = -1) -> None:
        self.total, self.number = start, number

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.total += message.n
        return self.total

    @hf.on(Where)
    def where(self, message: Where) -> str:
        return f"{self.ctx.path} {self.number}"

    @hf.on(Boom)
    def boom(self, message: Boom) -> None:
        raise ValueError("boom")


async def begin(
    system: hf.ActorSystem, count: int | None = 4, **options: Any
) -> hf.ActorRef[hf.supervision.PartitionSupervisor]:
    return await system.start(hf.supervision.partitions("top", hf.start(Counter, 100), count, **options))


async def routed(top: hf.ActorRef[Any], key: object) -> str:
    path: str = (await top.ask(hf.supervision.Route(key))).path
    return path.rpartition("/")[2]


@pytest.mark.parametrize("count", [1, 2, 3, 7])
async def test_an_int_goes_to_its_absolute_value_modulo_the_count(count: int) -> None:
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system, count)
        for key in (0, 1, 5, -5, -7, 12_345_678_901_234_567_890):
            assert await routed(top, key) == str(abs(key) % count)


async def test_any_other_key_has_one_place_for_good() -> None:
    keys = ["alice", "bob", b"x", 1.0, ("a", 1), None, True]
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system)
        assert [await routed(top, key) for key in keys] == [str(hf.supervision.partition_of(key, 4)) for key in keys]


def test_the_hash_is_the_same_in_every_process() -> None:
    keys = [f"key-{number}" for number in range(50)]
    program = f"import holdfast as hf; print([hf.supervision.partition_of(key, 8) for key in {keys!r}])"
    environment = {**os.environ, "PYTHONHASHSEED": "7"}
    done = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True, env=environment)
    here = [hf.supervision.partition_of(key, 8) for key in keys]
    assert done.stdout.strip() == str(here)
    assert set(here) == set(range(8)), "and it spreads"


async def test_there_are_as_many_as_processors_if_nothing_is_said() -> None:
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system, None)
        assert await top.ask(hf.supervision.CountPartitions()) == (os.cpu_count() or 1)


async def test_each_copy_is_supervised_and_keeps_its_place() -> None:
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system, intensity=9)
        ref = await top.ask(hf.supervision.Route(2))
        await ref.ask(Add(1))
        ref.tell(Boom())
        assert await ref.ask(Add(1)) == 101
        assert await top.ask(hf.supervision.Route(6)) == ref
        assert [info.id for info in await top.ask(hf.WhichChildren())] == ["0", "1", "2", "3"]


async def test_copies_can_be_given_arguments_by_their_number() -> None:
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system, 3, arguments=lambda number: (number * 10,))
        assert [await (await top.ask(hf.supervision.Route(key))).ask(Where()) for key in range(3)] == [
            f"/app/top/{number} {number * 10}" for number in range(3)
        ]


async def test_resize_stops_the_upper_ones_and_starts_them_again() -> None:
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system)
        await (await top.ask(hf.supervision.Route(0))).ask(Add(5))
        assert await top.ask(hf.supervision.ResizePartitions(2)) == 4
        assert [info.state for info in await top.ask(hf.WhichChildren())] == ["running"] * 2 + ["stopped"] * 2
        assert [await routed(top, key) for key in range(4)] == ["0", "1", "0", "1"]
        assert await top.ask(hf.supervision.ResizePartitions(3)) == 2
        assert await top.ask(hf.supervision.CountPartitions()) == 3
        assert [await routed(top, key) for key in range(4)] == ["0", "1", "2", "0"]
        assert await (await top.ask(hf.supervision.Route(0))).ask(Add()) == 105, "the lower ones were not touched"


async def test_with_no_partition_routing_is_refused() -> None:
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system)
        assert await top.ask(hf.supervision.ResizePartitions(0)) == 4
        assert await refused(top.ask(hf.supervision.Route(1))) == hf.errors.NoPartitions("/app/top")
        assert await top.ask(hf.supervision.ResizePartitions(1)) == 0
        assert await routed(top, 17) == "0"
    with pytest.raises(ValueError, match="no partition"):
        hf.supervision.partition_of(1, 0)


@pytest.mark.parametrize("count", [-1, 5, 1000])
async def test_there_are_never_more_than_at_the_start(count: int) -> None:
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system)
        error = await refused(top.ask(hf.supervision.ResizePartitions(count)))
        assert isinstance(error, hf.SpecError)
        assert "from 0 to 4" in str(error)
        assert await top.ask(hf.supervision.CountPartitions()) == 4


async def test_what_makes_no_sense_is_refused() -> None:
    for count in (0, -1, True, 1.5):
        with pytest.raises(hf.SpecError, match="partitions 'top': count must be a whole number >= 1"):
            hf.supervision.partitions("top", hf.start(Counter), count)  # type: ignore[arg-type]
    significant = hf.child(None, hf.start(Counter), restart="transient", significant=True)
    with pytest.raises(hf.SpecError, match="significant"):
        hf.supervision.partitions("top", significant, 2)
    async with hf.ActorSystem(log=False) as system:
        top = await begin(system)
        for call in (hf.StartChild(hf.child("x", hf.start(Counter))), hf.DeleteChild("0")):
            assert isinstance(await refused(top.ask(call)), hf.errors.NotSupported)
        unsavable = await refused(top.ask(hf.supervision.Route(object())))
        assert "type object" in str(unsavable)
        assert top._cell.life == 1


async def test_partitions_in_processes_and_in_one_process() -> None:
    async with hf.ActorSystem(log=False) as system:
        apart = await system.start(
            hf.supervision.partitions("apart", hf.child(None, hf.start(Counter), isolation="process"), 2)
        )
        refs = [await apart.ask(hf.supervision.Route(key)) for key in (0, 1)]
        assert [await ref.ask(Add(1)) for ref in refs] == [1, 1]
        assert len({system.pid_of(ref) for ref in refs} | {os.getpid()}) == 3
        together = await begin(system, 3, isolation="process")
        for key in ((1, "a"), [1, "a"], frozenset({2}), "a"):
            found = await together.ask(hf.supervision.Route(key))
            assert found.path == f"/app/top/{hf.supervision.partition_of(key, 3)}"
        ref = await together.ask(hf.supervision.Route(4))
        assert (ref.path, await ref.ask(Add(1))) == ("/app/top/1", 101)
        assert await together.ask(hf.supervision.ResizePartitions(1)) == 3
        assert await refused(together.ask(hf.supervision.ResizePartitions(4))) is not None
