"""Model files: two forms, and errors that name file and line (D29)."""

import subprocess
import sys
from pathlib import Path

import pytest

from holdfast.diagnosis.engine import Diagnoser
from holdfast.diagnosis.model import Kind, Model, ModelError, load, read
from tests.diagnosis.robot import ELEVEN, POWERED_DOWN, paper_robot

COMPONENTS = """\
hardware:
  ja: {prior: 0.001}
  hu:
  la:
  js: {switchable: false}
  imu: {switchable: no}
drivers:
  jn: {on: [ja], out: [/odom]}
  hn: {on: [hu], out: /scan}
  lan: {on: [la]}
  in: {out: [/imu_data]}
  jyn: {out: [/joy]}
nodes:
  jtn: {out: {/cmd_vel: [/joy]}}
  hm: {out: {/map: /scan}}
  lac:
  rviz: {}
related:
  - [[jn, odom.yaw], [in, imu.yaw]]
"""

FIVE = """\
ab: "AB"
nab: "NAB"
neg_prefix: "not_"
props:
  - on(ja)
  - running(jn)
  - ok(/odom)
rules:
  - NAB(ja)->on(ja)
  - NAB(jn)->running(jn)
  - NAB(jn),NAB(ja)->ok(/odom)
"""


SECTIONS = "hardware, drivers, nodes, values, related, expect, external, propositions, clauses"
AS_PROPOSITION = "declare it as a proposition"


def problems(text: str) -> list[str]:
    with pytest.raises(ModelError) as caught:
        Model(read(text, "robot.yaml"))
    return list(caught.value.problems)


def test_the_component_form_means_the_same_as_python(tmp_path: Path) -> None:
    path = tmp_path / "robot.yaml"
    path.write_text(COMPONENTS, "utf-8")
    model = Model(load(path))
    declared = Model(paper_robot())
    assert list(map(str, model.rules)) == list(map(str, declared.rules))
    assert {name: one.kind for name, one in model.components.items()} == {
        name: one.kind for name, one in declared.components.items()
    }
    assert model.components["ja"].prior == 0.001
    assert model.rules[0].where == f"{path}:2"
    (only,) = Diagnoser(model).diagnose_now(POWERED_DOWN).candidates
    assert set(only.bad) == ELEVEN


def test_the_papers_five_sections_are_read() -> None:
    model = Model(read(FIVE))
    assert {name: one.kind for name, one in model.components.items()} == {"ja": Kind.SWITCHABLE, "jn": Kind.NODE}
    assert [str(rule) for rule in model.rules] == [
        "not AB(ja) -> on(ja)",
        "not AB(jn) -> running(jn)",
        "not AB(jn) and not AB(ja) -> ok(/odom)",
    ]
    said = Diagnoser(model).diagnose_now(["on(ja)", "not ok(/odom)"])
    assert [one.bad for one in said.candidates] == [("jn",), ("ja",)]


def test_the_five_sections_may_spell_the_predicates_in_another_way() -> None:
    text = FIVE.replace("NAB", "Works").replace('"AB"', '"Broken"').replace("not_", "no_")
    assert str(Model(read(text + "  - Works(jn) -> no_on(ja)\n")).rules[-1]) == "not AB(jn) and on(ja) -> false"


