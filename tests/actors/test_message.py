"""Messages, replies and refusals, and how they are coded (DESIGN 3, 4 "Wire")."""

import datetime
import enum
from typing import Any, Generic, TypeVar

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import holdfast as hf
from holdfast.actors.kernel.cell import Cell
from holdfast.actors.kernel.codec import MAX_BYTES, Codec
from holdfast.actors.kernel.message import UnknownRefusal, message_name, reply_type

T = TypeVar("T")


class Add(hf.Message[int]):
    n: int
    note: str = ""


class Quiet(hf.Message): ...


class Named(hf.Message["Add"]): ...


class Wrapped(hf.Message[T], Generic[T]):
    value: int = 0


class OfText(Wrapped[str]): ...


class Derived(Add):
    more: float = 0.0


class Mode(enum.Enum):
    FAST = "fast"


class Rich(hf.Message[None]):
    who: hf.ActorRef[Any]
    others: list[hf.ActorRef[Any]]
    data: np.ndarray
    when: datetime.datetime
    mode: Mode
    inner: Add


class Overdrawn(hf.Refusal):
    missing: int
    currency: str = "EUR"


class Plain(hf.Refusal): ...


class Holder(hf.Actor):
    @hf.on(Quiet)
    def quiet(self, message: Quiet) -> None: ...


def lost(path: str) -> Cell:
    raise AssertionError(f"no ref was expected, but one to {path} came")


@pytest.fixture
def codec() -> Codec:
    return Codec(lost)


def through(codec: Codec, value: Any, kind: Any = None) -> Any:
    return codec.decode(kind or type(value), codec.encode(value, "/t/x"))


def test_a_message_is_a_value() -> None:
    assert Add(2, "x") == Add(n=2, note="x") != Add(2)
    assert repr(Add(2)) == "Add(n=2, note='')"
    assert {Add(1), Add(1)} == {Add(1)}


def test_a_message_is_frozen() -> None:
    with pytest.raises(AttributeError):
        Add(1).n = 2  # type: ignore[misc]


@pytest.mark.parametrize(("values", "named"), [((), {}), ((1, "", 3), {}), ((), {"m": 1})])
def test_wrong_fields_are_refused_where_the_message_is_made(values: Any, named: dict[str, Any]) -> None:
    with pytest.raises(TypeError):
        Add(*values, **named)


@pytest.mark.parametrize(
    ("kind", "reply"),
    [(Add, int), (Quiet, None), (Derived, int), (Named, Add), (OfText, str), (Wrapped, Any)],
)
def test_the_reply_type_is_what_the_class_or_its_base_declares(kind: type[hf.Message[Any]], reply: Any) -> None:
    assert reply_type(kind) is reply


def test_a_reply_type_that_is_not_known_is_named() -> None:
    class Odd(hf.Message["Nowhere"]): ...  # type: ignore[name-defined]

    with pytest.raises(TypeError, match="Nowhere"):
        reply_type(Odd)


@given(n=st.integers(-(2**63), 2**64 - 1), note=st.text())
def test_what_is_encoded_is_decoded_equal(n: int, note: str) -> None:
    assert through(Codec(lost), Derived(n, note, 1.5)) == Derived(n, note, 1.5)


@pytest.mark.parametrize("fields", [["1"], [1.5], [None], [True], [1, 2], []])
def test_a_wrong_type_is_refused_on_decode(codec: Codec, fields: list[Any]) -> None:
    with pytest.raises(msgspec.DecodeError):
        codec.decode(Add, msgspec.msgpack.encode(fields))


@given(body=st.binary(max_size=40))
def test_bytes_decode_to_the_type_or_are_refused(body: bytes) -> None:
    try:
        assert type(Codec(lost).decode(Add, body)) is Add
    except msgspec.DecodeError:
        pass


def test_old_data_is_read_into_a_class_with_a_new_field_and_new_data_into_the_old_class(codec: Codec) -> None:
    old = msgspec.msgpack.encode([7])
    assert codec.decode(Add, old) == Add(7, "")
    assert codec.decode(Derived, old) == Derived(7, "", 0.0)
    assert codec.decode(Add, codec.encode(Derived(7, "x", 2.5), "")) == Add(7, "x")


async def test_refs_arrays_times_and_enums_travel_inside_messages(system: hf.ActorSystem) -> None:
    ref, other = system.spawn(hf.start(Holder), "one"), system.spawn(hf.start(Holder), "two")
    data = np.arange(6, dtype=">f4").reshape(2, 3)
    when = datetime.datetime(2026, 1, 2, tzinfo=datetime.UTC)
    sent = Rich(ref, [other, ref], data, when, Mode.FAST, Add(3))
    got = through(system._node.codec, sent)
    assert (got.who, got.others, got.when, got.mode, got.inner) == (ref, [other, ref], when, Mode.FAST, Add(3))
    assert got.data.dtype == data.dtype
    np.testing.assert_array_equal(got.data, data)
    got.data[0, 0] = 9.0  # it owns its memory
    await got.who.send(Quiet())  # and the ref is a working one


