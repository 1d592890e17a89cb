"""The replay of one actor: its recorded turns one by one, with what each was and did, up to any of them."""

from __future__ import annotations

import asyncio
import dataclasses
import inspect
import os
import pdb  # noqa: T100  # it is what the user has asked for
import sys
import tempfile
import types
from collections.abc import Callable, Coroutine
from typing import Any, Final, cast

from ...actors.errors import DamagedValue, ReplayDiverged, SpecError
from ...actors.kernel.actor import Actor, Start
from ...actors.kernel.message import Message, reply_type
from ...actors.kernel.node import Node
from ...actors.process.wire.start_codec import loaded
from ...actors.values.classes import find_class
from ...checkpoint.home.homes import Homes
from ...checkpoint.inputs import Input, Turn
from ...checkpoint.method import hybrid
from ...checkpoint.protocol import (
    AWAITED,
    GIVEN_UP,
    LATER,
    MESSAGE,
    MOMENT,
    NOTHING,
    REPLY,
    SINCE_THEN,
    Answer,
    Out,
    untimed,
)
from ...checkpoint.recovery_file import load_recovery
from ...checkpoint.schema import Shape, shape_of
from ...checkpoint.snapshot.key_variables import save_state
from ...checkpoint.store_key import StoreKey, read_store_key
from ...checkpoint.store_opening import open_journal
from ...checkpoint.store_tools.copies import back_up_store
from ...checkpoint.store_tools.kept_lives import KeptLife, apart, kept_lives, lives_to
from ...checkpoint.store_tools.plain_export import plain_message, plain_result, plain_state
from ...checkpoint.store_tools.rerun import LifeEnded, Recipe, Rerun
from ...checkpoint.store_tools.upgrade_check import AddressCheck
from .new_program import NewProgram, find_in, load_specs

TURN_TIMEOUT: Final = 30.0
"""Seconds that a turn may wait, unless a debugger is at work."""
IN_HAND: Final = "in hand"
"""The status of a turn that has begun and has not ended."""


@dataclasses.dataclass(frozen=True, slots=True)
class ReplayedTurn:
    """One recorded turn, lived again. All values are such as JSON has.

    Attributes:
        turn: its number.
        kind: of its input: "message", "start", "tick", "pipe", "exit" or "down".
        type: of the message; "" if it is none.
        message: its fields.
        sender: who has sent it; None: nobody, or somebody outside.
        time: when it was accepted, Unix time in seconds.
        status: how it had ended: "ok", "stashed", or, not lived again, "failed" or "dropped"; "in hand": it has not.
        reply: what was replied; None if nobody had asked.
        outputs: what it has sent, in program order, with what it got for that. "waits": it waits for that still.
        changes: of the state: by variable what it was before, and what it is.
    """

    turn: int
    kind: str
    type: str
    message: Any
    sender: str | None
    time: float
    status: str
    reply: Any = None
    outputs: list[dict[str, Any]] = dataclasses.field(default_factory=list[dict[str, Any]])
    changes: dict[str, tuple[Any, Any]] = dataclasses.field(default_factory=dict[str, tuple[Any, Any]])


@dataclasses.dataclass(frozen=True, slots=True)
class ReplayedState:
    """Where a replay has ended.

    Attributes:
        address: of the actor.
        kept_from: the replay can begin behind this turn; -1: at the very start.
        last: the last turn that is recorded.
        turn: after which the replay has ended.
        state: of the actor then, by variable.
        problem: why it has ended earlier than was wanted; "" if it has not.
    """

    address: str
    kept_from: int
    last: int
    turn: int
    state: dict[str, Any]
    problem: str = ""


