"""Circuits of gates as models for diagnosis, and a second opinion on them that simulates each set of faulty gates.

A model has no circles, and in a circuit one concludes from inputs to outputs and back. So each line has its values once
in each layer, and the layers take turns: what a gate that works says of its output, and then of its inputs. Clauses
conclude step by step and never by cases ("whether this line is high or low, that one is high"), so a set of gates may
be left as a diagnosis that only cases would exclude. No set is ever excluded that explains what is observed.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import operator
from collections.abc import Iterator, Mapping

from holdfast.diagnosis.literals import Literal
from holdfast.diagnosis.model import Model, System

KINDS = {
    "and": (False, False),
    "buffer": (False, False),
    "nand": (False, True),
    "not": (False, True),
    "or": (True, True),
    "nor": (True, False),
}
"""Kind of gate to the value of an input that decides the output alone, and the output that it then has."""


@dataclasses.dataclass(frozen=True)
class Circuit:
    """Gates with their inputs, each after those whose output it takes.

    Attributes:
        inputs, outputs: lines that are observed, in order.
        gates: gate, which is also the name of its output line, to its kind and its inputs.
        layers: how often conclusions are drawn, from inputs to outputs and back in turn.
    """

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    gates: Mapping[str, tuple[str, tuple[str, ...]]]
    layers: int = 3

    def model(self) -> Model:
        """Each gate is a component, and each line may be high or low, as is concluded in each of the layers."""
        system = System()
        for layer in range(self.layers + 1):
            for line in (*self.inputs, *self.gates):
                high, low = (str(value(line, is_high, layer)) for is_high in (True, False))
                system.proposition(high, low)
                if layer:
                    system.clause(f"{value(line, True, layer - 1)} -> {high}")
                    system.clause(f"{value(line, False, layer - 1)} -> {low}")
                system.clause(f"{high}, {low} -> false")
        for gate, (kind, inputs) in self.gates.items():
            system.node(f"g{gate}")
            deciding, decided = KINDS[kind]
            for layer in range(1, self.layers + 1):
                works = f"NAB(g{gate})"
                if layer % 2:  # From inputs to outputs.
                    for line in inputs:
                        system.clause(f"{works}, {value(line, deciding, layer)} -> {value(gate, decided, layer)}")
                    others = ", ".join(str(value(line, not deciding, layer)) for line in inputs)
                    system.clause(f"{works}, {others} -> {value(gate, not decided, layer)}")
                    continue
                for line in inputs:
                    none = value(gate, not decided, layer)
                    system.clause(f"{works}, {none} -> {value(line, not deciding, layer)}")
                    rest = "".join(f", {value(one, not deciding, layer - 1)}" for one in inputs if one != line)
                    system.clause(f"{works}, {value(gate, decided, layer)}{rest} -> {value(line, deciding, layer)}")
        return Model(system)

    def observed(self, case: tuple[int, int]) -> list[Literal]:
        """The literals of a case: the inputs and the outputs as numbers, of which the first line is the lowest bit."""
        numbers = zip((self.inputs, self.outputs), case, strict=True)
        return [value(line, bool(number >> bit & 1), 0) for lines, number in numbers for bit, line in enumerate(lines)]

    def said(self, stuck: Mapping[str, bool]) -> list[int]:
        """What the outputs say for each number that the inputs can be, with these gates stuck high or low.

        All inputs are simulated at once: bit i of a line's number is its value while the inputs are i.
        """
        count = 1 << len(self.inputs)
        every = (1 << count) - 1
        lines = {line: every // ((1 << (1 << bit)) + 1) << (1 << bit) for bit, line in enumerate(self.inputs)}
        for gate, (kind, inputs) in self.gates.items():
            deciding, decided = KINDS[kind]
            undecided = every
            for line in inputs:
                undecided &= ~lines[line] if deciding else lines[line]
            made = undecided ^ every if decided else undecided
            lines[gate] = every * stuck[gate] if gate in stuck else made
        return [lines[line] for line in self.outputs]

    def cases(self, stuck: Mapping[str, bool]) -> list[tuple[int, int]]:
        """Each number of the inputs at which these stuck gates show, with the number that the outputs then are."""
        said = self.said(stuck)
        wrong = [one ^ healthy for one, healthy in zip(said, self.said({}), strict=True)]
        shows = functools.reduce(operator.or_, wrong)
        return [(number, sum((one >> number & 1) << bit for bit, one in enumerate(said))) for number in bits(shows)]

    def diagnoses(self, largest: int) -> dict[tuple[int, int], set[frozenset[str]]]:
        """The minimal diagnoses of every case, of up to `largest` gates, by simulation of all sets of faulty gates.

        A set explains a case if its gates could have said something, each what it wanted, with which the outputs come
        out as observed; a set is looked at for those cases only that no part of it explains.
        """
        count = 1 << len(self.inputs)
        every = (1 << count) - 1
        explained: dict[frozenset[str], list[int]] = {}
        found: dict[tuple[int, int], set[frozenset[str]]] = {
            case: set() for case in itertools.product(range(count), range(1 << len(self.outputs)))
        }
        for faulty in self._sets(largest):
            parts = [explained[faulty - {gate}] for gate in faulty]
            fits = [0] * (1 << len(self.outputs))
            for values in itertools.product((False, True), repeat=len(faulty)):
                said = self.said(dict(zip(sorted(faulty), values, strict=True)))
                for outputs in range(len(fits)):
                    same = every
                    for bit, line in enumerate(said):
                        same &= line if outputs >> bit & 1 else ~line
                    fits[outputs] |= same & every
            for outputs, same in enumerate(fits):
                new = same
                for part in parts:
                    new &= ~part[outputs]
                for number in bits(new):
                    found[number, outputs].add(frozenset(f"g{gate}" for gate in faulty))
                for part in parts:
                    fits[outputs] |= part[outputs]
            explained[faulty] = fits
        return found

    def _sets(self, largest: int) -> Iterator[frozenset[str]]:
        for size in range(largest + 1):
            yield from map(frozenset, itertools.combinations(self.gates, size))


def value(line: str, is_high: bool, layer: int) -> Literal:
    """The literal that a line is high, or low, as is known in a layer."""
    return Literal(f"{'high' if is_high else 'low'}{layer}", (f"w{line}",))


def bits(number: int) -> Iterator[int]:
    """The places of the ones of a number, lowest first."""
    while number:
        lowest = number & -number
        yield lowest.bit_length() - 1
        number ^= lowest


C17 = Circuit(
    ("1", "2", "3", "6", "7"),
    ("22", "23"),
    {
        gate: ("nand", inputs)
        for gate, inputs in {
            "10": ("1", "3"),
            "11": ("3", "6"),
            "16": ("2", "11"),
            "19": ("11", "7"),
            "22": ("10", "16"),
            "23": ("16", "19"),
        }.items()
    },
)
"""The smallest circuit of ISCAS-85."""


def _comparator() -> Circuit:
    gates: dict[str, tuple[str, tuple[str, ...]]] = {}
    for bit in range(4):
        gates[f"notA{bit}"] = ("not", (f"A{bit}",))
        gates[f"notB{bit}"] = ("not", (f"B{bit}",))
        gates[f"L{bit}"] = ("and", (f"notA{bit}", f"B{bit}"))
        gates[f"G{bit}"] = ("and", (f"A{bit}", f"notB{bit}"))
        gates[f"E{bit}"] = ("nor", (f"L{bit}", f"G{bit}"))
    equal = tuple(f"E{bit}" for bit in range(4))
    for name in ("L", "G"):
        gates[f"{name}3only"] = ("buffer", (f"{name}3",))
        for bit in (2, 1, 0):
            gates[f"{name}{bit}only"] = ("and", (f"{name}{bit}", *equal[bit + 1 :]))
        gates[f"{name}before"] = ("and", (f"{name}in", *equal))
        terms = (f"{name}3only", f"{name}2only", f"{name}1only", f"{name}0only", f"{name}before")
        gates[f"{name}out"] = ("or", terms)
    gates["Eout"] = ("and", ("Ein", *equal))
    inputs = (*(f"A{bit}" for bit in range(4)), *(f"B{bit}" for bit in range(4)), "Lin", "Ein", "Gin")
    return Circuit(inputs, ("Lout", "Eout", "Gout"), gates)


COMPARATOR = _comparator()
"""The magnitude comparator 74L85 of two numbers of four bits: less, equal and greater, with inputs to cascade it.

Gate by gate as Hansen, Yalcin and Hayes describe it ("Unveiling the ISCAS-85 Benchmarks", IEEE Design & Test 16(3),
1999, `Circuit74L85`), with 33 gates: their text has each of the eight ANDs `L` and `G` twice, with the same inputs.
"""
