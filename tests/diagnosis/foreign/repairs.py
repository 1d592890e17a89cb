"""What repair does to systems that know nothing of it: the same faults and traffic with repair off and on.

    python -m tests.diagnosis.foreign.repairs 3

runs three rounds over all faults and traffics and prints what they cost. A fault is of the life in which it begins,
so that a restart mends it, or for good. An outage is the time in which nothing comes out of a system at a place where
something came out before: what is longer than the longest pause before the fault, by a half and half a second more.
"""

from __future__ import annotations

import argparse
import asyncio
import dataclasses
import itertools
import statistics
import sys
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import holdfast as hf
from holdfast import diagnosis
from holdfast.diagnosis.repair import ActionBegan, Caution, GaveUp, Policy, Stance
from tests.diagnosis.foreign.systems import SYSTEMS, Faults
from tests.diagnosis.foreign.trials import CHANGED, TRAFFICS, WARM, in_its_own_loop, under_traffic

WATCHED = 60.0
"""Seconds for which a system is looked at after a fault."""
LONGER = 2.0
"""Seconds by which no outage may be longer with repair than without."""


@dataclasses.dataclass(frozen=True)
class RepairCost:
    """What a fault cost: seconds of outage, who was restarted by repair and when, and whether it gave up."""

    outage: float
    acted: tuple[tuple[str, float], ...]
    gave_up: bool


class RepairWitness(hf.Actor):
    """Notes what repair does, with its time."""

    def __init__(self, acted: list[tuple[str, float]], gave_up: list[GaveUp]) -> None:
        self._acted, self._gave_up = acted, gave_up

    def on_start(self, restored: bool) -> None:
        self.ctx.subscribe("/repair")

    @hf.on(ActionBegan)
    def _began(self, message: ActionBegan) -> None:
        now = asyncio.get_running_loop().time()
        self._acted.append((message.step.args[0].rpartition("/")[2], now))

    @hf.on(GaveUp)
    def _ended(self, message: GaveUp) -> None:
        self._gave_up.append(message)

    @hf.on(hf.Message)
    def _other(self, message: hf.Message) -> None:
        pass


@dataclasses.dataclass(frozen=True)
class RepairTrial:
    """Who is struck by what under which traffic, and for how long."""

    foreign: str
    fault: tuple[str, str]
    kind: str
    is_of_a_life: bool
    seed: int = 0


@dataclasses.dataclass(frozen=True)
class Haste:
    """Seconds of silence that are never too long, and for which a suspicion must stand before repair acts."""

    window: float = 2.0
    confirm: float = 1.0


async def cost(case: RepairTrial, stance: Stance, haste: Haste) -> RepairCost:
    """Let a system run under traffic, strike one of its actors, and look at what comes out for a minute."""
    (foreign,) = (one for one in SYSTEMS if one.name == case.foreign)
    loop = asyncio.get_running_loop()
    outputs = defaultdict[str, list[float]](list)
    faults = Faults(is_of_a_life=case.is_of_a_life, came_out=lambda name: outputs[name].append(loop.time()))
    acted, gave_up = list[tuple[str, float]](), list[GaveUp]()
    async with under_traffic(foreign, faults, case.kind, case.seed) as system:
        system.spawn(hf.start(RepairWitness, acted, gave_up))
        policy = Policy(caution=Caution(confirm=haste.confirm))
        await diagnosis.watch(system, seconds=3.0, repair=stance, policy=policy, window=haste.window)
        await asyncio.sleep(WARM + CHANGED)
        began = loop.time()
        faults.of |= dict([case.fault])
        await asyncio.sleep(WATCHED)
        end = loop.time()
    outage = 0.0
    for moments in outputs.values():
        usual = [began - CHANGED, *(when for when in moments if began - CHANGED < when < began), began]
        most = 1.5 * max(_gaps(usual)) + 0.5
        later = [began, *(when for when in moments if began < when < end), end]
        outage = max(outage, sum(gap for gap in _gaps(later) if gap > most))
    return RepairCost(outage, tuple((who, when - began) for who, when in acted), bool(gave_up))


def _gaps(moments: list[float]) -> list[float]:
    return [later - earlier for earlier, later in itertools.pairwise(moments)]


