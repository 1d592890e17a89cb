"""What the root does not believe of bindings: have it believe that, and a test fails.

`HOLDFAST_REMOVED=1 python -m pytest tests/actors/process/hostile/test_removed_claims.py` does so, in a copy; otherwise
it is only looked whether the checks and the tests are where this table says.
"""

from __future__ import annotations

from tests.removing import Check, as_tests

CLAIMS = "tests/actors/process/hostile/test_claims.py"
GATE = "actors/process/wire/worker_gate.py"
CHECKS = {
    "a recorded actor in a process orders whom it may": Check(
        "checkpoint/home/life_ports.py",
        "            gate.order(out.to, out.verb)\n",
        "            pass\n",
        CLAIMS,
        "test_an_order_among_the_outputs and asyncio",
    ),
    "an ask ends at a time": Check(
        "actors/process/wire/worker_gate.py",
        "        if not math.isfinite(frame.until):\n",
        "        if frame.until != frame.until:\n",
        "tests/actors/process/hostile/test_hostile.py",
        "test_a_breach_ends_the_worker",
    ),
    "what a recorded life says of time is finite": Check(
        "checkpoint/protocol.py",
        "Annotated[float, msgspec.Meta(ge=-sys.float_info.max, le=sys.float_info.max)]",
        "float",
        "tests/actors/process/hostile/test_hostile.py",
        "test_numbers_of_a_recorded_life",
    ),
    "claims grant nothing": Check(
        "actors/kernel/bindings.py",
        "for port, to in more.bindings.items() if port not in more.claimed}",
        "for port, to in more.bindings.items()}",
        CLAIMS,
        "test_a_claim_is_known_and_grants_nothing and plain",
    ),
    "what a process says of a life is a claim": Check(
        "actors/process/stand_ins.py",
        "            claim(cell, bound)\n",
        "            claim(cell, bound)\n            cell.extra().claimed = frozenset()\n",
        CLAIMS,
        "test_a_claim_is_known_and_grants_nothing and plain",
    ),
    "what a process says of a recorded child that it wants is a claim": Check(
        "checkpoint/places/far_parent.py",
        "        claim(cell, wanted.bindings)\n",
        "        claim(cell, wanted.bindings)\n        cell.extra().claimed = frozenset()\n",
        CLAIMS,
        "test_what_it_wants_of_another_child_grants_nothing and recorded",
    ),
    "what a process says of a protected child that it wants is a claim": Check(
        "checkpoint/places/far_parent.py",
        "        claim(cell, wanted.bindings)\n",
        "        claim(cell, wanted.bindings)\n        cell.extra().claimed = frozenset()\n",
        CLAIMS,
        "test_a_claim_is_known_and_grants_nothing and protected",
    ),
    "bindings that a process claims are addresses, and few": Check(
        "checkpoint/home/life_ports.py",
        "            gate.claims(record.bindings)\n",
        "            pass\n",
        CLAIMS,
        "test_bindings_that_cannot_be_are_a_breach",
    ),
    "a process is not believed that a signal was carried behind a move": Check(
        "actors/process/process_host.py",
        "            obey(node, cell, path, frame)\n",
        "            obey(node, cell, path, frame, by_root=True)\n",
        "tests/actors/process/hostile/test_hostile.py",
        "test_a_signal_that_says_it_was_carried",
    ),
    "a process kills in the name of its own actors": Check(
        GATE,
        '        gate.require_voice(by, "a kill in the name")\n',
        "        pass\n",
        "tests/actors/process/hostile/test_hostile.py",
        "test_a_breach_ends_the_worker_and_nobody_else",
    ),
    "a life's bindings, too": Check(
        GATE,
        '    gate.claims(frame.data.get("bindings", {}))\n',
        "",
        "tests/actors/process/hostile/test_hostile.py",
        "test_a_breach_ends_the_worker_and_nobody_else",
    ),
    "a process has names given if it has a supervisor": Check(
        GATE,
        "        if kind is None or not kind._supervises:\n",
        "        if False:\n",
        CLAIMS,
        "test_a_process_without_a_supervisor_gives_no_names",
    ),
    "and such as are names": Check(
        GATE,
        '        if name.startswith("/") or len(name)',
        "        if False and len(name)",
        CLAIMS,
        "test_nor_by_what_it_wants_of_a_child",
    ),
    "also by what it wants of a child": Check(
        "checkpoint/home/life_ports.py",
        "            if record.register is not None:\n",
        "            if False:\n",
        CLAIMS,
        "test_nor_by_what_it_wants_of_a_child",
    ),
    "one for each": Check(
        "actors/process/stand_ins.py",
        "        lifecycle.free_names(cell)  # A life has one name",
        "        pass  # A life has one name",
        CLAIMS,
        "test_its_own_actors_have_what_names_nobody_has",
    ),
}

test_the_table_is_true, test_a_test_fails = as_tests(CHECKS)
