"""Runs: a batch computed once more from the same state, by another version or another replica.

A shadow is a second life of the protected actor in a replica: what it computes is compared, and leaves only if the
replica that leads takes it over.
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

import msgspec

from ...actors.errors import HoldfastError, type_name
from ...actors.exit_reasons import SHUTDOWN, ExitReason
from ...actors.kernel import lifecycle
from ...actors.kernel.actor import Actor, Start
from ...actors.kernel.address_host import AddressHost
from ...actors.kernel.cell import Cell
from ...actors.values import decode_value, state_digest
from ...checkpoint.life.recorded_life import FED
from ...checkpoint.protocol import AWAITED, CRASH, DROPPED, FAILED, Answer, Feed, Outcome, TurnEnd
from ...supervision.spec import child
from ..replica.protected_actor import Server
from ..replica.replica_life import ServerLife
from ..votes.canonical import canonical, end_form
from ..votes.voters import Agreed, AnyVoter, Undecided, decide_by
from .brick_messages import Done, Request, ServerState, Work
from .bricks import After, Before

if TYPE_CHECKING:
    from .standing import Standing
    from .state_images import Image

MOST_INPUTS: Final = 4096
"""Requests that are remembered: more than can be inside a replica."""


class Run(msgspec.Struct):
    """What requests have come to: how turns ended, with all that they have sent, and the state they have left."""

    ends: list[TurnEnd]
    state: ServerState | None
    digest: bytes = b""  # of the state, where that has stayed where it is
    objections: list[tuple[int, str]] = []

    @property
    def objection(self) -> str:
        """What is against it; "" if nothing."""
        return "; ".join(dict.fromkeys(why for _, why in self.objections))


class Missing(msgspec.Struct):
    """Instead of a run: nobody has computed it, or it came to no end."""

    why: str


def compared_body(answer: Answer) -> bytes:
    """What counts of the body of an answer: a traceback tells where it stood, which is no difference between runs."""
    return b"" if answer.kind == CRASH else answer.body


def sent_by(run: Run) -> dict[int, list[int]]:
    """Digests of all that each turn of a run has sent, in order; of one that has failed, that is not known."""
    return {end.turn: [out.digest() for out in end.outs] for end in run.ends if end.status != FAILED}


def plain(run: Run, *, with_state: bool = True) -> tuple[Any, ...]:
    """What two runs have to have in common to be equal, as it is: cheap to compare."""
    ends = [
        (
            end.id,
            end.turn,
            end.status,
            end.answer.kind,
            end.answer.name,
            compared_body(end.answer),
            tuple(out.digest() for out in end.outs),
        )
        for end in run.ends
    ]
    if not with_state:
        return (ends,)
    if run.state is None:
        return ends, run.digest
    state = run.state
    return ends, state.turn, state.data, state.deltas, _aside(state)


def form(run: Run, *, with_state: bool = True) -> Any:
    """The canonical form of a run: ("run", ends, state)."""
    ends = ("list", *(end_form(end, with_state=False) for end in run.ends))
    if not with_state:
        return ("run", ends, "")
    return ("run", ends, run.digest if run.state is None else state_form(run.state))


def state_form(state: ServerState) -> Any:
    """The canonical form of a state."""
    saved = state.data.value()
    aside = canonical(_aside(state))
    return ("state", f"{state.turn}", canonical(saved), canonical(list(map(decode_value, state.deltas))), aside)


def _aside(state: ServerState) -> tuple[list[int], list[int]]:
    return [feed.id for feed in state.stash], [feed.id for feed in state.returned]


def digest_of_state(state: ServerState) -> bytes:
    """A digest of a state; the order of sets and dicts does not count. See `Digests`, if it is one of many."""
    return Digests().of(state)


class Digests:
    """Takes digests of states that follow each other: of what was there the last time, only deltas that are new count.

    The digest is a chain: that of the whole state, then that of each delta on top of it. So replicas that have come to
    the same state in the same steps come to the same digest, and an actor with `get_delta` pays for what has changed.
    """

    def __init__(self) -> None:
        self._data: Image | None = None
        self._deltas: list[bytes] = []
        self._chain = b""

    def of(self, state: ServerState) -> bytes:
        """The digest of one state."""
        known = len(self._deltas)
        if state.data is not self._data or state.deltas[:known] != self._deltas:
            saved = state.data.value()
            if saved is not None and type(saved[2]) is dict and all(type(name) is str for name in saved[2]):
                saved = (*saved[:2], sorted(saved[2].items()))  # Large and small ones have their own order in an image.
            self._data, self._chain, known = state.data, state_digest(saved), 0
        for delta in state.deltas[known:]:
            self._chain = state_digest([self._chain, decode_value(delta)])
        self._deltas = state.deltas
        return state_digest([state.turn, _aside(state), self._chain])


def vote(voter: AnyVoter, runs: Sequence[Run | None], *, with_state: bool = True) -> Agreed[Run] | Undecided:
    """Vote on runs; None is one that is missing."""
    rows = [None if run is None else plain(run, with_state=with_state) for run in runs]
    first = runs[0]
    if first is not None and all(row == rows[0] for row in rows):
        return Agreed(first, 0, tuple(range(len(runs))))
    decided = decide_by(voter, runs, lambda run: form(run, with_state=with_state))
    if isinstance(decided, Agreed) and decided.choice is None:
        return Undecided("no run has come to what is in the middle")
    return decided


def turns_of(runs: Sequence[Run | None]) -> str:
    """The turns that have not ended alike in all runs, as text; the last one, if only the states differ."""
    rows = [plain(run, with_state=False)[0] for run in runs if run is not None]
    found = sorted({row[0][1] for row in zip(*rows, strict=False) if any(one != row[0] for one in row)})
    last = max((run.ends[-1].turn for run in runs if run is not None and run.ends), default=-1)
    return ", ".join(map(str, found or [last]))


# -- shadows ---------------------------------------------------------------------------------------------------------


class Shadow(Server):
    """A second life of the protected actor, maybe of another class with the same state: it only computes.

    Its asks get the outcomes that the first run had. For one that has none the first run has not waited either; one
    that the first run has not made ends the run.
    """

    is_trial = True

    def __init__(self, standing: Standing, kind: type[Actor] | None, within: float = 30.0) -> None:
        main = standing.server
        super().__init__(standing, main.method)
        assert main.cell is not None
        start = main.cell.extra().start
        assert start is not None
        self._recipe: Start[Any] = start if kind is None else Start(kind, start.args, start.kwargs)
        self._within = within
        self._why = ""
        self._sent: dict[int, list[int]] = {}  # digests of what the first run has sent, by turn
        self.hooks = main.hooks
        self.state.is_again = True

    async def run(
        self, before: ServerState, requests: list[Request], heard: list[Outcome], sent: dict[int, list[int]]
    ) -> Run | Missing:
        """Run requests from a state; `heard` and `sent`: what the first run has heard and sent."""
        self._why, self._sent = "", sent
        self.traces.begin_anew(heard)
        ends, state = list[TurnEnd](), None
        try:
            async with asyncio.timeout(self._within):
                ends, state = await self._run(before, requests)
        except TimeoutError:
            self._why = f"it has not come to an end within {self._within} s"
        except Exception as error:  # What the user's own values and methods raise when the state is captured.
            self._why = str(error) or type_name(type(error))
        if self._why:
            await self.drop_life()
            self.points.point = None
            return Missing(self._why)
        objections = sorted(self.traces.objections.items())
        return Run(ends, state, objections=objections)

    async def _run(self, before: ServerState, requests: list[Request]) -> tuple[list[TurnEnd], ServerState | None]:
        self._place()
        await self._go_back(before)
        ends = await self._run_all(requests, even_stopping=False)
        self.attempts.skips.clear()
        if self.state.is_stopping:  # Stopped in the middle: what has no end here may well have one elsewhere.
            self._give_up("its replica ends")
        if self._why:
            return ends, None
        if self.state.is_over:
            self._why = "it has ended itself"
            return ends, None
        await self.ensure_as_given()
        return ends, self.capture()

    async def _go_back(self, before: ServerState) -> None:
        point, life = self.points.point, self.life
        if life is not None and point is not None and not self.points.tail and point == before:
            return  # It stands there already.
        if life is not None and not before.stash and life.is_live == before.live and life.feed is None:
            self.rewind(before)
            return
        await self.drop_life()
        self.install(before)
        await self.ensure_as_given()

    def _place(self) -> None:
        """The address at which it lives: below the replica's."""
        if self.cell is not None:
            return
        node, main = self.standing.node, self.standing.server.cell
        assert main is not None
        assert main.parent is not None
        name = f"shadow-{node.numbers.next_turn()}"
        cell = node.cell_below(main.parent, name, AddressHost(FED, self, node.ports.here.parent))
        self.standing.server.shadows.add(self)
        cell.spec = child(name, self._recipe)
        cell.extra().start = self._recipe
        claimed = main.extra().claimed
        for port, target in main.extra().bindings.items():
            node.bind(cell, port, target, is_claimed=port in claimed)
        self.start(cell)

    async def close(self) -> None:
        """It is not needed any more."""
        await self.drop_life()
        if self.cell is not None:
            lifecycle.retire(self.cell, SHUTDOWN)
            self.cell = None
            self.standing.server.shadows.discard(self)

    # -- nothing leaves ---------------------------------------------------------------------------------------------

    def stop(self, cell: Cell, reason: ExitReason) -> None:
        self.state.is_stopping = True
        self.kill(cell)

    def wants_out(self, life: ServerLife) -> None:
        if life is not self.life:
            return
        sent, heard = self._sent.get(life.turn), self.traces.heard
        for out in life.outs:
            outcome = heard.get((life.turn, out.k))
            asked = 0 if outcome is None else outcome.asked  # By a turn that has failed, and of which no more is known.
            is_alike = asked == out.digest() if sent is None else sent[out.k - 1 : out.k] == [out.digest()]
            if is_alike and outcome is not None:
                life.to_life(outcome)
            elif out.verb in AWAITED and not is_alike:
                life.cell.node.loop.call_soon(self._look, life, life.feed)

    def _look(self, life: ServerLife, feed: Feed | None) -> None:
        if self.life is life and life.feed is feed:
            self._give_up("it has asked what the first run has not asked")

    def _give_up(self, why: str) -> None:
        self._why = self._why or why
        self.abandon()


