"""What an earlier version of the program has recorded of a home: mapped when the home is taken up, compared in replays.

What a turn sends and replies when it is handled again is compared by digests. What was coded otherwise then is coded so
once more, as far as that is known.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Final

import msgspec

from ...actors.errors import StartFailed
from ...actors.persistence import UNFIT
from ..protocol import OK, REPLY, STASHED, TIMED, Answer, Out, answer_digest, timed, untimed
from ..schema import shape_name
from ..upgrade.mapping import BodyMapper, NotMapped, in_whole_numbers
from ..upgrade.present_classes import REFUSAL, REPLY_TO

if TYPE_CHECKING:
    from ..inputs import Input
    from ..upgrade.old_records import OldRecords
    from .switch import Switch

MESSAGES: Final = frozenset(("tell", "ask", "send", "publish", "forward"))
"""The outputs that are messages."""


def take_over(home: Switch) -> str:
    """Map what was read of a home and was written otherwise than it would be now; what that was, in words.

    Raises:
        StartFailed: something of it cannot be read by its class; the difference in words. Nothing was changed.
    """
    try:
        return "; ".join(_taken_over(home, home.shapes.all_read()))
    except NotMapped as error:
        raise StartFailed(home.path, f"{UNFIT}: {error}") from error


def _taken_over(home: Switch, old: OldRecords) -> list[str]:
    ledger, clocks, messages = home.ledger, home.timers.saved(), home.homes.rejoin.kept_for(home.path)
    ended = (turn.input for turn in ledger.turns.values() if turn.status in (OK, STASHED) and home.method.replays)
    sources = {source.id: source for source in (*ended, *ledger.open.values())}
    counts = Counter[BodyMapper]()

    def mapped(mapper: BodyMapper, body: bytes) -> bytes:
        counts[mapper] += 1
        return mapper.mapped(body)

    def outcome(mapper: BodyMapper, answer: Answer) -> Answer:
        own, when = untimed(answer)
        own = Answer(own.kind, mapper.name.rpartition(" ")[2], mapped(mapper, own.body))
        return timed(own, when) if answer.kind.startswith(TIMED) else own

    inputs = {key: mapped(one, sources[key].body) for key, one in old.inputs.items() if key in sources}
    outcomes = {key: outcome(one, ledger.outcomes[key]) for key, one in old.outcomes.items() if key in ledger.outcomes}
    timers = {key: (one.name, mapped(one, clocks[key][1])) for key, one in old.timers.items() if key in clocks}
    kept = {
        origin: messages[origin]._replace(name=one.name, body=mapped(one, messages[origin].body))
        for origin, one in old.kept.items()
        if origin in messages
    }
    for key, body in inputs.items():  # From here on nothing can fail.
        source = sources[key]
        ledger.journal_bytes += len(body) - len(source.body)
        source.name, source.body = old.inputs[key].name, body
    ledger.outcomes.update(outcomes)
    home.timers.map(timers)
    messages.update(kept)
    return [f"{count} of {mapper.written}{mapper.change}" for mapper, count in counts.items()]


def is_as_before(home: Switch, out: Out, digest: int) -> bool:
    """Whether a replayed output is the one of a digest but for what may have changed since.

    Its binding leads elsewhere now, or its class has other fields, or another name. It is taken for the same if its
    class has lost a field, or one has another type: how it was coded cannot be known then.
    """
    receivers = (out.to, *home.node.led.get(home.path, {}).get(out.to, ()))

    def is_same(name: str, body: bytes) -> bool:
        return any(msgspec.structs.replace(out, to=to, name=name, body=body).digest() == digest for to in receivers)

    if is_same(out.name, out.body):
        return True
    if out.verb == "wait":
        return any(is_same("|".join(names), b"") for names in _former_waits(home, out.name.split("|")))
    if out.verb != "reply":
        return _is_any(home, out.name, out.body, is_same)
    kind, _, name = out.name.partition("|")
    answer = Answer(kind, _asked(home, int(out.to)) if kind == REPLY else name, out.body)
    return _is_any(home, shape_name(answer), out.body, lambda old, body: is_same(_reply_name(kind, old), body))


def is_same_reply(home: Switch, source: Input, digest: int, answer: Answer) -> bool:
    """Whether the reply to an input is the one of a digest but for what may have changed since, as `is_as_before`."""
    if digest == answer_digest(answer):
        return True
    name = shape_name(Answer(answer.kind, source.name if answer.kind == REPLY else answer.name))

    def is_same(old: str, body: bytes) -> bool:
        own = old.removeprefix(REFUSAL) if answer.kind == "refusal" else answer.name
        return answer_digest(Answer(answer.kind, own, body)) == digest

    return _is_any(home, name, answer.body, is_same)


def _is_any(home: Switch, name: str, body: bytes, is_same: Callable[[str, bytes], bool]) -> bool:
    """Whether one of the older forms of what has this name is the same; also if there was one that is not known."""
    try:
        forms = itertools.chain(((name, body),), home.shapes.older_forms(name, body))
        return any(is_same(old, one) or is_same(old, in_whole_numbers(one)) for old, one in forms)
    except NotMapped:
        return True


def _former_waits(home: Switch, names: list[str]) -> Iterator[tuple[str, ...]]:
    """The classes that a turn waits for, under all names that they have had."""
    return itertools.product(*((name, *home.shapes.former_names(name)) for name in names))


def _asked(home: Switch, key: int) -> str:
    """The type of the message that was input `key`; "" if that is not known any more."""
    return next((source.name for source in home.ledger.handled_and_open() if source.id == key), "")


def _reply_name(kind: str, old: str) -> str:
    """How an output that is a reply names its class."""
    return f"{kind}|{old.removeprefix(REFUSAL)}" if not old.startswith(REPLY_TO) else f"{kind}|"
