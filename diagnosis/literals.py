"""Literals: what can be said about a system, and which words exist to say it.

A literal is `ok(/odom)` or `not ok(/odom)`, in the spelling of the paper (Zaman et al. 2013). It is a typed value, not
a string: a negation spelled in another way would silently be another proposition. So what cannot be read, and every
name that the model does not declare, is an error (T53).
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Iterator
from typing import Final
from urllib.parse import quote

import msgspec

from ..actors.errors import HoldfastError

ARITIES: Final = {
    "ok": 1,
    "running": 1,
    "on": 1,
    "matched": 2,
    "inc": 1,
    "dec": 1,
    "const": 1,
    "replies": 1,
    "progress": 1,
    "room": 1,
    "crashes": 1,
    "waits_for": 2,
    "led": 1,
    "whole": 1,
    "caught_up": 1,
    "keeps_up": 1,
}
"""The paper's predicates and those of the runtime, with their numbers of arguments."""

TRENDS: Final = ("inc", "dec", "const")
"""Of one value at most one of these holds at a time."""

SYMMETRIC: Final = frozenset({"matched"})
"""Predicates whose arguments can be exchanged."""

_FORM: Final = re.compile(r"\s*(?:(not)\s+|(¬)\s*)?([A-Za-z_]\w*)\s*\(([^()]*)\)\s*\Z")
_ARGUMENT: Final = re.compile(r"[^\s(),]+\Z")
_OTHER_NEGATION: Final = re.compile(r"\s*(?:!|~|-|not_|no_|NOT)\s*\(?[A-Za-z_]")


class BadLiteral(HoldfastError, text="{text!r}: {problem}"):
    """A text that is no literal, or a literal with a name that the model does not declare."""

    text: str
    problem: str


class Literal(msgspec.Struct, frozen=True, order=True, array_like=True, cache_hash=True, gc=False):
    """An atom, or its negation: `positive` says which.

    >>> str(~ok("/odom")), ok("/odom").positive
    ('not ok(/odom)', True)
    """

    name: str
    args: tuple[str, ...]
    positive: bool = True

    def __str__(self) -> str:
        return f"{'' if self.positive else 'not '}{self.name}({','.join(self.args)})"

    def __invert__(self) -> Literal:
        return Literal(self.name, self.args, not self.positive)

    @property
    def atom(self) -> Literal:
        """The literal without its negation."""
        return self if self.positive else Literal(self.name, self.args)


def ok(topic: str) -> Literal:
    """Make the atom that a topic, or anything else that has a name, is as it should be."""
    return Literal("ok", (topic,))


def running(component: str) -> Literal:
    """The literal that a component runs."""
    return Literal("running", (component,))


def on(device: str) -> Literal:
    """The literal that a device has power."""
    return Literal("on", (device,))


def replies(component: str) -> Literal:
    """Whoever asks a component gets an answer in time."""
    return Literal("replies", (component,))


def progress(component: str) -> Literal:
    """A component gets on with what it is to handle, as far as that is its own affair."""
    return Literal("progress", (component,))


def room(component: str) -> Literal:
    """The bounded mailbox of a component takes messages."""
    return Literal("room", (component,))


def crashes(component: str) -> Literal:
    """A component crashes, or ends though it is always to be there, again and again and for reasons of its own."""
    return Literal("crashes", (component,))


def waits_for(component: str, other: str) -> Literal:
    """The turn of a component waits for an answer of another one, for longer than is usual."""
    return Literal("waits_for", (component, other))


def led(component: str) -> Literal:
    """One of the replicas of a protected component leads, or another one takes its place in time."""
    return Literal("led", (component,))


def whole(component: str) -> Literal:
    """All replicas of a protected component live, or come back in time."""
    return Literal("whole", (component,))


def caught_up(component: str) -> Literal:
    """No replica of a protected component needs longer than is usual to come to the state of the others."""
    return Literal("caught_up", (component,))


def keeps_up(component: str) -> Literal:
    """A component handles its messages as fast as they come: its mailbox does not grow and grow."""
    return Literal("keeps_up", (component,))


def made_atom(word: str) -> Literal:
    """The atom of something that a component makes, or makes it from: `replies(cache)`, or a topic that is ok.

    Raises:
        BadLiteral: the word has brackets, and is no literal.

    >>> str(made_atom("/prices")), str(made_atom("replies(cache)"))
    ('ok(/prices)', 'replies(cache)')
    """
    return parse(word) if "(" in word else ok(word)


