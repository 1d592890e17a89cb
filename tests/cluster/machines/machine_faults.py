"""What may happen to the machines of a fleet, and when.

A fault is a strike at a moment. A strike does its harm and returns what undoes it; meanwhile another program may have
to lead. Moments: in calm, during a takeover, at a large snapshot, at a base, and while programs start.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import shutil
import signal
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Final, NamedTuple

from tests.cluster.machines.fleet_of_machines import FleetOfMachines, Kind

Undo = Callable[[], Awaitable[None]]
LARGE: Final = 96 << 10
"""Bytes of a message when snapshots are to be large, and bases frequent."""
SLOW_SECONDS: Final = 0.03
"""How much later a slow disk has written."""
SKEW_SECONDS: Final = 10
WAKES: Final = (0.5, 2.0)
"""Seconds that a strike lasts which deposes nobody."""
ANSWERS: Final = 10
"""So many answers say that the fleet goes on."""


def fake_time() -> str:
    """The library that has a program see another time."""
    found = find_spec("libfaketime")
    assert found is not None, "there is no libfaketime: make .venv/.dev"
    assert found.origin is not None
    return str(next(Path(found.origin).parent.rglob("libfaketime.so.1")))


class Strike(NamedTuple):
    """What happens.

    Attributes:
        do: does it, to the program that leads or begins to, and returns what undoes it.
        deposes: another program has to lead before it is undone.
        kinds: of fleets where it can happen.
    """

    do: Callable[[FleetOfMachines, int], Awaitable[Undo]]
    deposes: bool = False
    kinds: tuple[Kind, ...] = ("network", "links")


async def nothing() -> None:
    """There is nothing to undo."""


def kill_program(*, leads: bool) -> Strike:
    async def do(fleet: FleetOfMachines, leader: int) -> Undo:
        await fleet.end(leader if leads else fleet.other(leader))
        return nothing

    return Strike(do, leads)


def stop_program(*, leads: bool) -> Strike:
    """SIGSTOP; it wakes with what it had in hand."""

    async def do(fleet: FleetOfMachines, leader: int) -> Undo:
        pid = leader if leads else fleet.other(leader)
        os.kill(pid, signal.SIGSTOP)

        async def undo() -> None:
            os.kill(pid, signal.SIGCONT)

        return undo

    return Strike(do, leads)


def strike_worker(number: signal.Signals) -> Strike:
    async def do(fleet: FleetOfMachines, leader: int) -> Undo:
        pid = await fleet.clients.request({"worker": True})

        async def undo() -> None:
            with contextlib.suppress(ProcessLookupError):  # It was replaced, since it said nothing.
                os.kill(pid, signal.SIGCONT)

        with contextlib.suppress(ProcessLookupError):  # Its program has ended meanwhile.
            os.kill(pid, number)
        return undo

    return Strike(do)


def strike_servers(*places: int, kills: bool) -> Strike:
    """Servers by place: 0 leads the log."""

    async def do(fleet: FleetOfMachines, leader: int) -> Undo:
        first = await fleet.log_server()
        struck = [(first + place) % 3 for place in places]
        for number in struck:
            fleet.servers.kill(number) if kills else fleet.servers.stop(number)

        async def undo() -> None:
            if kills:
                await asyncio.gather(*map(fleet.servers.restart, struck))
            else:
                for number in struck:
                    fleet.servers.cont(number)

        return undo

    return Strike(do)


def partition(how: str, *, deposes: bool) -> Strike:
    async def do(fleet: FleetOfMachines, leader: int) -> Undo:
        network, place = fleet.network, fleet.places[leader]
        assert network is not None
        servers = ["n0", "n1", "n2"]
        first = f"n{await fleet.log_server()}"
        others = [one for one in servers if one != first]
        rest = fleet.places[fleet.other(leader)]
        flapping: asyncio.Task[None] | None = None
        match how:
            case "the leader":
                network.part([place], servers)
            case "what the leader sends":
                for one in servers:
                    network.cut(place, one)
            case "what the leader is sent":
                for one in servers:
                    network.cut(one, place)
            case "the leader with one server":
                network.part([place, others[0]], [first, others[1], rest])
            case "the standby with one server":
                network.part([rest, others[0]], [first, others[1], place])
            case "the log's server":
                network.part([first], [*others, place, rest])
            case "what the log's server sends":
                for one in (*others, place, rest):
                    network.cut(first, one)
            case _:

                async def flap() -> None:
                    while True:
                        network.part([first], [*others, place, rest])
                        await asyncio.sleep(fleet.draws.uniform(0.1, 0.7))
                        network.mend()
                        await asyncio.sleep(fleet.draws.uniform(0.1, 0.7))

                flapping = asyncio.ensure_future(flap())

        async def undo() -> None:
            if flapping is not None:
                flapping.cancel()
                await asyncio.wait([flapping])
            network.mend()

        return undo

    return Strike(do, deposes, ("network",))


def fill_disks(*places: int) -> Strike:
    async def do(fleet: FleetOfMachines, leader: int) -> Undo:
        first = await fleet.log_server()
        struck = [(first + place) % 3 for place in places]
        fillers = [fleet.disks[number] / "filler" for number in struck]
        for filler in fillers:
            with filler.open("wb", buffering=0) as file, contextlib.suppress(OSError):
                while True:
                    file.write(bytes(1 << 16))

        async def undo() -> None:
            for filler in fillers:
                filler.unlink()
            for number in struck:  # A server that has found its disk full keeps nothing until it is started again.
                fleet.servers.kill(number)
            await asyncio.gather(*map(fleet.servers.restart, struck))

        return undo

    return Strike(do, False, ("network",))


async def slow_disk(fleet: FleetOfMachines, leader: int) -> Undo:
    """Have the disk of the log's server be slow: each write and sync of it takes longer."""
    strace = shutil.which("strace")
    assert strace is not None, "there is no strace"
    calls = "fsync,fdatasync,pwrite64"
    inject = f"inject={calls}:delay_exit={int(1e6 * SLOW_SECONDS)}"
    pid = str(fleet.servers.pid(await fleet.log_server()))
    tracing = await asyncio.create_subprocess_exec(
        strace, "-f", "-qq", "-o", "/dev/null", "-e", f"trace={calls}", "-e", inject, "-p", pid,
        stderr=asyncio.subprocess.DEVNULL,
    )  # fmt: skip

    async def undo() -> None:
        with contextlib.suppress(ProcessLookupError):
            tracing.send_signal(signal.SIGINT)  # It lets go of the server.
        await tracing.wait()

    return undo


