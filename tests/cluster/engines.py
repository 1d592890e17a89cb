"""What every engine promises, as one function for each promise, to be run on simulated servers and on real ones.

Each takes `connect`, which makes one more connection to servers on which the system has nothing yet. They hold while
nothing goes wrong; what holds when something does is tested with simulated fleets.
"""

from __future__ import annotations

import asyncio
import random
from collections.abc import Awaitable, Callable
from typing import Final

import pytest

from holdfast.cluster.log_records import PART
from holdfast.cluster.ports import Engine, LogReader, LogRecord, OutOfTurn

Connect = Callable[[], Awaitable[Engine]]
WAIT: Final = 5.0
"""Seconds that a read waits for records that are there."""
MARGIN: Final = 2.0
"""Seconds by which a lease may end later than it should."""


async def _read(reader: LogReader, count: int) -> list[LogRecord]:
    """So many records, and nothing behind them."""
    found: list[LogRecord] = []
    while len(found) < count:
        some = await reader.next(WAIT)
        assert some, f"{len(found)} of {count} records came"
        found += some
    assert not await reader.next(0.2)
    await reader.close()
    return found


async def _read_behind(engine: Engine, after: int, count: int) -> list[LogRecord]:
    return await _read(await engine.log.read(after), count)


async def _write(engine: Engine, count: int, after: int = 0) -> list[LogRecord]:
    written: list[LogRecord] = []
    for number in range(count):
        data = b"record %d" % number
        after = await engine.log.append(data, after)
        written.append(LogRecord(after, data))
    return written


# ---- the log


async def a_log_has_what_was_appended_in_order(connect: Connect) -> None:
    """Numbers rise, every connection reads the same, from any record on."""
    one, other = await connect(), await connect()
    assert await one.log.last() is None
    assert not await (await one.log.read(0)).next(0.1)
    written = await _write(one, 5)
    assert [record.sequence for record in written] == sorted({record.sequence for record in written})
    assert written[0].sequence > 0
    for engine in (one, other):
        assert await engine.log.last() == written[-1]
        assert await _read_behind(engine, 0, 5) == written
        assert await _read_behind(engine, written[2].sequence, 2) == written[3:]
        assert await _read_behind(engine, written[-1].sequence, 0) == []


async def an_append_names_its_predecessor(connect: Connect) -> None:
    """Behind another record than the last one nothing is appended, the same record again included."""
    engine = await connect()
    written = await _write(engine, 3)
    for after in (0, written[0].sequence, written[1].sequence, written[2].sequence + 1):
        with pytest.raises(OutOfTurn):
            await engine.log.append(b"record 2", after)
    assert await _read_behind(engine, 0, 3) == written


async def of_many_appends_one_comes_through(connect: Connect) -> None:
    """At one time, from several connections, behind the same record."""
    engines = [await connect() for _ in range(3)]
    after = 0
    for turn in range(5):
        appends = [engines[number % 3].log.append(b"%d by %d" % (turn, number), after) for number in range(9)]
        results = await asyncio.gather(*appends, return_exceptions=True)
        (after,) = [result for result in results if isinstance(result, int)]
        assert sum(isinstance(result, OutOfTurn) for result in results) == 8
    assert len(await _read_behind(engines[0], 0, 5)) == 5


async def a_reader_hears_of_what_comes(connect: Connect) -> None:
    """It waits for it, and goes on from there."""
    one, other = await connect(), await connect()
    reader = await other.log.read(0)
    after = 0
    for number in range(3):
        hearing = asyncio.ensure_future(reader.next(WAIT))
        await asyncio.sleep(0.05)
        assert not hearing.done()
        after = await one.log.append(b"%d" % number, after)
        assert await hearing == [LogRecord(after, b"%d" % number)]
    await reader.close()


