"""Each check that keeps repair from doing harm is there for a reason: take it out, and a test fails.

`HOLDFAST_REMOVED=1 python -m pytest tests/diagnosis/repair/test_removed_repair.py` does so, in a copy; otherwise it is
only looked whether the checks and the tests are where this table says.
"""

from __future__ import annotations

from tests.removing import Check, as_tests

WHOLE = "tests/diagnosis/repair/test_whole_restarts.py"
ACTORS = "tests/diagnosis/repair/test_actors.py"
LOOP = "tests/diagnosis/repair/test_loop.py"
WORSE = "tests/diagnosis/repair/test_no_worse.py"

KILLS = "tests/checkpoint/test_kill_counts.py"
SOON = "tests/diagnosis/repair/test_soon.py"
HUNG = "tests/diagnosis/repair/test_hung_turns.py"

CHECKS = {
    "nobody else is restarted in place of one whose restart has not helped": Check(
        "diagnosis/repair/choice.py",
        "len(one.bad) <= most and ",
        "",
        "tests/diagnosis/repair/test_odd_one.py",
        "",
    ),
    "who hears nothing is killed": Check(
        "diagnosis/repair/stock.py",
        "blames_turn=True, at_once=is_silent)",
        "blames_turn=True)",
        HUNG,
        "hears_nothing and recorded",
    ),
    "nobody is asked about what is well": Check(
        "diagnosis/repair/repairer.py",
        "is_wanted = chosen == bad or (chosen is None and not is_gone)",
        "is_wanted = chosen in (None, bad)",
        LOOP,
        "got_well_before_anybody_answered",
    ),
    "what has not helped has no credit": Check(
        "diagnosis/repair/case.py",
        "self.useless.update(place for place in begun if",
        "self.useless.update(place for place in begun if False and",
        LOOP,
        "is_not_what_the_symptoms_went_by",
    ),
    "what was seen again behind an action is no merit of it": Check(
        "diagnosis/repair/repairer.py",
        "                self._note_vain(case)\n",
        "",
        LOOP,
        "no_merit_of_an_action",
    ),
    "only words from behind the grace say that it has not helped": Check(
        "diagnosis/repair/case_decisions.py",
        "        if word.time > behind and word.is_current(now)\n",
        "",
        LOOP,
        "mends_one_symptom",
    ),
    "a plan is judged also behind a moment of blindness": Check(
        "diagnosis/repair/repairer.py",
        "if case.phase is not None and self._outlook",
        "if not isinstance(case.phase, (type(None), deciding.Unclear)) and self._outlook",
        LOOP,
        "moment_of_blindness",
    ),
    "a turn that rests does not hang": Check(
        "diagnosis/observers/node_observer.py",
        "            self._rested[cell.path] = self.now\n",
        "            pass\n",
        HUNG,
        "rests_as_it_has_said and wait and task",
    ),
    "who hangs in an end that nobody has ordered is left to nobody": Check(
        "supervision/arbiter.py",
        " and not _hangs_in_its_end(child, cell):",
        ":",
        HUNG,
        "ends_by_itself",
    ),
    "an end may take as long as its supervisor gives it": Check(
        "supervision/arbiter.py",
        "return cell.node.loop.time() - turn.since > child.spec.shutdown",
        "return True",
        HUNG,
        "ends_by_itself",
    ),
    "that a recorded turn in a process rests is known": Check(
        "diagnosis/observers/node_observer.py",
        "status = known_at_home(told, cell)",
        "status = told",
        HUNG,
        "rests_as_it_has_said and wait and process",
    ),
    "the time behind a rest counts": Check(
        "diagnosis/observers/node_observer.py",
        "self.now - self._rested.get(cell.path, -math.inf)",
        "(0.0 if cell.path in self._rested else math.inf)",
        HUNG,
        "hangs_behind_its_rest",
    ),
    "who rests answers": Check(
        "diagnosis/repair/ping.py",
        "rests = first.turn_rests or second.turn_rests",
        'rests = ""',
        ACTORS,
        "who_rests_is_not_restarted",
    ),
    "what is harmless does not wait for what is dangerous": Check(
        "diagnosis/repair/repairer.py",
        '        if self._memory.stance == "on":  # Of what is left the next round plans.\n',
        "        if False:\n",
        ACTORS,
        "what_is_harmless and elsewhere",
    ),
    "what is below what is dangerous waits with it": Check(
        "diagnosis/repair/harmless.py",
        'above = {(ADDRESS, "/".join(parts[:count])) for count in range(1, len(parts))}',
        "above = set[Atom]()",
        ACTORS,
        "what_is_harmless and below",
    ),
    "a plan that is overtaken is not waited for": Check(
        "diagnosis/repair/repairer.py",
        "            if not is_wanted and left <= 0:\n",
        "            if is_wanted and left > math.inf:\n",
        ACTORS,
        "what_is_harmless and elsewhere",
    ),
    "a turn that repair has to cut off counts against its message": Check(
        "diagnosis/repair/stock.py",
        ", older=older, blames_turn=True, at_once",
        ", older=older, at_once",
        HUNG,
        "whose_turn_hangs_again and task",
    ),
    "only who says so blames the turn": Check(
        "supervision/supervisor.py",
        "if message.blames_turn and one.cell is not None:",
        "if one.cell is not None:",
        KILLS,
        "cut_off_twice_because_it_hangs and task",
    ),
    "the second turn that does not end is the last": Check(
        "checkpoint/method.py",
        "min(HUNG_DELIVERIES, self.max_deliveries) if has_hung else self.max_deliveries",
        "self.max_deliveries",
        KILLS,
        "cut_off_twice_because_it_hangs and task",
    ),
    "a restart by order whose start fails is tried on": Check(
        "supervision/supervisor.py",
        '            if has_run and one.spec.restart != "temporary":\n',
        "            if False:\n",
        WHOLE,
        "test_a_restart_by_order_whose_start_fails",
    ),
    "nothing below a supervisor that gives up is granted": Check(
        "supervision/arbiter.py",
        "        if (above := self._escalation(address)) is not None:\n",
        "        if (above := None) is not None:\n",
        WHOLE,
        "test_nothing_below_a_supervisor_that_escalates",
    ),
    "who answers is not restarted because somebody says that it does not run": Check(
        "diagnosis/repair/case_decisions.py",
        "    if wrong := [name for name in alive if name in down]:\n",
        "    if wrong := list[str]():\n",
        ACTORS,
        "test_an_observer_that_lies_about_who_runs",
    ),
    "a restart that changes nothing is not tried again": Check(
        "diagnosis/repair/ledger.py",
        "        if now < self._memory.vain.get((action.name, component), now):\n",
        "        if False:\n",
        ACTORS,
        "test_an_observer_that_lies_about_an_output",
    ),
    "who is suspended by order is not restarted": Check(
        "diagnosis/repair/case_decisions.py",
        "    if suspended := [name for name, answer in pings.items() if answer is None]:\n",
        "    if suspended := list[str]():\n",
        ACTORS,
        "test_who_is_suspended_by_order",
    ),
    "a denial lasts": Check(
        "diagnosis/repair/repairer.py",
        "            self._ledger.deny(bad, why)\n",
        "",
        LOOP,
        "test_what_was_denied_stays_so",
    ),
    "no more actions than the hour allows": Check(
        "diagnosis/repair/ledger.py",
        " and self._in_hour(now) < policy.hour_actions\n",
        "\n",
        LOOP,
        "test_no_more_actions_than_the_hour_allows",
    ),
    "what its supervisor has just started is given time": Check(
        "diagnosis/repair/repairer.py",
        "        if back := tuple(name for name, life in awaited.items() if self._life(name) not in (0, life)):\n",
        "        if back := tuple[str, ...]():\n",
        WORSE,
        "test_repair_is_no_worse_than_supervision_alone and slow",
    ),
    "who hangs in its end is given no time to begin": Check(
        "diagnosis/repair/repairer.py",
        "if back := tuple(name for name, life in awaited.items() if self._life(name) not in (0, life)):",
        "if back := tuple(awaited):",
        SOON,
        "hangs_in_its_end",
    ),
    "what has stood when it is told need not stand once more": Check(
        "diagnosis/repair/case_decisions.py",
        "        since = min(since, at.stood)\n",
        "        pass\n",
        SOON,
        "falls_silent",
    ),
    "while another one may be faulty the diagnosis has to stand": Check(
        "diagnosis/repair/case_decisions.py",
        "if set(bad) <= set(at.diagnosis.certain):",
        "if True:",
        SOON,
        "must_have_stood",
    ),
    "what began a moment ago has to stand, also if somebody is certain": Check(
        "diagnosis/repair/outlook.py",
        "default=math.inf))\n        return began",
        "default=-math.inf))\n        return began",
        SOON,
        "must_have_stood",
    ),
    "that those who ask are started again delays nobody": Check(
        "diagnosis/repair/outlook.py",
        "if until > now and (name in suspects or not symptoms.isdisjoint(model.dependents((name,))))",
        "if until > now",
        SOON,
        "delays_nobody",
    ),
    "a client of the board that has said nothing for the longest time gives its seat to a new one": Check(
        "diagnosis/board/tcp_server.py",
        "        if len(self._clients) > MOST_CLIENTS and not self._free_seat(task):\n",
        "        if len(self._clients) > MOST_CLIENTS:\n",
        "tests/diagnosis/board/test_board.py",
        "test_silent_clients_give_their_seats",
    ),
    "a board with a token serves nobody without it": Check(
        "diagnosis/board/tcp_server.py",
        "        if not self._is_known and not isinstance(frame, AuthenticateFrame):\n",
        "        if False:\n",
        "tests/diagnosis/board/test_board.py",
        "test_without_the_token_nothing_is_done",
    ),
}

test_the_table_is_true, test_without_the_check_a_test_fails = as_tests(CHECKS)
