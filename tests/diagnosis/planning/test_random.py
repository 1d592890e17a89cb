"""Random domains: what the planner answers against an exhaustive search by the simulator."""

import itertools
from collections.abc import Iterator

import msgspec
from hypothesis import example, given, settings
from hypothesis import strategies as st

from holdfast.diagnosis.planning import (
    Budget,
    ClingoPlanner,
    Domain,
    Plan,
    Problem,
    Simulator,
    Step,
    Unsolvable,
    check_plan,
    read_domain,
    read_problem,
)
from holdfast.diagnosis.planning.language import Action, And, Atom, Effect, Fact, Formula, Not, Or, PlanLiteral
from holdfast.diagnosis.planning.pddl_writer import Names, write_domain, write_problem

ATOMS = [(f"p{i}",) for i in range(4)]


def formula(literal: PlanLiteral) -> Formula:
    return Fact(literal.atom) if literal.value else Not(Fact(literal.atom))


literals = st.builds(PlanLiteral, st.sampled_from(ATOMS), st.booleans())
clauses = st.lists(literals, min_size=1, max_size=2).map(lambda of: Or(tuple(map(formula, of))))
conjunctions = st.lists(clauses, max_size=2).map(lambda of: And(tuple(of)))

needs = st.lists(literals, max_size=2).map(lambda of: And(tuple(map(formula, of))))


@st.composite
def problems(draw: st.DrawFn, conditional: bool) -> Problem:
    conditions = conjunctions if conditional else st.just(And())
    actions = [
        Action(
            f"a{number}",
            (),
            draw(conjunctions if conditional else needs),
            tuple(
                Effect((), draw(conditions), literal) for literal in draw(st.lists(literals, min_size=1, max_size=3))
            ),
            draw(st.integers(1, 3)),
        )
        for number in range(draw(st.integers(1, 4)))
    ]
    domain = Domain("random", (), tuple((atom[0], ()) for atom in ATOMS), tuple(actions))
    init = draw(st.frozensets(st.sampled_from(ATOMS)))
    goals = draw(st.lists(literals, min_size=1, max_size=3, unique=True))
    return Problem(domain, {}, init, tuple(goals))


def put(problem: Problem, state: frozenset[Atom]) -> Simulator:
    """The world of a problem, in this state."""
    return Simulator(Problem(problem.domain, problem.objects, state, problem.goals))


def reachable(problem: Problem) -> dict[frozenset[Atom], int]:
    """Every state there is, by single steps, and in how many."""
    steps = [Step(action.name) for action in problem.domain.actions]
    seen, queue = {problem.init: 0}, [problem.init]
    for state in queue:
        for step in steps:
            world = put(problem, state)
            if not world.missing(step):
                world.do(step)
                after = frozenset(world.state)
                if after not in seen:
                    seen[after] = seen[state] + 1
                    queue.append(after)
    return seen


def is_met(problem: Problem, state: frozenset[Atom]) -> bool:
    return all((goal.atom in state) is goal.value for goal in problem.goals)


def orders(plan: Plan) -> Iterator[list[Step]]:
    """Every order in which the steps may be done."""
    for stages in itertools.product(*(itertools.permutations(stage) for stage in plan.stages)):
        yield [step for stage in stages for step in stage]


@settings(max_examples=200)
@given(problems(conditional=True))
def test_there_is_a_plan_exactly_where_the_goals_can_be_reached(problem: Problem) -> None:
    outcome = ClingoPlanner().solve(problem, Budget(60))
    states = reachable(problem)
    if isinstance(outcome, Unsolvable):
        assert not any(is_met(problem, state) for state in states)
        for state in states:
            met = [(goal.atom in state) is goal.value for goal in outcome.goals]
            assert not (any(met) if outcome.is_each else all(met))
        return
    assert isinstance(outcome, Plan)
    check_plan(problem, outcome)
    for steps in itertools.islice(orders(outcome), 50):
        world = Simulator(problem)
        for step in steps:
            world.do(step)
        assert not world.unmet()


