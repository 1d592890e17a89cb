"""What a recorded actor asks of one that is not, when the root was started again and that one comes later."""

from __future__ import annotations

import holdfast as hf
from holdfast.testing import GuardedSystem, Simulation, advance, simulate

TOLD = 3


class Go(hf.Message): ...


class Fetch(hf.Message[int]): ...


class Said(hf.Message[list[str]]): ...


class Plain(hf.Actor):
    @hf.on(Fetch)
    def fetch(self, message: Fetch) -> int:
        return 1


class Asker(hf.Actor):
    def __init__(self) -> None:
        self.said: list[str] = []

    @hf.on(Go)
    async def go(self, message: Go) -> None:
        plain = self.ctx.find("/app/plain", Plain)
        try:
            self.said.append(str(await plain.ask(Fetch(), timeout=30.0)))
        except hf.HoldfastError as error:
            self.said.append(f"{type(error).__name__}: {error}")

    @hf.on(Said, readonly=True)
    def read(self, message: Said) -> list[str]:
        return list(self.said)


ASKER = hf.child("asker", hf.start(Asker), recovery=hf.hybrid())
PLAIN = hf.child("plain", hf.start(Plain))


def test_what_was_told_before_the_restart_asks_whoever_is_started_later() -> None:
    @simulate(seeds=20, store="simulated")
    async def run(system: GuardedSystem, simulation: Simulation) -> None:
        asker = await system.start(ASKER)
        await system.start(PLAIN)
        for _ in range(TOLD):
            asker.tell(Go())
        await simulation.moment(12)
        system = await simulation.crash_root()
        asker = await system.start(ASKER)
        await advance(3.0)  # A program may take its time between two of its children.
        await system.start(PLAIN)
        await advance(40.0)
        said = await asker.ask(Said())
        lost = [one for one in said if one != "1"]
        why = "the program was started again since, and what it had in hand was not recorded"
        assert lost in ([], [f"AskTimeout: /app/plain did not reply ({why}); it may have been handled"])

    run()


def test_if_nobody_comes_the_time_of_the_ask_runs_out() -> None:
    @simulate(seed=0, store="simulated")
    async def run(system: GuardedSystem, simulation: Simulation) -> None:
        asker = await system.start(ASKER)
        asker.tell(Go())
        system = await simulation.crash_root()
        asker = await system.start(ASKER)
        await advance(20.0)
        await advance(40.0)
        said = await asker.ask(Said())
        assert said in ([], ["AskTimeout: /app/plain did not reply within 30 s; it was not handled"])

    run()
