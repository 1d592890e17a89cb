"""Each safety check of the evidence for diagnosis is there for a reason: take it out, and a test fails.

`HOLDFAST_REMOVED=1 python -m pytest tests/diagnosis/test_removed_checks.py` does so, in a copy; otherwise it is only
looked whether the checks and the tests are where this table says.
"""

from __future__ import annotations

from tests.removing import Check, as_tests

ENGINE = "tests/diagnosis/test_engine.py"
OBSERVATIONS = "tests/diagnosis/test_observations.py"
RUNTIME = "tests/diagnosis/observers/test_runtime.py"
BACKLOG = "tests/diagnosis/observers/test_backlog.py"
REPLICAS = "tests/diagnosis/live/test_replicas.py"
FOLLOWING = "tests/diagnosis/live/test_following.py"
BRIDGES = "tests/diagnosis/bridges/test_bridges.py"
BOARD = "tests/diagnosis/board/test_board.py"
FLOW = "tests/diagnosis/observers/test_flow.py"
FOREIGN = "tests/diagnosis/foreign/test_foreign.py"

KINDS = "tests/diagnosis/observers/test_kinds.py"

CHECKS = {
    "a recorded actor has in hand what its home says": Check(
        "checkpoint/home/journal_home.py",
        "        return Work(mark, source is not None, None if turn is None else turn.since, has_answered)\n",
        "        return Work(cell.item)\n",
        KINDS,
        "seen_to_work_and_to_hang and process-hybrid",
    ),
    "a mailbox that drops what waits may be full": Check(
        "diagnosis/observers/runtime.py",
        "bound is not None and bound.overflow not in DROPS and bound.count >= bound.capacity",
        "bound is not None and bound.count >= bound.capacity",
        KINDS,
        "full_by_its_policy",
    ),
    "who has nothing to do does not stand still": Check(
        "diagnosis/observers/runtime.py",
        "        if not is_busy:\n            seen.idle = now\n",
        "",
        KINDS,
        "was_idle_for_long",
    ),
    "turns that nobody saw are guessed": Check(
        "diagnosis/observers/flow.py",
        "return learned.most_in if self.seen >= ENOUGH else max(learned.most_in, self.guess)",
        "return learned.most_in",
        FLOW,
        "nobody_saw_before",
    ),
    "what was guessed of bursts is forgotten": Check(
        "diagnosis/observers/flow.py",
        "return learned.most_in if self.seen >= ENOUGH else max(learned.most_in, self.guess)",
        "return max(learned.most_in, self.guess)",
        FOREIGN,
        "in_bursts",
    ),
    "what goes out is counted when all that came in is worked off": Check(
        "diagnosis/observers/flow.py",
        "flow.in_block >= BLOCK and all(map(_is_idle, cells, works))",
        "flow.in_block >= BLOCK",
        FLOW,
        "a_burst_that_is_larger_than_ever",
    ),
    "a single block of which little goes out is usual": Check(
        "diagnosis/observers/flow.py",
        "[*self.recent, part] if self.poor < 2 else []",
        "[*self.recent, part] if self.poor < 1 else []",
        FLOW,
        "now_and_then",
    ),
    "the block in which it became poor is not learned": Check(
        "diagnosis/observers/flow.py",
        "        if len(self.recent) > 2:\n",
        "        if self.recent:\n",
        FLOW,
        "too_little_goes_out",
    ),
    "a source in a process is seen to have turns": Check(
        "diagnosis/observers/flow.py",
        "marks = tuple(work.mark for work in works)",
        "marks = tuple(cell.item for cell in cells)",
        FLOW,
        "a_source_in_a_process",
    ),
    "a silence in which a publisher was started again is not usual": Check(
        "diagnosis/observers/flow.py",
        "return not is_cut and (",
        "return (",
        FLOW,
        "found_again",
    ),
    "a silence that was told as a fault is not usual": Check(
        "diagnosis/observers/flow.py",
        "(not is_missed or self.missed >= TOO_OFTEN)",
        "True",
        FLOW,
        "found_again",
    ),
    "what is put aside waits, too": Check(
        "diagnosis/observers/runtime.py",
        "seen.backlog.take(backlog + aside, now)",
        "seen.backlog.take(backlog, now)",
        "tests/diagnosis/observers/test_runtime.py",
        "puts_everything_aside",
    ),
    "limits go with an actor that is moved": Check(
        "diagnosis/live_limits.py",
        "brought.get(component) or self._by_pattern(component)",
        "self._by_pattern(component)",
        FOLLOWING,
        "limits_go_with",
    ),
    "actors that change places are seen to": Check(
        "diagnosis/model_follower.py",
        "if found is not known or limits != self._limits.applied:",
        "if found is not known:",
        FOLLOWING,
        "change_places",
    ),
    "lives of another actor are no restarts": Check(
        "diagnosis/observers/property.py",
        "if cell is not self._lived:",
        "if False:",
        FOLLOWING,
        "lives_of_another",
    ),
    "limits of nobody are refused": Check(
        "diagnosis/live_limits.py",
        "if name not in known and _OF_PATTERNS.isdisjoint(name):",
        "if False:",
        FOLLOWING,
        "there_is_not",
    ),
    "an actor has no name of replicas": Check(
        "diagnosis/generate.py",
        'return f"{word.removesuffix(_REPLICAS)}%2E{_REPLICAS[1:]}" if word.endswith(_REPLICAS) else word',
        "return word",
        REPLICAS,
        "told_apart",
    ),
    "a component of one's own has no name of replicas": Check(
        "diagnosis/generate.py",
        'raise ModelError(tuple(f"{name}: {why}" for name in taken))',
        "pass",
        REPLICAS,
        "is_refused",
    ),
    "an actor is not repaired as replicas": Check(
        "diagnosis/model_follower.py",
        "for name, path in groups.items() if name not in self.addresses}",
        "for name, path in groups.items()}",
        REPLICAS,
        "takes_nobody",
    ),
    "what is contested is unknown, and the rest is diagnosed": Check(
        "diagnosis/engine/minimal_diagnoses.py",
        "state = State.FAULTY if is_faulty else State.CONTRADICTORY",
        "state = State.CONTRADICTORY",
        ENGINE,
        "nobody_is_blamed or cost_only_what",
    ),
    "nobody is blamed for what is contested": Check(
        "diagnosis/engine/minimal_diagnoses.py",
        "clear = [part for part in cone.parts if contested.isdisjoint(part.components)]",
        "clear = list(cone.parts)",
        ENGINE,
        "nobody_is_blamed",
    ),
    "a part that ran out of time hides no other": Check(
        "diagnosis/engine/minimal_diagnoses.py",
        "parts = [solved for solved in every if solved.sets]",
        "parts = every",
        ENGINE,
        "what_is_certain_is_known",
    ),
    "an explanation has a time": Check(
        "diagnosis/engine/minimal_diagnoses.py",
        "return explain(index, positive, negative, time.monotonic() + seconds)",
        "return explain(index, positive, negative)",
        ENGINE,
        "an_explanation_ends",
    ),
    "that an actor runs says nothing of its work": Check(
        "diagnosis/engine/cone.py",
        "literal.name not in NO_WORK",
        "True",
        ENGINE,
        "is_unknown",
    ),
    "a liar is set aside as a whole": Check(
        "diagnosis/observations.py",
        "if seen.is_current(now) and seen.source not in liars",
        "if seen.is_current(now)",
        OBSERVATIONS,
        "set_aside",
    ),
    "who waits for another one is not accused": Check(
        "diagnosis/observers/runtime.py",
        "while (following := self._awaited(row[-1], waits)) is not None:",
        "while (following := None) is not None:",
        RUNTIME,
        "behind_two_that_wait",
    ),
    "what grows and then is worked off is no leak": Check(
        "diagnosis/observers/backlog.py",
        "has_grown = is_larger and still_rises and is_long and",
        "has_grown = is_larger and is_long and",
        BACKLOG,
        "a_long_rise",
    ),
    "a burst is no leak": Check(
        "diagnosis/observers/backlog.py",
        "has_grown = is_larger and still_rises and is_long and",
        "has_grown = is_long and",
        BACKLOG,
        "a_burst",
    ),
    "a rise is compared with what was usual": Check(
        "diagnosis/observers/backlog.py",
        "max(SHORTEST, LONGER * self.longest)",
        "SHORTEST",
        BACKLOG,
        "a_long_rise",
    ),
    "who does not keep up because it waits for another one is not accused": Check(
        "diagnosis/observers/runtime.py",
        "overrun = self._ends(growing, {}, waiting)",
        "overrun = set(growing)",
        BACKLOG,
        "Through",
    ),
    "a missing replica is no fault of the actor": Check(
        "diagnosis/generate.py",
        "Expectation(str(atom(name)), (replicas_of(name),))",
        "Expectation(str(atom(name)), (name,))",
        REPLICAS,
        "life_after_life",
    ),
    "catching up is compared with what was usual": Check(
        "diagnosis/observers/replicas.py",
        "max(self._catching, LONGER * group.catching)",
        "self._catching",
        REPLICAS,
        "four_times",
    ),
    "replicas that lead or follow are left alone": Check(
        "diagnosis/repair/stock.py",
        'if state not in ("leads", "follows")]',
        "]",
        REPLICAS,
        "begun_anew",
    ),
    "who crashes because of another one is not to blame": Check(
        "diagnosis/observers/runtime.py",
        "if component is not None and not (was_let_down or _is_anothers(reason)):",
        "if component is not None:",
        RUNTIME,
        "who_crashes_because",
    ),
    "who is always to be there, and ends again and again, is faulty": Check(
        "diagnosis/observers/runtime.py",
        "case ActorCrashed(reason=Crash() as reason) | ChildTerminated(reason=Normal() as reason):",
        "case ActorCrashed(reason=Crash() as reason):",
        RUNTIME,
        "a_crash_loop_is_certain",
    ),
    "a long turn that nobody waits for is no fault": Check(
        "diagnosis/observers/runtime.py",
        "stands = is_busy and is_wanted and now",
        "stands = is_busy and now",
        RUNTIME,
        "a_long_turn",
    ),
    "a refusal is no evidence": Check(
        "diagnosis/observers/runtime.py",
        "has_refused = now - seen.refused <= keeps",
        "has_refused = False",
        RUNTIME,
        "who_refuses",
    ),
    "what a recorded actor is refused counts, too": Check(
        "checkpoint/home/pending_asks.py",
        "            self.tell_failure(error)\n",
        "            pass\n",
        RUNTIME,
        "who_refuses",
    ),
    "nobody is told of failures when nobody looks": Check(
        "diagnosis/observers/runtime.py",
        "            self._node.deadlines.watcher = None",
        "            pass",
        RUNTIME,
        "nothing_is_told",
    ),
    "a start forgets what was seen of those that it is about, and of nobody else": Check(
        "diagnosis/observers/flow.py",
        "            if word_for(topic) in names:\n                flow.begin(self.now)\n",
        "            flow.begin(self.now)\n            flow.began = float('inf')\n",
        FLOW,
        "a_clock_that_has_stopped",
    ),
    "what was heard while the model was made is learned from": Check(
        "diagnosis/observers/flow.py",
        "        self._learn_from_before()\n",
        "",
        FLOW,
        "heard_before",
    ),
    "the time in which nobody listened is no silence": Check(
        "diagnosis/observers/flow.py",
        "            for flow in self._flows.values():\n                flow.begin(self.now)\n",
        "",
        FLOW,
        "heard_before",
    ),
    "repair follows the system": Check(
        "diagnosis/model_follower.py",
        "            self._reach.use(found.addresses)\n",
        "",
        FOLLOWING,
        "of_any_name",
    ),
    "components are named by words": Check(
        "diagnosis/generate.py",
        "names = {cell.path: component_for(cell.path[len(root.path) + 1 :]) for cell in cells}",
        "names = {cell.path: cell.path[len(root.path) + 1 :] for cell in cells}",
        FOLLOWING,
        "of_any_name",
    ),
    "topics are named by words": Check(
        "diagnosis/generate.py",
        "[*map(word_for, wired.publishes), str(replies(name))]",
        "[*wired.publishes, str(replies(name))]",
        FOLLOWING,
        "of_any_name",
    ),
    "what is said of a topic is said of its word": Check(
        "diagnosis/observers/flow.py",
        "self.verdict(ok(word_for(topic)), ",
        "self.verdict(ok(topic), ",
        FOLLOWING,
        "of_any_name",
    ),
    "an answer that is to come later is none yet": Check(
        "checkpoint/home/journal_home.py",
        "bool(ended.reply) and ended.input.ask is None",
        "bool(ended.reply)",
        "tests/diagnosis/live/test_processes.py",
        "test_who_answers_is_seen_to and recorded and process",
    ),
    "an alert needs the token": Check(
        "diagnosis/bridges/alert_app.py",
        "if not hmac.compare_digest(given, self._authorization):",
        "if False:",
        BRIDGES,
        "of_prometheus",
    ),
    "an alert ends only with the last one about its component": Check(
        "diagnosis/bridges/alerts.py",
        "elif all(one.component != component for one in self._firing.values()):",
        "else:",
        BRIDGES,
        "of_two_alerts",
    ),
    "a request has an end": Check(
        "diagnosis/bridges/alert_app.py",
        "if len(body) > MOST_BYTES:",
        "if False:",
        BRIDGES,
        "of_prometheus",
    ),
    "a token does not go over a network in clear": Check(
        "diagnosis/bridges/delivery.py",
        "not (insecure or is_loopback(parts.hostname))",
        "False",
        BRIDGES,
        "cannot_work",
    ),
    "what was not taken is posted again": Check(
        "diagnosis/bridges/webhook.py",
        "if not (is_taken or is_refused):",
        "if False:",
        BRIDGES,
        "posted_again",
    ),
    "a board takes no token in clear": Check(
        "diagnosis/board/board_tls.py",
        "not (is_encrypted or insecure or is_loopback(host))",
        "False",
        BOARD,
        "in_clear",
    ),
    "a board that asks for certificates wants one": Check(
        "diagnosis/board/board_tls.py",
        "        context.verify_mode = ssl.CERT_REQUIRED\n",
        "        pass\n",
        BOARD,
        "by_tls",
    ),
    "silence without input is no fault": Check(
        "diagnosis/observers/flow.py",
        "is_by_clock = not made.inputs and learned",
        "is_by_clock = learned",
        FLOW,
        "when_its_input_stops",
    ),
}

test_the_table_is_true, test_somebody_misses_it = as_tests(CHECKS)
