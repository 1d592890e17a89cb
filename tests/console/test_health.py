"""A system as a part of a program that others start, watch and end: verdicts, probes, workers, the end of a server."""

import asyncio
import os
import signal
import socket
import tempfile
from pathlib import Path

import pytest

import holdfast as hf
from holdfast.checkpoint.sqlite import SqliteJournal
from holdfast.console.service import probe_server
from holdfast.console.service.health import Service
from tests.system.trees import Add, Counter


class Break(hf.Message): ...


class Fragile(hf.Actor):
    @hf.on(Break)
    def crash(self, message: Break) -> None:
        raise RuntimeError("too weak")


def system(**options: object) -> hf.ActorSystem:
    return hf.ActorSystem("app", log=False, **options)  # type: ignore[arg-type]


async def get(service: Service, path: str, method: str = "GET") -> tuple[int, str]:
    """Status and body of the answer to a probe."""
    reader, writer = await asyncio.open_connection("127.0.0.1", service.probe_port)
    writer.write(f"{method} {path} HTTP/1.1\r\nHost: here\r\n\r\n".encode())
    head, _, body = (await reader.read()).decode().partition("\r\n\r\n")
    writer.close()
    await writer.wait_closed()
    return int(head.split()[1]), body


async def test_it_is_ready_when_all_is_up_and_not_before() -> None:
    async with Service(system(), probes="127.0.0.1:0") as service:
        assert await get(service, "/livez") == (200, "ok\n")
        assert await get(service, "/readyz?verbose") == (503, "the system is being started\n")
        await service.system.start(hf.child("kept", hf.start(Counter)))
        service.up()
        assert await get(service, "/readyz?verbose") == (200, "ok\n")
        service.stopping()
        assert await get(service, "/readyz") == (503, "the system is stopping\n")
        assert (await service.live()).is_good


async def test_what_is_no_probe_is_answered_too() -> None:
    async with Service(system(), probes="127.0.0.1:0") as service:
        assert (await get(service, "/metrics"))[0] == 404
        assert (await get(service, "/livez", "POST"))[0] == 400
        for sent in (b"x" * 20_000, b"GET /livez"):  # More than a request may have, and half of one.
            reader, writer = await asyncio.open_connection("127.0.0.1", service.probe_port)
            writer.write(sent)
            writer.write_eof()
            try:
                assert await reader.read() == b""
            except ConnectionResetError:
                pass
            writer.close()
        assert (await get(service, "/livez"))[0] == 200