async def skew(fleet: FleetOfMachines, leader: int) -> Undo:
    """Have the next leader see a wrong time: the standby is replaced by one that does, and then the leader killed."""
    await fleet.end(fleet.other(leader))
    way = fleet.draws.choice("+-")
    fleet.environ = {"LD_PRELOAD": fake_time(), "FAKETIME": f"{way}{SKEW_SECONDS}s", "DONT_FAKE_MONOTONIC": "1"}
    await fleet.complete()
    fleet.environ = {}
    await fleet.end(leader)
    return nothing


def slow_links(how: str, *, deposes: bool = False) -> Strike:
    async def do(fleet: FleetOfMachines, leader: int) -> Undo:
        links = fleet.links
        assert links is not None
        match how:
            case "late":
                links.delay = 0.1
            case "unsteady":
                links.jitter = 0.3
            case "narrow":
                links.rate = 100_000.0
            case "silent":
                links.hush()
            case "silent to the servers":
                links.hush(down=False)
            case "silent from the servers":
                links.hush(up=False)
            case _:
                links.sever()

        async def undo() -> None:
            links.mend()

        return undo

    return Strike(do, deposes, ("links",))


STRIKES: Final[dict[str, Strike]] = {
    "kill the leader": kill_program(leads=True),
    "kill the standby": kill_program(leads=False),
    "kill the worker": strike_worker(signal.SIGKILL),
    "stop the leader": stop_program(leads=True),
    "stop the standby": stop_program(leads=False),
    "stop the worker": strike_worker(signal.SIGSTOP),
    "kill the log's server": strike_servers(0, kills=True),
    "kill another server": strike_servers(1, kills=True),
    "kill two servers": strike_servers(0, 1, kills=True),
    "kill all servers": strike_servers(0, 1, 2, kills=True),
    "stop the log's server": strike_servers(0, kills=False),
    "stop another server": strike_servers(1, kills=False),
    "stop two servers": strike_servers(0, 1, kills=False),
    "stop all servers": strike_servers(0, 1, 2, kills=False),
    "cut off the leader": partition("the leader", deposes=True),
    "cut off what the leader sends": partition("what the leader sends", deposes=True),
    "cut off what the leader is sent": partition("what the leader is sent", deposes=True),
    "cut off the leader with one server": partition("the leader with one server", deposes=True),
    "cut off the standby with one server": partition("the standby with one server", deposes=False),
    "cut off the log's server": partition("the log's server", deposes=False),
    "cut off what the log's server sends": partition("what the log's server sends", deposes=False),
    "cut off the log's server again and again": partition("again and again", deposes=False),
    "fill the disk of the log's server": fill_disks(0),
    "fill the disk of another server": fill_disks(1),
    "fill all disks": fill_disks(0, 1, 2),
    "slow down the disk of the log's server": Strike(slow_disk, False, ("network",)),
    "have the next leader see another time": Strike(skew, True),
    "have links be late": slow_links("late"),
    "have links be unsteady": slow_links("unsteady"),
    "have links be narrow": slow_links("narrow"),
    "have links be silent": slow_links("silent"),
    "have links be silent to the servers": slow_links("silent to the servers"),
    "have links be silent from the servers": slow_links("silent from the servers"),
    "break links": slow_links("broken"),
}
MOMENTS: Final = ("in calm", "at a takeover", "at a snapshot", "at a base", "at a start")