async def what_is_forgotten_is_gone(connect: Connect) -> None:
    """Whoever reads from before it begins with what is left; the log goes on."""
    one, other = await connect(), await connect()
    written = await _write(one, 6)
    under_way = await other.log.read(written[0].sequence)
    await one.log.forget(written[3].sequence)
    await one.log.forget(written[2].sequence)
    assert await _read_behind(other, 0, 3) == written[3:]
    assert await _read_behind(other, written[1].sequence, 3) == written[3:]
    assert (await _read(under_way, 3))[-3:] == written[3:]
    assert await other.log.last() == written[-1]
    more = await other.log.append(b"more", written[-1].sequence)
    assert (await _read_behind(one, written[4].sequence, 2))[-1] == LogRecord(more, b"more")


async def a_log_takes_many_records_and_large_ones(connect: Connect) -> None:
    """As large as a part and what stands before it."""
    engine = await connect()
    written = await _write(engine, 600)
    data = random.Random(1).randbytes(PART + 1000)
    large = LogRecord(await engine.log.append(data, written[-1].sequence), data)
    assert await _read_behind(engine, 0, 601) == [*written, large]


# ---- the lease


async def a_lease_has_one_holder(connect: Connect) -> None:
    """Until it is given up; whoever has it may ask again, for an answer may have been lost."""
    one, other = (await connect()).lease, (await connect()).lease
    assert await one.holder() == ""
    token = await one.acquire("one")
    assert token is not None
    assert await other.acquire("other") is None
    assert await other.holder() == await one.holder() == "one"
    again = await one.acquire("one")
    assert again is not None
    renewed = await one.renew("one", again)
    assert renewed is not None
    renewed = await one.renew("one", again)  # The answer to the last one may have been lost.
    assert renewed is not None
    assert await other.renew("other", again) is None
    await one.release(renewed)
    assert await other.holder() == ""
    taken = await other.acquire("other")
    assert taken is not None
    assert await one.renew("one", renewed) is None
    await one.release(renewed)
    assert await one.holder() == "other"
    await other.release(taken)


async def a_lease_ends_by_itself(connect: Connect) -> None:
    """If nobody renews it; each renewal, and each time that its holder takes it again, begins its time anew."""
    one, other = (await connect()).lease, (await connect()).lease
    loop = asyncio.get_running_loop()
    token = await one.acquire("one")
    assert token is not None
    for _ in range(2):
        await asyncio.sleep(0.6 * one.seconds)
        token = await one.renew("one", token)
        assert token is not None
    await asyncio.sleep(0.6 * one.seconds)
    assert await one.acquire("one") is not None
    began = loop.time()
    await asyncio.sleep(0.6 * one.seconds)
    assert await other.acquire("other") is None
    while await other.holder():
        assert loop.time() < began + one.seconds + MARGIN
        await asyncio.sleep(0.05)
    assert await other.acquire("other") is not None


# ---- blobs


async def blobs_are_kept_by_name(connect: Connect) -> None:
    """Small, empty and large ones, for every connection, until they are removed."""
    one, other = (await connect()).blobs, (await connect()).blobs
    assert await one.names() == set()
    assert await one.get("none") is None
    kept = {"small": b"x", "empty": b"", "exact": b"y" * PART, "large": random.Random(2).randbytes(5 * PART // 2)}
    for name, data in kept.items():
        await one.put(name, data)
        await one.put(name, data)
    assert await other.names() == set(kept)
    for name, data in kept.items():
        assert await other.get(name) == data
    await other.drop("large")
    await other.drop("large")
    await other.drop("none")
    assert await one.get("large") is None
    assert await one.names() == set(kept) - {"large"}


PROMISES: Final = (
    a_log_has_what_was_appended_in_order,
    an_append_names_its_predecessor,
    of_many_appends_one_comes_through,
    a_reader_hears_of_what_comes,
    what_is_forgotten_is_gone,
    a_log_takes_many_records_and_large_ones,
    a_lease_has_one_holder,
    a_lease_ends_by_itself,
    blobs_are_kept_by_name,
)
"""All of them."""
