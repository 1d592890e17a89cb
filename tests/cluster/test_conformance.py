"""A journal that is replicated keeps to the store protocol, on simulated servers and a real event loop."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from holdfast.checkpoint.journal import Journal
from holdfast.cluster.engine_thread import EngineThread
from holdfast.cluster.leadership import Leading, lead
from holdfast.cluster.replicated_journal import ReplicatedJournal
from holdfast.testing.fleet.broker import SimBroker
from holdfast.testing.fleet.sim_engine import SimEngine
from holdfast.testing.stores import conformance


class Servers:
    """The simulated servers of each folder, all on one thread.

    Attributes:
        brokers: by the name of the folder's place.
    """

    def __init__(self) -> None:
        self.thread = EngineThread("simulated servers")
        self.brokers: list[SimBroker] = []

    def placed(self, folder: Path, broker: SimBroker) -> None:
        """Have the folder stand for these servers."""
        (folder / "broker").write_text(str(len(self.brokers)), encoding="ascii")
        self.brokers.append(broker)

    def broker_in(self, folder: Path) -> SimBroker:
        """The servers that the folder stands for."""
        if not (folder / "broker").exists():
            self.placed(folder, SimBroker(latency=(0.0, 0.0)))
        return self.brokers[int((folder / "broker").read_text(encoding="ascii"))]


SERVERS: list[Servers] = []


@pytest.fixture(scope="module", autouse=True)
def servers() -> Iterator[None]:
    SERVERS.append(Servers())
    yield
    SERVERS.pop().thread.close()


class SharedThread(EngineThread):
    """The thread of all servers, which outlives each journal."""

    def __init__(self) -> None:
        self.loop = SERVERS[0].thread.loop

    def close(self) -> None:
        """Do nothing: others are on it."""


def opened(folder: Path) -> Journal:
    broker, thread = SERVERS[0].broker_in(folder), SharedThread()
    engine, me = SimEngine(broker), f"opening {broker.lease_token}"

    async def leading() -> Leading:
        broker.expire_lease()
        return await lead(engine, me, standby=None)

    return ReplicatedJournal(engine, thread, thread.wait(leading()))


def left(journal: Journal, folder: Path) -> Path:
    """The servers as they are now, without whoever led."""

    async def copied() -> SimBroker:
        return SERVERS[0].broker_in(folder).copy()

    folder_of_copy = folder.with_name(str(int(folder.name) + 1))
    folder_of_copy.mkdir()
    SERVERS[0].placed(folder_of_copy, SERVERS[0].thread.wait(copied()))
    return folder_of_copy


class TestReplicated(conformance(opened, crash=left)):  # type: ignore[misc]
    """The store of `store="nats://..."`, on simulated servers."""
