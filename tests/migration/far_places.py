"""What tests of moves between processes share: an actor at each place, and who asks it all the while."""

from __future__ import annotations

import asyncio
import itertools
from typing import Any

import holdfast as hf
from holdfast.ftm.group.group_place import GroupPlace
from tests.migration.travellers import KINDS, TOLD, Add, Seen, Traveller

IN_TIME = 20.0
PLACES = ["task", "process", "replicas"]


def traveller(kind: str, place: str) -> hf.ChildSpec:
    more: dict[str, Any] = {} if KINDS[kind] is None else {"recovery": KINDS[kind]}
    more |= {"mechanism": hf.ftm.PBR()} if place == "replicas" else {"isolation": place}
    return hf.child("one", hf.start(Traveller), mailbox=hf.bounded(100_000), **more)


def processes(system: hf.ActorSystem, ref: Any) -> list[int]:
    """Those in which it lives."""
    place = ref._cell.host.place
    if not isinstance(place, GroupPlace) or place.group is None:
        return [system.pid_of(ref)]
    names = place.group.membership.names
    return [system.pid_of(system.ref(f"{ref.path}/ftm/{name}", hf.Actor)) for name in names]


def pid_of(system: hf.ActorSystem, supervisor: str) -> int:
    return system.pid_of(system.ref(f"/app/{supervisor}", hf.Supervisor))


class Pump:
    """Tells, and asks one after another. Each answer must be the sum of what stands before it."""

    def __init__(self, ref: Any) -> None:
        self._ref, self._is_over = ref, False
        self.answers: list[int] = []
        self._task = asyncio.create_task(self._send())

    async def _send(self) -> None:
        while not self._is_over:
            self._ref.tell(Add(TOLD + len(self.answers)))
            self.answers.append(await self._ref.ask(Add(1 + len(self.answers)), IN_TIME))

    async def reached(self, more: int) -> None:
        wanted = len(self.answers) + more
        while len(self.answers) < wanted and not self._task.done():
            await asyncio.sleep(0)

    async def judge(self) -> None:
        self._is_over = True
        await self._task
        added, count = (await self._ref.ask(Seen(), IN_TIME))["added"], len(self.answers)
        assert added == [n for number in range(count) for n in (TOLD + number, 1 + number)]
        assert self.answers == list(itertools.accumulate(added))[1::2]