# -- deciding --------------------------------------------------------------------------------------------------------


class Remembering(Before):
    """A Before that keeps what goes in: the other runs get that, whatever has become of it further inside."""

    async def before(self, work: Work) -> Work:
        """Remember the requests of a batch."""
        inputs = self._standing.server.traces.inputs
        inputs.update((one.feed.id, one) for one in work.requests)
        while len(inputs) > MOST_INPUTS:
            del inputs[next(iter(inputs))]
        return work


class Deciding(After):
    """Base of Afters that compute a part more than once, and decide what is right.

    What cannot be decided for a part as a whole is decided request by request; one for which nothing is found fails
    with a typed error, and leaves no trace.
    """

    async def choose(self, before: ServerState, requests: list[Request], first: Run | None) -> Run | HoldfastError:
        """The run that is right, or why there is none. Without `first`, the actor has not run these requests yet."""
        raise NotImplementedError

    async def begun(self, done: Done) -> None:
        """Hear of the first turn, about which nothing can be decided."""

    async def after(self, done: Done) -> Done | None:
        """Have the part decided; what was found in place of what had come out goes on."""
        server = self._standing.server
        life = server.life
        if not done.ends or server.state.is_over or (life is None and server.points.previous is None):
            return done
        if life is not None and life.spoiled is not None:
            return done  # It has run nothing.
        if life is not None and life.feed is not None:  # A follower's turn waits in the middle: nothing is decided.
            if any(end.id in server.traces.objections for end in done.ends):
                raise HoldfastError(f"{self._standing.path}: an assertion has failed while a turn waits")
            return done
        if server.points.previous is None:
            await self.begun(done)
            return done  # The very first turn, `on_start`: there is nothing to begin again from.
        before, asked = server.points.previous
        before = before if life is None else msgspec.structs.replace(before, live=life.is_live)
        dropped = {end.id for end in done.ends if end.status == DROPPED}
        inputs = self._standing.server.traces.inputs
        asked = [as_it_came(inputs.get(one.feed.id), one) for one in asked]
        requests = [one if one.feed.id in dropped else without_deadline(one) for one in asked]
        first = self._last_run(done.ends)
        server.forget_objections()
        found = await self.choose(before, requests, first)
        if found is first:
            return done
        ends = await self._take(before, requests, found, first)
        known = {end.id for end in ends}
        if server.state.is_over:
            return msgspec.structs.replace(done, ends=ends)
        server.left_over += [one for one in asked if one.feed.id not in known]  # What was put back comes first.
        goes_on = server.left_over or server.has_returned  # Home must not take the batch to be over.
        return msgspec.structs.replace(done, ends=ends, is_last=done.is_last and not goes_on)

    def _last_run(self, ends: list[TurnEnd]) -> Run:
        server = self._standing.server
        known = {end.id for end in ends}
        objections = sorted((key, why) for key, why in server.traces.objections.items() if key in known)
        return Run(ends, server.capture(), objections=objections)

    async def run_here(self, before: ServerState, requests: list[Request]) -> Run:
        """Have the actor itself run requests, from a state."""
        server = self._standing.server
        ends = await server.run_again(before, requests)
        return self._last_run(ends)

    async def _take(
        self, state: ServerState, requests: list[Request], found: Run | HoldfastError, first: Run
    ) -> list[TurnEnd]:
        """Put what was found in place; one request after the other, if nothing was found for all of them."""
        server, ends = self._standing.server, list[TurnEnd]()
        if isinstance(found, Run):
            ends, state = found.ends, found.state or state
        elif len(requests) == 1:
            ends, state = self._failed(state, first.ends, found)
        else:
            for one in requests:
                run = await self.choose(state, [one], None)
                if isinstance(run, Run):
                    ends += run.ends
                    state = run.state or state
                else:
                    failed, state = self._failed(state, [TurnEnd(0, one.feed.id, FAILED, [], Answer())], run)
                    ends += failed
                if state.returned and state.live:
                    break
        if server.points.point is not state or server.life is None:
            await server.adopt(state)
        return ends

    def _failed(
        self, state: ServerState, ends: list[TurnEnd], error: HoldfastError
    ) -> tuple[list[TurnEnd], ServerState]:
        """These requests fail: their numbers are used, and nothing else has happened."""
        answer = Answer(*self._standing.node.codec.encode_error(error))
        numbers = list(dict.fromkeys(end.id for end in ends))
        failed = [
            TurnEnd(turn, number, FAILED, [], answer if self._is_ask(state, number) else Answer())
            for turn, number in enumerate(numbers, state.turn + 1)
        ]
        left = [feed for feed in state.returned if feed.id not in numbers]  # Else they would be handled once more.
        return failed, msgspec.structs.replace(state, turn=state.turn + len(failed), returned=left)

    def _is_ask(self, state: ServerState, number: int) -> bool:
        request = self._standing.inside.get(number)
        feeds = [request.feed] if request is not None else [*state.stash, *state.returned]
        return any(feed.id == number and feed.is_ask for feed in feeds)

    def heard(self, before: ServerState) -> list[Outcome]:
        """What the actor's asks have come to since a state."""
        return [one for one in self._standing.server.traces.heard.values() if one.turn > before.turn]


def as_it_came(came: Request | None, request: Request) -> Request:
    """A request as it came in; one that was put back since is another, without the turn that it was replayed for."""
    return came if came is not None and came.feed.turn == request.feed.turn else request


def without_deadline(request: Request) -> Request:
    """It was begun in time: it is not too late for the next run of it."""
    feed = request.feed
    if not feed.deadline:
        return request
    return Request(request.client, request.incarnation, msgspec.structs.replace(feed, deadline=0.0))
