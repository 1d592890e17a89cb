"""Docstrings of the public names: which begin with a pronoun, and which say less than the name does.

`python -m tests.public_docs` lists them; tests/test_public_docs.py sees to it that there is none.
"""

import importlib
import inspect
import re
from collections.abc import Iterator
from functools import cached_property

ROOMS = (
    "holdfast",
    "holdfast.adapters",
    "holdfast.checkpoint",
    "holdfast.diagnosis",
    "holdfast.errors",
    "holdfast.events",
    "holdfast.ftm",
    "holdfast.supervision",
    "holdfast.system",
    "holdfast.testing",
)
PRONOUNS = {
    *("he", "her", "his", "i", "it", "its", "she", "that", "their", "them", "these", "they", "this", "those", "we"),
    *("what", "which", "who", "whom", "whose", "you", "your"),
}
"""A first word that points at something the reader does not see when a docstring stands alone."""
FRAGMENTS = {"as", "how", "when", "where", "whether", "why"}
"""A first word that opens half a sentence: say who does what, or what to do."""
LEAST = 4
"""Words of the first sentence that are not in the name."""


def words(text: str) -> list[str]:
    """Split a text or a name into its words, in lower case.

    >>> words("ask_later"), words("MailboxFull"), words("It's `x`.")
    (['ask', 'later'], ['mailbox', 'full'], ["it's", 'x'])
    """
    apart = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", " ", text)
    return [word.lower() for word in re.findall(r"[A-Za-z0-9'’]+", apart.replace("_", " "))]


def problem(name: str, text: str | None) -> str:
    """Say what is wrong with the docstring of a name; nothing if it is good.

    >>> problem("Timer.cancel", "It is over."), problem("Timer.cancel", "Cancel the timer.")
    ('begins with a pronoun', 'says less than the name')
    >>> problem("Timer.cancel", "Cancel the timer; a message that has come stays.")
    ''
    """
    if not text:
        return "is missing"
    said = words(text.split("\n\n")[0])
    if said and said[0].partition("'")[0] in PRONOUNS:
        return "begins with a pronoun"
    if said and said[0] in FRAGMENTS:
        return "is no whole sentence"
    own = set(words(name.rpartition(".")[2]))
    return "says less than the name" if len([word for word in said if word not in own]) < LEAST else ""


def own_docstring(value: object) -> str | None:
    """Return what the source says of a value itself, not what it inherits."""
    text = getattr(value, "__doc__", None)
    return inspect.cleandoc(text) if isinstance(text, str) else None


def public_docstrings() -> Iterator[tuple[str, str | None]]:
    """Yield the public classes and functions of every room, and their public methods, each once, with their docstrings.

    Methods of messages, errors and other structs that msgspec or Python make are left out, as are overriding methods
    without a docstring of their own, whose base speaks for them.
    """
    seen: set[int] = set()
    for room in ROOMS:
        module = importlib.import_module(room)
        for name in getattr(module, "__all__", [name for name in vars(module) if not name.startswith("_")]):
            value = getattr(module, name)
            if not hasattr(module, "__all__") and getattr(value, "__module__", "") != room:
                continue  # It is imported there, and of another room.
            if not (inspect.isclass(value) or inspect.isfunction(value)) or id(value) in seen:
                continue
            seen.add(id(value))
            yield f"{room}.{name}", own_docstring(value)
            if inspect.isclass(value):
                yield from _methods(f"{room}.{name}", value)


def _methods(where: str, kind: type) -> Iterator[tuple[str, str | None]]:
    for name, member in vars(kind).items():
        if name.startswith("_"):
            continue
        method = member.__func__ if isinstance(member, (classmethod, staticmethod)) else member
        if inspect.isfunction(method) or isinstance(method, (property, cached_property)):
            inherited = any(name in vars(base) for base in kind.__mro__[1:])
            text = own_docstring(method)
            handles = hasattr(method, "__handles__")  # A handler is known by its message.
            if text is not None or not (inherited or handles):
                yield f"{where}.{name}", text


def offenders() -> list[str]:
    """List every public name whose docstring is not good, with what is wrong."""
    return [f"{name}: {wrong}" for name, text in public_docstrings() if (wrong := problem(name, text))]


if __name__ == "__main__":
    print("\n".join(offenders()))