def read(formula: Formula) -> set[PlanLiteral]:
    """The literals of a conjunction."""
    match formula:
        case And(of):
            return {literal for part in of for literal in read(part)}
        case Not(Fact(atom)):
            return {PlanLiteral(atom, False)}
        case Fact(atom):
            return {PlanLiteral(atom)}
        case _:
            raise AssertionError(formula)


def written(action: Action) -> set[PlanLiteral]:
    """What an action makes so; what it both adds and deletes is added."""
    made = {effect.literal for effect in action.effects}
    return {literal for literal in made if literal.value or PlanLiteral(literal.atom) not in made}


def disturb(a: Action, b: Action) -> bool:
    """Whether one takes away what the other needs or makes."""
    return any(
        PlanLiteral(atom, not value) in read(other.precondition) | written(other)
        for one, other in ((a, b), (b, a))
        for atom, value in written(one)
    )


def best(problem: Problem, most: int) -> tuple[int, int] | None:
    """The least number of stages, and the least cost with so many, found by trying every set of steps in each."""
    actions = problem.domain.actions
    subsets = [
        some
        for size in range(1, len(actions) + 1)
        for some in itertools.combinations(actions, size)
        if not any(disturb(a, b) for a, b in itertools.combinations(some, 2))
    ]
    layer: dict[frozenset[Atom], int] = {problem.init: 0}
    for stages in range(most + 1):
        costs = [cost for state, cost in layer.items() if is_met(problem, state)]
        if costs:
            return stages, min(costs)
        after = dict(layer)  # A stage may be empty.
        for (state, cost), some in itertools.product(layer.items(), subsets):
            if all((atom in state) is value for action in some for atom, value in read(action.precondition)):
                made = {literal for action in some for literal in written(action)}
                reached = state - {atom for atom, value in made if not value} | {atom for atom, value in made if value}
                total = cost + sum(action.cost for action in some)
                after[reached] = min(total, after.get(reached, total))
        layer = after
    return None


def plain(name: str, needs: list[PlanLiteral], makes: list[PlanLiteral]) -> Action:
    effects = tuple(Effect((), And(), literal) for literal in makes)
    return Action(name, (), And(tuple(map(formula, needs))), effects)


P = [PlanLiteral(atom) for atom in ATOMS]
MADE_SO_AGAIN = Problem(
    Domain(
        "again",
        (),
        tuple((atom[0], ()) for atom in ATOMS),
        (plain("a0", [], [P[2], P[3]]), plain("a1", [P[2]], [P[0]]), plain("a2", [P[0], P[3]], [P[1]])),
    ),
    {},
    frozenset([P[2].atom]),
    (P[1],),
)
"""What a0 makes so is so already: a1 need not wait for it."""


@settings(max_examples=100)
@given(problems(conditional=False))
@example(MADE_SO_AGAIN)
def test_a_plan_has_the_fewest_stages_and_then_the_least_cost(problem: Problem) -> None:
    outcome = ClingoPlanner().solve(problem, Budget(60))
    found = best(problem, 2 ** len(ATOMS))
    if isinstance(outcome, Plan):
        assert outcome.is_optimal
        assert (len(outcome.stages), outcome.cost) == found
    else:
        assert found is None


@settings(max_examples=25)
@given(problems(conditional=True))
@example(Problem(Domain("d", (), (("p0", ()),), ()), {"A b": "object", "(": "object"}, frozenset(), ()))
def test_what_is_written_is_read_as_the_same(problem: Problem) -> None:
    names = Names(problem.everything())
    domain = read_domain(write_domain(problem.domain, names))
    written = read_problem(domain, write_problem(problem, names)) if problem.goals else problem
    before, after = (ClingoPlanner().solve(one, Budget(60)) for one in (problem, written))
    assert type(before) is type(after)
    if isinstance(before, Plan) and isinstance(after, Plan):
        assert (len(before.stages), before.cost) == (len(after.stages), after.cost)


def test_outcomes_can_be_sent() -> None:
    plan = Plan(((Step("power_up", ("ja",)),),), 1, True, (PlanLiteral(("good", "imu")),))
    assert msgspec.msgpack.decode(msgspec.msgpack.encode(plan), type=Plan) == plan