def test_all_sections_of_the_component_form_are_read() -> None:
    model = Model(
        read(
            "nodes: {a: {out: {/a: [/clock]}, prior: 0.2}, b: {out: [/b]}}\n"
            "values: {/a: [a.v]}\n"
            "external: [/clock]\n"
            "propositions: [on(lamp)]\n"
            "expect: [{atom: ok(memory), of: [a], given: [ok(/b)]}]\n"
            "clauses: ['NAB(a) -> on(lamp)']\n"
        )
    )
    assert {"not AB(a) and ok(/b) -> ok(memory)", "not AB(a) -> on(lamp)"} <= set(map(str, model.rules))
    assert model.vocabulary.parse("inc(a.v)")
    assert model.components["a"].prior == 0.2


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("nodes:\n  a: {}\n  b: {}\n  a: {}\n", ["robot.yaml:4: a is there twice, also in line 2"]),
        ("nodes:\n  a:\n    out: [/a]\n    prior: high\n", ["robot.yaml:4: Expected `float`, got `str` (at prior)"]),
        ("nodes:\n  a:\n    oot: [/a]\n", ["robot.yaml:3: Object contains unknown field `oot`"]),
        ("nods:\n  a:\n", [f"robot.yaml:2: there is no section 'nods'; the sections are {SECTIONS}"]),
        ("drivers:\n  a: {}\n  b: {on: [c]}\n", ["robot.yaml:3: b drives c, a component that does not exist"]),
        ("nodes:\n  a: {}\nrelated:\n  - [[a, v]]\n", ["robot.yaml:4: Expected `array` of length 2, got 1"]),
        ("nodes:\n  a: {}\nclauses:\n  - NAB(a) -> ok(/x)\n",
         [f"robot.yaml:4: 'ok(/x)': the model declares no such atom (clause not AB(a) -> ok(/x)); {AS_PROPOSITION}"]),
        ("nodes:\n  a: {out: {/a: [/b]}}\n  b: {out: {/b: [/a]}}\n",
         ["robot.yaml:2: circle: ok(/a) <- ok(/b) <- ok(/a); leave out the input that matters least"]),
        ("- a\n- b\n", ["robot.yaml:1: the file is a mapping, `name: ...`"]),
        ("", ["robot.yaml: empty"]),
        ("nodes: [1\nb: {", ["robot.yaml:2: expected ',' or ']', but got ':'"]),
        ("nodes: &all {a: {}}\nhardware: *all\n", ["robot.yaml:2: aliases are not allowed here"]),
        ("ab: AB\nrules:\n  - ok(x) -> NAB(a)\nextra: 1\n", None),
    ],
)  # fmt: skip
def test_errors_name_file_and_line(text: str, expected: list[str] | None) -> None:
    found = problems(text)
    if expected is None:
        assert len(found) == 2
        assert all(problem.startswith("robot.yaml:") for problem in found)
    else:
        assert found == expected


def test_a_clause_of_the_papers_files_about_faulty_components_is_refused_by_line() -> None:
    (problem,) = problems(FIVE + "  - AB(ja)->not_on(ja)\n")
    assert problem.startswith("robot.yaml:12: clause 'AB(ja)->not_on(ja)': it says how a faulty component behaves")


def test_an_atom_that_is_not_among_the_propositions_is_refused() -> None:
    """T53."""
    (problem,) = problems(FIVE + "  - NAB(jn)->ok(/odm)\n")
    assert problem.startswith("robot.yaml:12: 'ok(/odm)': the model declares no such atom; did you mean 'ok(/odom)'?")


def test_a_tag_makes_no_object() -> None:
    text = "nodes: !!python/object/apply:os.system ['true']\n"
    assert problems(text) == ["robot.yaml:1: a section of components is a mapping, `name: ...`"]


def test_what_is_too_deep_or_no_text_is_refused(tmp_path: Path) -> None:
    assert "too deep" in problems("nodes: {a: {out: " + "[" * 600 + "]" * 600 + "}}")[0]
    path = tmp_path / "robot.yaml"
    path.write_bytes(b"nodes: \xff")
    with pytest.raises(ModelError, match="no UTF-8"):
        load(path)


def test_without_the_extra_it_is_said_what_to_install() -> None:
    program = (
        "import importlib.util as finder\n"
        "real = finder.find_spec\n"
        "finder.find_spec = lambda name, *rest: None if name == 'yaml' else real(name, *rest)\n"
        "from holdfast import diagnosis\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    said = "ImportError: holdfast.diagnosis needs yaml: pip install 'holdfast[diagnosis]'"
    assert (done.returncode, done.stderr.splitlines()[-1]) == (1, said)
