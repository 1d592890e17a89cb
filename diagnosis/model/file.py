"""Models in YAML files: the paper's five sections (D29), or components.

Five sections, the form of the paper's own files; `rules` are clauses, and components are whoever occurs in `AB`/`NAB`:

    ab: AB
    nab: NAB
    neg_prefix: not_
    props: [on(ja), ok(/odom)]
    rules:
      - NAB(ja) -> on(ja)
      - NAB(jn), NAB(ja) -> ok(/odom)

Components, where clauses 1 to 6 are made:

    hardware: {ja: {prior: 0.001}, imu: {switchable: false}}
    drivers: {jn: {on: [ja], out: [/odom]}}
    nodes: {hm: {out: {/map: [/scan]}}}
    values: {/odom: [odom.yaw]}
    related: [[[jn, odom.yaw], [in, imu.yaw]]]
    expect: [{atom: ok(memory), of: [hm], given: []}]
    external: [/clock]
    propositions: [on(lamp)]
    clauses: [NAB(hm) -> ok(/other)]

Every scalar is read as text and then as what its place asks for, so that `on` and `no` are names, not booleans. No tag
makes an object, an alias is refused, and a key that occurs twice is an error. Errors name file and line.
"""

from __future__ import annotations

import re
import typing
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final, TypeAlias, TypeVar, cast

import msgspec
import yaml

from .check import ModelError
from .clauses import BadClause, read_clause
from .declaration import (
    DEFAULT_PRIOR,
    Clause,
    Component,
    Declaration,
    Expectation,
    Kind,
    Relation,
    Spelling,
    Value,
    outputs,
)

LARGEST: Final = 16 * 1024 * 1024
"""Bytes of a model file that are read."""

_FIVE: Final = {"ab", "nab", "neg_prefix", "props", "rules"}
_LEVELS: Final = 50

YesNo: TypeAlias = typing.Literal["true", "yes", "false", "no"]
Outputs: TypeAlias = str | list[str] | dict[str, str | list[str]]
T = TypeVar("T")


class _Hardware(msgspec.Struct, forbid_unknown_fields=True):
    switchable: YesNo = "true"
    prior: float = DEFAULT_PRIOR


class _Driver(msgspec.Struct, forbid_unknown_fields=True):
    on: list[str] = []
    out: Outputs = []
    prior: float = DEFAULT_PRIOR


class _Node(msgspec.Struct, forbid_unknown_fields=True):
    out: Outputs = []
    prior: float = DEFAULT_PRIOR


class _Expected(msgspec.Struct, forbid_unknown_fields=True):
    atom: str
    of: list[str]
    given: list[str] = []


def load(path: str | Path) -> Declaration:
    """Read a model file.

    Raises:
        ModelError: it is no YAML, or no model; names file and line.
        OSError: it cannot be read.
    """
    file = Path(path)
    if file.stat().st_size > LARGEST:
        raise ModelError((f"{file}: larger than {LARGEST} bytes",))
    try:
        text = file.read_text("utf-8")
    except UnicodeDecodeError as error:
        raise ModelError((f"{file}: no UTF-8 text ({error.reason} at byte {error.start})",)) from None
    return read(text, str(file))


def read(text: str, file: str = "model") -> Declaration:
    """As `load`, from text; `file` is for errors."""
    return _Reader(file).declaration(text)


