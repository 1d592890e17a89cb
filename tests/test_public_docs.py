"""Public names are documented: by docstrings that can be read alone (`public_docs.py`), and by code that runs."""

import ast
import doctest
from types import ModuleType

import pytest

import holdfast as hf
from tests import public_docs, used_names
from tests.public_docs import offenders, problem, public_docstrings
from tests.used_names import imported, unused, used

NOT_YET_USED = frozenset(
    {
        "holdfast.SendError",
        "holdfast.errors.ActorRestarting",
        "holdfast.errors.AlreadyRegistered",
        "holdfast.errors.AskDeadlock",
        "holdfast.errors.AssertionFailed",
        "holdfast.errors.BadMessage",
        "holdfast.errors.BadReply",
        "holdfast.errors.CannotAdapt",
        "holdfast.errors.CannotMove",
        "holdfast.errors.CheckpointFailed",
        "holdfast.errors.ChildParked",
        "holdfast.errors.ControlFailed",
        "holdfast.errors.DamagedStore",
        "holdfast.errors.ForeignStore",
        "holdfast.errors.GrantLost",
        "holdfast.errors.InOtherHands",
        "holdfast.errors.InputRefused",
        "holdfast.errors.KeyTaken",
        "holdfast.errors.MechanismRefused",
        "holdfast.errors.NameTaken",
        "holdfast.errors.NoPartitions",
        "holdfast.errors.NoRoute",
        "holdfast.errors.NoSuchChild",
        "holdfast.errors.NoSuchGroup",
        "holdfast.errors.NotAccepted",
        "holdfast.errors.NotAnActor",
        "holdfast.errors.NotDeterministic",
        "holdfast.errors.NotGranted",
        "holdfast.errors.NotQuarantined",
        "holdfast.errors.NotReadonly",
        "holdfast.errors.NotSupported",
        "holdfast.errors.NotSuspended",
        "holdfast.errors.NotUnique",
        "holdfast.errors.ProcessUnavailable",
        "holdfast.errors.ProgramFailed",
        "holdfast.errors.ReplayDiverged",
        "holdfast.errors.StaleEpoch",
        "holdfast.errors.StartIgnored",
        "holdfast.errors.StashError",
        "holdfast.errors.StateDiverged",
        "holdfast.errors.StateMismatch",
        "holdfast.errors.StoreError",
        "holdfast.errors.StoreFailed",
        "holdfast.errors.Unbound",
        "holdfast.errors.UnknownRefusal",
        "holdfast.errors.UnsavableValue",
        "holdfast.errors.UntrustedFile",
        "holdfast.errors.WrongActor",
        "holdfast.errors.WrongThread",
        "holdfast.events.AdaptationUndone",
        "holdfast.events.AutoShutdown",
        "holdfast.events.BackgroundWorkLost",
        "holdfast.events.ChildStartFailed",
        "holdfast.events.Diverged",
        "holdfast.events.EventStream",
        "holdfast.events.FrameRefused",
        "holdfast.events.HookFailed",
        "holdfast.events.JournalGoesOn",
        "holdfast.events.LifeAbandoned",
        "holdfast.events.MechanismAttached",
        "holdfast.events.MechanismChanged",
        "holdfast.events.MechanismDetached",
        "holdfast.events.MechanismSettled",
        "holdfast.events.MessageOut",
        "holdfast.events.NondeterminismFound",
        "holdfast.events.Objected",
        "holdfast.events.Outvoted",
        "holdfast.events.ProtectionCostly",
        "holdfast.events.RecoveryHookFailed",
        "holdfast.events.RecoveryPhase",
        "holdfast.events.RecoveryTableUnused",
        "holdfast.events.ReplayPaced",
        "holdfast.events.ReplicaFaulty",
        "holdfast.events.ReplicaJoined",
        "holdfast.events.ReplicaLost",
        "holdfast.events.RequestsDropped",
        "holdfast.events.RolledBack",
        "holdfast.events.SafeStateMissed",
        "holdfast.events.SafeStateOverdue",
        "holdfast.events.ScriptLoaded",
        "holdfast.events.ShutdownError",
        "holdfast.events.SpecificationNotKept",
        "holdfast.events.SpecificationSuperseded",
        "holdfast.events.StatesDiffer",
        "holdfast.events.StopOverdue",
        "holdfast.events.StoreRefused",
        "holdfast.events.TransactionBegan",
        "holdfast.events.TransactionCommitted",
        "holdfast.events.TransactionRolledBack",
        "holdfast.events.TurnHung",
        "holdfast.events.TurnsSkipped",
        "holdfast.events.WrongSuspicion",
    }
)
"""Names that no code uses yet which runs. The list only gets shorter."""


def test_no_public_docstring_offends() -> None:
    assert len(list(public_docstrings())) > 600
    assert offenders() == []


@pytest.mark.parametrize(
    ("name", "text", "wrong"),
    [
        ("Timer.cancel", None, "is missing"),
        ("Timer.cancel", "It is over: nothing comes any more.", "begins with a pronoun"),
        ("Timer.cancel", "Its message does not come any more.", "begins with a pronoun"),
        ("Timer.cancel", "What is done at the end of a timer.", "begins with a pronoun"),
        ("Timer.is_active", "Whether the message of the timer may still come.", "is no whole sentence"),
        ("Timer.cancel", "Cancel the timer.", "says less than the name"),
        ("StashError", "A stash error.\n\nRaised by `stash` when it is full.", "says less than the name"),
        ("Timer.cancel", "Cancel the timer, so that no message comes any more.", ""),
        ("Timer.is_active", "Say whether the message of the timer may still come.", ""),
    ],
)
def test_what_offends(name: str, text: str | None, wrong: str) -> None:
    assert problem(name, text) == wrong


@pytest.mark.parametrize("module", [public_docs, used_names], ids=lambda module: module.__name__)
def test_the_examples_of_the_rules(module: ModuleType) -> None:
    assert doctest.testmod(module).failed == 0


def test_every_public_name_is_used_in_code_that_runs() -> None:
    """In a block of a document that is no quotation, in `examples/`, or in a docstring example."""
    missing = frozenset(unused())
    assert sorted(missing - NOT_YET_USED) == [], "show how it is used, in the page that explains it"
    assert sorted(NOT_YET_USED - missing) == [], "take it out of the list"


@pytest.mark.parametrize(
    ("text", "is_used"),
    [
        ("import holdfast as hf\nhf.errors.StoreError", True),
        ("from holdfast.errors import StoreError as Bad\ntry: ...\nexcept Bad: ...", True),
        ("from holdfast import errors\ndef f(no: errors.StoreError): ...", True),
        ("from holdfast.errors import StoreError", False),
        ("import holdfast as hf\nprint('hf.errors.StoreError')", False),
        ("class StoreError(Exception): ...\nraise StoreError", False),
    ],
)
def test_what_counts_as_a_use(text: str, is_used: bool) -> None:
    tree = ast.parse(text)
    assert (hf.errors.StoreError in list(used(tree, imported(tree)))) is is_used
