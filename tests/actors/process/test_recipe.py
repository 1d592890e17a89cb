"""Recipes cross the border as data; the class is found by name, or the start is refused with the reason."""

from __future__ import annotations

import datetime
import threading
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.process.wire.start_codec import loaded, pack_recipe, unpack_recipe
from holdfast.actors.values import UnsavableValue, encode_value
from holdfast.supervision.spec import Flags
from tests.actors.process.players import Account, Where


class Rich(hf.Actor):
    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.args, self.kwargs = args, kwargs


class Outer:
    class Nested(hf.Actor):
        pass


class NoActor:
    pass


def round_trip(start: hf.Start[Any]) -> hf.Start[Any]:
    return unpack_recipe(pack_recipe(start, "here"))


def test_class_and_arguments_come_back_as_they_were() -> None:
    when = datetime.datetime(2024, 5, 6, tzinfo=datetime.UTC)
    start = hf.start(Rich, 1, (2, [3]), {"a": {4}}, when=when, flags=Flags("one_for_all", 2, 3.0), none=None)
    back = round_trip(start)
    assert back == start
    assert type(back.args[1]) is tuple
    assert back.kind is Rich


def test_a_nested_class_is_found() -> None:
    assert round_trip(hf.start(Outer.Nested)).kind is Outer.Nested


def test_recipes_inside_recipes() -> None:
    inner = hf.start(Account, 5)
    start = hf.start(Rich, inner, [inner, (inner,)], by_name={"x": inner})
    assert round_trip(start) == start


def test_a_supervisor_with_all_options_of_its_children() -> None:
    children = [
        hf.child("a", hf.start(Account, 5), restart="transient", shutdown="infinity", mailbox=hf.bounded(7)),
        hf.child("b", hf.start(Account), backoff=hf.Backoff(initial=0.5), shutdown=1.5),
        hf.supervisor("c", strategy="rest_for_one", children=[hf.child("d", hf.start(Account, balance=3))]),
    ]
    start = hf.supervisor("top", intensity=4, period=9.0, children=children).start
    assert round_trip(start) == start


def test_a_class_in_a_function_is_refused_when_the_spec_is_built() -> None:
    class Local(hf.Actor):
        pass

    with pytest.raises(hf.SpecError, match=r"Local is defined in a function, so another process cannot import it"):
        pack_recipe(hf.start(Local), "child 'x'")
    with pytest.raises(hf.SpecError, match=r"child 'x'.*is defined in a function"):
        hf.child("x", hf.start(Local), isolation="process")
    with pytest.raises(hf.SpecError, match=r"is defined in a function"):
        hf.supervisor("top", isolation="process", children=[hf.child("x", hf.start(Local))])


def test_an_argument_that_is_no_data_is_refused_by_name() -> None:
    with pytest.raises(UnsavableValue, match=r"here: start\(Rich, ...\).*lock"):
        pack_recipe(hf.start(Rich, 1, {"key": threading.Lock()}), "here")
    with pytest.raises(hf.SpecError, match="cannot be sent to another process"):
        hf.child("x", hf.start(Rich, threading.Lock()), isolation="process")


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("no.such.module:Actor", "cannot be imported: No module named 'no'"),
        (f"{__name__}:Missing", "cannot be imported"),
        (f"{__name__}:Outer.Missing", "cannot be imported"),
        (f"{__name__}:NoActor", "is no Actor"),
        (f"{__name__}:round_trip", "is no Actor"),
        ("os:system", "is no Actor"),
        ("", "cannot be imported"),
        (":", "cannot be imported"),
    ],
)
def test_a_name_that_is_no_actor_is_refused(name: str, why: str) -> None:
    data = pack_recipe(hf.start(Account, 1), "here")
    true_name = f"{Account.__module__}:Account".encode()
    assert true_name in data
    with pytest.raises(hf.SpecError, match=why):
        unpack_recipe(encode_value(_renamed(name)))


def _renamed(name: str) -> Any:
    from holdfast.actors.process.wire import start_codec

    return start_codec._Packed(name, (1,), {})


def test_data_that_is_no_recipe_is_refused() -> None:
    with pytest.raises(hf.SpecError, match="no actor recipe"):
        unpack_recipe(encode_value([1, 2]))


def test_looking_for_a_class_imports_nothing() -> None:
    assert loaded(f"{Account.__module__}:Account", hf.Actor) is Account
    for name in ("no.such:Actor", f"{__name__}:NoActor", f"{__name__}:Missing.More", ""):
        assert loaded(name, hf.Actor) is None


async def test_a_class_that_the_process_cannot_import_refuses_the_start(system: hf.ActorSystem) -> None:
    """A class that only this process has, of a module that nobody can import."""
    made = type("Ghost", (hf.Actor,), {"__module__": "made.at.run_time"})
    with pytest.raises(hf.StartFailed, match=r"made\.at\.run_time:Ghost cannot be imported"):
        await system.start(hf.child("ghost", hf.start(made), isolation="process"))
    account = await system.start(hf.child("account", hf.start(Account), isolation="process"))
    assert await account.ask(Where()) == system.pid_of(account)
