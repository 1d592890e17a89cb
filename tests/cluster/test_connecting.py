"""Who is let in by servers, and who is not: in words, and nothing that is to be encrypted goes in plain text."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import sys
import threading
from collections.abc import AsyncGenerator, Callable
from pathlib import Path
from time import monotonic

import msgspec
import pytest

import holdfast as hf
from holdfast.cluster.leadership import Standby, lead
from holdfast.cluster.nats.access import NatsAccess, access_of
from holdfast.cluster.nats.connecting import SystemClient
from holdfast.cluster.nats.nats_engine import open_engine
from holdfast.cluster.nats.server_check import check_store
from holdfast.cluster.nats.server_file import TlsFiles, UserRole, new_seed, public_key, seed_file
from holdfast.cluster.ports import AccessRefused, Unanswered
from tests.cluster.certificates import certificates
from tests.cluster.servers import PATIENCE, NatsServers, free_ports


class Put(hf.Message[int]): ...


class Shelf(hf.Actor):
    def __init__(self) -> None:
        self.count = 0

    @hf.on(Put)
    def put(self, message: Put) -> int:
        self.count += 1
        return self.count


@contextlib.asynccontextmanager
async def overheard(port: int) -> AsyncGenerator[tuple[int, bytearray]]:
    """A port that leads to another one, and what is sent there."""
    heard = bytearray()

    async def pass_on(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, into: bytearray | None) -> None:
        with contextlib.suppress(OSError):
            while data := await reader.read(65536):
                if into is not None:
                    into.extend(data)
                writer.write(data)
                await writer.drain()
        writer.close()

    async def connected(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        far_reader, far_writer = await asyncio.open_connection("127.0.0.1", port)
        await asyncio.gather(pass_on(reader, far_writer, heard), pass_on(far_reader, writer, None))

    async with await asyncio.start_server(connected, "127.0.0.1", 0) as server:
        yield server.sockets[0].getsockname()[1], heard


async def until(is_so: Callable[[], bool]) -> None:
    """Wait for something of which nobody tells."""
    async with asyncio.timeout(PATIENCE):
        while not is_so():
            await asyncio.sleep(0.02)


async def refusal(access: NatsAccess) -> str:
    """Why the servers do not let a program in that is to run the system."""
    with pytest.raises(AccessRefused) as refused:
        await let_in(access)
    return str(refused.value)


async def let_in(access: NatsAccess) -> None:
    """Begin to run the system, and end."""
    await (await open_engine(access)).close()


@pytest.mark.parametrize("setting", ["tls", "ca"])
async def test_nothing_is_sent_to_a_server_without_encryption(nats1: NatsServers, tmp_path: Path, setting: str) -> None:
    """Neither by a program that starts, nor by the check: who stands before a server may say that it has none."""
    system, files = nats1.new_system(), certificates(tmp_path)
    nkey = nats1.store(system).partition("?")[2]
    async with overheard(nats1.plans[0].port) as (port, heard):
        store = f"{'tls' if setting == 'tls' else 'nats'}://127.0.0.1:{port}/{system}?{nkey}"
        if setting == "ca":
            store += f"&ca={files.ca}&certificate={files.certificate}&key={files.key}"
        assert "offers no TLS" in await refusal(access_of(store))
        with pytest.raises(AccessRefused, match="offers no TLS"):
            await check_store(store)
        assert bytes(heard) == b""


@pytest.mark.asyncio(loop_factories=["asyncio"])  # which is the one that warns
async def test_the_end_of_an_encrypted_connection_is_no_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    servers = NatsServers(tmp_path / "servers", tls=certificates(tmp_path))
    (tmp_path / "servers").mkdir()
    await servers.start()
    client = SystemClient(servers.access(servers.new_system()))
    try:
        await client.enter(PATIENCE)
        servers.kill(0)
        await until(lambda: not client.is_connected)
        await servers.restart(0)
        await until(lambda: client.is_connected)
        assert "eof_received" not in caplog.text
    finally:
        await client.close()
        servers.close()


async def test_a_server_that_comes_back_without_encryption_is_told_nothing(tmp_path: Path) -> None:
    servers = NatsServers(tmp_path / "servers", tls=certificates(tmp_path))
    (tmp_path / "servers").mkdir()
    await servers.start()
    client = SystemClient(servers.access(servers.new_system()))
    try:
        await client.enter(PATIENCE)
        servers.kill(0)
        servers.rewrite(0, lambda text: text[: text.index("tls {")] + text[text.index("accounts {") :])
        await servers.restart(0)
        await until(lambda: any("offers no TLS" in one.problem for one in client.refusals.values()))
        assert not client.is_connected
        await client.publish("told", b"secret")  # It waits for a connection.
    finally:
        await client.close()
        servers.close()


async def test_a_certificate_that_is_not_good_is_told_in_words(tmp_path: Path) -> None:
    files, others = certificates(tmp_path / "own"), certificates(tmp_path / "other")
    servers = NatsServers(tmp_path / "servers", tls=files)
    (tmp_path / "servers").mkdir()
    await servers.start()
    try:
        system = servers.new_system()
        nkey = servers.store(system).partition("?")[2].partition("&")[0]
        where = f"tls://127.0.0.1:{servers.plans[0].port}/{system}?{nkey}"

        async def said(ca: TlsFiles, own: TlsFiles | None) -> str:
            mine = "" if own is None else f"&certificate={own.certificate}&key={own.key}"
            return await refusal(access_of(f"{where}&ca={ca.ca}{mine}"))

        assert "the certificate of the server" in await said(others, files)
        assert "asks for a certificate" in await said(files, None)
        assert f"does not take the certificate {others.certificate}" in await said(files, others)
        elsewhere = certificates(tmp_path / "elsewhere", "127.0.0.2")
        servers.kill(0)
        servers.rewrite(0, lambda text: text.replace(str(tmp_path / "own"), str(tmp_path / "elsewhere")))
        await servers.restart(0)
        assert "not valid for '127.0.0.1'" in await said(elsewhere, elsewhere)
    finally:
        servers.close()


async def test_each_refusal_has_its_own_words(nats1: NatsServers, tmp_path: Path) -> None:
    system, other = nats1.new_system(), nats1.new_system()
    stranger = tmp_path / "stranger.nk"
    stranger.touch(0o600)
    stranger.write_text(new_seed())
    bare = nats1.store(system).partition("?")[0]
    said = [
        await refusal(access_of(bare)),
        await refusal(access_of(f"{bare}?nkey={stranger}")),
        await refusal(nats1.access(system, UserRole.CLIENT)),
        await refusal(nats1.access(system, UserRole.OBSERVER)),
        await refusal(access_of(nats1.store(other).replace(f"/{other}?", f"/{system}?"))),
    ]
    for text, words in zip(
        said,
        (
            "lets nobody in without a key",
            f"does not know the key {stranger}",
            "the key of a client, or of another system",
            "the key of an observer",
            "the key of a client, or of another system",
        ),
        strict=True,
    ):
        assert words in text
        assert f"{system}-node.nk" in text or "reload" in text, "it does not say what to do"
    client = await nats1.connect(other)
    assert await client.jetstream().streams_info() == [], "something was made in the account of another system"
    await client.close()


async def test_servers_that_are_not_there_are_another_error() -> None:
    with pytest.raises(Unanswered, match="nobody listens there"):
        await open_engine(access_of(f"nats://127.0.0.1:{free_ports(1)[0]}/app"))


@pytest.mark.parametrize("standby", ["warm", None])
async def test_who_is_refused_does_not_stand_by(nats1: NatsServers, standby: Standby | None) -> None:
    store = nats1.store(nats1.new_system()).partition("?")[0]
    with pytest.raises(hf.errors.AccessRefused, match="lets nobody in without a key"):
        async with asyncio.timeout(PATIENCE), hf.ActorSystem("app", store=store, standby=standby, log=False):
            raise AssertionError("it leads")


async def test_a_client_without_a_key_is_told_of_the_key_of_a_client(nats1: NatsServers) -> None:
    name = nats1.new_system()
    store = nats1.store(name).partition("?")[0]
    with pytest.raises(hf.errors.AccessRefused, match=f"such as {name}-client.nk"):
        async with asyncio.timeout(PATIENCE), hf.connect(store, system="app"):
            raise AssertionError("it is connected")


async def test_a_client_with_the_key_of_an_observer_is_refused_and_does_not_wait(nats1: NatsServers) -> None:
    name = nats1.new_system()
    access = nats1.access(name, UserRole.OBSERVER)
    at = f"{nats1.store(name).partition('?')[0]}?nkey={access.nkey}"
    with pytest.raises(hf.errors.AccessRefused, match=f"it is the key of an observer.*nkey={name}-client.nk"):
        async with asyncio.timeout(PATIENCE), hf.connect(at, timeout=10 * PATIENCE):
            raise AssertionError("it is connected")


async def test_who_waits_for_servers_says_so(tmp_path: Path) -> None:
    servers = NatsServers(tmp_path)
    await servers.start()
    servers.kill(0)
    system = hf.ActorSystem("app", store=servers.store(servers.new_system()), standby="warm", log=False)

    async def led() -> None:
        async with system:
            pass

    leading = asyncio.create_task(led())
    try:
        await asyncio.sleep(0)  # It begins to wait, and tells events from then on.
        async with asyncio.timeout(PATIENCE):
            silent = await system.events().until(hf.events.ServersSilent)
        assert "nobody listens there" in silent.reason
        await servers.restart(0)
        async with asyncio.timeout(PATIENCE):
            await leading
    finally:
        leading.cancel()
        servers.close()


async def test_a_server_that_has_refused_is_asked_again(own_nats1: NatsServers) -> None:
    """The key of a program that is connected is taken out of the file of its server, and put back."""
    system = own_nats1.new_system()
    client = SystemClient(own_nats1.access(system))
    try:
        await client.enter(PATIENCE)
        whole = (own_nats1.folder / "n0.conf").read_text()
        own = public_key(seed_file(own_nats1.folder, system, UserRole.NODE).read_text())
        own_nats1.reload(0, lambda text: text.replace(own, public_key(new_seed())))
        await until(lambda: bool(client.refusals))
        own_nats1.reload(0, lambda text: whole)
        await until(lambda: client.is_connected)
        await client.probe(is_node=True)
    finally:
        await client.close()


async def test_a_role_may_have_two_keys_for_a_while(own_nats1: NatsServers, tmp_path: Path) -> None:
    """The entry of the new one is written below the old one, and the server takes up its file."""
    system, seed = own_nats1.new_system(), new_seed()
    old, new = public_key(seed_file(own_nats1.folder, system, UserRole.NODE).read_text()), public_key(seed)
    file = tmp_path / "new.nk"
    file.touch(0o600)
    file.write_text(seed)
    client = SystemClient(own_nats1.access(system))
    access = msgspec.structs.replace(own_nats1.access(system), nkey=str(file))

    def with_both(text: str) -> str:
        begin = text.index(f"{{ nkey: {old}")
        entry = text[begin : text.index("{ nkey: ", begin + 1)]
        return text[:begin] + entry + entry.replace(old, new) + text[begin + len(entry) :]

    try:
        await client.enter(PATIENCE)
        own_nats1.reload(0, with_both)
        async with asyncio.timeout(PATIENCE):
            while True:
                other = SystemClient(access)
                try:
                    await other.enter(PATIENCE)
                    break
                except AccessRefused:  # The server has not taken up its file yet.
                    await asyncio.sleep(0.05)
        await other.probe(is_node=True)
        await other.close()
        await client.probe(is_node=True)
        assert client.stats["reconnects"] == 0
    finally:
        await client.close()


async def test_a_connection_that_a_server_has_ended_is_made_anew(nats1: NatsServers) -> None:
    """A subject that is too long for a server has it say so and hang up."""
    client = SystemClient(nats1.access(nats1.new_system()))
    try:
        await client.enter(PATIENCE)
        await client.publish("x" * 5000, b"")
        await until(lambda: client.stats["reconnects"] == 1 or client.is_closed)
        await client.probe(is_node=True)
    finally:
        await client.close()


async def test_who_asks_a_deposed_leader_is_told_that_the_store_failed(nats1: NatsServers) -> None:
    """It is one of the outcomes that an ask is promised to have; and the message may have been handled."""
    system = nats1.new_system()
    engine = await open_engine(nats1.access(system))
    asking: asyncio.Task[None] | None = None

    async def ask_on(shelf: hf.ActorRef[Shelf]) -> None:
        while True:
            await shelf.ask(Put(), timeout=PATIENCE)

    try:
        async with asyncio.timeout(PATIENCE), hf.ActorSystem("app", store=nats1.store(system), log=False) as old:
            shelf = await old.start(hf.child("shelf", hf.start(Shelf), recovery=hf.hybrid()))
            await shelf.ask(Put())
            asking = asyncio.create_task(ask_on(shelf))
            await engine.lease.release(1 << 53)  # Whoever has it is not asked.
            leading = await lead(engine, "another program", standby="cold")
            await leading.keeper.release()
            await asyncio.Event().wait()
    except hf.errors.LeadershipLost:
        assert asking is not None
        with pytest.raises(hf.errors.StoreFailed, match="may be handled by the new owner"):
            await asking
    else:
        raise AssertionError("it leads for ever")
    finally:
        await engine.close()


async def test_a_start_that_is_cancelled_leaves_nothing(nats1: NatsServers) -> None:
    """No thread, and no lease: the next start need not wait, whenever it was cancelled."""
    store = nats1.store(nats1.new_system())

    async def lead_on() -> None:
        async with hf.ActorSystem("app", store=store, log=False):
            await asyncio.Event().wait()

    began = monotonic()
    async with hf.ActorSystem("app", store=store, log=False):
        took = monotonic() - began
    for moment in range(40):  # over the time that a start takes
        leading = asyncio.create_task(lead_on())
        await asyncio.wait([leading], timeout=took * moment / 40)
        leading.cancel()
        with pytest.raises(asyncio.CancelledError):
            await leading
        assert [one.name for one in threading.enumerate() if one.name == "holdfast app"] == []
        async with asyncio.timeout(PATIENCE), hf.ActorSystem("app", store=store, log=False):
            pass


LEADS = """
import asyncio, sys
import holdfast as hf
from tests.cluster.test_connecting import Put, Shelf

