"""What a machine for transactions is to do, drawn from a seed before it begins: plain numbers, which can be left out.

A draw says no more than "move the third of those that can be moved": what it means is settled against the
specification at that point. So a plan from which a step or a round is taken is still a plan, and can be shrunk.
"""

from __future__ import annotations

import dataclasses
import random
from collections.abc import Callable, Iterator
from typing import Final

from tests.system.transaction_model import ROOT, STRATEGIES, Cannot, Kind, Node, Spec, Step

HAZARDS: Final = (
    "children",  # crash, or are killed
    "supervisors",  # are killed
    "restarts",  # supervisors are killed between transactions: the specification in force comes back
    "cancel",  # the caller gives up
    "timeouts",  # of the transaction, with a step that hangs
    "failures",  # a step fails
    "concurrency",  # two scripts at once
    "busy",  # actors are in long turns, and starts take a while
)
VERBS: Final = (
    *("add", "add", "remove", "stop", "start", "start", "move", "move", "reorder", "strategy", "intensity", "bind"),
    *("bind", "unbind", "register", "unregister", "suspend", "resume", "resume", "replace_state", "replace_code"),
)
NAMES: Final = ("first", "second", "third", "fourth")
GUESSES: Final = 12
"""How many ways to take a draw are tried before it is left out."""

Pause = tuple[str, float]
"""("ticks", n) of the loop, or ("seconds", n)."""


@dataclasses.dataclass(frozen=True)
class Draw:
    """A step to be: its verb, and numbers that choose the rest. "fail", "hang" and "pause" are steps of the tests."""

    verb: str
    numbers: tuple[int, int, int] = (0, 0, 0)

    def __str__(self) -> str:
        return f"{self.verb}{self.numbers}"


@dataclasses.dataclass(frozen=True)
class Script:
    """One transaction."""

    draws: tuple[Draw, ...]
    timeout: float = 10.0
    cancelled_after: Pause | None = None
    begins_after: int = 0
    """Ticks of the loop."""

    @property
    def is_plain(self) -> bool:
        """Whether nothing in itself keeps it from being carried out."""
        return self.timeout >= 10 and not self.cancelled_after and not {d.verb for d in self.draws} & {"fail", "hang"}

    def __str__(self) -> str:
        more = f", cancelled after {self.cancelled_after}" if self.cancelled_after else ""
        return f"[{', '.join(map(str, self.draws))}; timeout {self.timeout:g}{more}]"


@dataclasses.dataclass(frozen=True)
class Strike:
    """Something that happens to somebody: "boom", "kill", "kill supervisor" or "nap"."""

    after: Pause
    kind: str
    number: int

    def __str__(self) -> str:
        return f"{self.kind} {self.number} after {self.after[1]:g} {self.after[0]}"


@dataclasses.dataclass(frozen=True)
class Round:
    """What happens at once; the next round begins when the dust has settled."""

    scripts: tuple[Script, ...]
    strikes: tuple[Strike, ...] = ()
    restarts: tuple[int, ...] = ()
    """Supervisors that are killed when all is over."""

    @property
    def is_calm(self) -> bool:
        """Whether nothing keeps its transactions from being carried out."""
        return not self.strikes and len(self.scripts) == 1 and all(script.is_plain for script in self.scripts)

    def __str__(self) -> str:
        parts = [" | ".join(map(str, self.scripts)), *map(str, self.strikes)]
        return "; ".join([*parts, *(f"restart supervisor {number}" for number in self.restarts)])


Plan = tuple[Round, ...]


def draw_plan(rng: random.Random, hazards: frozenset[str], verbs: tuple[str, ...] = VERBS, *, rounds: int) -> Plan:
    """A plan of so many rounds in which no other hazards occur than these, and no other steps."""
    return tuple(_round(rng, hazards, verbs) for _ in range(rounds))


def _round(rng: random.Random, hazards: frozenset[str], verbs: tuple[str, ...]) -> Round:
    count = 2 if "concurrency" in hazards and rng.random() < 0.5 else 1
    scripts = tuple(_script(rng, hazards, verbs) for _ in range(count))
    kinds = [
        *(["boom", "boom", "kill"] if "children" in hazards else []),
        *(["kill supervisor"] if "supervisors" in hazards else []),
        *(["nap"] if "busy" in hazards else []),
    ]
    strikes = [Strike(_pause(rng), rng.choice(kinds), rng.randrange(60)) for _ in range(rng.randrange(4)) if kinds]
    restarts = [rng.randrange(60) for _ in range(rng.randrange(3)) if "restarts" in hazards]
    return Round(scripts, tuple(strikes), tuple(restarts))


def _script(rng: random.Random, hazards: frozenset[str], verbs: tuple[str, ...]) -> Script:
    draws = [Draw(rng.choice(verbs), _numbers(rng)) for _ in range(rng.randint(1, 6))]
    is_struck = bool(hazards & {"children", "supervisors", "cancel", "concurrency", "busy"})
    for verb, is_wanted in (
        ("pause", is_struck and rng.random() < 0.6),
        ("fail", "failures" in hazards and rng.random() < 0.4),
        ("hang", "timeouts" in hazards and rng.random() < 0.3),
    ):
        if is_wanted:
            draws.insert(rng.randint(0, len(draws)), Draw(verb, _numbers(rng)))
    timeout = rng.choice((0.02, 0.1, 1.0)) if "timeouts" in hazards and rng.random() < 0.5 else 10.0
    cancelled = _pause(rng) if "cancel" in hazards and rng.random() < 0.5 else None
    return Script(tuple(draws), timeout, cancelled, rng.randrange(12))