async def test_a_probe_that_says_nothing_holds_up_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sixteen may say nothing at a time; a further one is closed at once, and they are after a while."""
    monkeypatch.setattr(probe_server, "LONGEST", 0.2)
    async with Service(system(), probes="127.0.0.1:0") as service, asyncio.timeout(30):
        silent = [
            await asyncio.open_connection("127.0.0.1", service.probe_port) for _ in range(probe_server.MOST_PROBES + 1)
        ]
        ends = [asyncio.create_task(reader.read()) for reader, _ in silent]
        done, _ = await asyncio.wait(ends, return_when="FIRST_COMPLETED")
        assert len(done) == 1
        await asyncio.wait(ends)
        for end, (_, writer) in zip(ends, silent, strict=True):
            assert isinstance(end.exception(), ConnectionResetError) or end.result() == b""
            writer.close()
        assert (await get(service, "/livez"))[0] == 200


async def test_probes_are_answered_while_a_long_start_runs() -> None:
    class Slow(hf.Actor):
        async def on_start(self, restored: bool) -> None:
            reached.set()
            await goes_on.wait()

    reached, goes_on = asyncio.Event(), asyncio.Event()
    async with Service(system(), probes="127.0.0.1:0") as service:
        start = asyncio.create_task(service.system.start(hf.child("slow", hf.start(Slow))))
        await reached.wait()
        assert (await get(service, "/livez"))[0] == 200
        assert (await get(service, "/readyz"))[0] == 503
        goes_on.set()
        await start


async def test_a_child_that_is_away_makes_it_not_ready() -> None:
    async with Service(system()) as service:
        child = hf.child("fragile", hf.start(Fragile), backoff=hf.Backoff(initial=60.0, maximum=60.0))
        fragile = await service.system.start(child)
        service.up()
        assert (await service.ready()).text == "ok"
        async with asyncio.timeout(20):
            fragile.tell(Break())
            while (verdict := await service.ready()).is_good:
                await asyncio.sleep(0)
        assert verdict.text == "1 of 1 children of the root do not run"
        assert (await service.live()).is_good  # It will come back: another program would not help.


async def test_so_does_a_child_of_a_supervisor_that_is_watched() -> None:
    async with Service(system(), watch=["/app/inner"]) as service:
        service.up()
        assert (await service.ready()).text.startswith("/app/inner does not answer: ")
        child = hf.child("fragile", hf.start(Fragile), backoff=hf.Backoff(initial=60.0, maximum=60.0))
        await service.system.start(hf.supervisor("inner", children=[child]))
        assert (await service.ready()).text == "ok"
        fragile = service.system.ref("/app/inner/fragile", Fragile)
        async with asyncio.timeout(20):
            fragile.tell(Break())
            while (verdict := await service.ready()).is_good:
                await asyncio.sleep(0)
        assert verdict.text == "1 of 1 children of /app/inner do not run"
        assert (await service.live()).is_good


async def test_a_child_whose_process_is_silent_makes_it_not_ready() -> None:
    async with Service(system()) as service:
        kept = await service.system.start(hf.child("kept", hf.start(Counter), isolation="process"))
        service.up()
        assert (await service.ready()).text == "ok"
        pid = service.system.pid_of(kept)
        os.kill(pid, signal.SIGSTOP)
        try:
            assert (await service.ready()).text == "the process of /app/kept does not answer"
            assert (await service.live()).is_good
        finally:
            os.kill(pid, signal.SIGCONT)
        assert await kept.ask(Add(1)) == 1
        assert (await service.ready()).text == "ok"


class FullStore(SqliteJournal):
    """Takes nothing any more, for now or for good."""

    refuses = is_broken = False

    def append(self, entries):
        if self.refuses:
            raise hf.errors.StoreFailed("app.db", "no room")
        return super().append(entries)

    def has_failed(self) -> bool:
        return self.is_broken


@pytest.mark.parametrize("is_broken", [False, True])
async def test_a_store_that_is_full_makes_it_not_ready_and_one_that_has_failed_not_live(
    is_broken: bool, tmp_path: Path
) -> None:
    store = FullStore(str(tmp_path / "app.db"))
    async with Service(system(store=store)) as service:
        counter = await service.system.start(hf.child("kept", hf.start(Counter), recovery=hf.hybrid()))
        service.up()
        assert (await service.ready()).is_good
        store.refuses, store.is_broken = True, is_broken
        with pytest.raises(hf.HoldfastError):
            await counter.ask(Add())
        assert "the store takes nothing: " in (await service.ready()).text
        assert (await service.live()).is_good is not is_broken
        store.refuses = False


async def test_a_root_that_does_not_answer_makes_it_not_live() -> None:
    async with Service(system()) as service:
        service.up()
        await service.system.suspend(service.system.ref("/app"))
        assert "the root does not answer" in (await service.live(timeout=0.05)).text
        assert "the root does not answer" in (await service.ready(timeout=0.05)).text
        await service.system.resume(service.system.ref("/app"))
        assert (await service.ready()).is_good


async def test_if_the_tree_fails_the_server_ends() -> None:
    loop, told = asyncio.get_running_loop(), asyncio.Event()
    loop.add_signal_handler(signal.SIGTERM, told.set)

    async def serve() -> None:
        async with Service(system(intensity=0), ends_server=True) as service:
            fragile = await service.system.start(hf.child("fragile", hf.start(Fragile)))
            fragile.tell(Break())
            await asyncio.Event().wait()

    try:
        with pytest.raises(hf.TreeFailed):
            await serve()
        async with asyncio.timeout(20):
            await told.wait()
        told.clear()
        async with Service(system(), ends_server=True):
            pass
        await asyncio.sleep(0)
        assert not told.is_set()
    finally:
        loop.remove_signal_handler(signal.SIGTERM)


async def test_each_worker_has_a_store_of_its_own_and_waits_for_one(tmp_path: Path) -> None:
    def worker(patience: float = 30.0) -> Service:
        return Service(lambda n: system(store=f"sqlite:{tmp_path}/{n}.db"), workers=2, patience=patience)

    async with worker() as first:
        async with worker() as second:
            assert (first.number, second.number) == (0, 1)
            with pytest.raises(hf.errors.StoreInUse):
                await worker(patience=0.01).__aenter__()
            third = worker()
            entering = asyncio.create_task(third.__aenter__())
            await asyncio.sleep(0)
            assert not entering.done()
        assert (await entering).number == 1
        await third.__aexit__(None, None, None)


async def test_only_the_master_of_several_workers_talks_to_the_service_manager(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager, tempfile.TemporaryDirectory(dir="/tmp") as folder:
        manager.bind(f"{folder}/notify")
        manager.setblocking(False)
        told = {"NOTIFY_SOCKET": f"{folder}/notify"}
        async with Service(lambda n: system(), workers=2, environment=told) as service:
            service.up()
        with pytest.raises(BlockingIOError):
            manager.recv(4096)
        async with Service(system(), environment=told) as service:
            service.up("two carts wait")
            assert "STATUS=two carts wait" in manager.recv(4096).decode()
        assert "STOPPING=1" in manager.recv(4096).decode()


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        ({"workers": 2}, "several workers need a store each"),
        ({"workers": 0}, "a number from 1 on"),
        ({"patience": -1.0}, "patience"),
        ({"watch": "/app/inner"}, "addresses, not one text"),
        ({"probes": "8080"}, "must be HOST:PORT"),
        ({"probes": "host:http"}, "must be HOST:PORT"),
    ],
)
async def test_wrong_arguments_are_refused(arguments: dict[str, object], problem: str) -> None:
    with pytest.raises(hf.SpecError, match=problem):
        Service(system(), **arguments)  # type: ignore[arg-type]


async def test_a_port_that_is_taken_is_refused() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(hf.SpecError, match=f"probes: 127.0.0.1:{port}"):
            await Service(system(), probes=f"127.0.0.1:{port}").__aenter__()


async def test_a_service_that_was_not_entered_says_so() -> None:
    service = Service(system())
    assert service.probe_port == 0
    with pytest.raises(hf.HoldfastError, match="async with Service"):
        service.system.tree()
    assert (await service.ready()).text == "the system is being started"


async def test_a_system_that_is_opened_without_a_block_cancels_nobody() -> None:
    opened = await system(intensity=0).open()
    with pytest.raises(hf.HoldfastError, match="entered already"):
        await opened.open()
    fragile = await opened.start(hf.child("fragile", hf.start(Fragile)))
    assert not opened.has_failed
    fragile.tell(Break())
    async with asyncio.timeout(20):
        while not opened.has_failed:
            await asyncio.sleep(0)
    with pytest.raises(hf.ActorStopped):
        await fragile.ask(Break())
    await opened.shutdown()
