"""Testing without sleeping: a probe, a day on the virtual clock, and a bug of order that a seed finds and repeats."""

import asyncio

import holdfast as hf
from holdfast.testing import GuardedSystem, advance, idle, probe, simulate, virtual


class Beat(hf.Message): ...


class Sensor(hf.Actor):
    """Reports once a minute."""

    def __init__(self, log: hf.ActorRef) -> None:
        self.log = log

    def on_start(self, restored: bool) -> None:
        self.ctx.every(60.0, Beat())

    @hf.on(Beat)
    def beat(self, message: Beat) -> None:
        self.log.tell(message)


async def a_day() -> None:
    async with GuardedSystem() as system:
        log = probe(system)
        system.spawn(hf.start(Sensor, log.ref))
        await log.expect(Beat, timeout=3600.0)
        await advance(24 * 3600.0 - 60.0)
        print(1 + len(log.waiting), "beats")  # 1440 beats


class Go(hf.Message): ...


class Runner(hf.Actor):
    """Appends to a list that it shares with others: who is first?"""

    def __init__(self, name: str, arrived: list[str]) -> None:
        self.name, self.arrived = name, arrived

    @hf.on(Go)
    def go(self, message: Go) -> None:
        self.arrived.append(self.name)


async def race(system: GuardedSystem) -> None:
    arrived: list[str] = []
    for name in ("one", "two", "three", "four"):
        system.spawn(hf.start(Runner, name, arrived)).tell(Go())
    await idle(system)
    assert arrived[-1] != "one", "who was told first may come last"


def main() -> None:
    with asyncio.Runner(loop_factory=virtual) as runner:
        runner.run(a_day())
    try:
        simulate(race)()
    except AssertionError as error:
        print(str(error).splitlines()[0])  # who was told first may come last
        seed = int(error.__notes__[0].split(":")[0].removeprefix("seed="))
        try:
            simulate(race, seed=seed)()
        except AssertionError as again:
            print(again.__notes__ == error.__notes__)  # True


if __name__ == "__main__":
    main()
