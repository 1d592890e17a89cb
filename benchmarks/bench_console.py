"""How long does an operator wait for a running system?

For one actor while the system is saturated, for a tree of 10,000, and for either while another operator adds 1,000.
Baseline: the same with the system idle, and for the others none. Each client is a process of its own.
Command: python benchmarks/bench_console.py [--quick]
"""

from __future__ import annotations

import asyncio
import gc
import json
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from bench_lag import RELAYS, TOKEN, TOKENS, Join, Relay
from harness import Run, main

import holdfast as hf
from holdfast.console.endpoint import control_endpoint
from holdfast.console.remote import RemoteSystem

ACTORS = 10_000
CHANGED = 1_000
"""Children that are added by one transaction."""


class Idle(hf.Actor):
    """Is there."""


def client(socket: str, requests: int) -> None:
    """The other process: prints the 99th percentile of a request about one actor, and the best of three whole trees."""
    with RemoteSystem(socket) as remote:
        taken: list[float] = []
        for _ in range(requests):
            began = time.perf_counter()
            remote.inspect("/bench")
            taken.append(time.perf_counter() - began)
        trees: list[float] = []
        for _ in range(3):
            began = time.perf_counter()
            remote.look()
            trees.append(time.perf_counter() - began)
    print(json.dumps({"p99": sorted(taken)[int(requests * 0.99)] * 1e3, "tree": min(trees)}))


def reader(socket: str) -> None:
    """Asks for the tree and for one actor in turn, until its input ends: prints when each began and what it took."""
    found: list[tuple[str, float, float]] = []
    is_over = threading.Event()

    def wait() -> None:
        sys.stdin.read()
        is_over.set()

    threading.Thread(target=wait, daemon=True).start()
    with RemoteSystem(socket) as remote:
        print("ready", flush=True)
        while not is_over.is_set():
            for what, ask in (("tree", remote.tree), ("inspect", lambda: remote.inspect("/bench/many"))):
                began = time.monotonic()
                ask()
                found.append((what, began, time.monotonic() - began))
    print(json.dumps(found))


def changer(socket: str, count: int) -> None:
    """Adds children by one transaction: prints when it was sent, and when it was over."""

    async def change(remote: RemoteSystem) -> list[float]:
        async with remote.transaction(timeout=60.0) as change:
            for number in range(count):
                change.add("/bench/many", hf.child(f"n{number}", hf.start(Idle)))
            began = time.monotonic()
        return [began, time.monotonic()]

    with RemoteSystem(socket) as remote:
        print(json.dumps(asyncio.run(change(remote))))


async def asked(socket: Path, requests: int) -> dict[str, float]:
    """What the client has measured."""
    process = await asyncio.create_subprocess_exec(
        sys.executable, __file__, "client", str(socket), str(requests), stdout=subprocess.PIPE
    )
    output, _ = await process.communicate()
    found: dict[str, float] = json.loads(output)
    return found


@asynccontextmanager
async def served() -> AsyncGenerator[tuple[hf.ActorSystem, Path]]:
    """A system with its endpoint."""
    with tempfile.TemporaryDirectory() as folder:
        async with hf.ActorSystem("bench", log=False) as system, control_endpoint(system, f"{folder}/s") as socket:
            yield system, socket


async def saturated(run: Run) -> None:
    requests = 200 if run.quick else 1000

    async def busy() -> float:
        async with served() as (system, socket):
            refs: list[Any] = [system.spawn(hf.start(Relay)) for _ in range(RELAYS)]
            for ref, neighbour in zip(refs, refs[1:] + refs[:1], strict=True):
                ref.tell(Join(neighbour))
            for number in range(TOKENS):
                refs[number % RELAYS].tell(TOKEN)
            return (await asked(socket, requests))["p99"]

    async def idle() -> float:
        async with served() as (_, socket):
            return (await asked(socket, requests))["p99"]

    await run.added("p99 added to a request by a saturated system", busy, idle, unit="ms", target=20.0)


async def tree(run: Run) -> None:
    async def whole() -> float:
        async with served() as (system, socket):
            children = [hf.child(f"n{number}", hf.start(Idle)) for number in range(ACTORS)]
            await system.start(hf.supervisor("many", children=children))
            return (await asked(socket, 1))["tree"]

    async def none() -> float:
        return 0.0

    await run.added(f"a tree of {ACTORS:,} actors with their statuses", whole, none, unit="s", target=1.0)


