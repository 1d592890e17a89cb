"""The program that is to come: from the name of its specs, how it starts the actor at each address."""

from __future__ import annotations

import dataclasses
import importlib
import os
import sys
from collections.abc import Iterable, Mapping
from typing import Any, cast

from ...actors.errors import HoldfastError, SpecError, error_text, type_name
from ...actors.kernel.actor import Start
from ...actors.persistence import child_key, plan_key
from ...actors.process.fork.preload import attempt, load_main
from ...checkpoint.home.homes import Homes
from ...checkpoint.recovery_file import RecoveryFile
from ...checkpoint.store_tools.rerun import Recipe
from ...checkpoint.store_tools.upgrade_check import AddressCheck
from ...supervision.dynamic import MADE_UP
from ...supervision.noted import noted_plan, unpack_noted
from ...supervision.spec import NAMELESS, ChildSpec, Plan
from ...supervision.supervisor import Supervisor
from ..mechanism_notes import MechanismNotes
from ..specification import Specifications

Named = dict[str, ChildSpec]
"""Specs by address; those of the children of the root by "/" and their id."""


def load_specs(target: str) -> Named:
    """Import what "module:name" or "path/to/program.py:name" stands for: what a program starts.

    A program is named by its path if its classes are recorded as those of `__main__`, for it was started as a script;
    what stands below `if __name__ == "__main__"` is not run.

    The name stands for a spec, an iterable of specs, a mapping of addresses to specs (of those that are started while
    the program runs), or a function without arguments that returns one of these.

    Raises:
        SpecError: it cannot be imported, or is none of these.
    """
    return specs_in(target, load_named(target))


def load_named(target: str) -> Any:
    """What a target names, 'module:name' or 'program.py:name', whatever it is.

    Raises:
        SpecError: it cannot be imported, or is not there.
    """
    module, _, name = target.rpartition(":")
    if not module or not name:
        raise SpecError(target, "name the specs as 'module:name' or 'program.py:name', such as 'shop.main:tree'")
    is_script = module.endswith(".py")
    find_in(os.path.dirname(os.path.abspath(module)) if is_script else os.getcwd())
    problem = attempt(lambda: load_main(module, True) if is_script else _import(module))
    if problem:
        where = "" if is_script else "; it is looked for in this folder, and where PYTHONPATH says"
        raise SpecError(target, f"it cannot be imported: {problem}{where}")
    found: Any = sys.modules["__main__" if is_script else module]
    for part in name.split("."):
        found = getattr(found, part, None)
    if found is None:
        raise SpecError(target, f"{module} has no {name}")
    return found


def specs_in(target: str, found: Any) -> Named:
    """The specs in what a target names, which is called if it is a function. Raises SpecError."""
    specs: Named = {}
    try:
        _collect(target, found() if callable(found) else found, specs)
    except HoldfastError:
        raise
    except BaseException as error:  # A program that reads its specs again goes on, whatever they raise.
        raise SpecError(target, f"it raised {type_name(type(error))}: {error_text(error)}") from error
    return specs


def find_in(folder: str, *, first: bool = True) -> None:
    """Let modules be found in a folder: first, as `python -m` does with the current one, or after all others."""
    if folder not in sys.path:
        sys.path.insert(0 if first else len(sys.path), folder)


def _import(module: str) -> None:
    importlib.import_module(module)


def _collect(target: str, found: Any, specs: Named) -> None:
    if isinstance(found, ChildSpec):
        specs[f"/{found.id}"] = found
    elif isinstance(found, Mapping):
        for address, spec in cast("Mapping[object, object]", found).items():
            if not isinstance(address, str) or not address.startswith("/") or not isinstance(spec, ChildSpec):
                raise SpecError(target, f"a mapping must be of addresses to specs, not of {address!r} to {spec!r:.100}")
            specs[address] = spec
    elif isinstance(found, Iterable) and not isinstance(found, str | bytes):
        for one in cast("Iterable[object]", found):
            _collect(target, one, specs)
    else:
        raise SpecError(target, f"it must be a spec, some specs, or a function that returns them, not {found!r:.100}")


