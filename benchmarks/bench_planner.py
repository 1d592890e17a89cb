"""How long until there is a plan, when a thousand components have failed at once?

Absolute figures, the best of five: from the problem to the checked plan, asked for from the event loop as repair does.
"again": the grounding is kept, as between two plans for the same system; "first": it is not.
Command: python benchmarks/bench_planner.py [--quick]
"""

from __future__ import annotations

import asyncio
import gc
import time

from harness import Run, main

from holdfast.diagnosis.planning import ClingoPlanner, Plan, Problem, find_plan, repair_domain, repair_problem

FAULTY = 1000
LIMIT = 0.3


def failed(count: int, *, hung: bool) -> Problem:
    """All hardware off, a third of the components; all nodes down, or up and hung; a third of them drives a device."""
    hardware = [f"h{i}" for i in range(count // 3)]
    nodes = [f"n{i}" for i in range(count - count // 3)]
    return repair_problem(
        repair_domain(),
        hardware=hardware,
        nodes=nodes,
        drives={f"n{i}": [name] for i, name in enumerate(hardware)},
        bad=[*hardware, *nodes],
        running=nodes if hung else (),
    )


async def seconds(planner: ClingoPlanner, count: int, *, hung: bool) -> float:
    """From the problem to the plan."""
    repair_domain()  # Its text is parsed once in a life.
    began = time.perf_counter()
    plan = await find_plan(planner, failed(count, hung=hung), timeout=60)
    elapsed = time.perf_counter() - began
    assert isinstance(plan, Plan)
    assert plan.is_optimal
    assert len(plan.stages) == 2
    assert plan.cost == count + (count - count // 3) * hung
    return elapsed


async def planner(run: Run) -> None:
    count = run.size(FAULTY)
    for hung in (False, True):
        state = "hung" if hung else "down"
        kept = ClingoPlanner()
        first = min([await seconds(ClingoPlanner(), count, hung=hung) for _ in range(run.n)])
        await seconds(kept, count, hung=hung)
        again = min([await seconds(kept, count, hung=hung) for _ in range(run.n)])
        run.bound(f"plan for {count:,} faulty components, nodes {state}, first", first, unit="s", target=LIMIT)
        run.bound(f"plan for {count:,} faulty components, nodes {state}, again", again, unit="s", target=LIMIT)


async def lag(run: Run) -> None:
    count = run.size(FAULTY)
    planner = ClingoPlanner()
    await seconds(planner, count, hung=True)
    gc.collect()
    gc.freeze()  # As in bench_ftm.py: a full collection stops the loop for longer than all else.
    worst, is_over = 0.0, False

    async def watch() -> None:
        nonlocal worst
        while not is_over:
            began = time.perf_counter()
            await asyncio.sleep(0.001)
            worst = max(worst, time.perf_counter() - began - 0.001)

    watching = asyncio.create_task(watch())
    problem = failed(count, hung=True)
    await asyncio.sleep(0.01)
    worst = 0.0
    await find_plan(planner, problem, timeout=60)
    is_over = True
    await watching
    run.bound(f"loop lag while a plan for {count:,} is made", worst * 1e3, unit="ms", target=10)


if __name__ == "__main__":
    main([planner, lag])
