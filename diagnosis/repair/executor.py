"""Executes a plan, and checks that its effects come about.

The steps of a stage are done at the same time. Before each its precondition is checked against what is observed now;
after it, its effects are waited for in the observations (T60). A step that fails takes with it those that need it, and
no others; whoever gave the plan then sees from the next diagnosis what is left to do.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import math
from collections.abc import Callable
from typing import Final, Protocol

from ...supervision.arbiter import Arbiter, Grant, GrantLost, Hand, InOtherHands, on_errand
from ..literals import Literal
from ..planning import Plan, Problem, Simulator, Step
from ..planning.language import Atom
from ..planning.language import PlanLiteral as Effect
from .actions import Act, RepairAction, Undo

DONE: Final = "done"
FAILED: Final = "failed"
UNVERIFIED: Final = "unverified"
SKIPPED: Final = "skipped"
LOST: Final = "lost"


@dataclasses.dataclass(frozen=True, slots=True)
class Result:
    """What became of a step: `outcome` is one of the words above."""

    step: Step
    outcome: str
    why: str = ""
    undo: Undo | None = None


class RepairWorld(Protocol):
    """What an executor sees and tells; the repairer is it."""

    def now(self) -> float:
        """Seconds on the loop clock."""
        ...

    def seen(self, atom: Literal) -> tuple[bool | None, float]:
        """Whether an atom holds, None if that is not known; and when it was last observed, -inf: never."""
        ...

    async def changed(self) -> None:
        """Return when something is observed, or a diagnosis comes."""
        ...

    def overtaken(self, step: Step) -> str:
        """Why the step is not to be done any more; empty if it is."""
        ...

    async def began(self, step: Step, epoch: int) -> None:
        """Note and tell that a step begins."""
        ...

    async def ended(self, result: Result) -> None:
        """Note and tell that a step has ended."""
        ...


class Executor:
    """Carries out one plan.

    Args:
        world: what is seen.
        arbiter: is asked for each actor before it is touched.
        address: of a step: what it acts on.
        actions: by name.
        make: the execution that a coroutine is given.
        reason: why, in words.
    """

    def __init__(
        self,
        world: RepairWorld,
        arbiter: Arbiter,
        *,
        address: Callable[[Step], str],
        actions: Callable[[str], RepairAction],
        make: Callable[[Step, int, str, Callable[[], None]], Act],
        reason: str,
    ) -> None:
        self._world, self._arbiter, self._address, self._actions = world, arbiter, address, actions
        self._make, self._reason = make, reason
        self._put: dict[Atom, float] = {}

    async def execute(self, problem: Problem, plan: Plan) -> list[Result]:
        """Do the plan's stages one after another; all that became of its steps."""
        self._simulator = Simulator(problem)
        results: list[Result] = []
        for stage in plan.stages:
            effects = {step: self._simulator.effects(step) for step in stage}
            async with asyncio.TaskGroup() as group:
                tasks = [group.create_task(self._step(step, effects[step])) for step in stage]
            done = [task.result() for task in tasks]
            results += done
            for result in done:
                if result.outcome == DONE:  # Who needs what another one was to bring about is left out, and says so.
                    self._simulator.put(effects[result.step])
                    self._put |= {effect.atom: self._world.now() for effect in effects[result.step]}
        return results

    async def _step(self, step: Step, effects: list[Effect]) -> Result:
        result = await self._tried(step, effects)
        await self._world.ended(result)
        return result

    async def _tried(self, step: Step, effects: list[Effect]) -> Result:
        if why := self._missing(step):
            return Result(step, SKIPPED, why)
        return await self._granted(step, self._actions(step.action), effects)

    async def _granted(self, step: Step, action: RepairAction, effects: list[Effect]) -> Result:
        """With the actor in our hands; if somebody else takes it, the action is cancelled at once."""
        work: asyncio.Task[Result] | None = None
        taken = list[str]()

        def lost(reason: str) -> None:
            taken.append(reason)
            if work is not None:
                work.cancel()

        try:
            grant = self._arbiter.claim(self._address(step), Hand.REPAIR, self._reason, lost=lost, errand=taken)
        except InOtherHands as error:
            return Result(step, SKIPPED, str(error))
        try:
            work = asyncio.create_task(self._carried_out(step, action, effects, grant), name=f"repair: {step}")
            return await work
        except asyncio.CancelledError:
            task = asyncio.current_task()
            if taken and not (task is not None and task.cancelling()):
                return Result(step, LOST, taken[0])
            raise
        finally:
            self._arbiter.release(grant)

    async def _carried_out(self, step: Step, action: RepairAction, effects: list[Effect], grant: Grant) -> Result:
        before = {effect: self._world.seen(_observable(effect))[0] for effect in effects}
        await self._world.began(step, grant.epoch)
        started = self._world.now()
        on_errand.set(grant.errand)  # What the action has done by others, such as a transaction, is ours too.
        act = self._make(step, grant.epoch, self._reason, lambda: self._arbiter.check(grant))
        scope = asyncio.timeout(action.timeout)
        try:
            async with scope:
                undo = await action.run(act, *step.args)
        except GrantLost as error:
            return Result(step, LOST, str(error))
        except InOtherHands as error:  # Whoever has it in another process says so himself.
            return Result(step, SKIPPED, str(error))
        except Exception as error:  # Whatever a user's action raises is told, and counts as an attempt.
            if scope.expired() and isinstance(error, TimeoutError):
                return Result(step, FAILED, f"it did not return within {action.timeout:g} s")
            return Result(step, FAILED, f"{type(error).__name__}: {error}")
        ended = self._world.now()
        # What looked so before as well has to be seen anew: an old word says nothing of what was done since.
        since = {effect: ended if before[effect] is effect.value else started for effect in effects}
        unseen = await self._verified(since, ended + action.effect_timeout)
        if unseen is not None:
            return Result(step, UNVERIFIED, f"{unseen} was not observed within {action.effect_timeout:g} s", undo)
        return Result(step, DONE, undo=undo)

    async def _verified(self, since: dict[Effect, float], deadline: float) -> Effect | None:
        """Wait until all effects are observed; the first that is not in time. What nobody observes is believed."""
        while True:
            unseen = next((effect for effect, when in since.items() if not self._is_seen(effect, when)), None)
            left = deadline - self._world.now()
            if unseen is None or left <= 0:
                return unseen
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(left):
                    await self._world.changed()

    def _is_seen(self, effect: Effect, since: float) -> bool:
        value, when = self._world.seen(_observable(effect))
        return when == -math.inf or (value is effect.value and when >= since)

    def _missing(self, step: Step) -> str:
        """Why the step cannot or must not be done now: as the world is seen, and as the plan has made it."""
        if why := self._world.overtaken(step):
            return why
        for atom in self._simulator.reads(step):
            value, when = self._world.seen(_observable(Effect(atom)))
            if value is not None and when >= self._put.get(atom, -math.inf):
                self._simulator.put([Effect(atom, value)])
        return self._simulator.missing(step)


def _observable(effect: Effect) -> Literal:
    return Literal(effect.atom[0], effect.atom[1:])
