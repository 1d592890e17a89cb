"""Literals have one spelling, and names that the model does not declare are errors (T53)."""

from urllib.parse import unquote

import pytest
from hypothesis import given
from hypothesis import strategies as st

from holdfast.diagnosis.literals import (
    BadLiteral,
    Literal,
    Vocabulary,
    const,
    dec,
    inc,
    matched,
    ok,
    on,
    parse,
    running,
    word_for,
)

WORDS = Vocabulary([ok("/odom"), running("jn"), on("ja"), matched("odom.yaw", "imu.yaw"), inc("odom.yaw")])


@pytest.mark.parametrize(
    ("literal", "text"),
    [
        (ok("/odom"), "ok(/odom)"),
        (~running("jn"), "not running(jn)"),
        (on("ja"), "on(ja)"),
        (~matched("odom.yaw", "imu.yaw"), "not matched(odom.yaw,imu.yaw)"),
        (inc("v"), "inc(v)"),
        (~dec("v"), "not dec(v)"),
        (const("v"), "const(v)"),
    ],
)
def test_the_papers_spelling_is_printed_and_read(literal: Literal, text: str) -> None:
    assert str(literal) == text
    assert parse(text) == literal


@pytest.mark.parametrize("text", ["  not  ok( /odom ) ", "¬ok(/odom)", "¬ ok(/odom)"])
def test_spaces_and_the_sign_of_logic_are_read(text: str) -> None:
    assert parse(text) == ~ok("/odom")


@given(
    st.builds(
        Literal,
        st.from_regex(r"[a-z]\w*", fullmatch=True).filter(lambda name: name != "not"),
        st.lists(
            st.text(st.characters(exclude_categories=("Z", "C"), exclude_characters="(),"), min_size=1), min_size=1
        ).map(tuple),
        st.booleans(),
    )
)
def test_what_is_printed_is_read_as_the_same(literal: Literal) -> None:
    assert parse(str(literal)) == literal


@given(st.text(min_size=1))
def test_any_name_has_a_word_of_its_own_that_can_be_written(name: str) -> None:
    literal = ~ok(word_for(name))
    assert parse(str(literal)) == literal
    assert unquote(word_for(name)) == name


def test_a_word_is_a_name_as_far_as_it_can_be() -> None:
    assert word_for("/lab/it's-Köln_☃.2") == "/lab/it's-Köln_☃.2"
    assert word_for("left arm, \u3000100%(\udc00)") == "left%20arm%2C%20%E3%80%80100%25%28%ED%B0%80%29"


@pytest.mark.parametrize(
    "text", ["", "ok", "ok()", "ok(a", "ok(a))", "ok(a b)", "not not ok(a)", "not(ok(a))", "!ok(a)", "ok(a,)", "-ok(a)"]
)
def test_other_texts_are_no_literals(text: str) -> None:
    with pytest.raises(BadLiteral, match=r"spelled like|argument"):
        parse(text)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("ok(/odm)", r"did you mean 'ok\(/odom\)'"),
        ("not_ok(/odom)", "a negation is spelled `not `"),
        ("runing(jn)", "did you mean 'running'"),
        ("matched(odom.yaw)", "takes 2 arguments, not 1"),
        ("running(ja)", "no such atom"),
    ],
)
def test_an_unknown_name_is_an_error_that_helps(text: str, problem: str) -> None:
    with pytest.raises(BadLiteral, match=problem):
        WORDS.parse(text)


def test_the_order_of_related_values_means_nothing() -> None:
    assert WORDS.parse("not matched(imu.yaw,odom.yaw)") == ~matched("odom.yaw", "imu.yaw")
    assert matched("imu.yaw", "odom.yaw") in WORDS


def test_a_vocabulary_lists_each_atom_once_as_it_was_declared() -> None:
    assert [str(atom) for atom in WORDS] == [
        "ok(/odom)", "running(jn)", "on(ja)", "matched(odom.yaw,imu.yaw)", "inc(odom.yaw)"
    ]  # fmt: skip