async def main():
    async with hf.ActorSystem("app", store=sys.argv[1]) as system:
        shelf = await system.start(hf.child("shelf", hf.start(Shelf), recovery=hf.hybrid()))
        await shelf.ask(Put())
        print("leads", flush=True)
        await asyncio.to_thread(sys.stdin.readline)
        shelf.tell(Put())
        await asyncio.sleep(0.05)
        print("told", flush=True)
        await asyncio.Event().wait()

hf.run(main)
"""


async def test_who_is_ended_while_the_servers_are_down_ends_in_order(own_nats1: NatsServers) -> None:
    """Its status is that of SIGTERM, and one line says what could not be written."""
    store = own_nats1.store(own_nats1.new_system())
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-c", LEADS, store),
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )
    assert process.stdin is not None
    assert process.stdout is not None
    async with asyncio.timeout(PATIENCE):
        while (line := await process.stdout.readline()) != b"leads\n":
            assert line, "it has ended"
        own_nats1.stop(0)
        process.stdin.write(b"tell\n")
        assert await process.stdout.readline() == b"told\n"
        process.send_signal(signal.SIGTERM)
        output, errors = await process.communicate()
    said = (output + errors).decode()
    assert process.returncode == 128 + signal.SIGTERM, said
    assert "Traceback" not in said
    assert said.count("journal stopped") == 1, said
    assert "may be lost" in said
