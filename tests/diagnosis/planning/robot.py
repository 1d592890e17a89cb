"""The rescue robot of the paper, as problems of repair."""

from collections.abc import Collection

from holdfast.diagnosis.planning import Domain, Outcome, Plan, Problem, repair_domain, repair_problem

HARDWARE = ("ja", "hu", "la")
DEVICES = ("js", "imu")
NODES = ("jn", "hn", "lan", "in", "jyn", "jtn", "hm", "lac", "rviz")
DRIVES = {"jn": ["ja"], "hn": ["hu"], "lan": ["la"]}


def robot(
    bad: Collection[str],
    *,
    on: Collection[str] = HARDWARE,
    running: Collection[str] = NODES,
    optional: Collection[str] = (),
    restart_drivers: bool = False,
    domain: Domain | None = None,
) -> Problem:
    """The robot with these components blamed."""
    return repair_problem(
        domain or repair_domain(),
        hardware=HARDWARE,
        devices=DEVICES,
        nodes=NODES,
        drives=DRIVES,
        bad=bad,
        on=on,
        running=running,
        optional=optional,
        restart_drivers=restart_drivers,
    )


def power_up() -> Problem:
    """All is off but the board and the PC, and the operator's rviz."""
    return robot([*HARDWARE, *[node for node in NODES if node != "rviz"]], on=(), running=("rviz",))


def told(outcome: Outcome) -> list[list[str]]:
    """The stages of a plan, as text."""
    assert isinstance(outcome, Plan), outcome
    return [[str(step) for step in stage] for stage in outcome.stages]
