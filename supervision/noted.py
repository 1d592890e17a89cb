"""What the journal of a dynamic supervisor says of a child, so that it comes back as what it has become.

A child that was made of the template comes back as the template says then, with the arguments of its own start and with
all that was changed of it since. A change says what the template said when it was made: where the template says
something else by now, that is newer, and counts. What is as in the template again is no change any more. All other
children are noted whole. A template that the supervisor was given while it worked is a change of the one that its
recipe says, and noted in the same way; so are its flags.

The mechanism is noted as it was when the child came: what has become of that has notes of its own.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any, TypeAlias

from ..actors.errors import SpecError, type_name
from ..actors.kernel.actor import Start
from ..actors.process.wire.start_codec import pack_data, packed_digest, unpack_data
from .spec import ChildSpec, Flags, Plan

Change: TypeAlias = "tuple[bytes, bytes]"
"""What the template said (a digest), and what the child says instead (packed)."""

OWN = ("id", "comes_back", "made_up")
"""The fields of a spec that are a child's own anyway."""
FIELDS = tuple(field.name for field in dataclasses.fields(ChildSpec) if field.name not in OWN)
TEMPLATE = "template"
OF_TEMPLATE = ("id", *FIELDS)
FLAGS = tuple(field.name for field in dataclasses.fields(Flags))


@dataclasses.dataclass(frozen=True, slots=True)
class OfTemplate:
    """What a child that was made of a template has beside it."""

    args: tuple[Any, ...] = ()
    kwargs: dict[str, Any] = dataclasses.field(default_factory=dict[str, Any])
    changes: dict[str, Change] = dataclasses.field(default_factory=dict[str, Change])
    """By the name of the field."""

    def spec(self, template: ChildSpec, name: str, *, made_up: bool) -> ChildSpec:
        """The child as it comes back.

        Raises:
            SpecError: the arguments do not fit the class, or a change cannot be had any more.
        """
        now = {
            field: unpack_data(packed)
            for field, (before, packed) in self.changes.items()
            if before == _said(template, field)
        }
        base = template if "start" in now else filled(template, self.args, self.kwargs)
        return dataclasses.replace(base, id=name, made_up=made_up, **now)

    def changed(self, template: ChildSpec, before: ChildSpec, after: ChildSpec) -> OfTemplate:
        """The same with what has changed of the child. Raises HoldfastError: it cannot be stored."""
        return self._with(template, after, _changed(before, after))

    def _with(self, template: ChildSpec, after: ChildSpec, fields: set[str]) -> OfTemplate:
        if not fields:
            return self
        changes = {field: change for field, change in self.changes.items() if field not in fields}
        for field in fields:
            was, now = self._as_made(template, field), getattr(after, field)
            if was is not now and packed_digest(was, field) != packed_digest(now, field):
                changes[field] = (_said(template, field), pack_data(now, f"{field} of child {after.id!r}"))
        return self if changes == self.changes else dataclasses.replace(self, changes=changes)

    def _as_made(self, template: ChildSpec, field: str) -> Any:
        """What a child has in a field that nobody has changed."""
        if field != "start":
            return getattr(template, field)
        try:
            return filled(template, self.args, self.kwargs).start
        except SpecError:  # The template has become one that does not take its arguments.
            return None


Noted: TypeAlias = "OfTemplate | ChildSpec"


def first_noted(template: ChildSpec | None, spec: ChildSpec, only: Iterable[str] = FIELDS) -> Noted:
    """What is noted of a child that comes; `only`: the fields that may differ from the template.

    Raises:
        HoldfastError: it cannot be stored.
    """
    if template is None or spec.start.kind is not template.start.kind:
        return spec
    args, kwargs = _added(template, spec)
    fields = {name for name in only if name != "start" and getattr(template, name) is not getattr(spec, name)}
    if not _is_added_to(template.start, spec.start):
        fields.add("start")
    return OfTemplate(args, kwargs)._with(template, spec, fields)


def renewed(known: Noted | None, template: ChildSpec | None, before: ChildSpec, after: ChildSpec) -> Noted:
    """What is noted of a child that has changed. Raises HoldfastError: it cannot be stored."""
    if isinstance(known, OfTemplate) and template is not None:
        return known.changed(template, before, after)
    base = known if isinstance(known, ChildSpec) else before
    now = {name: getattr(after, name) for name in _changed(before, after)}
    now = {
        name: said
        for name, said in now.items()
        if packed_digest(getattr(base, name), name) != packed_digest(said, name)
    }
    return first_noted(template, dataclasses.replace(base, **now)) if now else base