def _numbers(rng: random.Random) -> tuple[int, int, int]:
    return rng.randrange(60), rng.randrange(60), rng.randrange(60)


def _pause(rng: random.Random) -> Pause:
    if rng.random() < 0.5:
        return "ticks", rng.randrange(1, 60)
    return "seconds", rng.choice((0.001, 0.01, 0.03, 0.06, 0.1, 0.3))


# -- what a draw means -------------------------------------------------------------------------------------------------


def settle(draw: Draw, draft: Spec, fresh: Callable[[], int]) -> Step | None:
    """The step that a draw stands for at this point; the draft is changed by it. None: it stands for none here."""
    for shift in range(GUESSES):
        a, b, c = draw.numbers
        try:
            step = _guess(draw.verb, a + shift, b + shift // 3, c, draft, fresh)
            draft.copy().do(step)  # A step that does not fit may have changed half of it.
        except (Cannot, IndexError, ZeroDivisionError):
            continue
        draft.do(step)
        return step
    return None


def _guess(verb: str, a: int, b: int, c: int, draft: Spec, fresh: Callable[[], int]) -> Step:
    supervisors = [node.who for node in draft.supervisors()]
    leaves = [node.who for node in draft.leaves()]
    above = supervisors[a % len(supervisors)]
    who = leaves[a % len(leaves)]
    match verb:
        case "add":
            return Step("add", (above, _newcomer(above, b, c, draft, fresh)))
        case "remove" | "stop":
            some = [node.who for node in draft.nodes.values() if node.above != ROOT]
            return Step(verb, (some[a % len(some)],))
        case "start":
            some = [node.who for node in draft.nodes.values() if node.is_stopped]
            return Step("start", (some[a % len(some)],))
        case "move":
            some = [node.who for node in draft.nodes.values() if node.above != ROOT]
            return Step("move", (some[a % len(some)], supervisors[b % len(supervisors)]))
        case "reorder":
            return Step("reorder", (above, _order(draft.nodes[above].below, b, c)))
        case "strategy":
            return Step("strategy", (above, STRATEGIES[b % 3]))
        case "intensity":
            return Step("intensity", (above, 1000 + b, 1.0 + c % 7))
        case "isolation":
            return Step("isolation", (who, "task" if draft.nodes[who].isolation == "process" else "process"))
        case "bind":
            return Step("bind", (who, leaves[b % len(leaves)]))
        case "register":
            return Step("register", (NAMES[b % len(NAMES)], who))
        case "unregister":
            return Step("unregister", (NAMES[a % len(NAMES)],))
        case "replace_code":
            kind: Kind = "Tally" if draft.nodes[who].kind == "Twice" else "Twice"
            return Step("replace_code", (who, kind))
        case "resume":
            some = [node.who for node in draft.leaves() if node.is_suspended]
            return Step("resume", (some[a % len(some)],))
        case _:  # unbind, suspend, replace_state
            return Step(verb, (who,))


def _order(below: list[int], b: int, c: int) -> tuple[int, ...]:
    order = list(below)
    random.Random(b).shuffle(order)
    return tuple(order[: c % (len(order) + 1)])


def _newcomer(above: int, b: int, c: int, draft: Spec, fresh: Callable[[], int]) -> Node:
    who = fresh()
    old = [path.rpartition("/")[2] for path in sorted(draft.free) if path.rpartition("/")[0] == draft.path(above)]
    if old and b % 2:
        return Node(who, old[b % len(old)], above)  # Somebody else at an address that was left.
    match c % 12:
        case 0 | 1 | 2:
            return Node(who, f"n{who}", above, is_recorded=True)
        case 3 | 4:
            return Node(who, f"n{who}", above, is_late=True)
        case 5 | 6:
            return Node(who, f"s{who}", above, "supervisor")
        case 7 | 8:
            leaves = draft.leaves()
            return Node(who, f"n{who}", above, spec_peer=leaves[b % len(leaves)].who)
        case _:
            return Node(who, f"n{who}", above)


def shorter(plan: Plan) -> Iterator[Plan]:
    """Plans with a little less in them: first without whole rounds, then scripts, strikes, steps."""
    for size in (16, 8, 4, 2, 1):
        for at in range(0, len(plan), size):
            if size < len(plan):
                yield plan[:at] + plan[at + size :]
    for at, one in enumerate(plan):
        for less in _less(one):
            yield (*plan[:at], less, *plan[at + 1 :])


def _less(one: Round) -> Iterator[Round]:
    for part in ("restarts", "strikes", "scripts"):
        these = getattr(one, part)
        for at in range(len(these)):
            if part != "scripts" or len(these) > 1:
                yield dataclasses.replace(one, **{part: these[:at] + these[at + 1 :]})
    for at, script in enumerate(one.scripts):
        simpler = [dataclasses.replace(script, draws=script.draws[:n] + script.draws[n + 1 :]) for n in _places(script)]
        if script.cancelled_after:
            simpler.append(dataclasses.replace(script, cancelled_after=None))
        if script.begins_after:
            simpler.append(dataclasses.replace(script, begins_after=0))
        if script.timeout != 10.0:
            simpler.append(dataclasses.replace(script, timeout=10.0))
        for less in simpler:
            yield dataclasses.replace(one, scripts=(*one.scripts[:at], less, *one.scripts[at + 1 :]))


def _places(script: Script) -> range:
    return range(len(script.draws))