def word_for(name: str) -> str:
    """Make a word of any name that an actor or a topic may have, so that literals can be written with it.

    Spaces, brackets, commas, `%` and what cannot be printed are spelled as in a URL; no two names have the same word.

    >>> word_for("/lab/left arm (new)"), word_for("/odom")
    ('/lab/left%20arm%20%28new%29', '/odom')
    """
    return "".join(
        char if char.isprintable() and char not in " (),%" else quote(char, safe="", errors="surrogatepass")
        for char in name
    )


def matched(one: str, other: str) -> Literal:
    """The trends of two values are alike; the order of the two means nothing."""
    return Literal("matched", (one, other))


def inc(value: str) -> Literal:
    """The literal that a value rises."""
    return Literal("inc", (value,))


def dec(value: str) -> Literal:
    """The literal that a value falls."""
    return Literal("dec", (value,))


def const(value: str) -> Literal:
    """The literal that a value stays as it is."""
    return Literal("const", (value,))


def parse(text: str) -> Literal:
    """Read one literal; names are not looked up (`Vocabulary.parse` does).

    Raises:
        BadLiteral: the text is none.

    >>> parse("not matched(odom.yaw, imu.yaw)")
    Literal(name='matched', args=('odom.yaw', 'imu.yaw'), positive=False)
    """
    found = _FORM.match(text)
    if found is None or found[3] == "not":
        raise BadLiteral(text, "a literal is spelled like `ok(/odom)` or `not ok(/odom)`")
    args = tuple(argument.strip() for argument in found[4].split(","))
    if not all(map(_ARGUMENT.match, args)):
        raise BadLiteral(text, "an argument is a word without spaces, brackets and commas, and there is at least one")
    return Literal(found[3], args, not (found[1] or found[2]))


def literal_of(given: Literal | str) -> Literal:
    """Return a literal that is given as such, or as its text.

    Raises:
        BadLiteral: the text is none. TypeError: it is neither.

    >>> literal_of("not ok(/odom)") == literal_of(~ok("/odom"))
    True
    """
    if isinstance(given, Literal):
        return given
    if isinstance(given, str):
        return parse(given)
    raise TypeError(f"a literal, or its text such as 'ok(/odom)', is wanted, and not {given!r}")


def atom_of(given: Literal | str) -> Literal:
    """Return an atom that is given as such, or as its text. Raises BadLiteral, also for a negation; TypeError."""
    literal = literal_of(given)
    if not literal.positive:
        raise BadLiteral(str(literal), "an observer is told of the atom; whether it holds is what it finds out")
    return literal


class Vocabulary:
    """The atoms that exist: those the model declares, and no other (T53).

    >>> words = Vocabulary([ok("/odom"), matched("odom.yaw", "imu.yaw")])
    >>> str(words.parse("not matched(imu.yaw,odom.yaw)"))
    'not matched(odom.yaw,imu.yaw)'
    """

    def __init__(self, atoms: Iterable[Literal]) -> None:
        self._atoms = {atom.atom: atom.atom for atom in atoms}
        for atom in tuple(self._atoms):
            if atom.name in SYMMETRIC:
                self._atoms.setdefault(Literal(atom.name, atom.args[::-1]), atom)

    def __iter__(self) -> Iterator[Literal]:
        return (atom for atom, declared in self._atoms.items() if atom == declared)

    def __contains__(self, literal: Literal) -> bool:
        return literal.atom in self._atoms

    def check(self, given: Literal | str) -> Literal:
        """The literal as it was declared (the arguments of a symmetric predicate in their declared order).

        Raises:
            BadLiteral: a text is no literal, or the model has no such atom. TypeError: it is neither literal nor text.
        """
        literal = literal_of(given)
        declared = self._atoms.get(literal.atom)
        if declared is None:
            raise BadLiteral(str(literal), self._unknown(literal))
        return declared if literal.positive else ~declared

    def parse(self, text: str) -> Literal:
        """Read a literal and look its names up.

        Raises:
            BadLiteral: the text is no literal, or the model has no such atom.
        """
        return self.check(parse(text))

    def _unknown(self, literal: Literal) -> str:
        names = {atom.name: len(atom.args) for atom in self._atoms}
        arity = names.get(literal.name, ARITIES.get(literal.name))
        if arity is None:
            hint = "; a negation is spelled `not `" if _OTHER_NEGATION.match(literal.name) else ""
            return f"the model knows no predicate {literal.name!r}{near(literal.name, names)}{hint}"
        if arity != len(literal.args):
            return f"{literal.name} takes {arity} argument{'s' * (arity != 1)}, not {len(literal.args)}"
        return f"the model declares no such atom{near(str(literal.atom), map(str, self))}"


def near(word: str, words: Iterable[str]) -> str:
    """Return the end of a sentence on a word that is unknown: which of the words may be meant, if any is like it."""
    like = difflib.get_close_matches(word, list(words), n=1)
    return f"; did you mean {like[0]!r}?" if like else ""