@dataclasses.dataclass(frozen=True)
class OffAndOn:
    """The same fault and seed with repair off and on."""

    case: RepairTrial
    off: RepairCost
    on: RepairCost

    @property
    def longer(self) -> float:
        """Seconds by which the outage is longer with repair."""
        return self.on.outage - self.off.outage

    @property
    def wrong(self) -> list[tuple[str, float]]:
        """Actions of repair on somebody else than who is faulty."""
        return [one for one in self.on.acted if one[0] != self.case.fault[0]]

    @property
    def after(self) -> float | None:
        """Seconds from the fault to the first action on who is faulty; None: there was none."""
        return next((when for who, when in self.on.acted if who == self.case.fault[0]), None)


def off_and_on(case: RepairTrial, haste: Haste = Haste()) -> OffAndOn:
    """Run a fault with repair off and with repair on."""
    stances: tuple[Stance, Stance] = ("off", "on")
    off, on = (in_its_own_loop(cost(case, stance, haste)) for stance in stances)
    return OffAndOn(case, off, on)


ALL_TRIALS = [
    RepairTrial(foreign.name, fault, kind, is_of_a_life)
    for foreign in SYSTEMS
    for fault in foreign.faults
    for kind in TRAFFICS
    for is_of_a_life in (True, False)
]


def main(arguments: list[str] | None = None) -> int:
    """Run the rounds that were asked for, and print what they cost. Returns the exit status."""
    parser = argparse.ArgumentParser(description="faults of foreign systems with repair off and on")
    parser.add_argument("rounds", type=int)
    parser.add_argument("--every", type=int, default=1, help="only one case in so many")
    parser.add_argument("--first", type=int, default=0, help="the first case of these")
    parser.add_argument("--jobs", type=int, default=2, help="processes at a time")
    parser.add_argument("--window", type=float, default=Haste.window, help="seconds of silence that are never too long")
    parser.add_argument("--confirm", type=float, default=Haste.confirm, help="seconds for which a suspicion must stand")
    options = parser.parse_args(arguments)
    haste = Haste(options.window, options.confirm)
    pairs: list[OffAndOn] = []
    with ProcessPoolExecutor(options.jobs, get_context("spawn")) as pool:
        running = [
            pool.submit(off_and_on, dataclasses.replace(case, seed=seed), haste)
            for seed in range(options.rounds)
            for case in ALL_TRIALS[options.first :: options.every]
        ]
        for done in running:
            pair = done.result()
            pairs.append(pair)
            if pair.longer > 0.5 or pair.wrong:
                print(f"longer by {pair.longer:.1f} s:" if pair.longer > 0.5 else "wrong:", pair, flush=True)
    return say(pairs)


def say(pairs: list[OffAndOn]) -> int:
    """Print what these runs cost. Returns 1 if repair was worse than none."""
    actions = sum(len(pair.on.acted) for pair in pairs)
    wrong = sum(len(pair.wrong) for pair in pairs)
    longer = [pair.longer for pair in pairs if pair.longer > 0.5]
    after = [pair.after for pair in pairs if pair.after is not None]
    print(
        f"{len(pairs)} faults: {len(longer)} with an outage that repair made longer (at most by "
        f"{max(longer, default=0.0):.1f} s), {actions} actions, {wrong} of them wrong; from fault to repair "
        f"{statistics.median(after):.1f} s in the median"
    )
    by_kind = defaultdict[tuple[bool, str], list[OffAndOn]](list)
    for pair in pairs:
        by_kind[not pair.case.is_of_a_life, pair.case.fault[1]].append(pair)
    for (is_for_good, kind), chosen in sorted(by_kind.items()):
        off, on = (statistics.fmean(getattr(one, side).outage for one in chosen) for side in ("off", "on"))
        times = sorted(one.after for one in chosen if one.after is not None)
        print(
            f"{kind + (' for good' if is_for_good else ''):<20}{len(chosen):>4} faults, outage {off:5.1f} s off, "
            f"{on:5.1f} s on, {sum(len(one.on.acted) for one in chosen)} actions on {len(times)}"
            + (f", after {times[0]:.1f} to {times[-1]:.1f} s" if times else "")
            + f", given up {sum(one.on.gave_up for one in chosen)}"
        )
    return 1 if wrong > actions / 100 or len(longer) > len(pairs) / 100 or max(longer, default=0.0) > LONGER else 0


if __name__ == "__main__":
    sys.exit(main())