class _Reader:
    """One file on its way to a declaration; collects all problems of one kind before it gives up."""

    def __init__(self, file: str) -> None:
        self._file = file
        self._problems: list[str] = []

    def declaration(self, text: str) -> Declaration:
        sections = self._mapping(self._compose(text), "the file")
        unknown = set(sections) - _FIVE
        if unknown == set(sections):
            made = self._components(sections)
        else:
            for name in sorted(unknown):
                self._problem(sections[name], f"section {name} does not go with the five sections of clauses")
            made = self._five(sections)
        if self._problems:
            raise ModelError(tuple(self._problems))
        return made

    def _compose(self, text: str) -> yaml.Node:
        try:
            # A few bytes of aliases could stand for gigabytes.
            for event in yaml.parse(text, yaml.BaseLoader):
                if isinstance(event, yaml.AliasEvent):
                    self._problems.append(f"{self._file}:{event.start_mark.line + 1}: aliases are not allowed here")
                    raise ModelError(tuple(self._problems))
            node: yaml.Node | None = yaml.compose(text, yaml.BaseLoader)
        except yaml.MarkedYAMLError as error:
            mark = error.problem_mark or error.context_mark
            line = f":{mark.line + 1}" if mark else ""
            raise ModelError((f"{self._file}{line}: {error.problem or error.context}",)) from None
        except yaml.YAMLError as error:
            raise ModelError((f"{self._file}: {error}",)) from None
        except RecursionError:
            raise ModelError((f"{self._file}: nested too deeply",)) from None
        if node is None:
            raise ModelError((f"{self._file}: empty",))
        return node

    # The paper's five sections.

    def _five(self, sections: Mapping[str, yaml.Node]) -> Declaration:
        texts = {name: self._read(sections[name], str) for name in ("ab", "nab", "neg_prefix") if name in sections}
        spelling = msgspec.structs.replace(Spelling(), **{name: text for name, text in texts.items() if text})
        props = [(self._read(node, str) or "", self._where(node)) for node in self._list(sections.get("props"))]
        clauses = [Clause(self._read(node, str) or "", self._where(node)) for node in self._list(sections.get("rules"))]
        propositions = [text for text, _ in props if not text.startswith((f"{spelling.ab}(", f"{spelling.nab}("))]
        named = [(text[text.index("(") + 1 : -1].strip(), where) for text, where in props if text not in propositions]
        named += self._needed(clauses, spelling)
        components = {name: _bare(name, propositions, where) for name, where in reversed(named)}
        return Declaration(
            components=tuple(reversed(components.values())),
            clauses=tuple(clauses),
            propositions=tuple(propositions),
            spelling=spelling,
            where=self._file,
        )

    def _needed(self, clauses: list[Clause], spelling: Spelling) -> Iterator[tuple[str, str]]:
        for clause in clauses:
            try:
                rule = read_clause(clause, spelling)
            except BadClause as error:
                self._problems.append(f"{clause.where}: clause {clause.text!r}: {error}")
            else:
                yield from ((name, clause.where) for name in (rule.needs if rule else ()))

    # Components.

    def _components(self, sections: Mapping[str, yaml.Node]) -> Declaration:
        readers = {
            "hardware": self._hardware,
            "drivers": self._drivers,
            "nodes": self._nodes,
            "values": self._values,
            "related": self._related,
            "expect": self._expectations,
            "external": self._external,
            "propositions": self._propositions,
            "clauses": self._clauses,
        }
        found: dict[str, list[Any]] = {name: [] for name in readers}
        for name, node in sections.items():
            if name not in readers:
                self._problem(node, f"there is no section {name!r}; the sections are {', '.join(readers)}")
            else:
                found[name] = list(readers[name](node))
        return Declaration(
            components=(*found["hardware"], *found["drivers"], *found["nodes"]),
            values=tuple(found["values"]),
            relations=tuple(found["related"]),
            expectations=tuple(found["expect"]),
            propositions=(*found["external"], *found["propositions"]),
            clauses=tuple(found["clauses"]),
            where=self._file,
        )

    def _hardware(self, node: yaml.Node) -> Iterator[Component]:
        for name, where, entry in self._entries(node, _Hardware):
            kind = Kind.SWITCHABLE if entry.switchable in ("true", "yes") else Kind.DEVICE
            yield Component(name=name, kind=kind, prior=entry.prior, where=where)

    def _drivers(self, node: yaml.Node) -> Iterator[Component]:
        for name, where, entry in self._entries(node, _Driver):
            out = outputs(entry.out)
            yield Component(name=name, kind=Kind.DRIVER, on=tuple(entry.on), out=out, prior=entry.prior, where=where)

    def _nodes(self, node: yaml.Node) -> Iterator[Component]:
        for name, where, entry in self._entries(node, _Node):
            yield Component(name=name, out=outputs(entry.out), prior=entry.prior, where=where)

    def _values(self, node: yaml.Node) -> Iterator[Value]:
        for topic, names in self._mapping(node, "values").items():
            for name in self._read(names, list[str]) or []:
                yield Value(name, topic, self._where(names))

    def _related(self, node: yaml.Node) -> Iterator[Relation]:
        for item in self._list(node):
            pair = self._read(item, tuple[tuple[str, str], tuple[str, str]])
            if pair is not None:
                yield Relation(*pair, self._where(item))

    def _expectations(self, node: yaml.Node) -> Iterator[Expectation]:
        for item in self._list(node):
            entry = self._read(item, _Expected)
            if entry is not None:
                yield Expectation(entry.atom, tuple(entry.of), tuple(entry.given), self._where(item))

    def _external(self, node: yaml.Node) -> Iterator[str]:
        return (f"ok({topic})" for topic in self._read(node, list[str]) or [])

    def _propositions(self, node: yaml.Node) -> Iterator[str]:
        return iter(self._read(node, list[str]) or [])

    def _clauses(self, node: yaml.Node) -> Iterator[Clause]:
        return (Clause(self._read(item, str) or "", self._where(item)) for item in self._list(node))

    # Nodes of YAML.

    def _entries(self, node: yaml.Node, kind: type[T]) -> Iterator[tuple[str, str, T]]:
        entries = self._mapping(node, "a section of components")
        lines = {key.value: self._where(key) for key, _ in node.value} if entries else {}
        for name, entry in entries.items():
            is_empty = isinstance(entry, yaml.ScalarNode) and entry.value in ("", "~", "null")
            made = kind() if is_empty else self._read(entry, kind)
            if made is not None:
                yield name, lines[name], made

    def _mapping(self, node: yaml.Node, what: str) -> dict[str, yaml.Node]:
        if isinstance(node, yaml.ScalarNode) and not node.value:
            return {}
        if not isinstance(node, yaml.MappingNode):
            self._problem(node, f"{what} is a mapping, `name: ...`")
            return {}
        found: dict[str, yaml.Node] = {}
        for key, value in node.value:
            if not isinstance(key, yaml.ScalarNode):
                self._problem(key, "a key is a name")
            elif key.value in found:
                self._problem(key, f"{key.value} is there twice, also in line {found[key.value].start_mark.line + 1}")
            else:
                found[key.value] = value
        return found

    def _list(self, node: yaml.Node | None) -> list[yaml.Node]:
        if node is None or (isinstance(node, yaml.ScalarNode) and not node.value):
            return []
        if not isinstance(node, yaml.SequenceNode):
            self._problem(node, "a list is expected here")
            return []
        return cast("list[yaml.Node]", node.value)

    def _read(self, node: yaml.Node, kind: type[T]) -> T | None:
        """The node as a value of that type; None, and a problem with its line, if it is none."""
        try:
            return msgspec.convert(self._plain(node), kind, strict=False)
        except msgspec.ValidationError as error:
            text, _, path = str(error).partition(" - at `$")
            self._problem(_at(node, path.rstrip("`")), f"{text}{f' (at {path[1:-1]})' if len(path) > 2 else ''}")
            return None

    def _plain(self, node: yaml.Node, level: int = 0) -> Any:
        if level > _LEVELS:
            self._problem(node, "nested too deeply")
            return None
        if isinstance(node, yaml.SequenceNode):
            return [self._plain(item, level + 1) for item in node.value]
        if isinstance(node, yaml.MappingNode):
            return {key: self._plain(value, level + 1) for key, value in self._mapping(node, "this").items()}
        return node.value

    def _where(self, node: yaml.Node) -> str:
        return f"{self._file}:{node.start_mark.line + 1}"

    def _problem(self, node: yaml.Node, text: str) -> None:
        self._problems.append(f"{self._where(node)}: {text}")


def _at(node: yaml.Node, path: str) -> yaml.Node:
    """The node that msgspec's path leads to, as far as it says."""
    for key, index in re.findall(r"\.(\w+)|\[(\d+)\]", path):
        if key and isinstance(node, yaml.MappingNode):
            node = next((value for name, value in node.value if name.value == key), node)
        elif index and isinstance(node, yaml.SequenceNode):
            node = node.value[int(index)]
    return node


def _bare(name: str, propositions: list[str], where: str) -> Component:
    """A component of which only clauses speak: what it is follows from what can be observed of it."""
    if f"on({name})" in propositions:
        kind = Kind.SWITCHABLE
    elif f"running({name})" in propositions:
        kind = Kind.NODE
    else:
        kind = Kind.DRIVER  # published somewhere, or nobody would ask
    return Component(name=name, kind=kind, is_implied=False, where=where)
