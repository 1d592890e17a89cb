"""Each bound and each check of the last lines is there for a reason: take it out, and a test fails.

`HOLDFAST_REMOVED=1 python -m pytest tests/last_lines/test_removed_lines.py` does so, in a copy; otherwise it is only
looked whether the checks and the tests are where this table says.
"""

from __future__ import annotations

from tests.removing import Check, as_tests

MEMORY = "tests/last_lines/test_line_memory.py"
LOGS = "tests/last_lines/test_logs.py"

CHECKS = {
    "all lines together are bounded": Check(
        "system/last_lines/line_memory.py",
        "            self._make_room()\n",
        "            pass\n",
        MEMORY,
        "test_it_keeps_the_newest_within_its_bounds",
    ),
    "those with the most lines give way first": Check(
        "system/last_lines/line_memory.py",
        "            if before > share:\n",
        "            if False:\n",
        MEMORY,
        "test_who_prints_much_does_not_drive_out_who_prints_little",
    ),
    "a line is bounded": Check(
        "system/last_lines/line_memory.py",
        "        return shortened(text, self._limits.characters)\n",
        "        return text\n",
        MEMORY,
        "test_a_long_line_is_kept_with_its_beginning_and_its_end",
    ),
    "what gives way is counted": Check(
        "system/history/ring.py",
        "            self.gone.add(event.number)\n",
        "",
        MEMORY,
        "test_whoever_follows_gets_each_line_or_is_told_of_it",
    ),
    "what stands behind the page is not counted for it": Check(
        "system/last_lines/line_memory.py",
        "one.after(after) - one.after(until)",
        "one.after(after)",
        MEMORY,
        "test_whoever_follows_gets_each_line_or_is_told_of_it",
    ),
    "of older runs none is forgotten": Check(
        "system/history/ring.py",
        "            runs[:2] = [(min(one, other), max(to, until), many + more)]\n",
        "            del runs[0]\n",
        MEMORY,
        "test_older_runs_become_one_and_none_is_forgotten",
    ),
    "addresses that are forgotten leave a count": Check(
        "system/last_lines/line_memory.py",
        "        self._forgotten.add(ring.oldest, ring.newest, ring.gone.count + len(ring))\n",
        "",
        MEMORY,
        "test_of_addresses_that_are_forgotten_it_is_told_that_there_were_lines",
    ),
    "a line is that of the life that printed it": Check(
        "actors/process/worker_pool.py",
        "LogLine(path, stream, text, self.life)",
        "LogLine(path, stream, text, 0 if self.cell is None else self.cell.life)",
        LOGS,
        "test_lines_before_kill_9_are_there_with_the_life_that_printed_them",
    ),
    "a storm of events does not cost lines": Check(
        "actors/events.py",
        "        self.hears_lines = anybody or records\n",
        "        self.hears_lines = self.has_listeners\n",
        LOGS,
        "test_in_a_storm_of_events_lines_are_kept_all_the_same",
    ),
    "a terminal obeys no line": Check(
        "console/operate/told_lines.py",
        "line.text.translate(ESCAPED)",
        "line.text",
        LOGS,
        "test_the_command_shows_them_and_what_a_terminal_would_obey_as_text",
    ),
}

test_the_table_is_true, test_each_check_is_missed = as_tests(CHECKS)
