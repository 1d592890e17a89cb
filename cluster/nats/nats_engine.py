"""A system's log, lease and blobs in NATS JetStream.

Each is a stream of its own. The log is one subject: `Nats-Expected-Last-Subject-Sequence` makes the server compare the
predecessor, at whoever leads the stream, on one server and on three alike. Streams answer reads through their leaders
only (`allow_direct=False`). The lease is one message with a time to live.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Sequence
from typing import Final

import nats.errors
from nats.js import JetStreamContext, api
from nats.js.errors import APIError, NotFoundError
from nats.js.errors import Error as JetStreamError

from ...checkpoint.journal import ForeignStore, StoreFailed
from ..leadership import LOOK_SECONDS, MOMENT_SECONDS
from ..log_records import PART
from ..ports import LogGone, LogReader, LogRecord, OutOfTurn, Unanswered
from .access import NatsAccess
from .connecting import ANSWER_SECONDS, SystemClient, answering, why_unanswered
from .server_check import NO_STREAM, lost_log, refuse_unsafe
from .system_streams import SubjectNames, stream_settings

CONNECT_SECONDS: Final = 5.0
"""How long it may take until the first server answers."""
LEASE_SECONDS: Final = 3
"""How long a lease lasts after each renewal, in whole seconds, as the server counts them."""
BATCH: Final = 256
"""Records that are asked for at once."""
AT_ONCE: Final = 8
"""Parts of a blob that are under way at one time."""
IDLE_SECONDS: Final = 60.0
"""After so long without a request the server forgets a reader."""
_WRONG_PREDECESSOR: Final = (10071, 10164)
"""What the server says if the last record is another one, or may be: a majority has not come so far."""


class NatsEngine:
    """One system's engine in NATS JetStream; see `cluster.ports.Engine`.

    Args:
        client: connected, and closed with the engine.
        name: what errors call it, without secrets.
        system: its name.
    """

    def __init__(self, client: SystemClient, name: str, system: str) -> None:
        self.name = name
        self._client = client
        stream = client.jetstream(timeout=ANSWER_SECONDS)
        self.names = names = SubjectNames(system)
        self.log = NatsLog(client, stream, names, name)
        self.lease = NatsLease(client, stream, names, name)
        self.blobs = NatsBlobs(client, stream, names, name)

    async def prepare(self, access: NatsAccess, *, is_new: bool) -> None:
        """Refuse servers that may lose something, and make the streams that are not there: that of the log first.

        Raises:
            ForeignStore: the log is gone, and something else of the system is there.
            StoreFailed, UnsafeServer, Unanswered: as `open_engine`.
        """
        await refuse_unsafe(self._client, access)
        with answering(self.name, self._client):
            lost = await lost_log(self._client, access)
        if lost is not None:
            raise ForeignStore(self.name, lost.where, lost.problem, lost.remedy)
        stream = self._client.jetstream(timeout=5 * ANSWER_SECONDS)
        with answering(self.name, self._client):
            for settings in stream_settings(self.names, access.replicas):
                try:
                    await stream.stream_info(settings.name or "")
                except NotFoundError as error:
                    if not is_new:
                        problem = f"there is no system {access.system} on these servers; is it written as it was made?"
                        raise StoreFailed(self.name, problem) from error
                    await stream.add_stream(settings)

    async def close(self) -> None:
        """Close the connection; see `Engine`."""
        with contextlib.suppress(nats.errors.Error, TimeoutError, OSError):
            await asyncio.wait_for(self._client.flush(timeout=1), 1.0)
        with contextlib.suppress(nats.errors.Error, TimeoutError, OSError):
            await self._client.close()


async def open_engine(access: NatsAccess, *, is_new: bool = True) -> NatsEngine:
    """Connect, refuse servers that may lose something, and make the streams of the system if they are not there.

    Args:
        access: where the servers are, and how they are reached.
        is_new: whether the streams are made; else it is an error that they are not there.

    Raises:
        StoreFailed: nothing is there of the system, and nothing is to be made.
        ForeignStore: the log of the system is gone, and something else of it is there.
        SpecError: a file of secrets or certificates must not be used.
        AccessRefused: the servers do not let this program in, or do not let it run the system.
        UnsafeServer: the servers or streams are not set as they have to be.
        Unanswered: no server can be reached, or they have no leader now.
    """
    client = SystemClient(access)
    try:
        await client.enter(CONNECT_SECONDS)
        engine = NatsEngine(client, access.name, access.system)
        await client.probe(is_node=True)
        await client.unless_denied(engine.prepare(access, is_new=is_new))
    except BaseException:
        await client.close()
        raise
    return engine


class NatsLog:
    """The log: one subject of one stream; see `cluster.ports.Log`."""

    def __init__(self, client: SystemClient, stream: JetStreamContext, names: SubjectNames, name: str) -> None:
        self._client, self._stream, self._names, self._name = client, stream, names, name

    async def append(self, data: bytes, after: int) -> int:
        """Append a record behind the one with the number `after`; see `Log`.

        Raises:
            AccessRefused: this program may not write there any more.
        """
        denials = self._client.denials
        try:
            return await _publish(self._client, self._stream, self._names.log, data, after, self._name)
        except Unanswered:
            self._client.refuse_denied(self._names.log, denials)
            raise

    async def last(self) -> LogRecord | None:
        """The last record, from whoever leads the stream; see `Log`."""
        loop, stream = asyncio.get_running_loop(), self._names.log_stream
        until = loop.time() + MOMENT_SECONDS
        while True:
            try:
                return await _last(self._client, self._stream, stream, self._names.log, self._name)
            except Unanswered as error:
                if not _is_no_stream(error):
                    raise
                if loop.time() >= until:
                    raise LogGone(f"the stream {stream}") from error
            await asyncio.sleep(LOOK_SECONDS)  # Servers that have just begun may not know of it yet.

    async def read(self, after: int) -> LogReader:
        """A reader of what stands behind the record with that number; see `Log`."""
        config = _reading(after + 1)
        with answering(self._name, self._client):
            return NatsReader(
                await self._stream.pull_subscribe(self._names.log, stream=self._names.log_stream, config=config),
                self._client,
                self._name,
            )

    async def forget(self, before: int) -> None:
        """Remove all records with smaller numbers; see `Log`."""
        with answering(self._name, self._client):
            await self._stream.purge_stream(self._names.log_stream, seq=before, subject=self._names.log)


def _reading(start: int) -> api.ConsumerConfig:
    """A reader that the server forgets by itself."""
    return api.ConsumerConfig(
        deliver_policy=api.DeliverPolicy.BY_START_SEQUENCE,
        opt_start_seq=start,
        ack_policy=api.AckPolicy.NONE,
        inactive_threshold=IDLE_SECONDS,
        mem_storage=True,
        num_replicas=1,
    )


class NatsReader:
    """Reads the log through a consumer of its own; see `cluster.ports.LogReader`."""

    def __init__(self, consumer: JetStreamContext.PullSubscription, client: SystemClient, name: str) -> None:
        self._consumer, self._client, self._name = consumer, client, name

    async def next(self, seconds: float) -> Sequence[LogRecord]:
        """The next records; see `LogReader`."""
        try:
            messages = await self._consumer.fetch(BATCH, timeout=seconds)
            return [LogRecord(message.metadata.sequence.stream, message.data) for message in messages]
        except TimeoutError:
            return []
        except (nats.errors.Error, JetStreamError, OSError) as error:
            raise Unanswered(self._name, why_unanswered(error, self._client)) from error

    async def close(self) -> None:
        """Have the server forget the consumer; see `LogReader`."""
        with contextlib.suppress(nats.errors.Error, JetStreamError, TimeoutError, OSError):
            await self._consumer.unsubscribe()


class NatsLease:
    """The lease: one message with a time to live; see `cluster.ports.Lease`."""

    def __init__(self, client: SystemClient, stream: JetStreamContext, names: SubjectNames, name: str) -> None:
        self._client, self._stream, self._names, self._name = client, stream, names, name
        self.seconds = float(LEASE_SECONDS)

    async def acquire(self, holder: str) -> int | None:
        """Take the lease if nobody has it; see `Lease`."""
        last = await self._last()
        if last is not None:
            return await self._publish(holder, last.sequence) if last.data.decode() == holder else None
        return await self._publish(holder, 0)

    async def renew(self, holder: str, token: int) -> int | None:
        """Renew what was acquired; see `Lease`."""
        renewed = await self._publish(holder, token)
        if renewed is None:
            last = await self._last()  # The answer to an earlier renewal may have been lost.
            if last is not None and last.data.decode() == holder:
                renewed = await self._publish(holder, last.sequence)
        return renewed

    async def release(self, token: int) -> None:
        """Give the lease up; see `Lease`."""
        with answering(self._name, self._client):
            await self._stream.purge_stream(self._names.lease_stream, seq=token + 1, subject=self._names.lease)

    async def holder(self) -> str:
        """Who has the lease; see `Lease`."""
        last = await self._last()
        return "" if last is None else last.data.decode()

    async def _last(self) -> LogRecord | None:
        return await _last(self._client, self._stream, self._names.lease_stream, self._names.lease, self._name)

    async def _publish(self, holder: str, after: int) -> int | None:
        try:
            return await _publish(
                self._client, self._stream, self._names.lease, holder.encode(), after, self._name, msg_ttl=self.seconds
            )
        except OutOfTurn:
            return None


class NatsBlobs:
    """Large values in parts, each a subject of its own; see `cluster.ports.Blobs`."""

    def __init__(self, client: SystemClient, stream: JetStreamContext, names: SubjectNames, name: str) -> None:
        self._client, self._stream, self._names, self._name = client, stream, names, name

    def _subject(self, name: str) -> str:
        return f"{self._names.blobs}.{name}"

    async def put(self, name: str, data: bytes) -> None:
        """Keep a value; see `Blobs`."""
        subject = self._subject(name)
        parts = [(f"{subject}.{at // PART}", data[at : at + PART]) for at in range(0, len(data), PART)]
        for at in range(0, len(parts), AT_ONCE):
            await asyncio.gather(*(self._put(*part) for part in parts[at : at + AT_ONCE]))
        await self._put(f"{subject}.size", str(len(data)).encode())  # The last one: now it is there.

    async def _put(self, subject: str, data: bytes) -> None:
        with answering(self._name, self._client):
            await self._stream.publish(subject, data)

    async def get(self, name: str) -> bytes | None:
        """A value, or `None`; see `Blobs`."""
        stream, subject = self._names.blob_stream, self._subject(name)
        size = await _last(self._client, self._stream, stream, f"{subject}.size", self._name)
        if size is None:
            return None
        wanted = -(-int(size.data) // PART)
        parts: dict[int, bytes] = {}
        with answering(self._name, self._client):
            consumer = await self._stream.pull_subscribe(f"{subject}.*", stream=stream, config=_reading(1))
        try:
            while len(parts) < wanted:
                try:
                    messages = await consumer.fetch(BATCH, timeout=ANSWER_SECONDS)
                except TimeoutError as error:
                    if await _last(self._client, self._stream, stream, f"{subject}.size", self._name) is None:
                        return None  # It was dropped meanwhile.
                    raise Unanswered(self._name, f"{wanted - len(parts)} parts of {name} do not come") from error
                for message in messages:
                    part = message.subject.rpartition(".")[2]
                    if part != "size":
                        parts[int(part)] = message.data
        except (nats.errors.Error, JetStreamError, OSError) as error:
            raise Unanswered(self._name, why_unanswered(error, self._client)) from error
        finally:
            with contextlib.suppress(nats.errors.Error, JetStreamError, TimeoutError, OSError):
                await consumer.unsubscribe()
        return b"".join(parts[number] for number in range(wanted))

    async def drop(self, name: str) -> None:
        """Remove a value; see `Blobs`."""
        with answering(self._name, self._client):
            await self._stream.purge_stream(self._names.blob_stream, subject=f"{self._subject(name)}.>")

    async def names(self) -> set[str]:
        """The names of all values; see `Blobs`."""
        with answering(self._name, self._client):
            info = await self._stream.stream_info(self._names.blob_stream, subjects_filter=f"{self._names.blobs}.>")
        at = len(self._names.blobs) + 1
        return {subject[at:].partition(".")[0] for subject in info.state.subjects or {}}


def _is_no_stream(error: Unanswered) -> bool:
    """Whether the servers have answered that there is no such stream."""
    return isinstance(error.__cause__, NotFoundError) and error.__cause__.err_code == NO_STREAM


async def _publish(
    client: SystemClient,
    stream: JetStreamContext,
    subject: str,
    data: bytes,
    after: int,
    name: str,
    *,
    msg_ttl: float | None = None,
) -> int:
    """Publish behind the last message of the subject, which has to have the number `after`; return the new number."""
    headers = {str(api.Header.EXPECTED_LAST_SUBJECT_SEQUENCE.value): str(after)}
    try:
        with answering(name, client):
            return (await stream.publish(subject, data, headers=headers, msg_ttl=msg_ttl)).seq
    except Unanswered as error:
        cause = error.__cause__
        if isinstance(cause, APIError) and cause.err_code in _WRONG_PREDECESSOR:
            raise OutOfTurn(after) from error
        raise


async def _last(
    client: SystemClient, stream: JetStreamContext, stream_name: str, subject: str, name: str
) -> LogRecord | None:
    """The last message of a subject, from whoever leads the stream."""
    try:
        with answering(name, client):
            found = await stream.get_last_msg(stream_name, subject)
    except Unanswered as error:
        if isinstance(error.__cause__, NotFoundError) and not _is_no_stream(error):
            return None
        raise
    return LogRecord(found.seq or 0, found.data or b"")
