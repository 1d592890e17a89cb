"""Child specs: every wrong option is a SpecError that names the child, the option, and what it may be (DESIGN 5)."""

import re
from collections.abc import Callable
from typing import Any

import pytest

import holdfast as hf


class Idle(hf.Actor):
    teller: hf.Binding[hf.Actor]

    def __init__(self, first: object = 0) -> None:
        self.first = first


def kid(id: Any = "kid", **options: Any) -> hf.ChildSpec:
    return hf.child(id, hf.start(Idle), **options)


def top(**options: Any) -> hf.ChildSpec:
    return hf.supervisor("top", **options)


WRONG: list[tuple[Callable[[], object], str, str]] = [
    (lambda: kid(""), "child ''", "the id must be text without '/' and control characters"),
    (lambda: kid("a/b"), "child 'a/b'", "the id must be text without '/' and control characters"),
    (lambda: kid("a\nb"), "child 'a\\nb'", "the id must be text without '/' and control characters"),
    (lambda: kid("a\x1b[31m"), "child 'a\\x1b[31m'", "the id must be text without '/' and control characters"),
    (lambda: hf.ActorSystem("a\u202e"), "ActorSystem", "the name must be text without '/' and control characters"),
    (lambda: kid(7), "child 7", "the id must be text without '/' and control characters"),
    (lambda: hf.child("kid", Idle), "child 'kid'", "start must come from start(Class, ...)"),  # type: ignore[arg-type]
    (
        lambda: hf.child("kid", hf.start(Idle, 1, 2)),  # type: ignore[call-arg]
        "child 'kid'",
        "Idle, ...): too many positional arguments; it takes (",
    ),
    (lambda: hf.child("kid", hf.start(Idle, last=1)), "child 'kid'", "unexpected keyword argument 'last'"),  # type: ignore[call-arg]
    (lambda: kid(restart="always"), "child 'kid'", "restart must be one of permanent, transient, temporary, not 'alw"),
    (lambda: kid(restart=["permanent"]), "child 'kid'", "restart must be one of permanent, transient, temporary"),
    (lambda: kid(isolation="thread"), "child 'kid'", "isolation must be one of task, process, not 'thread'"),
    (lambda: kid(shutdown="kill"), "child 'kid'", "shutdown must be seconds >= 0, 'brutal_kill' or 'infinity'"),
    (lambda: kid(shutdown=-1), "child 'kid'", "shutdown must be seconds >= 0"),
    (lambda: kid(shutdown=float("nan")), "child 'kid'", "shutdown must be seconds >= 0"),
    (lambda: kid(shutdown=True), "child 'kid'", "shutdown must be seconds >= 0"),
    (lambda: kid(autostart="no"), "child 'kid'", "autostart must be True or False, not 'no'"),
    (lambda: kid(significant=1), "child 'kid'", "significant must be True or False, not 1"),
    (lambda: kid(recovery="hybrid"), "child 'kid'", "recovery must be a method such as hybrid(...) or left out"),
    (lambda: kid(mailbox=100), "child 'kid'", "mailbox must be bounded(...) or left out, not 100"),
    (lambda: kid(backoff=1.0), "child 'kid'", "backoff must be Backoff(...) or left out, not 1.0"),
    (lambda: kid(limits={}), "child 'kid'", "limits must be Limits(...) or left out, not {}"),
    (lambda: kid(bindings="teller"), "child 'kid'", "bindings must be a mapping of port names to addresses"),
    (lambda: kid(bindings={"clerk": "/app/x"}), "child 'kid'", "Idle has no binding 'clerk'"),
    (lambda: kid(bindings={"teller": 5}), "child 'kid'", "bindings must name an address such as '/app/bank'"),
    (lambda: kid(bindings={"teller": "bank"}), "child 'kid'", "bindings must name an address such as '/app/bank'"),
    (
        lambda: top(strategy="one_for_some"),
        "supervisor 'top'",
        "strategy must be one of one_for_one, one_for_all, rest",
    ),
    (lambda: top(intensity=-1), "supervisor 'top'", "intensity must be a whole number >= 0, not -1"),
    (lambda: top(intensity=1.5), "supervisor 'top'", "intensity must be a whole number >= 0, not 1.5"),
    (lambda: top(intensity=True), "supervisor 'top'", "intensity must be a whole number >= 0, not True"),
    (lambda: top(period=0), "supervisor 'top'", "period must be a finite number of seconds > 0, not 0"),
    (lambda: top(period=float("inf")), "supervisor 'top'", "period must be a finite number of seconds > 0, not inf"),
    (lambda: top(period="5"), "supervisor 'top'", "period must be a finite number of seconds > 0, not '5'"),
    (lambda: top(children=[kid(), kid()]), "supervisor 'top'", "two children have the id 'kid'"),
    (
        lambda: hf.Plan([hf.child(None, hf.start(Idle)), hf.child(None, hf.start(Idle))]),
        "supervisor",
        "a dynamic supervisor takes one template, the child without an id, and not two",
    ),
    (lambda: top(children=[hf.start(Idle)]), "supervisor 'top'", "children must come from child(...) or supervisor("),
    (
        lambda: top(restart="never"),
        "child 'top'",
        "restart must be one of permanent, transient, temporary, not 'never'",
    ),
    (lambda: top(shutdown=-2.0), "child 'top'", "shutdown must be seconds >= 0"),
    (
        lambda: hf.ActorSystem("a/b"),
        "ActorSystem",
        "the name must be text without '/' and control characters, not 'a/b'",
    ),
    (lambda: hf.ActorSystem(intensity=-1), "supervisor", "intensity must be a whole number >= 0, not -1"),
    (lambda: hf.bounded(0), "bounded", "capacity must be a whole number of messages >= 1, not 0"),
    (lambda: hf.bounded(1, overflow="wait"), "bounded", "overflow must be one of block, reject, drop_newest"),  # type: ignore[arg-type]
]


