"""A system with its dashboard, in a process of its own, which does as it is told on its standard input."""

from __future__ import annotations

import asyncio
import sys

import holdfast as hf
from holdfast.console.dashboard import dashboard, open_dashboard
from holdfast.diagnosis import watch
from tests.console.dashboard.ailing import EVIL_NAME, Leaf, Work, Worker

OPERATORS, READERS = "operators-token-0123456789", "readers-token-0123456789"


def plan(leaves: int) -> list[hf.ChildSpec]:
    """The tree: a shop with ill actors, and if there are leaves a protected actor and a crowd of well ones."""
    shop = [
        hf.child("bank", hf.start(Worker), shutdown=0.2),
        hf.child("till", hf.start(Worker), bindings={"bank": "/app/shop/bank"}, shutdown=0.2),
        hf.child("clerk", hf.start(Worker), shutdown=0.2),
        hf.child("ledger", hf.start(Worker), recovery=hf.hybrid()),
        hf.child("fragile", hf.start(Worker), isolation="process", recovery=hf.hybrid(max_deliveries=1)),
    ]
    groups = [
        hf.supervisor(f"group{at}", children=[hf.child(f"leaf{n}", hf.start(Leaf)) for n in range(99)])
        for at in range(leaves // 100)
    ]
    ill = hf.supervisor("shop", intensity=50, period=60.0, children=shop)
    if not leaves:
        return [ill]
    return [
        ill,
        hf.child("safe", hf.start(Worker), mechanism=hf.ftm.PBR()),
        hf.supervisor("crowd", children=groups),
    ]


async def main(leaves: int, with_diagnosis: bool) -> None:
    """Serve, and do each line: `ADDRESS WHAT` sends that."""
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        for spec in plan(leaves):
            await system.start(spec)
        if with_diagnosis:
            await watch(system, repair="ask", seconds=1.0, hung_after=1.0)
        else:
            async with system.transaction() as change:
                change.add("/app/shop", hf.child(EVIL_NAME, hf.start(Worker)))
        app = dashboard(system, operators=OPERATORS, readers=READERS)
        async with open_dashboard(app) as url:
            print(url, flush=True)
            while line := (await asyncio.to_thread(sys.stdin.readline)).strip():
                path, _, what = line.rpartition(" ")
                system.ref(path, Worker).tell(Work(what))


if __name__ == "__main__":
    asyncio.run(main(int(sys.argv[1]), "diagnosis" in sys.argv))
