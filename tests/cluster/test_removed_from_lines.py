"""Each safety check of lines between systems is there for a reason: take it out, and a test fails.

`HOLDFAST_REMOVED=1 python -m pytest tests/cluster/test_removed_from_lines.py` does so, in a copy; otherwise it is only
looked whether the checks and the tests are where this table says.
"""

from __future__ import annotations

from tests.removing import Check, as_tests

LINES = "tests/cluster/test_lines.py"
GREEDY = "tests/cluster/test_greedy_clients.py"
CONNECTIONS = "tests/cluster/test_connections.py"

CHECKS: dict[str, Check] = {
    "an item that comes again is not taken again": Check(
        "cluster/lines/line.py",
        "for data in batch.items[self.got + 1 - batch.first :]:",
        "for data in batch.items:",
        LINES,
        "all_arrives_once",
    ),
    "an item is not taken before those in front of it": Check(
        "cluster/lines/line.py",
        "if batch.first > self.got + 1:",
        "if False:",
        LINES,
        "all_arrives_once",
    ),
    "what is not acknowledged is sent again": Check(
        "cluster/lines/line.py",
        "self._sent = self._arrived\n        self.flush()",
        "pass",
        LINES,
        "all_arrives_once",
    ),
    "what is for an earlier run of this program is refused": Check(
        "cluster/lines/calls.py",
        "elif batch.to == lines.boot and far is not None and far.is_with(batch):",
        "elif far is not None and far.is_with(batch):",
        CONNECTIONS,
        "an_earlier_run_has_sent",
    ),
    "no other system gives orders": Check(
        "cluster/lines/far_line.py",
        "return is_order(self.connection.names.from_wire(name))",
        "return False",
        CONNECTIONS,
        "order_another_about",
    ),
    "what may have been done by an actor without a journal is not done again": Check(
        "cluster/lines/far_line.py",
        "if again and (homes is None or switch_of(cell) is None):",
        "if False:",
        CONNECTIONS,
        "another_program_leads",
    ),
    "an ask that has its outcome is not done again": Check(
        "cluster/lines/far_line.py",
        "if known is not None or homes.far.is_open(which):",
        "if False:",
        CONNECTIONS,
        "another_program_leads",
    ),
    "the outcome of an ask is stored with its turn's end": Check(
        "checkpoint/home/ask_recovery.py",
        'batch.add(FAR, ("answered", *msgspec.structs.astuple(one)), place)',
        "pass",
        CONNECTIONS,
        "another_program_leads",
    ),
    "what is told to another system is stored with its turn's end": Check(
        "checkpoint/home/ask_recovery.py",
        'batch.add(FAR, ("out", *msgspec.structs.astuple(kept)), self._positions)',
        "pass",
        CONNECTIONS,
        "outlives_its_own_program",
    ),
    "it is stored that another system has accepted": Check(
        "checkpoint/home/ask_recovery.py",
        'batch.add(FAR, ("accepted", origin), self._positions)',
        "pass",
        CONNECTIONS,
        "outlives_its_own_program",
    ),
    "an ask of another system does not end with the program that was asked": Check(
        "checkpoint/home/ask_recovery.py",
        "return self.is_closing and isinstance(ask, SwitchAsk) and self.is_far(ask.asker)",
        "return False",
        CONNECTIONS,
        "waits_at_the_end_of_a_program",
    ),
    "whoever has called and is silent is forgotten": Check(
        "cluster/lines/lines.py",
        "if quiet > FORGET_SECONDS:",
        "if False:",
        CONNECTIONS,
        "silent_is_forgotten",
    ),
    "a program speaks for its own actors": Check(
        "cluster/lines/far_line.py",
        "            self._check_addresses(frame)\n",
        "",
        CONNECTIONS,
        "speaks_for_its_own_actors",
    ),
    "a program has a name that can be part of an address": Check(
        "cluster/lines/calls.py",
        "if not back or not _is_sound(batch) or batch.sender == lines.name:",
        "if not back:",
        CONNECTIONS,
        "a_name_that_is_none",
    ),
    "an outcome that is too large does not stop the line": Check(
        "cluster/lines/far_line.py",
        "        if len(data) > self.most:",
        "        if False:",
        CONNECTIONS,
        "too_large",
    ),
    "answers go to inboxes only": Check(
        "cluster/nats/nats_transport.py",
        "if message.reply and not message.reply.startswith(INBOX):",
        "if False:",
        "tests/cluster/test_connections_on_nats.py",
        "write_into_its_own_log",
    ),
    "nothing is sent to a system that is away": Check(
        "cluster/lines/far_line.py",
        "(self.is_lost and isinstance(frame, (frames.Tell, frames.Offer, frames.Publish)))",
        "False",
        CONNECTIONS,
        "away_are_refused",
    ),
    "a program that has too many messages waiting is held back": Check(
        "cluster/lines/inflow.py",
        "self.is_full = not self.has_room(1.0)",
        "pass",
        GREEDY,
        "tells_too_much",
    ),
    "whoever is held back is told so": Check(
        "cluster/lines/far_line.py",
        'note = "full"',
        "pass",
        GREEDY,
        "tells_too_much",
    ),
    "answers go past the messages that wait": Check(
        "cluster/lines/far_line.py",
        "        if _is_answer(data):",
        "        if False:",
        GREEDY,
        "answers_go_past",
    ),
    "asks over the limit are refused": Check(
        "cluster/lines/inflow.py",
        "            if len(self._asks) >= self.limits.asks:\n                return False",
        "            pass",
        GREEDY,
        "asks_over_the_limit",
    ),
    "asks that have run out do not count": Check(
        "cluster/lines/inflow.py",
        "if last > now}",
        "if last}",
        GREEDY,
        "have_run_out",
    ),
    "subscriptions over the limit are refused": Check(
        "cluster/lines/far_line.py",
        "elif topics.has(topic, cell) or self.inflow.topics.may_add(",
        "elif True or self.inflow.topics.may_add(",
        GREEDY,
        "subscribes_and_watches",
    ),
    "ties over the limit are refused": Check(
        "cluster/lines/far_line.py",
        '            case "monitor" | "link" if not self._may_tie(frame):',
        '            case "monitor" | "link" if False:',
        GREEDY,
        "subscribes_and_watches",
    ),
    "whoever does not hold back loses its line": Check(
        "cluster/lines/far_line.py",
        "if inflow.held_bytes > MOST_HELD and self.line is not None:",
        "if False:",
        GREEDY,
        "does_not_hold_back",
    ),
    "whoever does not take its outcomes gets no more": Check(
        "cluster/lines/far_line.py",
        "if self.line is not None and self.line.waiting_bytes > limits.message_bytes:",
        "if False:",
        GREEDY,
        "never_takes_its_outcomes",
    ),
    "whoever takes nothing of what is sent to it loses its line": Check(
        "cluster/lines/lines.py",
        "if far.line is not None and (waits := far.line.stuck_for(STUCK_SECONDS, MOST_WAITING)):",
        "if waits := 0:",
        GREEDY,
        "takes_nothing_of_what_it_is_told",
    ),
    "whoever accepts nothing of what is published loses its line": Check(
        "cluster/lines/lines.py",
        "if far.unaccepted_for() > STUCK_SECONDS:",
        "if False:",
        GREEDY,
        "takes_nothing_of_what_is_published",
    ),
    "whoever only greets gives way to others": Check(
        "cluster/lines/calls.py",
        "stranger = next(iter(self._strangers), None)",
        "stranger = None",
        GREEDY,
        "only_greets",
    ),
    "so many systems are taken note of": Check(
        "cluster/lines/calls.py",
        "if homes is not None and not homes.far.may_know(name, MOST_SYSTEMS):",
        "if False:",
        GREEDY,
        "names_of_systems",
    ),
    "what is kept for a system that stays away has a limit": Check(
        "checkpoint/home/ask_recovery.py",
        "if len(mail.outs) >= limits.kept or mail.size + len(kept.body) > limits.kept_bytes:",
        "if False:",
        GREEDY,
        "stays_away",
    ),
    "it is stored that what was kept is dropped": Check(
        "checkpoint/home/ask_recovery.py",
        'batch.add(FAR, ("dropped", system), self._positions)',
        "pass",
        GREEDY,
        "stays_away",
    ),
    "outcomes that nobody takes are given up": Check(
        "checkpoint/home/ask_recovery.py",
        "while left > MOST_GONE or size > MOST_GONE_BYTES:",
        "while False:",
        GREEDY,
        "never_take_them",
    ),
    "what was given up is not done again": Check(
        "cluster/lines/far_line.py",
        "if again and homes.far.has_forgotten(which):",
        "if False:",
        GREEDY,
        "never_take_them",
    ),
    "a program is taken from for so long at a time": Check(
        "cluster/lines/far_line.py",
        "if inflow.left > 0 and not inflow.held and not inflow.is_full:",
        "if not inflow.held and not inflow.is_full:",
        GREEDY,
        "so_long_at_a_time",
    ),
    "nobody takes over a connection by a greeting": Check(
        "cluster/lines/calls.py",
        "if far is not None and is_called and far.theirs != batch.boot:",
        "if False:",
        CONNECTIONS,
        "takes_over_a_connection",
    ),
    "a system that calls answers whoever calls it": Check(
        "cluster/lines/calls.py",
        'self._answer(batch, back, far.numbers[0], "")\n            return',
        "return",
        CONNECTIONS,
        "at_the_same_time",
    ),
    "a line that was begun anew is not taken for the one before it": Check(
        "cluster/lines/calls.py",
        "elif far.numbers[1] < batch.line:",
        "elif False:",
        CONNECTIONS,
        "begins_anew",
    ),
}

test_the_table_is_true, test_somebody_misses_it = as_tests(CHECKS)