@pytest.mark.parametrize(("make", "where", "problem"), WRONG, ids=lambda value: value if isinstance(value, str) else "")
def test_a_wrong_option_is_named(make: Callable[[], object], where: str, problem: str) -> None:
    with pytest.raises(hf.SpecError, match=re.escape(problem)) as caught:
        make()
    assert caught.value.where == where


def test_a_process_actor_must_be_importable() -> None:
    class Hidden(hf.Actor):
        pass

    with pytest.raises(hf.SpecError, match=r"child 'kid': .*Hidden is defined in a function") as caught:
        hf.child("kid", hf.start(Hidden), isolation="process")
    assert caught.value.args == (caught.value.where, caught.value.problem)


def test_arguments_of_a_process_actor_must_be_encodable() -> None:
    with pytest.raises(hf.SpecError, match=r"child 'kid': start\(Idle, ...\)\.args\[0\]: .*object cannot be sent"):
        hf.child("kid", hf.start(Idle, object()), isolation="process")
    assert hf.child("kid", hf.start(Idle, object())).isolation == "task"


def test_a_subtree_in_a_process_takes_all_options_but_supervisors_with_another() -> None:
    rich = kid(mailbox=hf.bounded(3), backoff=hf.Backoff(), bindings={"teller": "/app/x"}, shutdown="brutal_kill")
    assert top(isolation="process", children=[rich]).isolation == "process"
    assert top(isolation="process", children=[kid(isolation="process")]).isolation == "process"
    with pytest.raises(hf.SpecError, match="supervisor 'top': a subtree in a process cannot hold another supervisor"):
        top(isolation="process", children=[hf.supervisor("inner", children=[], isolation="process")])


def test_defaults_are_those_of_otp() -> None:
    """otp.md 1.1: permanent, 5 s for workers, infinity for supervisors, one restart in 5 s."""
    worker, supervisor = kid(), top()
    assert (worker.restart, worker.shutdown, worker.isolation) == ("permanent", 5.0, "task")
    assert (supervisor.restart, supervisor.shutdown, supervisor.is_supervisor) == ("permanent", "infinity", True)
    flags = supervisor.start.args[0]
    assert (flags.strategy, flags.intensity, flags.period) == ("one_for_one", 1, 5.0)


def test_a_spec_keeps_a_copy_of_its_bindings() -> None:
    bindings = {"teller": "/app/x"}
    spec = kid(bindings=bindings)
    bindings["teller"] = "/app/y"
    assert spec.bindings == {"teller": "/app/x"}


def test_start_takes_actor_classes_only() -> None:
    with pytest.raises(TypeError, match="start takes an Actor class, not <class 'int'>"):
        hf.start(int)  # type: ignore[type-var]


def test_a_process_holds_no_supervisor_with_another_however_deep() -> None:
    deep = hf.supervisor("deep", children=[hf.child("a", hf.start(hf.Actor), isolation="process")])
    assert hf.supervisor("outer", children=[deep], isolation="process").isolation == "process"
    inner = hf.supervisor("inner", children=[hf.supervisor("far", children=[], isolation="process")])
    with pytest.raises(hf.SpecError, match="supervisor 'outer': a subtree in a process cannot hold another supervisor"):
        hf.supervisor("outer", children=[inner], isolation="process")
