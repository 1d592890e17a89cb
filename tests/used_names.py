"""Public names that no code uses which runs: blocks of the documents, programs of `examples/`, docstring examples.

A name is used if an expression leads to the very thing that it stands for: `hf.errors.StoreError`, `testing.Strike`, or
`Strike` alone where it was imported. An import by itself is no use, and neither is a quotation.
"""

import ast
import doctest
import importlib
from collections.abc import Iterator, Mapping

from tests.public_docs import ROOMS
from tests.test_docs import DOCUMENTS, MODULES, ROOT, program, python_blocks, source_of

NOTHING = object()


def imported(tree: ast.AST) -> dict[str, object]:
    """What the import statements of a program bind, as far as it is holdfast's.

    >>> names = imported(ast.parse("import json, holdfast as hf; from holdfast.testing import Strike as S"))
    >>> sorted(names), names["hf"].__name__, names["S"].__name__
    (['S', 'hf'], 'holdfast', 'Strike')
    """
    bound: dict[str, object] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for one in node.names:
                if one.name.partition(".")[0] == "holdfast":
                    whole = importlib.import_module(one.name)
                    bound[one.asname or "holdfast"] = whole if one.asname else importlib.import_module("holdfast")
        elif isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] == "holdfast":
            module = importlib.import_module(node.module or "")
            for one in node.names:
                bound[one.asname or one.name] = member(module, one.name)
    return bound


def member(owner: object, name: str) -> object:
    """An attribute, or a module in a package that nobody has imported yet."""
    found = getattr(owner, name, NOTHING)
    if found is NOTHING and hasattr(owner, "__path__"):
        return importlib.import_module(f"{owner.__name__}.{name}")  # type: ignore[attr-defined]
    return found


def used(tree: ast.AST, bound: Mapping[str, object]) -> Iterator[object]:
    """Yield what the expressions of a program lead to, if it begins with a name in `bound`.

    >>> import holdfast as hf
    >>> list(used(ast.parse("hf.errors.StoreError; other.StoreError"), {"hf": hf})) == [hf.errors.StoreError]
    True
    """
    if isinstance(tree, (ast.Name, ast.Attribute)):
        found = value_of(tree, bound)
        if found is not NOTHING:
            yield found
            return
    for child in ast.iter_child_nodes(tree):
        yield from used(child, bound)


def value_of(expression: ast.AST, bound: Mapping[str, object]) -> object:
    """What a dotted name stands for; NOTHING if that is not known."""
    if isinstance(expression, ast.Name):
        return bound.get(expression.id, NOTHING)
    if isinstance(expression, ast.Attribute):
        owner = value_of(expression.value, bound)
        return NOTHING if owner is NOTHING else getattr(owner, expression.attr, NOTHING)
    return NOTHING


def programs() -> Iterator[tuple[ast.AST, dict[str, object]]]:
    """Yield everything that runs, with what its names stand for."""
    documents = [program(list(python_blocks(path.read_text("utf-8")))) for path in DOCUMENTS]
    files = [path.read_text("utf-8") for path in sorted((ROOT / "examples").rglob("*.py"))]
    for text in [*documents, *files]:
        tree = ast.parse(text)
        yield tree, imported(tree)
    for name in MODULES:
        if ">>>" in source_of(name).read_text("utf-8"):
            module = importlib.import_module(name)
            for test in doctest.DocTestFinder().find(module):
                tree = ast.parse("".join(example.source for example in test.examples))
                yield tree, {**vars(module), **imported(tree)}


def unused() -> list[str]:
    """List the public names that nothing uses which runs, each once, with its room."""
    seen = {id(found) for tree, bound in programs() for found in used(tree, bound)}
    missing: dict[int, str] = {}
    for room in ROOMS:
        module = importlib.import_module(room)
        for name in module.__all__:
            value = getattr(module, name)
            if id(value) not in seen:
                missing.setdefault(id(value), f"{room}.{name}")
    return sorted(missing.values())


if __name__ == "__main__":
    print("\n".join(unused()))
