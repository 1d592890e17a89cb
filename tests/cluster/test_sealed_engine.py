"""What is kept on servers with a key cannot be read without it, and is not taken back when it was changed or moved."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from holdfast.checkpoint.journal import DamagedStore, WrongStoreKey
from holdfast.cluster.joining import open_store
from holdfast.cluster.leadership import Follower, lead
from holdfast.cluster.log_records import DamagedLog
from holdfast.cluster.ports import LogRecord
from holdfast.cluster.replicated_journal import LARGE, ReplicatedJournal
from holdfast.cluster.sealed_engine import SealedEngine, sealed
from holdfast.testing.fleet.broker import SimBroker
from holdfast.testing.fleet.same_loop import SameLoop
from holdfast.testing.fleet.sim_engine import SimEngine
from tests.cluster.servers import NatsServers
from tests.cluster.shelves import copied, fill, found_in

KEY, OTHER = bytes(range(32)), bytes(range(1, 33))
SECRET = b"the cake is in the cellar"

virtual = pytest.mark.asyncio(loop_factories=["virtual"])


async def written(broker: SimBroker, key: bytes | None) -> None:
    """A program leads and writes secrets of each kind: an entry, snapshots in the log and beside it, blocks, a note."""
    engine = await sealed(SimEngine(broker), key, "app")
    journal = ReplicatedJournal(engine, SameLoop(), await lead(engine, "the first", standby=None))
    journal.append([("/app/secret", ("in", 1, SECRET))])
    journal.cut("/app/small", SECRET, [], turn=1)
    journal.cut("/app/large", SECRET * LARGE, [], turn=1)
    journal.keep_blocks("/app/large", 1, [(0, memoryview(SECRET * 10))], False)
    journal.note("the cake", SECRET)
    await journal.synced()
    await journal.end()


@virtual
async def test_nothing_of_it_can_be_read_without_the_key() -> None:
    broker = SimBroker()
    await written(broker, KEY)
    kept = [record.data for record in broker.records] + list(broker.blobs.values())
    assert len(broker.blobs) == 2
    for data in kept:
        for secret in (SECRET[:10], b"the cake", b"/app/", b"the first"):
            assert secret not in data
    engine = await sealed(SimEngine(broker), KEY, "app")
    leading = await lead(engine, "the second", standby=None)
    journal = ReplicatedJournal(engine, SameLoop(), leading)
    assert journal.load("/app/secret").entries[0][1] == ("in", 1, SECRET)
    assert journal.load("/app/small").snapshot == SECRET
    assert journal.load("/app/large").snapshot == SECRET * LARGE
    segment = journal.read_blocks("/app/large", 1, [(0, 250)])
    assert segment.block(0, 250) == SECRET * 10
    segment.close()
    assert journal.noted("the cake") == SECRET
    await journal.end()


@virtual
@pytest.mark.parametrize(
    ("made", "key", "problem"),
    [
        (KEY, OTHER, "the key is not the one"),
        (KEY, None, "it is encrypted, and there is no key"),
        (None, KEY, "it is not encrypted, and there is a key"),
    ],
)
async def test_a_wrong_key_is_refused_before_anything_is_changed(
    made: bytes | None, key: bytes | None, problem: str
) -> None:
    broker = SimBroker()
    await written(broker, made)
    before = list(broker.everything), dict(broker.blobs), broker.lease_token
    with pytest.raises(WrongStoreKey, match=problem):
        await sealed(SimEngine(broker), key, "app")
    assert (list(broker.everything), dict(broker.blobs), broker.lease_token) == before


@virtual
async def test_records_of_another_log_or_without_a_key_are_not_taken() -> None:
    broker, other = SimBroker(), SimBroker()
    await written(broker, KEY)
    await written(other, OTHER)
    plain = SimBroker()
    await written(plain, None)
    engine = await sealed(SimEngine(broker), KEY, "app")
    assert isinstance(engine, SealedEngine)
    with pytest.raises(DamagedLog, match="its tag is wrong"):
        engine.log.opened(other.records[0])
    with pytest.raises(DamagedLog, match="it is not encrypted, and what stands before it is"):
        engine.log.opened(plain.records[0])
    changed = bytearray(broker.records[0].data)
    changed[-20] ^= 1
    with pytest.raises(DamagedLog, match="its tag is wrong"):
        engine.log.opened(LogRecord(1, bytes(changed)))
    with pytest.raises(WrongStoreKey):
        await sealed(SimEngine(broker), KEY, "shop")  # The same key in another system.
    follower = Follower(SimEngine(broker))  # It began when nothing stood there, and has no key.
    with pytest.raises(DamagedLog, match="it is encrypted, and there is no key for it"):
        await follower.catch_up()


@virtual
async def test_what_stands_beside_the_log_is_bound_to_its_name() -> None:
    broker = SimBroker()
    await written(broker, KEY)
    one, two = broker.blobs
    broker.blobs[one], broker.blobs[two] = broker.blobs[two], broker.blobs[one]
    engine = await sealed(SimEngine(broker), KEY, "app")
    journal = ReplicatedJournal(engine, SameLoop(), await lead(engine, "the second", standby=None))
    with pytest.raises(DamagedStore, match="is missing"):
        await asyncio.to_thread(journal.load, "/app/large")
    await journal.end()


async def test_a_system_on_real_servers_is_encrypted_and_copied_both_ways(nats1: NatsServers, tmp_path: Path) -> None:
    key, new = tmp_path / "app.key", tmp_path / "new.key"
    for file, data in ((key, KEY), (new, OTHER)):
        file.touch(mode=0o600)
        file.write_bytes(data)
    servers, plain, back = (
        nats1.store(nats1.new_system()),
        f"sqlite:{tmp_path / 'app.db'}",
        f"sqlite:{tmp_path / 'b.db'}",
    )
    await fill(plain)
    done = copied(plain, servers, "--new-key-file", str(key))
    assert done.returncode == 0, done.stderr
    assert await found_in(servers, KEY) == (5 << 20, 6)
    with pytest.raises(WrongStoreKey, match="the key is not the one"):
        await found_in(servers, OTHER)
    with pytest.raises(WrongStoreKey, match="there is no key for it"):
        await asyncio.to_thread(open_store, servers)
    done = copied(servers, back, "--key-file", str(key), "--new-key-file", str(new))
    assert done.returncode == 0, done.stderr
    assert await found_in(back, OTHER) == (5 << 20, 7)
    done = copied(servers, back + "2")
    assert (done.returncode, "it is encrypted, and there is no key for it" in done.stderr) == (2, True), done.stderr
    other = nats1.store(nats1.new_system())
    done = copied(back, other, "--key-file", str(new))
    assert done.returncode == 0, done.stderr
    assert await found_in(other) == (5 << 20, 8)