def replay_actor(
    store: str | os.PathLike[str],
    address: str,
    *,
    until: int | None = None,
    since: int | None = None,
    target: str | None = None,
    recovery: str | os.PathLike[str] | None = None,
    store_key: StoreKey | None = None,
    breaks: bool = False,
    told: Callable[[ReplayedTurn], None] = lambda turn: None,
) -> ReplayedState:
    """Live the recorded turns of one actor again, in this process; the store is not changed, and may be open.

    It blocks for as long as the turns take, and runs the actor's code: call it in a thread, or in another process.

    Args:
        store: the path of the SQLite database.
        address: of the actor.
        until: the last turn that is lived; all of them if left out, and that in hand as far as it had come. Turns
            before a state or a class was put in place from outside are lived if this is one of them.
        since: the first turn that is told of; all that are kept if left out.
        target: the specs of the program (see `load_specs`). Left out, the recorded class is started without arguments.
        recovery: the recovery file of the program, if it has one.
        store_key: of an encrypted store, as in `ActorSystem(store_key=...)`.
        breaks: stop in pdb before the handler of the last turn.
        told: is called with each turn when it has been lived.

    Raises:
        SpecError: the program cannot be had, or there is no such address or turn. StoreError: the store cannot be read.
            WrongStoreKey: the key is not the store's. StartFailed: the class does not fit what is recorded.
            HoldfastError: as it says.
    """
    specs = None if target is None else load_specs(target)
    file = None if recovery is None else load_recovery(recovery)
    with tempfile.TemporaryDirectory(prefix="holdfast-replay-") as folder:
        copy = os.path.join(folder, "copy.db")
        secret = read_store_key(store_key)
        back_up_store(store, copy, key=secret)

        async def replayed() -> ReplayedState:
            homes = apart(Node("replay", asyncio.get_running_loop()), open_journal(f"sqlite:{copy}", key=secret))
            try:
                lives = lives_to(_known(homes, address), until)
                if specs is None:
                    recipe = _recorded(address, lives)
                else:
                    recipe = _chosen(NewProgram(homes, specs, file).recipe(address))
                return await _Replay(homes, address, recipe, told, breaks=breaks).lived(lives, since, until)
            finally:
                homes.close()

        return asyncio.run(replayed())


def _known(homes: Homes, address: str) -> list[KeptLife]:
    if not homes.knows(address):
        known = ", ".join(sorted(homes.known(""))[:20]) or "nothing"
        raise SpecError(address, f"nothing is recorded of it; the store has {known}")
    return kept_lives(homes, address)


def _chosen(recipe: Recipe | AddressCheck) -> Recipe:
    if isinstance(recipe, AddressCheck):
        raise SpecError(recipe.address, recipe.problem)
    return recipe


def _recorded(address: str, lives: list[KeptLife]) -> Recipe:
    """The class that is recorded, without arguments."""
    name = next((one.kind for one in reversed(lives) if one.kind), "")
    hint = "name the specs of its program with --spec"
    find_in(os.getcwd())
    try:
        kind = find_class(name)
    except DamagedValue as error:
        raise SpecError(address, f"{error.args[0]}; {hint}") from error
    if not issubclass(kind, Actor):
        raise SpecError(address, f"{name} is no actor class; {hint}")
    start: Start[Any] = Start(kind, (), {})
    try:
        start.check()
    except TypeError as error:
        raise SpecError(address, f"{name} cannot be started without arguments ({error}); {hint}") from error
    return Recipe(start, hybrid(), {})


class Debugger(pdb.Pdb):
    """Stops where a function begins."""

    quitting = False

    def stop_in(self, code: types.CodeType) -> None:
        """Stop when this function is called next."""
        self.reset()
        self.set_break(code.co_filename, code.co_firstlineno, temporary=True, funcname=code.co_name)
        self.botframe = sys._getframe()
        self.set_continue()
        sys.settrace(self.trace_dispatch)