def pack_plan(declared: Plan, now: Plan) -> bytes | None:
    """What a dynamic supervisor was given and its recipe does not say; None: nothing.

    Raises:
        HoldfastError: it cannot be stored.
    """
    before, after = _parts(declared, now), _parts(now, declared)
    changes = {
        name: (_digest(name, said), pack_data(after[name], name))
        for name, said in before.items()
        if packed_digest(said, name) != packed_digest(after[name], name)
    }
    return pack_data(changes, "what it was given") if changes else None


def noted_plan(declared: Plan, data: bytes) -> Plan:
    """With what a dynamic supervisor begins whose recipe says `declared`.

    Raises:
        HoldfastError: what it was given cannot be had any more.
    """
    parts = {TEMPLATE: declared.children, **_parts(declared, declared)}
    for name, (before, packed) in unpack_data(data).items():
        if name in parts and before == _digest(name, parts[name]):
            parts[name] = unpack_data(packed)
    given: dict[str, Any] = {name: parts[name] for name in FLAGS}
    flags = Flags(**given)
    of_template = {name: parts[name] for name in OF_TEMPLATE if name in parts}
    return Plan.of(flags, [dataclasses.replace(one, **of_template) for one in parts[TEMPLATE]])


def _parts(plan: Plan, other: Plan) -> dict[str, Any]:
    """What may be changed of a plan: its flags, and its template, field by field if the other has one too."""
    parts: dict[str, Any] = {name: getattr(plan.flags, name) for name in FLAGS}
    if not (plan.children and other.children):
        return {**parts, TEMPLATE: plan.children}
    return {**parts, **{name: getattr(plan.children[0], name) for name in OF_TEMPLATE}}


def _digest(name: str, said: Any) -> bytes:
    """Digest what is said; of a start the class counts."""
    return packed_digest(type_name(said.kind) if name == "start" else said, name)


def pack_noted(known: Noted, spec: ChildSpec) -> bytes:
    """The note. Raises HoldfastError: it cannot be stored."""
    note: Any = known
    if isinstance(known, OfTemplate):
        note = (known.args, known.kwargs, spec.made_up, *([known.changes] if known.changes else []))
    return pack_data(note, f"child {spec.id!r}")


def unpack_noted(supervisor: str, template: ChildSpec | None, name: str, data: bytes) -> tuple[ChildSpec, Noted]:
    """A child of a dynamic supervisor as its journal has it. Raises HoldfastError if it can not be made any more."""
    what = unpack_data(data)
    if isinstance(what, ChildSpec):
        spec = dataclasses.replace(what, id=name)
        return spec, spec
    if template is None:
        raise SpecError(supervisor, f"{name!r} was started from a template, and there is none now")
    args, kwargs, *more = what
    known = OfTemplate(args, kwargs, *more[1:])
    return known.spec(template, name, made_up=more[:1] == [True]), known


def filled(template: ChildSpec, args: tuple[Any, ...], kwargs: dict[str, Any]) -> ChildSpec:
    """The template with the arguments of one start behind its own.

    Raises:
        SpecError: the arguments do not fit the class.
    """
    own = template.start
    start = Start(own.kind, (*own.args, *args), {**own.kwargs, **kwargs})
    try:
        start.check()
    except TypeError as error:
        raise SpecError("StartChild", f"start({type_name(own.kind)}, ...): {error}") from error
    return dataclasses.replace(template, start=start)


def _changed(before: ChildSpec, after: ChildSpec) -> set[str]:
    """The fields that are others now, without the mechanism."""
    return {name for name in FIELDS if getattr(before, name) is not getattr(after, name)} - {"mechanism"}


def _said(template: ChildSpec, field: str) -> bytes:
    """What a template says of a field, as a digest."""
    return _digest(field, getattr(template, field))


def _is_added_to(own: Start[Any], start: Start[Any]) -> bool:
    """Whether a start has the very arguments of a template, and more."""
    is_longer = len(start.args) >= len(own.args) and own.kwargs.keys() <= start.kwargs.keys()
    return is_longer and all(one is other for one, other in zip(own.args, start.args, strict=False))


def _added(template: ChildSpec, spec: ChildSpec) -> tuple[tuple[Any, ...], dict[str, Any]]:
    """The arguments that a start has added to those of its template."""
    own, start = template.start, spec.start
    kwargs = {key: value for key, value in start.kwargs.items() if own.kwargs.get(key, start) is not value}
    return start.args[len(own.args) :], kwargs