class NewProgram:
    """What the new program starts where, as far as that is known before it runs."""

    def __init__(self, homes: Homes, specs: Named, file: RecoveryFile | None = None) -> None:
        self._homes, self._file = homes, file
        self._specifications = Specifications(homes, is_kept=False)
        self._mechanisms = MechanismNotes(homes)
        self._found: dict[str, ChildSpec] = {}
        self._unasked: dict[str, str] = {}
        self._lost: dict[str, str] = {}
        self._dynamic: dict[str, Plan] = {}
        named = {address: spec for address, spec in specs.items() if address.count("/") > 1}
        for system in {address.split("/")[1] for address in homes.known("")}:
            for address, spec in specs.items():
                if address not in named:
                    at = f"/{system}{address}"
                    self._take(at, self._specifications.in_force(at, spec, fresh=False))
        for address, spec in {**self._specifications.added(), **named}.items():
            self._take(address, spec)

    def _take(self, path: str, spec: ChildSpec) -> None:
        spec = self._mechanisms.completed(self._file.complete(spec, path) if self._file is not None else spec, path)
        self._found[path] = spec
        if not spec.is_supervisor:
            return
        plan = self._plan(path, spec)
        given = self._homes.noted(plan_key(path)) if spec.start.kind.init is Supervisor.init else None
        if given is not None:
            try:
                plan = noted_plan(plan, given)
            except HoldfastError as error:
                self._unasked[path] = str(error)
        for one in plan.children:
            if one.id != NAMELESS and not spec.start.kind._is_dynamic:
                self._take(f"{path}/{one.id}", one)
        if spec.start.kind._is_dynamic and path not in self._unasked:
            self._dynamic[path] = plan
            if plan.flags.journal:
                self._take_noted(path, plan.children[0] if plan.children else None)

    def _plan(self, path: str, spec: ChildSpec) -> Plan:
        """The children that a supervisor begins with: it is constructed, and asked as at its start."""
        start: Start[Any] = spec.start
        try:
            supervisor = start.kind(*start.args, **start.kwargs)
            return cast("Supervisor", supervisor).init()
        except Exception as error:  # It may want more than there is: its `ctx`, say.
            self._unasked[path] = f"{type_name(type(error))}: {error_text(error)}"
            return Plan()

    def _take_noted(self, path: str, template: ChildSpec | None) -> None:
        """The children of a dynamic supervisor that come back with it."""
        where = child_key(path, "")
        for key, data in self._homes.notes(where).items():
            name = key.removeprefix(where)
            if not name or "/" in name or data == MADE_UP:
                continue
            try:
                self._take(f"{path}/{name}", unpack_noted(path, template, name, data)[0])
            except HoldfastError as error:  # So will its supervisor find it: nobody is started there.
                self._lost[f"{path}/{name}"] = str(error)

    def recipe(self, path: str) -> Recipe | AddressCheck:
        """How the new program starts the actor at an address, or what is to be said if it does not."""
        spec = self._found.get(path) or self._started_later(path)
        if spec is None:
            if (above := _at_or_above(path, self._lost)) is not None:
                why = f"{above} would not be started, since what is noted of it cannot be read: {self._lost[above]}"
                return AddressCheck(path, "refused", problem=why)
            if (above := _at_or_above(path, self._unasked)) is not None:
                return AddressCheck(path, "unchecked", problem=f"{above} could not be asked: {self._unasked[above]}")
            if (supervisor := self._forgotten_by(path)) is not None:
                why = f"{supervisor} has forgotten it, as whoever has ended in good order, and starts nobody there"
                return AddressCheck(path, "ended", problem=why)
            why = "the new program starts nobody there; an actor that is started later can be named by its address"
            return AddressCheck(path, "missing", problem=why)
        if spec.recovery is None or not spec.recovery.records:
            why = "the new program starts it without a recovery method, so what is recorded would not be used"
            return AddressCheck(path, "refused", problem=why)
        return Recipe(spec.start, spec.recovery, spec.bindings)

    def _started_later(self, path: str) -> ChildSpec | None:
        """How a dynamic supervisor would start the actor at an address by its template, if it is asked for it again."""
        above, _, name = path.rpartition("/")
        template = (
            self._dynamic[above].children[0] if above in self._dynamic and self._dynamic[above].children else None
        )
        if template is None or path in self._lost:
            return None
        try:
            template.start.check()
        except TypeError:  # Each start brings arguments of its own, and nobody has noted them.
            return None
        self._take(path, dataclasses.replace(template, id=name))
        return self._found[path]

    def _forgotten_by(self, path: str) -> str | None:
        """The dynamic supervisor with a journal of its children in which that at an address, or above it, is not."""
        parts = path.split("/")
        for end in range(len(parts) - 1, 1, -1):
            above, child = "/".join(parts[:end]), "/".join(parts[: end + 1])
            if above in self._dynamic and child not in self._found:
                return above if self._dynamic[above].flags.journal else None
        return None


def _at_or_above(path: str, addresses: Iterable[str]) -> str | None:
    """The one of these addresses that is this one, or above it."""
    return next((one for one in addresses if path == one or path.startswith(f"{one}/")), None)
