"""Are the servers, and the streams of a system on them, such that nothing is lost that was acknowledged?

`look_at` asks the servers, `problems_of` judges what they say. A start refuses servers with a problem that is more than
a warning; `holdfast nats check` prints them all.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Sequence
from time import monotonic
from typing import TYPE_CHECKING, Final, TypeVar

import msgspec

from ...actors.errors import SpecError
from ..leadership import MOMENT_SECONDS
from ..ports import Unanswered, UnsafeServer
from .access import NatsAccess, access_of
from .server_file import MOST_BYTES, NEEDS, VARZ

if TYPE_CHECKING:
    from nats.aio.client import Client

T = TypeVar("T")

OLDEST: Final = (2, 12)
"""The first version that loses no acknowledged write when a server is killed."""
LEAST_BYTES: Final = 1024 * 1024
"""Messages of this size must be taken: parts of records are smaller, with some room."""
_PAUSE: Final = 0.1
_ENGINE: Final = "NATS"
NO_STREAM: Final = 10059
"""What the API says of a stream that is not there."""
_NOT_ENABLED: Final = (10039, 10076)
"""Answers of the API where JetStream is off, for the account or for the server."""


LOSES: Final = {
    "subjects": "records go to none",
    "retention": "records go although nobody has dropped them",
    "storage": "a restart loses all",
    "discard": "a full stream does what it should not",
    "num_replicas": "the loss of a server loses records, or stops all",
    "max_age": "records go with time",
    "max_msgs": "there is room for so many records only",
    "max_msgs_per_subject": "another number of records stays",
    "max_bytes": "there is room for so many bytes only",
    "max_msg_size": "larger records are refused",
    "no_ack": "nobody knows what is kept",
    "sealed": "nothing can be appended",
    "allow_direct": "reads may miss the last records",
    "mirror_direct": "reads may miss the last records",
    "persist_mode": "what was acknowledged may not be on the disk",
}
"""Settings of a stream on which it depends whether something is lost, and what another one leads to."""


class ServerProblem(msgspec.Struct, frozen=True):
    """Something about a server or a stream that is not as it should be.

    Attributes:
        where: the server, or the stream.
        problem: what is wrong, and what it may lead to.
        remedy: what to change.
        is_warning: a system can be started all the same.
    """

    where: str
    problem: str
    remedy: str
    is_warning: bool = False

    def __str__(self) -> str:
        return f"{self.where}: {self.problem}; {self.remedy}"


class MetaGroup(msgspec.Struct, frozen=True):
    """The servers of a cluster that vote about streams."""

    cluster_size: int = 0


class JetStreamConfig(msgspec.Struct, frozen=True):
    """How JetStream of a server is set up; `sync_always` is left out by the server where it is false."""

    sync_always: bool = False


class JetStreamSeen(msgspec.Struct, frozen=True):
    """What a server says of its JetStream; no configuration where it is off."""

    config: JetStreamConfig | None = None
    meta: MetaGroup | None = None


class ServerSeen(msgspec.Struct, frozen=True):
    """What a server says of itself."""

    server_name: str
    version: str
    max_payload: int = LEAST_BYTES
    jetstream: JetStreamSeen = JetStreamSeen()


class StreamSetting(msgspec.Struct, frozen=True):
    """The configuration of a stream, as far as what was acknowledged depends on it; times in nanoseconds."""

    name: str
    subjects: tuple[str, ...] = ()
    retention: str = "limits"
    storage: str = "file"
    discard: str = "old"
    num_replicas: int = 1
    max_age: int = 0
    max_msgs: int = -1
    max_msgs_per_subject: int = -1
    max_bytes: int = -1
    max_msg_size: int = -1
    no_ack: bool = False
    sealed: bool = False
    allow_direct: bool = False
    mirror_direct: bool = False
    persist_mode: str = "default"


class Seen(msgspec.Struct, frozen=True):
    """What can be seen of the servers from the account of a system.

    Attributes:
        version: of the server that the client is connected to.
        max_payload: of that server, in bytes.
        has_jetstream: whether the account has JetStream.
        servers: those that have said how they are set up; none where the account does not import that.
        streams: all in the account.
    """

    version: str
    max_payload: int
    has_jetstream: bool
    servers: tuple[ServerSeen, ...] = ()
    streams: tuple[StreamSetting, ...] = ()


class _Varz(msgspec.Struct):
    data: ServerSeen


class _ApiError(msgspec.Struct):
    code: int = 0
    err_code: int = 0
    description: str = ""


class _Info(msgspec.Struct):
    error: _ApiError | None = None


class _StreamState(msgspec.Struct):
    messages: int = 0
    last_seq: int = 0


class _StreamInfo(_Info):
    state: _StreamState | None = None


class _ListedStream(msgspec.Struct):
    config: StreamSetting


class _Streams(_Info):
    total: int = 0
    streams: list[_ListedStream] | None = None


async def check_server(client: Client, access: NatsAccess, *, seconds: float = 5.0) -> list[ServerProblem]:
    """What is wrong with the servers that a client is connected to, and with the streams of its system.

    Args:
        seconds: how long each answer may take.

    Raises:
        Unanswered: a server has not answered in time, or has no leader now.
    """
    from .connecting import answering  # which imports the library

    with answering(access.name, client):
        return problems_of(await look_at(client, access, seconds=seconds), access)


async def lost_log(client: Client, access: NatsAccess, *, seconds: float = 5.0) -> ServerProblem | None:
    """What is wrong if the log of a system is gone and something else of it is there: that is no new system.

    The streams of a new one are made with that of the log first, so they are asked for in the other order. A lease
    alone may come before the first record of a log.

    Raises:
        Unanswered: a server has not answered in time, or has no leader now.
    """
    from .system_streams import SubjectNames

    names = SubjectNames(access.system)
    until = monotonic() + MOMENT_SECONDS
    while True:
        others = {name: await _state(client, name, seconds) for name in (names.lease_stream, names.blob_stream)}
        there = [name for name, state in others.items() if state is not None]
        log, blobs = await _state(client, names.log_stream, seconds), others[names.blob_stream]
        if log is not None and (log.messages or not (log.last_seq or (blobs is not None and blobs.last_seq))):
            return None
        if log is None and not there:
            return None
        if monotonic() >= until:
            break
        await asyncio.sleep(_PAUSE)  # Servers that have just begun may not know of it yet.
    gone = "is gone" if log is None else "is empty"
    problem = f"it {gone}, and {' and '.join(there)} of the same system is there: somebody has removed what it recorded"
    at = f"{access.name}?..."
    remedy = (
        f"bring it back with a copy of the servers' disks; or remove the rest with `holdfast nats remove '{at}'`, and "
        "copy a backup there (`holdfast store copy`), or begin with nothing"
    )
    return ServerProblem(f"the stream {names.log_stream}", problem, remedy)


async def _state(client: Client, stream: str, seconds: float) -> _StreamState | None:
    """What a stream has; None if there is no such stream."""
    found = await _asked(client, f"STREAM.INFO.{stream}", _StreamInfo, {}, seconds)
    if found.error is not None and found.error.err_code == NO_STREAM:
        return None
    if refused := _refusal(found):
        raise Unanswered(_ENGINE, refused)
    return found.state or _StreamState()


async def refuse_unsafe(client: Client, access: NatsAccess, *, seconds: float = 5.0) -> list[ServerProblem]:
    """Check the servers, and return what is only a warning.

    Raises:
        UnsafeServer: something that was acknowledged may be lost there; the text has each problem and its remedy.
        Unanswered: a server has not answered in time, or has no leader now.
    """
    found = await check_server(client, access, seconds=seconds)
    fatal = tuple(str(one) for one in found if not one.is_warning)
    if fatal:
        raise UnsafeServer(", ".join(access.servers), fatal)
    return found


async def check_store(store: str, *, seconds: float = 5.0) -> list[ServerProblem]:
    """What is wrong with the servers and streams that a store names: connect, look, and go.

    Args:
        store: `nats://host,host/system?...`, see `access_of`.
        seconds: how long it may take to connect, and each answer.

    Raises:
        SpecError: the store cannot be read, or the library for it is missing.
        AccessRefused: the servers do not let this program in, or its key is not for this system.
        Unanswered: no server answers, or one has not done so in time.
    """
    try:
        from .connecting import SystemClient
    except ImportError as error:
        raise SpecError("store", NEEDS) from error
    client = SystemClient(access_of(store))
    try:
        await client.enter(seconds)
        await client.probe(is_node=False)
        return await client.unless_denied(_check_all(client, client.access, seconds))
    finally:
        await client.close()


async def _check_all(client: Client, access: NatsAccess, seconds: float) -> list[ServerProblem]:
    """What is wrong with servers and streams, and with what stands there."""
    from .connecting import answering

    with answering(access.name, client):
        seen = await look_at(client, access, seconds=seconds)
        lost = await lost_log(client, access, seconds=seconds) if seen.has_jetstream else None
    return problems_of(seen, access) + ([lost] if lost is not None else [])


async def look_at(client: Client, access: NatsAccess, *, seconds: float = 5.0) -> Seen:
    """Ask the servers how they are set up. Nothing is changed there.

    Raises:
        Unanswered: a server has not answered in time, or has no leader now.
    """
    has_jetstream = await _has_jetstream(client, seconds)
    until = monotonic() + MOMENT_SECONDS  # While a server takes up its file, all of its accounts are without.
    while not has_jetstream and monotonic() < until:
        await asyncio.sleep(_PAUSE)
        has_jetstream = await _has_jetstream(client, seconds)
    return Seen(
        version=str(client.connected_server_version),
        max_payload=client.max_payload,
        has_jetstream=has_jetstream,
        servers=await _servers(client, access),
        streams=await _streams(client, seconds) if has_jetstream else (),
    )


async def _has_jetstream(client: Client, seconds: float) -> bool:
    from nats.errors import NoRespondersError

    try:
        return _refusal(await _asked(client, "INFO", _Info, {}, seconds)) is None
    except NoRespondersError:
        return False


def problems_of(seen: Seen, access: NatsAccess) -> list[ServerProblem]:
    """Judge what was seen of the servers; each problem says what to change."""
    told = seen.servers or (ServerSeen("the server", seen.version, seen.max_payload),)
    found = [problem for server in told for problem in _of_version(server)]
    if not seen.has_jetstream:
        remedy = "give the account `jetstream: enabled` and the server a block `jetstream { ... }`"
        return [
            *found,
            ServerProblem(f"the account of {access.system}", "JetStream is off, so nothing can be kept", remedy),
        ]
    if not seen.servers:
        problem = "nobody can see from here whether each record is on the disk before it is acknowledged"
        remedy = (
            "look for `sync_interval: always` in the file of each server, or use what `holdfast nats config` writes, "
            f"which lets the account import {VARZ}"
        )
        found.append(ServerProblem("the servers", problem, remedy, is_warning=True))
    for server in seen.servers:
        found += _of_jetstream(server)
    found += _of_cluster(seen.servers, access)
    wanted = wanted_streams(access)
    for stream in seen.streams:
        if stream.name in wanted:
            found += _of_stream(stream, wanted[stream.name])
    return found


def _of_version(server: ServerSeen) -> list[ServerProblem]:
    where, found = server.server_name, list[ServerProblem]()
    if _version(server.version) < OLDEST:
        problem = f"its version is {server.version}, which may lose acknowledged records when it is killed"
        found.append(ServerProblem(where, problem, f"install {'.'.join(map(str, OLDEST))} or later"))
    if server.max_payload < MOST_BYTES:
        problem = f"it takes messages of at most {server.max_payload} bytes, and a message may have {MOST_BYTES}"
        is_warning = server.max_payload >= LEAST_BYTES
        found.append(ServerProblem(where, problem, f"set `max_payload: {MOST_BYTES}`", is_warning=is_warning))
    return found


def _of_jetstream(server: ServerSeen) -> list[ServerProblem]:
    if server.jetstream.config is None:
        problem = "JetStream is off there, so it keeps no copies of what the others have"
        return [ServerProblem(server.server_name, problem, "add a block `jetstream { ... }`", is_warning=True)]
    if not server.jetstream.config.sync_always:
        problem = "it acknowledges records before they are on the disk, and a power cut loses them"
        return [ServerProblem(server.server_name, problem, "set `jetstream { sync_interval: always }`")]
    return []


def _of_cluster(servers: Sequence[ServerSeen], access: NatsAccess) -> list[ServerProblem]:
    size = _cluster_size(servers)
    if size == 2:
        problem = "the cluster has two servers, and the loss of either stops both"
        return [ServerProblem("the cluster", problem, "add a third server, or use one alone")]
    if servers and access.replicas > max(size, 1):
        problem = f"{access.replicas} replicas are wanted, and there is one server"
        return [
            ServerProblem(
                "the cluster", problem, f"add servers until there are {access.replicas}, or write ?replicas=1"
            )
        ]
    return []


def _cluster_size(servers: Sequence[ServerSeen]) -> int:
    """How many servers vote about streams; 0 for one that is alone."""
    return max((one.jetstream.meta.cluster_size for one in servers if one.jetstream.meta is not None), default=0)


def _of_stream(stream: StreamSetting, wanted: StreamSetting) -> list[ServerProblem]:
    """One problem for each setting of a stream that is not as the system makes it."""
    where, found = f"the stream {stream.name}", list[ServerProblem]()
    for setting in LOSES:
        now, right = getattr(stream, setting), getattr(wanted, setting)
        if now != right and not (setting == "num_replicas" and now % 2 and now > right):
            problem = f"{setting} is {_shown(now)}, and {LOSES[setting]}"
            found.append(ServerProblem(where, problem, f"set it to {_shown(right)} (`nats stream edit {stream.name}`)"))
    return found


def _shown(value: object) -> str:
    """A value as the server's own tools write it.

    >>> _shown(("a", "b")), _shown(False), _shown("file"), _shown(-1)
    ('a b', 'false', 'file', '-1')
    """
    match value:
        case bool():
            return str(value).lower()
        case tuple():
            return " ".join(map(str, value))
        case _:
            return str(value)


def wanted_streams(access: NatsAccess) -> dict[str, StreamSetting]:
    """How the streams of a system have to be set, by name."""
    from .system_streams import SubjectNames, stream_settings

    settings = [one.as_dict() for one in stream_settings(SubjectNames(access.system), access.replicas)]
    as_listed = msgspec.json.decode(msgspec.json.encode(settings), type=list[StreamSetting])
    return {one.name: one for one in as_listed}


def _version(text: str) -> tuple[int, ...]:
    """The numbers of a version.

    >>> _version("2.12.0-RC.1"), _version("<nats server v2.15.1>")
    ((2, 12, 0), (2, 15, 1))
    """
    plain = text.strip("<>").rpartition(" ")[2].lstrip("v").partition("-")[0]
    return tuple(int(part) for part in plain.split(".") if part.isdigit())


async def _servers(client: Client, access: NatsAccess) -> tuple[ServerSeen, ...]:
    """What each server says of itself, as far as the account may ask; those that are down say nothing."""
    inbox = client.new_inbox()
    asked = await client.subscribe(inbox)
    found: dict[str, ServerSeen] = {}
    try:
        await client.publish(VARZ, b"", reply=inbox)
        until, expected = monotonic() + 1.0, len(access.servers)
        while len(found) < expected:
            try:
                answer = await asked.next_msg(max(0.001, until - monotonic()))
            except TimeoutError:  # of nats-py, too
                break
            if not answer.data:  # Nobody listens: the account does not import it.
                break
            seen = _read(answer.data, _Varz).data
            found[seen.server_name] = seen
            expected = max(expected, _cluster_size([seen]))
    finally:
        await asked.unsubscribe()
    return tuple(found[name] for name in sorted(found))


async def _streams(client: Client, seconds: float) -> tuple[StreamSetting, ...]:
    found: list[StreamSetting] = []
    while True:
        page = await _asked(client, "STREAM.LIST", _Streams, {"offset": len(found)}, seconds)
        if refused := _refusal(page):
            raise Unanswered(_ENGINE, refused)
        found += (one.config for one in page.streams or ())
        if not page.streams or len(found) >= page.total:
            return tuple(found)


def _refusal(info: _Info) -> str | None:
    """Why the API refuses to answer since JetStream is off; None if it answers.

    Raises:
        Unanswered: it cannot answer now.
    """
    if info.error is None:
        return None
    if info.error.err_code in _NOT_ENABLED:
        return info.error.description
    raise Unanswered(_ENGINE, f"{info.error.description} ({info.error.err_code})")


async def _asked(client: Client, what: str, kind: type[T], wanted: dict[str, int], seconds: float) -> T:
    """The answer of the JetStream API, asked for again each second: a request to a server that dies is lost.

    Raises:
        Unanswered: it does not come in time.
        NoRespondersError: nobody answers there.
    """
    from nats.errors import Error, NoRespondersError

    until = monotonic() + seconds
    while True:
        left = until - monotonic()
        try:
            answer = await client.request(f"$JS.API.{what}", json.dumps(wanted).encode(), timeout=min(left, 1.0))
            return _read(answer.data, kind)
        except NoRespondersError:
            raise
        except TimeoutError as error:
            if left <= 1.0:
                raise Unanswered(_ENGINE, f"{_server(client)} has not answered {what} for {seconds:g} s") from error
        except Error as error:
            raise Unanswered(_ENGINE, f"{_server(client)}: {what}: {error}") from error


def _server(client: Client) -> str:
    """The server that a client is connected to, or was."""
    url = client.connected_url
    return "the server" if url is None else f"the server {url.hostname}:{url.port}"


def _read(data: bytes, kind: type[T]) -> T:
    try:
        return msgspec.json.decode(data, type=kind)
    except msgspec.MsgspecError as error:
        raise SpecError("nats check", f"the server answers in a way that is not known: {error}") from error
