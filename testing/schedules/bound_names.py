"""Names by which a test and its actors hold the world: functions imported by name, and generators made at import.

They are looked for in the modules of a program: that of the test, those of what it has imported, and so on. What is
installed is no part of it, but for the modules of actors.
"""

from __future__ import annotations

import functools
import random
import sys
import sysconfig
from collections.abc import Callable
from types import BuiltinFunctionType, FunctionType, ModuleType
from typing import Any, Final, NamedTuple

from ...actors.kernel.actor import Actor
from ..library_code import is_file_of_library

INSTALLED: Final = tuple({f"{sysconfig.get_paths()[name]}/" for name in ("stdlib", "purelib", "platlib")})
WORLD: Final = ("time", "os", "posix", "asyncio.tasks")
"""The modules whose functions are exchanged in a run."""


class BoundNames(NamedTuple):
    """What the modules of a program hold.

    Attributes:
        functions: names that may be those of functions of the world.
        generators: generators of random numbers, with a name that is the same in each process.
    """

    functions: tuple[tuple[ModuleType, str], ...]
    generators: tuple[tuple[str, Any], ...]


def names_of(test: Callable[..., Any]) -> BoundNames:
    """What the modules of a test and of its actors hold, as it was when they were first looked at."""
    while isinstance(test, functools.partial):
        test = test.func
    return _names_beside(test.__module__)


@functools.lru_cache(maxsize=256)
def _names_beside(first: str) -> BoundNames:
    functions, generators = list[tuple[ModuleType, str]](), dict[int, tuple[str, Any]]()
    for module in _modules_beside(first):
        for name, value in [*vars(module).items()]:
            if isinstance(value, BuiltinFunctionType | FunctionType) and value.__module__ in WORLD:
                functions.append((module, name))
            elif _is_generator(value):
                generators.setdefault(id(value), (f"{module.__name__}.{name}", value))
    return BoundNames(tuple(functions), tuple(generators.values()))


def _modules_beside(first: str) -> list[ModuleType]:
    """The modules of a program, from that of its test on."""
    found: dict[str, ModuleType] = {}
    names = [(first, True)]
    while names:
        name, is_of_program = names.pop()
        module = sys.modules.get(name)
        if module is None or name in found or not (is_of_program or _is_of_user(module)):
            continue
        found[name] = module
        for value in [*vars(module).values()]:
            if isinstance(value, ModuleType):
                names.append((value.__name__, False))
            elif isinstance(value, type | FunctionType) and isinstance(value.__module__, str):
                is_actor = isinstance(value, type) and issubclass(value, Actor)
                names.append((value.__module__, is_actor and not _is_of_library(value.__module__)))
    return [*found.values()]


def _is_of_user(module: ModuleType) -> bool:
    file = module.__dict__.get("__file__")
    return isinstance(file, str) and not file.startswith(INSTALLED) and not is_file_of_library(file)


def _is_of_library(name: str) -> bool:
    module = sys.modules.get(name)
    return module is not None and is_file_of_library(str(module.__dict__.get("__file__")))


def _is_generator(value: Any) -> bool:
    """Whether a value is a generator whose numbers depend on its state alone."""
    if isinstance(value, random.Random):
        return not isinstance(value, random.SystemRandom)
    numpy: Any = sys.modules.get("numpy.random")
    return numpy is not None and isinstance(value, numpy.Generator | numpy.RandomState)


class OwnStates:
    """Generators of a program, which draw from the seed of a run while it lasts."""

    def __init__(self, generators: tuple[tuple[str, Any], ...], seed: int) -> None:
        self._generators, self._seed = generators, seed
        self._own: dict[str, Any] = {}
        self._before: dict[str, Any] = {}

    def put(self) -> None:
        """Go on with the numbers of the run."""
        for name, generator in self._generators:
            self._before[name] = _state(generator)
            if name in self._own:
                _set_state(generator, self._own[name])
            else:
                _seed(generator, f"{name} {self._seed}")

    def take_back(self) -> None:
        """Go on with the numbers that each would have had."""
        for name, generator in self._generators:
            self._own[name] = _state(generator)
            _set_state(generator, self._before.pop(name))


def _state(generator: Any) -> Any:
    if isinstance(generator, random.Random):
        return generator.getstate()
    return generator.bit_generator.state if _is_new(generator) else generator.get_state()


def _set_state(generator: Any, state: Any) -> None:
    if isinstance(generator, random.Random):
        generator.setstate(state)
    elif _is_new(generator):
        generator.bit_generator.state = state
    else:
        generator.set_state(state)


def _seed(generator: Any, text: str) -> None:
    if isinstance(generator, random.Random):
        generator.seed(text)
        return
    number = random.Random(text).getrandbits(32)
    if _is_new(generator):
        generator.bit_generator.state = type(generator.bit_generator)(number).state
    else:
        generator.seed(number)


def _is_new(generator: Any) -> bool:
    """Whether it is of numpy's newer kind, whose state is that of its source of bits."""
    return isinstance(generator, sys.modules["numpy.random"].Generator)
