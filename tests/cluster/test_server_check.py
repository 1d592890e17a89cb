"""What is wrong with servers and streams: found by a real server, or judged from what one would say."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import msgspec
import nats
import pytest
from nats.aio.client import Client
from nats.js.api import StorageType, StreamConfig

from holdfast.cluster.nats import server_check
from holdfast.cluster.nats.access import NatsAccess
from holdfast.cluster.nats.server_check import (
    LOSES,
    JetStreamConfig,
    JetStreamSeen,
    MetaGroup,
    Seen,
    ServerSeen,
    StreamSetting,
    check_server,
    look_at,
    problems_of,
    refuse_unsafe,
    wanted_streams,
)
from holdfast.cluster.nats.server_file import MOST_BYTES, UserRole
from holdfast.cluster.nats.system_streams import SubjectNames, stream_settings
from holdfast.cluster.ports import Unanswered, UnsafeServer
from tests.cluster.servers import NatsServers

ACCESS = NatsAccess(servers=("nats://127.0.0.1:4222",), system="app")
THREE = msgspec.structs.replace(ACCESS, replicas=3)


def server(name: str = "n0", version: str = "2.15.1", size: int = 0, **more: Any) -> ServerSeen:
    meta = MetaGroup(size) if size else None
    return ServerSeen(name, version, MOST_BYTES, JetStreamSeen(JetStreamConfig(sync_always=True), meta), **more)


def seen(*servers: ServerSeen, **more: Any) -> Seen:
    told: dict[str, Any] = {"version": "2.15.1", "max_payload": MOST_BYTES, "has_jetstream": True, **more}
    return Seen(servers=servers or (server(),), **told)


def stream(replicas: int = 1, **more: Any) -> StreamSetting:
    access = msgspec.structs.replace(ACCESS, replicas=replicas)
    return msgspec.structs.replace(wanted_streams(access)["hf-app-log"], **more)


async def test_a_server_of_our_own_configuration_has_no_problem(nats1: NatsServers) -> None:
    system = nats1.new_system()
    client = await nats1.connect(system)
    for setting in stream_settings(SubjectNames(system), 1):
        await client.jetstream().add_stream(setting)
    assert await refuse_unsafe(client, nats1.access(system)) == []
    found = await look_at(client, nats1.access(system))
    assert [one.jetstream.config for one in found.servers] == [JetStreamConfig(sync_always=True)]
    assert {one.name: one for one in found.streams} == wanted_streams(nats1.access(system))
    await client.close()


async def test_all_servers_of_a_cluster_are_looked_at(nats3: NatsServers) -> None:
    system = nats3.new_system()
    client = await nats3.connect(system)
    assert await check_server(client, nats3.access(system)) == []
    one_named = msgspec.structs.replace(nats3.access(system), servers=nats3.access(system).servers[:1])
    assert [one.server_name for one in (await look_at(client, one_named)).servers] == ["n0", "n1", "n2"]
    url = client.connected_url
    assert url is not None
    nats3.kill(next(number for number in range(3) if nats3.plans[number].port != url.port))
    assert len((await look_at(client, one_named, seconds=60)).servers) == 2
    await client.close()


async def test_a_server_that_is_fast_and_loose_is_refused(own_nats1: NatsServers) -> None:
    file = own_nats1.folder / "n0.conf"
    file.write_text(
        file.read_text().replace("sync_interval: always", "sync_interval: 2m").replace(str(MOST_BYTES), "65536")
    )
    await own_nats1.restart(0)
    system = own_nats1.new_system()
    client = await own_nats1.connect(system)
    with pytest.raises(UnsafeServer) as refused:
        await refuse_unsafe(client, own_nats1.access(system))
    assert "set `jetstream { sync_interval: always }`" in str(refused.value)
    assert f"set `max_payload: {MOST_BYTES}`" in str(refused.value)
    await client.close()


async def test_where_nobody_says_how_servers_are_set_up_there_is_a_warning(own_nats1: NatsServers) -> None:
    file = own_nats1.folder / "n0.conf"
    kept = (one for one in file.read_text().splitlines() if "imports:" not in one)
    file.write_text("\n".join("SYS {}" if "exports:" in one else one for one in kept))
    await own_nats1.restart(0)
    system = own_nats1.new_system()
    client = await own_nats1.connect(system)
    (only,) = await refuse_unsafe(client, own_nats1.access(system))
    assert only.is_warning
    assert "sync_interval: always" in only.remedy
    await client.close()


async def test_a_server_without_jetstream_is_refused(own_nats1: NatsServers, tmp_path: Path) -> None:
    (own_nats1.folder / "n0.conf").write_text(f'listen: "127.0.0.1:{own_nats1.plans[0].port}"\n')
    own_nats1.kill(0)
    own_nats1._start(0)
    client = await nats.connect(
        f"nats://127.0.0.1:{own_nats1.plans[0].port}", max_reconnect_attempts=-1, reconnect_time_wait=0.01
    )
    with pytest.raises(UnsafeServer, match="JetStream is off"):
        await refuse_unsafe(client, ACCESS)
    await client.close()


async def test_a_server_that_takes_up_its_file_is_not_refused(
    own_nats1: NatsServers, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While it does so JetStream is off for all accounts for a moment."""
    system, whole, refused = own_nats1.new_system(), list[str](), asyncio.Event()
    client = await own_nats1.connect(system)
    has_jetstream = server_check._has_jetstream

    async def watched(client: Client, seconds: float) -> bool:
        found = await has_jetstream(client, seconds)
        if not found:
            refused.set()
        return found

    def without(text: str) -> str:
        whole.append(text)
        return text.replace("jetstream: enabled", "jetstream: disabled")

    own_nats1.reload(0, without)
    while await has_jetstream(client, 5.0):
        await asyncio.sleep(0.01)
    monkeypatch.setattr(server_check, "_has_jetstream", watched)
    monkeypatch.setattr(server_check, "MOMENT_SECONDS", 60.0)
    checked = asyncio.ensure_future(refuse_unsafe(client, own_nats1.access(system)))
    await asyncio.wait_for(refused.wait(), 30.0)
    own_nats1.reload(0, lambda text: whole[0])
    assert await asyncio.wait_for(checked, 30.0) == []
    await client.close()


