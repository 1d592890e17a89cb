"""What follows from how actors are connected."""

import pytest

import holdfast as hf
from holdfast.diagnosis import observer
from holdfast.diagnosis.engine import Diagnoser
from holdfast.diagnosis.generate import Wired, declared
from holdfast.diagnosis.model import Model


def wired(**fields: object) -> Wired:
    return Wired(path="/x", kind="", **fields)  # type: ignore[arg-type]


def test_a_circle_is_cut_where_it_closes_and_told() -> None:
    found = declared(
        {
            "a": wired(publishes=("/a",), subscribes=("/b",)),
            "b": wired(publishes=("/b",), subscribes=("/a", "/c")),
            "c": wired(publishes=("/c",), bound={"port": "a"}),
        }
    )
    Model(found.declaration)  # it has no circles
    assert len(found.left_out) == 2


def test_two_that_publish_on_one_topic_are_both_suspected_and_neither_is_sure() -> None:
    found = declared({"a": wired(publishes=("/t",)), "b": wired(publishes=("/t",))})
    diagnosis = Diagnoser(found.declaration).diagnose_now(["not ok(/t)"])
    assert sorted(one.bad for one in diagnosis.candidates) == [("a",), ("b",)]


def test_what_is_no_observer_is_refused() -> None:
    with pytest.raises(TypeError, match="Observer"):
        observer("x", hf.start(hf.Actor))
