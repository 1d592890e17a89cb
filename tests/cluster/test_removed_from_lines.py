"""Each safety check of lines between systems is there for a reason: take it out, and a test fails.

`HOLDFAST_REMOVED=1 python -m pytest tests/cluster/test_removed_from_lines.py` does so, in a copy; otherwise it is only
looked whether the checks and the tests are where this table says.
"""

from __future__ import annotations

from tests.removing import Check, as_tests

LINES = "tests/cluster/test_lines.py"
CONNECTIONS = "tests/cluster/test_connections.py"

CHECKS = {
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
        "cluster/lines/lines.py",
        "elif batch.to != lines.boot or far is None or far.theirs != batch.boot:",
        "elif far is None or far.theirs != batch.boot:",
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
    "no other system ends an actor": Check(
        "cluster/lines/far_line.py",
        "case verb if verb in COMMANDS:",
        "case verb if verb:",
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
        'batch.add(FAR, ("answered", *msgspec.structs.astuple(one)), self._positions)',
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
        "if quiet > FORGET_SECONDS and any(gate.has(far) for gate in self._gates):",
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
        "cluster/lines/lines.py",
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
}

test_the_table_is_true, test_somebody_misses_it = as_tests(CHECKS)
