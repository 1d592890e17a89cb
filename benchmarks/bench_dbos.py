"""How many durable workflows of one step are done in a second, beside DBOS on SQLite?

Baseline: DBOS with the same setting of SQLite's `synchronous` (NORMAL beside `durability="os"`, FULL beside `"fsync"`)
and its database in WAL mode, like ours. Its workflow is an asynchronous function that awaits one step. Ours is a
recorded turn: once with the step in its own code, which a replay makes again, and once as an effect, which it does not.
All callers wait for the result. Needs `pip install dbos`; without it nothing is measured.
Command: python benchmarks/bench_dbos.py [--quick]
"""

from __future__ import annotations

import contextlib
import functools
import tempfile
from collections.abc import AsyncGenerator, Awaitable, Callable
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from harness import Run, main, rate

import holdfast as hf

BODY = "x" * 100
CALLERS = 100
SETTINGS = {"os": "NORMAL", "fsync": "FULL"}


async def step(body: str) -> str:
    return body


class Order(hf.Message[str]):
    body: str


class Careful(Order): ...


class Desk(hf.Actor):
    """Its workflow is a turn."""

    def __init__(self) -> None:
        self.done = 0

    @hf.on(Order)
    async def order(self, message: Order) -> str:
        self.done += 1
        return await step(message.body)

    @hf.on(Careful)
    async def order_carefully(self, message: Careful) -> str:
        self.done += 1
        made: str = await self.ctx.effect(step, message.body)
        return made


@contextlib.asynccontextmanager
async def ours(folder: str, durability: Any, order: Order) -> AsyncGenerator[Callable[[], Awaitable[object]]]:
    """Calls of our workflow: one desk for each caller, since a turn has its actor to itself."""
    async with hf.ActorSystem("bench", store=f"sqlite:{folder}/ours.db", durability=durability, log=False) as system:
        desks = [
            await system.start(hf.child(f"desk{n}", hf.start(Desk), recovery=hf.hybrid(interval=1.0)))
            for n in range(CALLERS)
        ]
        free = list(desks)

        async def call() -> None:
            desk = free.pop()
            await desk.ask(order, timeout=600.0)
            free.append(desk)

        yield call


@contextlib.contextmanager
def theirs(folder: str, durability: str) -> Any:
    """Calls of their workflow."""
    dbos: Any = import_module("dbos")
    sqlalchemy: Any = import_module("sqlalchemy")
    setting = SETTINGS[durability]

    def connected(connection: Any, record: object) -> None:
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute(f"PRAGMA synchronous = {setting}")

    sqlalchemy.event.listen(sqlalchemy.Engine, "connect", connected)
    config = {"name": "bench", "system_database_url": f"sqlite:///{folder}/theirs.db", "log_level": "ERROR"}
    dbos.DBOS(config=config)
    made = dbos.DBOS.step()(step)

    async def order(body: str) -> str:
        result: str = await made(body)
        return result

    workflow = dbos.DBOS.workflow()(order)
    dbos.DBOS.launch()
    try:
        yield lambda: workflow(BODY)
    finally:
        dbos.DBOS.destroy()
        sqlalchemy.event.remove(sqlalchemy.Engine, "connect", connected)


async def workflows(run: Run) -> None:
    if find_spec("dbos") is None:
        print("dbos is not installed: nothing is measured (pip install dbos)")
        return
    for durability, setting in SETTINGS.items():
        with tempfile.TemporaryDirectory(dir=Path.cwd()) as folder, theirs(folder, durability) as their_call:
            for what, order in (("turn", Order(BODY)), ("turn with an effect", Careful(BODY))):
                async with ours(folder, durability, order) as call:
                    for callers, target, size in ((1, 20.0, 3_000), (CALLERS, 150.0, 20_000)):
                        await run.compare(
                            f"workflow of one step, a {what}, {callers} outstanding, synchronous = {setting}",
                            functools.partial(rate, call, callers, run.size(size)),
                            functools.partial(rate, their_call, callers, run.size(size // 10)),
                            unit="workflows/s",
                            target=target,
                        )


if __name__ == "__main__":
    main([workflows])