class _Replay:
    def __init__(
        self, homes: Homes, address: str, recipe: Recipe, told: Callable[[ReplayedTurn], None], *, breaks: bool
    ) -> None:
        self._homes, self._address, self._recipe, self._told = homes, address, recipe, told
        self._breaks, self._debugger = breaks, Debugger()
        self._turn, self._state = -1, dict[str, Any]()

    async def lived(self, lives: list[KeptLife], since: int | None, until: int | None) -> ReplayedState:
        """Live the turns of the latest life from which those that are wanted can be reached."""
        kept = [one.turn for one in lives]
        first = kept[0] if since is None else max((turn for turn in kept if turn < since), default=kept[0])
        rerun = Rerun(self._homes, self._address, self._recipe, lives[kept.index(first)].saved)
        last = rerun.ledger.turn
        in_hand = rerun.ledger.open.get(rerun.ledger.begun) if until is None and rerun.ledger.released else None
        until = last if until is None else until
        if not kept[0] <= until <= last:
            gone = f"turns up to {kept[0]} are only in a snapshot, and " if kept[0] >= 0 else ""
            raise SpecError(self._address, f"there is no turn {until}: {gone}the last one that is recorded is {last}")
        try:
            rerun.begin()
            self._turn, self._state = first, _state(rerun)
            problem = await self._live(rerun, first + 1 if since is None else since, until, in_hand)
        finally:
            await rerun.close()
        return ReplayedState(self._address, kept[0], last, self._turn, self._state, problem)

    async def _live(self, rerun: Rerun, since: int, until: int, in_hand: Input | None) -> str:
        """Why it has ended early; "" if it has not."""
        again = dict(rerun.turns)
        before = [one for one in rerun.turns if one[0] < since]
        wanted = [one for one in rerun.ledger.turns.items() if since <= one[0] <= until]
        try:
            await rerun.live(before)
            self._turn, self._state = min(since - 1, until), _state(rerun)
            for number, turn in wanted:
                if number in again:
                    breaks = self._breaks and number == until and in_hand is None
                    self._told(
                        await self._step(rerun, _input(number, turn), rerun.live([(number, turn)]), breaks=breaks)
                    )
                else:
                    self._told(_input(number, turn))
                self._turn = number
            if in_hand is not None:
                ended = self._state
                seen = _input(until + 1, Turn(in_hand, IN_HAND, []))
                self._told(await self._step(rerun, seen, rerun.live_begun(), breaks=self._breaks))
                self._state = ended  # What it has changed so far counts when it has ended.
        except (ReplayDiverged, LifeEnded) as error:
            return "the debugger was left" if self._debugger.quitting else str(error)
        except TimeoutError:
            return f"turn {rerun.turn} has not come to its end within {TURN_TIMEOUT:g} s"
        return ""

    async def _step(
        self, rerun: Rerun, seen: ReplayedTurn, lived: Coroutine[Any, Any, object], *, breaks: bool
    ) -> ReplayedTurn:
        """Have a turn lived, in front of the debugger if `breaks`; what is to be told of it."""
        if breaks:
            self._debugger.stop_in(_code(rerun.actor, seen))
            try:
                await lived
            finally:
                sys.settrace(None)
        else:
            async with asyncio.timeout(TURN_TIMEOUT):
                await lived
        before, after = self._state, _state(rerun)
        self._state = after
        changes = {
            name: (before.get(name), after.get(name))
            for name in {**before, **after}
            if before.get(name) != after.get(name)
        }
        reply = None if rerun.end is None else _outcome(rerun, rerun.end.answer, seen.type)
        outputs = [_output(rerun, seen.turn, out, is_over=seen.status != IN_HAND) for out in rerun.outs]
        return dataclasses.replace(seen, reply=reply, outputs=outputs, changes=changes)


def _state(rerun: Rerun) -> dict[str, Any]:
    """The state of the actor as plain data, by variable."""
    plain = plain_state(save_state(rerun.actor))
    variables = plain.get("variables")
    return variables if isinstance(variables, dict) else {"state": plain.get("state")}


def _code(actor: Actor, seen: ReplayedTurn) -> types.CodeType:
    """The code of the handler, or of the hook, that handles an input."""
    name, kind = seen.type, type(actor)
    handler: Any = kind._table[kind._table.kind_named(name)] if name else getattr(kind, f"on_{seen.kind}")
    return cast("types.CodeType", inspect.unwrap(handler).__code__)


def _input(number: int, turn: Turn) -> ReplayedTurn:
    source = turn.input
    message = plain_message(source.body, _shape(source.name)) if source.name else None
    return ReplayedTurn(number, source.kind, source.name, message, source.sender, source.time, turn.status)


def _output(rerun: Rerun, turn: int, out: Out, *, is_over: bool) -> dict[str, Any]:
    to = "" if out.to == SINCE_THEN else out.to
    said: dict[str, Any] = {"output": out.k, "verb": out.verb, "to": to, "type": out.name}
    if out.body:
        said["message"] = plain_message(out.body, _shape(out.name.rpartition("|")[2]))
    if out.seconds:
        said["until" if out.verb == "sleep" and not out.to else "seconds"] = out.seconds
    outcome = rerun.ledger.outcomes.get((turn, out.k))
    if outcome is not None:
        answer, _ = untimed(outcome)
        is_result = out.verb == "effect" and answer.kind == REPLY
        said["got"] = plain_result(answer.body) if is_result else _outcome(rerun, answer, out.name)
    elif not is_over and out.verb in AWAITED and out.verb not in ("send", "publish"):
        said["waits"] = True
    return said


def _outcome(rerun: Rerun, answer: Answer, asked: str) -> Any:
    """What somebody got who had asked."""
    if answer.kind == NOTHING:
        return None
    if answer.kind == REPLY:
        return plain_message(answer.body, _reply_shape(asked))
    if answer.kind == MOMENT:
        return {"moment": True}
    if answer.kind == MESSAGE:
        return {"message": answer.name, "fields": plain_message(answer.body, _shape(answer.name))}
    if answer.kind in (LATER, GIVEN_UP):
        return {answer.kind: True}
    return {"error": rerun.said(answer)}


def _shape(name: str) -> Shape:
    kind = loaded(name, Message) if ":" in name else None
    return () if kind is None else shape_of(kind)


def _reply_shape(asked: str) -> Shape:
    kind = loaded(asked, Message) if ":" in asked else None
    return () if kind is None else shape_of(reply_type(kind))