@pytest.mark.parametrize(
    "array",
    [
        np.zeros((0, 3)),
        np.array(5.0),
        np.arange(12).reshape(3, 4)[:, ::2],
        np.array([(1, 2.0)], dtype=[("a", "i4"), ("b", "f8")]),
        np.array(["2026-01-01"], dtype="M8[D]"),
        np.array([True, False]),
    ],
)
def test_an_array_keeps_shape_type_and_elements(codec: Codec, array: np.ndarray) -> None:
    got = through(codec, array, np.ndarray)
    assert (got.shape, got.dtype) == (array.shape, array.dtype)
    assert got.tobytes() == array.tobytes()


def test_an_array_of_objects_is_refused(codec: Codec) -> None:
    with pytest.raises(hf.errors.BadMessage, match="objects"):
        codec.encode(np.array([object()]), "/t/x")


class Box(hf.Message[None]):
    label: str
    content: Any


def test_what_cannot_be_coded_is_named_by_type_and_field(codec: Codec) -> None:
    with pytest.raises(hf.errors.BadMessage) as refused:
        codec.encode(Box("x", object()), "/t/x")
    assert refused.value.actor == "/t/x"
    assert refused.value.message.endswith("Box")
    assert "'content'" in refused.value.problem
    assert "object" in refused.value.problem


def test_a_message_beyond_the_limit_is_refused_and_the_large_field_named(codec: Codec) -> None:
    with pytest.raises(hf.errors.BadMessage, match=r"'content'.*in parts"):
        codec.encode(Box("x", bytes(MAX_BYTES)), "/t/x")
    assert codec.encode(Box("x", bytes(MAX_BYTES - 100)), "/t/x")


def test_a_refusal_has_typed_fields_with_defaults() -> None:
    no = Overdrawn(missing=5)
    assert (no.missing, no.currency) == (5, "EUR")
    assert no == Overdrawn(5, "EUR") != Overdrawn(6)
    assert str(no) == "Overdrawn(missing=5, currency='EUR')"


@pytest.mark.parametrize(("values", "named"), [((), {}), ((1, "x", 2), {}), ((), {"owed": 1})])
def test_a_refusal_with_wrong_fields_is_a_programming_error(values: Any, named: dict[str, Any]) -> None:
    with pytest.raises(TypeError):
        Overdrawn(*values, **named)


@pytest.mark.parametrize(
    "error",
    [
        Overdrawn(5),
        Plain(),
        hf.ActorStopped("/t/a", "normal"),
        hf.MailboxFull("/t/a", 3),
        hf.MailboxFull("/t/a", 3, "latest"),
        hf.UnknownMessage("/t/a", "m.M"),
        hf.errors.BadMessage("/t/a", "m.M", "why"),
        hf.errors.AskDeadlock("/t/a", ("/t/b",)),
        hf.AskTimeout("/t/a", 2.0, False),
        hf.AskTimeout("/t/a", 2.0, None),
        hf.AskFailed("/t/a", "killed"),
        hf.errors.ReplayDiverged("/t/a", 3, 1),
        hf.StartFailed("/t/a", "why"),
        hf.errors.NameTaken("/t/a"),
        hf.errors.NoSuchActor("/t/a"),
        hf.errors.WrongActor("/t/a", "A", "B"),
        hf.SpecError("here", "why"),
        hf.errors.Unbound("/t/a", "port"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_an_error_arrives_as_its_class_with_its_fields(codec: Codec, error: hf.HoldfastError) -> None:
    got = codec.decode_error(*codec.encode_error(error))
    assert type(got) is type(error)
    assert (got.args, str(got), vars(got)) == (error.args, str(error), vars(error))


def test_any_other_exception_arrives_as_remote_crash(codec: Codec) -> None:
    try:
        raise KeyError("gone")
    except KeyError as error:
        got = codec.decode_error(*codec.encode_error(error))
    assert isinstance(got, hf.RemoteCrash)
    assert (got.type_name, got.text) == ("KeyError", "'gone'")
    assert "raise KeyError" in got.traceback


def test_a_refusal_of_a_class_that_is_not_loaded_keeps_its_name_and_fields(codec: Codec) -> None:
    kind, _, body = codec.encode_error(Overdrawn(5))
    assert codec.decode_error(kind, "elsewhere:Gone", body) == UnknownRefusal("elsewhere:Gone", [5, "EUR"])


def test_a_refusal_whose_fields_have_wrong_types_is_not_built(codec: Codec) -> None:
    got = codec.decode_error("refusal", message_name(Overdrawn), msgspec.msgpack.encode(["five"]))
    assert isinstance(got, hf.errors.BadReply)
    assert "cannot be made" in str(got)


def test_the_wire_name_says_module_and_class() -> None:
    assert message_name(Add) == f"{__name__}:Add"
