"""Random schemas of a message over generations of a program, and the oracle: plain dicts that are mapped by name."""

from __future__ import annotations

import copy
import dataclasses
import random
from typing import Any

TYPES = {
    "int": lambda chance: chance.randrange(-5, 300),
    "float": lambda chance: chance.randrange(-5, 300) / 4,
    "str": lambda chance: chance.choice(("", "a", "much longer")),
    "int | None": lambda chance: chance.choice((None, 3, 70000)),
    "list[int]": lambda chance: [chance.randrange(300) for _ in range(chance.randrange(3))],
    "Inner": lambda chance: None,
    "list[Inner]": lambda chance: None,
    "dict[str, Inner | None]": lambda chance: None,
}
WIDER = {"int": ("float", "int | None"), "list[int]": ("list[float]",)}


@dataclasses.dataclass
class Field:
    """A field of a class: its type, its default (None: it has none) in Python, and what it was called."""

    name: str
    kind: str
    default: str | None = None
    former: tuple[str, ...] = ()


@dataclasses.dataclass
class Schema:
    """Two classes, one in the other; `numbers` counts names, so that none comes twice."""

    outer: list[Field]
    inner: list[Field]
    is_array: bool = True
    name: str = "Add"
    formers: tuple[str, ...] = ()
    numbers: int = 0

    def text(self) -> str:
        """The program with these classes."""
        return PROGRAM.format(
            inner=_fields(self.inner),
            outer=_fields(self.outer),
            inner_renames=_renames((), self.inner),
            renames=_renames(self.formers, self.outer),
            form=", array_like=True" if self.is_array else "",
            name=self.name,
        )

    def value(self, chance: random.Random) -> dict[str, Any]:
        """Drawn values of a message, by name."""
        return {field.name: self._drawn(field.kind, chance) for field in self.outer}

    def _drawn(self, kind: str, chance: random.Random) -> Any:
        if "Inner" not in kind:
            return TYPES.get(kind, TYPES["int"])(chance) if not kind.startswith("list[") else TYPES["list[int]"](chance)
        inner = {field.name: self._drawn(field.kind, chance) for field in self.inner}
        if kind == "Inner":
            return inner
        if kind == "list[Inner]":
            return [copy.deepcopy(inner) for _ in range(chance.randrange(3))]
        return {"x": inner, "y": None}

    # -- one step from a generation to the next, and what it does to a dict of before -------------------------------

    def step(
        self,
        chance: random.Random,
        messages: list[dict[str, Any]],
        kinds: tuple[str, ...] = ("add", "add", "remove", "swap", "rename", "widen", "inner", "form", "class"),
    ) -> None:
        """Change something of these kinds, in the classes and in what was said before."""
        what = chance.choice(kinds)
        if what == "form":
            self.is_array = not self.is_array
        elif what == "class":
            self.formers = (self.name, *self.formers)
            self.numbers += 1
            self.name = f"Add{self.numbers}"
        elif what == "inner":
            inside = [one for message in messages for field in self.outer for one in _inner(message[field.name], field)]
            self._change(self.inner, chance.choice(("add", "remove", "swap", "rename", "widen")), chance, inside, False)
        else:
            self._change(self.outer, what, chance, messages, True)

    def _change(
        self, fields: list[Field], what: str, chance: random.Random, values: list[dict[str, Any]], is_outer: bool
    ) -> None:
        if what == "add":
            kind, default = chance.choice((("int", "7"), ("str", "'x'"), ("int | None", "None"), ("list[int]", "[]")))
            self.numbers += 1
            field = Field(f"f{self.numbers}", kind, default)
            fields.insert(chance.randrange(len(fields) + 1), field)
            for value in values:
                value[field.name] = eval(default)
        elif what == "remove" and len(fields) > 1:
            gone = fields.pop(chance.randrange(len(fields)))
            for value in values:
                del value[gone.name]
        elif what == "swap":
            chance.shuffle(fields)
        elif what == "rename":
            field = chance.choice(fields)
            self.numbers += 1
            old, field.name = field.name, f"f{self.numbers}"
            field.former = (old, *field.former)
            for value in values:
                value[field.name] = value.pop(old)
        elif what == "widen":
            field = chance.choice(fields)
            field.kind = chance.choice(WIDER.get(field.kind, (field.kind,)))
            if field.default == "7" and field.kind == "float":
                field.default = "7.0"


def _fields(fields: list[Field]) -> str:
    return "\n".join(
        f"    {field.name}: {field.kind}" + ("" if field.default is None else f" = {field.default}") for field in fields
    )


def _renames(names: tuple[str, ...], fields: list[Field]) -> str:
    said = [repr(name) for name in names]
    said += [f"{field.name}={field.former!r}" for field in fields if field.former]
    return f"@hf.renamed({', '.join(said)})" if said else ""


def _inner(value: Any, field: Field) -> list[dict[str, Any]]:
    """The inner dicts of a field's value."""
    if "Inner" not in field.kind:
        return []
    found = value if isinstance(value, list) else value.values() if field.kind.startswith("dict") else (value,)
    return [one for one in found if one is not None]


def first(chance: random.Random) -> Schema:
    """The schema of the first generation. All fields may come without a default."""
    kinds = [chance.choice(tuple(TYPES)) for _ in range(chance.randrange(2, 5))]
    outer = [Field(f"f{number}", kind) for number, kind in enumerate(kinds)]
    inner = [Field(f"g{number}", chance.choice(("int", "str", "float", "list[int]"))) for number in range(2)]
    return Schema(outer, inner, chance.random() < 0.5, numbers=10)


PROGRAM = """
{inner_renames}
class Inner(msgspec.Struct, kw_only=True{form}):
{inner}


{renames}
class {name}(hf.Message["{name}"], kw_only=True):
{outer}


class Sink(hf.Actor):
    @hf.on({name})
    def take(self, message: {name}) -> {name}:
        return message


OTHERS = {{"sink": Sink}}
Add = {name}


class A(hf.Actor):
    def __init__(self) -> None:
        self.said: list[Any] = []

    @hf.on({name})
    async def add(self, message: {name}) -> {name}:
        sink = self.ctx.find("/app/sink", Sink)
        sink.tell(message)
        again = await sink.ask(message)
        self.said = [*self.said, plain(again)]
        return message

    @hf.on(Get, readonly=True)
    def get(self, message: Get) -> list[Any]:
        return self.said
"""