async def test_who_may_not_ask_is_told(nats1: NatsServers) -> None:
    system = nats1.new_system()

    async def refused(error: Exception) -> None:
        assert "permissions violation" in str(error)

    client = await nats1.connect(system, UserRole.CLIENT, error_cb=refused)
    with pytest.raises(Unanswered, match="has not answered"):
        await check_server(client, nats1.access(system), seconds=0.1)
    await client.close()


async def test_the_streams_of_a_system_are_all_looked_at(nats1: NatsServers) -> None:
    system = nats1.new_system()
    client = await nats1.connect(system)
    for setting in stream_settings(SubjectNames(system), 1):
        setting.storage = StorageType.MEMORY
        await client.jetstream().add_stream(setting)
    await client.jetstream().add_stream(StreamConfig(name="other", subjects=["other"], storage=StorageType.MEMORY))
    found = await check_server(client, nats1.access(system))
    assert sorted((one.where, one.problem) for one in found) == [
        (f"the stream hf-{system}-{kind}", "storage is memory, and a restart loses all")
        for kind in ("blob", "lease", "log")
    ]
    await client.close()


@pytest.mark.parametrize(
    ("looked", "access", "problem", "remedy"),
    [
        (seen(server(version="2.11.9")), ACCESS, "its version is 2.11.9", "install 2.12 or later"),
        (seen(has_jetstream=False), ACCESS, "JetStream is off", "jetstream: enabled"),
        (seen(server(size=2), server("n1", size=2)), ACCESS, "two servers", "add a third"),
        (seen(), THREE, "3 replicas are wanted", "?replicas=1"),
        (seen(streams=(stream(num_replicas=2),)), ACCESS, "num_replicas is 2", "set it to 1"),
        (seen(server(size=3), streams=(stream(),)), THREE, "num_replicas is 1", "set it to 3"),
        (seen(streams=(stream(subjects=("other",)),)), ACCESS, "subjects is other", "hf.app.root.log"),
        (seen(streams=(stream(storage="memory"),)), ACCESS, "storage is memory", "file"),
        (seen(streams=(stream(retention="interest"),)), ACCESS, "retention is interest", "limits"),
        (seen(streams=(stream(discard="old"),)), ACCESS, "discard is old", "new"),
        (seen(streams=(stream(max_age=5 * 10**9),)), ACCESS, "max_age is 5", "set it to 0"),
        (seen(streams=(stream(max_msgs=1),)), ACCESS, "max_msgs is 1", "-1"),
        (seen(streams=(stream(max_msgs_per_subject=1),)), ACCESS, "max_msgs_per_subject is 1", "-1"),
        (seen(streams=(stream(max_bytes=9),)), ACCESS, "max_bytes is 9", "-1"),
        (seen(streams=(stream(max_msg_size=1000),)), ACCESS, "max_msg_size is 1000", "-1"),
        (seen(streams=(stream(allow_direct=True),)), ACCESS, "reads may miss", "false"),
        (seen(streams=(stream(mirror_direct=True),)), ACCESS, "reads may miss", "false"),
        (seen(streams=(stream(no_ack=True),)), ACCESS, "no_ack is true", "false"),
        (seen(streams=(stream(sealed=True),)), ACCESS, "sealed is true", "false"),
        (seen(streams=(stream(persist_mode="async"),)), ACCESS, "may not be on the disk", "default"),
    ],
)
def test_each_wrong_setting_is_one_problem_that_says_what_to_change(
    looked: Seen, access: NatsAccess, problem: str, remedy: str
) -> None:
    (only,) = problems_of(looked, access)
    assert problem in only.problem
    assert remedy in only.remedy
    assert not only.is_warning


def test_what_is_as_it_should_be_is_no_problem() -> None:
    assert problems_of(seen(streams=(*wanted_streams(ACCESS).values(),)), ACCESS) == []
    assert problems_of(seen(streams=(stream(num_replicas=3),)), ACCESS) == []
    three = tuple(server(f"n{number}", size=3) for number in range(3))
    assert problems_of(seen(*three, streams=(stream(3),)), THREE) == []
    assert problems_of(seen(streams=(StreamSetting("other", ("other",), storage="memory"),)), ACCESS) == []


def test_each_setting_that_is_looked_at_says_what_it_leads_to() -> None:
    assert {*LOSES} == {*StreamSetting.__struct_fields__} - {"name"}


def test_a_server_that_takes_small_messages_only_is_a_warning() -> None:
    small = msgspec.structs.replace(server(), max_payload=server_check.LEAST_BYTES)
    assert [one.is_warning for one in problems_of(seen(small), ACCESS)] == [True]