@dataclass(frozen=True)
class Fault:
    """A strike at a moment."""

    moment: str
    strike: str

    def __str__(self) -> str:
        return f"{self.strike} {self.moment}"


async def commit(fleet: FleetOfMachines, fault: Fault) -> None:
    """Have the fault happen, undo it, and wait until the fleet goes on."""
    strike = STRIKES[fault.strike]
    leader = await _moment(fleet, fault.moment)
    undo = await strike.do(fleet, leader)
    try:
        if strike.deposes:
            await fleet.complete()
            await fleet.clients.progress(ANSWERS, beside=leader)
        else:
            await asyncio.sleep(fleet.draws.uniform(*WAKES))  # How long it lasts; nothing is waited for.
    finally:
        await undo()
    fleet.clients.size = 0
    await fleet.complete()
    await fleet.clients.progress(ANSWERS)


async def _moment(fleet: FleetOfMachines, moment: str) -> int:
    """Wait for the moment; return the program that leads, or is about to."""
    leader = fleet.clients.leader
    match moment:
        case "in calm":
            return leader
        case "at a takeover":
            next_one = fleet.other(leader)
            await fleet.end(leader)
            await fleet.complete()
            await fleet.record("epoch")
            return next_one
        case "at a snapshot" | "at a base":
            fleet.clients.size = LARGE
            await fleet.record("cut" if moment == "at a snapshot" else "base")
            return leader
        case _:
            for pid in [*fleet.places]:
                await fleet.end(pid)
            await fleet.complete()
            await asyncio.sleep(fleet.draws.uniform(0.0, 4.0))  # Programs start, and the old lease ends meanwhile.
            return next(iter(fleet.places))