async def changing(run: Run) -> None:
    taken: dict[str, list[float]] = {"tree": [], "inspect": []}
    for _ in range(2 if run.quick else 10):
        async with served() as (system, socket):
            await system.start(hf.supervisor("many", children=[]))
            arguments = (sys.executable, __file__, "reader", str(socket))
            reads = await asyncio.create_subprocess_exec(*arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
            assert reads.stdout is not None
            await reads.stdout.readline()
            changes = await asyncio.create_subprocess_exec(
                *(sys.executable, __file__, "changer", str(socket), str(CHANGED)), stdout=subprocess.PIPE
            )
            begun, over = json.loads((await changes.communicate())[0])
            found: list[tuple[str, float, float]] = json.loads((await reads.communicate(b""))[0])
            for what, began, seconds in found:
                if began < over and began + seconds > begun:
                    taken[what].append(seconds)
    for what, values in taken.items():
        p99 = sorted(values)[int(len(values) * 0.99)] * 1e3
        run.bound(f"p99 of {what} while {CHANGED:,} children are added", p99, unit="ms", target=20.0)


class Pay(hf.Message[int]):
    """Count one more."""


class Account(hf.Actor):
    """Counts."""

    def __init__(self) -> None:
        self.total = 0

    @hf.on(Pay)
    def pay(self, message: Pay) -> int:
        self.total += 1
        return self.total


class Clerk(hf.Actor):
    """Has the account count that it is bound to."""

    account: hf.Binding[Account]

    @hf.on(Pay)
    async def pay(self, message: Pay) -> int:
        return await self.account.ask(Pay())


PAIRS = 25
"""Clerks, each with an account; a transaction has four operations for each of them."""
ASKERS = 4
"""Of each clerk, each with one ask outstanding: nothing is ever idle."""


async def loaded(run: Run) -> None:
    """A hundred operations, again and again, while 100 askers have clerks ask accounts as fast as they can."""
    rounds = 5 if run.quick else 40
    taken: list[float] = []  # by the asks that were out lately
    p99: tuple[list[float], list[float]] = [], []  # of each round: without a change, and with one
    async with hf.ActorSystem("bench", log=False) as system:
        accounts = await system.start(hf.supervisor("accounts", children=[]))
        desk = await system.start(hf.supervisor("clerks", children=[]))
        clerks: list[hf.ActorRef[Clerk]] = []
        for number in range(PAIRS):
            await accounts.ask(hf.StartChild(hf.child(f"a0-{number}", hf.start(Account))))
            bound = {"account": f"/bench/accounts/a0-{number}"}
            clerks.append(await desk.ask(hf.StartChild(hf.child(f"c{number}", hf.start(Clerk), bindings=bound))))
        is_over = False

        async def ask(clerk: hf.ActorRef[Clerk]) -> None:
            while not is_over:
                began = time.perf_counter()
                await clerk.ask(Pay(), timeout=60.0)  # An ask that is lost ends the benchmark.
                taken.append(time.perf_counter() - began)

        def note(values: list[float]) -> None:
            values.append(sorted(taken)[int(len(taken) * 0.99)] * 1e3)
            taken.clear()

        async with asyncio.TaskGroup() as askers:
            for clerk in clerks * ASKERS:
                askers.create_task(ask(clerk))
            for turn in range(rounds):
                gc.collect()
                await asyncio.sleep(0.1)
                taken.clear()
                await asyncio.sleep(0.1)
                note(p99[0])
                async with system.transaction(timeout=60.0) as change:
                    for number, clerk in enumerate(clerks):
                        new = change.add("/bench/accounts", hf.child(f"a{turn + 1}-{number}", hf.start(Account)))
                        change.bind(clerk, "account", new)
                        change.respecify(clerk, shutdown=float(5 + turn % 2))
                        change.remove(f"/bench/accounts/a{turn}-{number}")
                assert len(change.operations) == 4 * PAIRS
                await asyncio.sleep(0.01)  # Also asks that were out at its end are.
                note(p99[1])
            is_over = True
    quiet, busy = map(statistics.median, p99)
    run.bound(
        "p99 added to asks by a change of 100 operations under full load, 0 lost", busy - quiet, unit="ms", target=10.0
    )


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["client", where, requests]:
            client(where, int(requests))
        case ["reader", where]:
            reader(where)
        case ["changer", where, count]:
            changer(where, int(count))
        case _:
            main([saturated, tree, changing, loaded])
