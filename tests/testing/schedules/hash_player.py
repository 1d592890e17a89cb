"""A simulated run of much of the library; prints its turns. What another order of sets would change shows there."""

from __future__ import annotations

import asyncio
from typing import Any

import holdfast as hf
from holdfast.testing import GuardedSystem, Simulation, idle
from holdfast.testing.simulation import run_seed
from tests.testing.fleet.locks import two_hold_one_lock


class Add(hf.Message[int]):
    number: int


class News(hf.Message):
    text: str


class Cell(hf.Actor):
    def __init__(self, peers: tuple[str, ...] = ()) -> None:
        self.total, self.peers = 0, peers

    def on_start(self, restored: bool) -> None:
        self.ctx.subscribe("/news")
        self.ctx.trap_exits = True

    @hf.on(Add)
    def add(self, message: Add) -> int:
        if message.number < 0:
            raise ValueError("negative")
        self.total += message.number
        return self.total

    @hf.on(News)
    def hear(self, message: News) -> None:
        self.total += len(message.text)


NAMES = ("anna", "bert", "carl", "dora", "emil", "fritz")


async def lives(system: GuardedSystem, simulation: Simulation) -> None:
    system.expect_crashes()
    system.expect_dead_letters()
    options: dict[str, dict[str, Any]] = {
        "anna": {},
        "bert": {"recovery": hf.hybrid(interval=2)},
        "carl": {"isolation": "process"},
        "dora": {"isolation": "process", "recovery": hf.hybrid()},
        "emil": {"mechanism": hf.ftm.PBR()},
        "fritz": {"recovery": hf.hybrid(durability="os")},
    }
    children = [hf.child(name, hf.start(Cell), **options[name]) for name in NAMES]
    await system.start(hf.supervisor("top", children=children, strategy="one_for_all", intensity=50))
    await system.start(
        hf.supervisor(
            "below", isolation="process", intensity=50, children=[hf.child(name, hf.start(Cell)) for name in NAMES]
        )
    )
    refs = [system.ref(f"/app/{top}/{name}", Cell) for top in ("top", "below") for name in NAMES]
    asks = [ref.ask(Add(1)) for ref in refs for _ in range(2)]
    await asyncio.gather(*asks)
    await system.publish("/news", News("today"))
    refs[0].tell(Add(-1))
    refs[7].tell(Add(-1))
    await asyncio.sleep(1.0)
    await system.publish("/news", News("tomorrow"))
    await idle(system)
    system = await simulation.crash_root()
    await system.start(hf.supervisor("top", children=children))
    await asyncio.gather(*(system.ref(f"/app/top/{name}", Cell).ask(Add(1)) for name in NAMES))


if __name__ == "__main__":
    for seed in range(6):
        options = {"store": "simulated", "durability": "fsync"}
        for path, what in run_seed(lives, seed, {"system", "simulation"}, options).trace:
            print(seed, path, what)
    for seed in range(3):  # In none of them the bug shows.
        for path, what in run_seed(two_hold_one_lock, seed, {"fleet", "faults"}, {}).trace:
            print(seed, path, what)
