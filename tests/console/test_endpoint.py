"""The control endpoint: whom it serves, what it refuses, and that nobody is hurt by what another sends (DESIGN 9)."""

import asyncio
import contextlib
import inspect
import os
import socket
import stat
import subprocess
import sys
from pathlib import Path
from typing import Any

import msgspec
import pytest

import holdfast as hf
from holdfast.actors.kernel.codec import MAX_BYTES
from holdfast.actors.process.wire.frame_buffer import LENGTH
from holdfast.actors.values import encode_value
from holdfast.console import claims
from holdfast.console import endpoint as endpoint_module
from holdfast.console.claims import EndpointInUse, claimed
from holdfast.console.client_session import ClientSession
from holdfast.console.endpoint import Endpoint, control_endpoint
from holdfast.console.remote import Client, NotReached, RemoteRef, RemoteSystem
from holdfast.console.wire import (
    RESPONSE,
    BadRequest,
    ControlActor,
    ControlRequest,
    PackedArg,
    PlainArg,
    Transact,
    Tree,
    WrongUser,
    frame,
    outcome,
)
from tests.system.trees import Add, Counter, counter, picture, ref


async def far(path: Path, work: Any) -> Any:
    """`work(remote)` in a thread, as another process would do it: what blocks there must not block us."""

    def run() -> Any:
        with RemoteSystem(path) as remote:
            return asyncio.run(work(remote)) if inspect.iscoroutinefunction(work) else work(remote)

    return await asyncio.to_thread(run)


async def raw(path: Path, data: bytes) -> tuple[Any, bytes]:
    """Send bytes; the response, and what comes behind it until the end."""
    reader, writer = await asyncio.open_unix_connection(path)
    try:
        writer.write(data)
        await writer.drain()
        (size,) = LENGTH.unpack(await reader.readexactly(LENGTH.size))
        response = RESPONSE.decode(await reader.readexactly(size))
        return response, await reader.read()
    finally:
        writer.close()
        await writer.wait_closed()


# -- the socket -------------------------------------------------------------------------------------------------------


async def test_only_its_user_may_open_it_and_it_goes_with_the_endpoint(system: hf.ActorSystem, tmp_path: Path) -> None:
    where = tmp_path / "app.sock"
    umask = os.umask(0)
    try:
        async with control_endpoint(system, where):
            assert stat.S_IMODE(os.lstat(where).st_mode) == 0o600
    finally:
        os.umask(umask)
    assert not where.exists()


async def test_it_has_no_wider_rights_at_the_moment_of_its_birth(
    system: hf.ActorSystem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[int] = []

    class Looking(socket.socket):
        def bind(self, address: Any) -> None:
            os.umask(0)  # Whatever the umask: the rights come from the socket itself.
            super().bind(address)
            seen.append(stat.S_IMODE(os.lstat(address).st_mode))

    monkeypatch.setattr(socket, "socket", Looking)
    before = os.umask(0o022)
    try:
        sock, _ = claims.listen(tmp_path / "app.sock")
    finally:
        os.umask(before)
    sock.close()
    os.unlink(tmp_path / "app.sock")
    assert seen == [0o600]


async def test_a_folder_that_others_may_write_is_refused(system: hf.ActorSystem, tmp_path: Path) -> None:
    folder = tmp_path / "open"
    folder.mkdir()
    folder.chmod(0o777)
    with pytest.raises(hf.errors.UntrustedFile, match="others may write it"):
        async with control_endpoint(system, folder / "app.sock"):
            pass
    assert list(folder.iterdir()) == []


async def test_a_live_endpoint_is_not_replaced(system: hf.ActorSystem, path: Path) -> None:
    with pytest.raises(EndpointInUse, match="a live process listens there"):
        async with control_endpoint(system, path):
            pass
    assert await far(path, lambda remote: remote.tree()) == system.tree()


async def test_the_socket_of_a_dead_process_is_replaced(system: hf.ActorSystem, tmp_path: Path) -> None:
    where = tmp_path / "app.sock"
    program = (
        "import socket, sys; s = socket.socket(socket.AF_UNIX); s.bind(sys.argv[1]); s.listen(); import os; os._exit(9)"
    )
    assert subprocess.run([sys.executable, "-c", program, where], check=False, timeout=60).returncode == 9
    assert where.is_socket()
    async with control_endpoint(system, where):
        assert await far(where, lambda remote: remote.tree()) == system.tree()


async def test_what_is_no_socket_is_left_alone(system: hf.ActorSystem, tmp_path: Path) -> None:
    where = tmp_path / "notes"
    where.write_text("mine")
    with pytest.raises(EndpointInUse, match="something else"):
        async with control_endpoint(system, where):
            pass
    assert where.read_text() == "mine"


@pytest.mark.parametrize("what", ["content", "hard link", "link", "fifo"])
async def test_a_lock_that_is_not_ours_is_left_alone(system: hf.ActorSystem, tmp_path: Path, what: str) -> None:
    where, lock, foreign = tmp_path / "app.sock", tmp_path / "app.sock.lock", tmp_path / "foreign"
    foreign.write_text("mine" if what == "content" else "")
    match what:
        case "content":
            foreign.rename(lock)
        case "hard link":
            os.link(foreign, lock)
        case "link":
            lock.symlink_to(foreign)
        case _:
            os.mkfifo(lock)
    before = os.lstat(lock)
    with pytest.raises(EndpointInUse, match=r"no lock of ours|symbolic links"):
        async with control_endpoint(system, where):
            pass
    assert os.path.samestat(os.lstat(lock), before)
    assert not where.exists()


async def test_another_user_is_not_served(system: hf.ActorSystem, tmp_path: Path) -> None:
    """The check asks the kernel who is there; here the endpoint serves a user that we are not."""
    endpoint = Endpoint(system, os.geteuid() + 1)
    server = await asyncio.start_unix_server(endpoint.serve, tmp_path / "app.sock")
    try:
        response, rest = await raw(tmp_path / "app.sock", frame(Tree()))
        with pytest.raises(WrongUser, match=f"uid {os.geteuid()}, and only uid {os.geteuid() + 1} is served"):
            outcome(response)
        assert rest == b""
    finally:
        server.close()
        await endpoint.close()
        await server.wait_closed()


# -- what is sent -----------------------------------------------------------------------------------------------------

BAD = {
    "no MessagePack": LENGTH.pack(3) + b"\xc1\xc1\xc1",
    "no request": LENGTH.pack(1) + b"\x01",
    "unknown request": LENGTH.pack(20) + msgspec.msgpack.encode({"ask": "shutdown all"})[:20].ljust(20, b"\0"),
    "too large": LENGTH.pack(MAX_BYTES + 1),
    "unknown field": (lambda body: LENGTH.pack(len(body)) + body)(msgspec.msgpack.encode({"ask": "tree", "all": True})),
    "no UTF-8": (lambda body: LENGTH.pack(len(body)) + body)(b"\x82\xa3ask\xa7whereis\xa4name\xa2\xff\xfe"),
    "nesting without end": (lambda body: LENGTH.pack(len(body)) + body)(b"\x81\xa3ask" * 300_000),
    "wrong type": (lambda body: LENGTH.pack(len(body)) + body)(msgspec.msgpack.encode({"ask": "whereis", "name": 5})),
}


@pytest.mark.parametrize(
    ("request_", "problem"),
    [
        (Transact([("step", [PlainArg("x")])], dry_run=False, timeout=1.0), "there is no operation 'step'"),
        (Transact([("update", [])], dry_run=False, timeout=1.0), "update lacks mechanism"),
        (Transact([("update", [PlainArg("/app/left")])], dry_run=False, timeout=1.0), "update lacks role"),
        (
            ControlActor("replace_state", "/app/left", [PackedArg("function", encode_value("os:system"))], 1.0),
            "is no function: a name, its arguments",
        ),
    ],
)
async def test_a_request_that_cannot_be_read_is_answered(
    system: hf.ActorSystem, path: Path, request_: ControlRequest, problem: str
) -> None:
    reader, writer = await asyncio.open_unix_connection(path)
    writer.write(frame(request_))
    (size,) = LENGTH.unpack(await reader.readexactly(LENGTH.size))
    with pytest.raises(hf.HoldfastError, match=problem):
        outcome(RESPONSE.decode(await reader.readexactly(size)))
    writer.close()


@pytest.mark.parametrize("what", BAD)
async def test_what_is_no_request_ends_its_own_connection_only(system: hf.ActorSystem, path: Path, what: str) -> None:
    reader, writer = await asyncio.open_unix_connection(path)  # Another client, in the middle of its session.
    response, rest = await raw(path, BAD[what])
    with pytest.raises(BadRequest):
        outcome(response)
    assert rest == b""
    writer.write(frame(Tree()))
    (size,) = LENGTH.unpack(await reader.readexactly(LENGTH.size))
    assert outcome(RESPONSE.decode(await reader.readexactly(size))) == system.tree()
    writer.close()
    await writer.wait_closed()


async def test_a_client_that_goes_in_the_middle_of_a_frame_hurts_nobody(system: hf.ActorSystem, path: Path) -> None:
    _, writer = await asyncio.open_unix_connection(path)
    writer.write(frame(Tree())[:3])
    writer.close()
    await writer.wait_closed()
    assert await far(path, lambda remote: remote.tree()) == system.tree()


async def test_idle_clients_make_room_for_the_next(
    system: hf.ActorSystem, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever holds connections and says nothing cannot lock the operator out: the idlest one goes."""
    monkeypatch.setattr(endpoint_module, "MOST_CLIENTS", 2)
    held = [await asyncio.open_unix_connection(path) for _ in range(2)]
    for reader, writer in held:
        writer.write(frame(Tree()))
        assert await reader.readexactly(4)  # It is served: it counts from now on.
    held[1][1].write(frame(Tree())[:3])  # This one has begun to say something, and does not go on.
    for _ in range(3):
        assert await far(path, lambda remote: remote.tree()) == system.tree()
    for _, writer in held:
        writer.close()
        await writer.wait_closed()


async def test_clients_at_work_are_not_sent_away(
    system: hf.ActorSystem, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(endpoint_module, "MOST_CLIENTS", 1)
    at_work, finish = asyncio.Event(), asyncio.Event()

    async def wait(session: ClientSession, request: Any) -> Any:
        at_work.set()
        await finish.wait()
        return system.tree()

    monkeypatch.setattr(ClientSession, "answer", wait)
    reader, writer = await asyncio.open_unix_connection(path)
    writer.write(frame(Tree()))
    await at_work.wait()
    response, _ = await raw(path, frame(Tree()))
    with pytest.raises(BadRequest, match="1 connections already"):
        outcome(response)
    finish.set()
    (size,) = LENGTH.unpack(await reader.readexactly(LENGTH.size))
    assert outcome(RESPONSE.decode(await reader.readexactly(size))) == system.tree()
    writer.close()
    await writer.wait_closed()


async def test_a_path_that_somebody_is_about_to_take_is_left_alone(system: hf.ActorSystem, tmp_path: Path) -> None:
    """Between the look at a dead process's socket and a socket in its place there is a moment: it has one owner."""
    where = tmp_path / "app.sock"
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(where))
    before = os.lstat(where).st_ino
    with claimed(where), pytest.raises(EndpointInUse, match="a live process listens there"):
        async with control_endpoint(system, where):
            pass
    assert os.lstat(where).st_ino == before
    async with control_endpoint(system, where):
        assert await far(where, lambda remote: remote.tree()) == system.tree()
    assert list(tmp_path.iterdir()) == []


def test_every_request_is_typed() -> None:
    assert all(kind.__struct_config__.forbid_unknown_fields for kind in ControlRequest.__subclasses__())


# -- what a script can do ---------------------------------------------------------------------------------------------


async def test_the_tree_is_looked_at_and_actors_are_controlled(system: hf.ActorSystem, path: Path) -> None:
    a = ref(system, "/app/left/a")
    await a.ask(Add(4))

    async def work(remote: RemoteSystem) -> list[Any]:
        one = remote.ref("/app/left/a", Counter)
        assert remote.whereis("first") == one == RemoteRef("/app/left/a")
        with pytest.raises(hf.errors.NoSuchActor, match="nobody"):
            remote.whereis("nobody")
        with pytest.raises(hf.errors.NoSuchActor):
            await remote.get_state("/app/nowhere")
        await remote.statistics(one, True)
        await remote.suspend(one)
        found = [await remote.get_state(one), (await remote.get_status(one)).state]
        await remote.resume(one)
        counts = await remote.statistics(one)
        assert counts is not None
        return found

    assert await far(path, work) == [{"count": 4}, "suspended"]
    assert await a.ask(Add(1)) == 5


async def test_a_transaction_is_carried_out_as_one(system: hf.ActorSystem, path: Path) -> None:
    async def work(remote: RemoteSystem) -> str:
        async with remote.transaction() as change:
            g = change.add("/app/left", counter("g", 7))
            change.register("seven", g)
            change.move("/app/left/b", "/app/right")
            change.bind(remote.ref("/app/right/client"), "peer", g)
            change.reorder("/app/left", ["g", "a", "c"])
            change.intensity("/app/left", 5, 2.5)
        return change.describe()

    told = await far(path, work)
    assert "2. register /app/left/g as 'seven'" in told
    assert "+ /app/left/g: Counter, permanent, task, named 'seven'" in told
    assert await system.whereis("seven").ask(Add()) == 8
    assert "/app/right/b" in system.tree()


async def test_a_transaction_that_fails_changes_nothing_and_says_why(system: hf.ActorSystem, path: Path) -> None:
    before = picture(system)

    async def fails(remote: RemoteSystem) -> None:
        async with remote.transaction() as change:
            change.move("/app/left/b", "/app/right")
            change.replace_state("/app/left/c", raises)

    async def refused(remote: RemoteSystem) -> None:
        async with remote.transaction() as change:
            change.move("/app/left/b", "/app/right")
            change.remove("/app/left/x")

    with pytest.raises(hf.TransactionFailed, match="cannot be done") as failed:
        await far(path, fails)
    assert failed.value.undone == ("replace state of /app/left/c", "move /app/left/b to /app/right")
    with pytest.raises(hf.TransactionRefused, match="there is no actor at /app/left/x"):
        await far(path, refused)
    assert picture(system) == before


def raises(state: Any) -> Any:
    raise ValueError("cannot be done")


async def test_a_transaction_whose_client_goes_is_rolled_back(system: hf.ActorSystem, path: Path) -> None:
    before = picture(system)
    await system.suspend(ref(system, "/app/right"))  # It will not start anybody.
    async with asyncio.timeout(30):
        with system.events() as stream:

            async def work(remote: RemoteSystem) -> None:
                async with remote.transaction(timeout=60.0) as change:
                    change.unregister("first")
                    change.add("/app/pool", hf.child("slow", hf.start(Endless)))

            client = asyncio.create_task(far(path, lambda remote: go_in_the_middle(remote, work)))
            reason = await rolled_back(stream)
        await client
    await system.resume(ref(system, "/app/right"))
    assert reason == "cancelled"
    assert picture(system) == before


async def rolled_back(stream: hf.events.EventStream) -> str:
    async for event in stream:
        if isinstance(event, hf.events.TransactionRolledBack):
            return event.reason
    raise AssertionError("the stream has ended")


class Endless(Counter):
    async def on_start(self, restored: bool) -> None:
        await asyncio.get_running_loop().create_future()


def go_in_the_middle(remote: RemoteSystem, work: Any) -> None:
    async def main() -> None:
        task = asyncio.create_task(work(remote))
        while "/app/pool/slow" not in await asyncio.to_thread(other.tree):
            await asyncio.sleep(0)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    with RemoteSystem(remote._client.path) as other:
        asyncio.run(main())


async def test_nobody_listens(tmp_path: Path) -> None:
    with pytest.raises(NotReached, match="is it running, with a control endpoint there"):
        RemoteSystem(tmp_path / "gone.sock")


async def test_the_endpoint_ends_with_clients_connected(system: hf.ActorSystem, tmp_path: Path) -> None:
    async with control_endpoint(system, tmp_path / "app.sock") as where:
        reader, writer = await asyncio.open_unix_connection(where)
        writer.write(frame(Tree()))
        assert await reader.readexactly(4)
    async with asyncio.timeout(10):
        await reader.read()
    writer.close()
    await writer.wait_closed()


PROTECTIONS: list[tuple[Any, tuple[str, ...], str]] = [
    (hf.ftm.PBR(), ("pbr",), "protect /app/left/a by PBR"),
    ((hf.ftm.LFR(), hf.ftm.TR()), ("lfr", "tr"), "protect /app/left/a by LFR + TR"),
    ([hf.ftm.PBR()], ("pbr",), "protect /app/left/a by PBR"),
    ("lfr", ("lfr",), "protect /app/left/a by LFR"),
    (None, (), "protect /app/left/a by no mechanism"),
]


@pytest.mark.asyncio(loop_factories=["uvloop"])
async def test_an_actor_is_protected_by_just_what_is_asked_for_and_by_nothing_again(
    system: hf.ActorSystem, path: Path
) -> None:
    """One stack after the other in the same session; its state and its address stay."""
    actor = ref(system, "/app/left/a")

    async def work(remote: RemoteSystem) -> list[Any]:
        seen: list[Any] = []
        for mechanism, _, _ in PROTECTIONS:
            async with remote.transaction(dry_run=True) as change:
                change.protect(RemoteRef("/app/left/a"), mechanism)
            before = (await remote.protection("/app/left/a")).stack
            async with remote.transaction(timeout=60.0) as change:
                change.protect(RemoteRef("/app/left/a"), mechanism)
            seen.append((before, (await remote.protection("/app/left/a")).stack, change.steps[0].text))
        return seen

    assert await actor.ask(Add(3)) == 3
    before = [(), *(stack for _, stack, _ in PROTECTIONS)]
    expected = [(was, stack, text) for was, (_, stack, text) in zip(before, PROTECTIONS, strict=False)]
    assert await far(path, work) == expected
    assert await actor.ask(Add(1)) == 4


NO_MECHANISMS: list[tuple[Any, type[hf.HoldfastError], str]] = [
    (Counter, hf.TransactionRefused, "it must be one such as PBR"),
    (object(), hf.SpecError, "cannot be sent to the running system"),
    ((hf.ftm.PBR(), None), hf.SpecError, "cannot be sent to the running system"),
    ("no such one", hf.TransactionRefused, "there is no mechanism of that name"),
]


@pytest.mark.parametrize(("mechanism", "error", "problem"), NO_MECHANISMS)
async def test_what_is_no_mechanism_is_refused_over_the_socket_too(
    system: hf.ActorSystem, path: Path, mechanism: Any, error: type[hf.HoldfastError], problem: str
) -> None:
    before = picture(system)

    async def work(remote: RemoteSystem) -> None:
        async with remote.transaction() as change:
            change.protect("/app/left/a", mechanism)

    with pytest.raises(error, match=problem):
        await far(path, work)
    assert picture(system) == before


async def test_an_answer_beyond_the_limit_is_not_read(tmp_path: Path) -> None:
    """Whoever listens in place of the system cannot have the client take any amount of memory."""
    path = tmp_path / "app.sock"
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(path))
        listening.listen(1)
        with contextlib.closing(Client(path)) as client, listening.accept()[0] as other:
            other.sendall(LENGTH.pack(MAX_BYTES + 1))
            with pytest.raises(BadRequest, match=f"it has {MAX_BYTES + 1} bytes"):
                client.call(Tree(), 5.0)
