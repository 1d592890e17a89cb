"""Each safety check of erasing is there for a reason: take it out, and a test fails.

`HOLDFAST_REMOVED=1 python -m pytest tests/erasing/test_removed_checks.py` does so, in a copy; otherwise it is only
looked whether the checks and the tests are where this table says.
"""

from __future__ import annotations

from tests.removing import Check, as_tests

ERASING = "tests/erasing/test_erasing.py"
ERASURES = "checkpoint/home/disposal.py"

CHECKS = {
    "a start waits for what is being erased at its address": Check(
        "supervision/supervisor.py",
        "            await self._await_erased(row, one)\n",
        "",
        ERASING,
        "test_who_is_started_where_is_being_erased",
    ),
    "the store knows of each erasure before its first step": Check(
        ERASURES,
        '            self._homes.journal.note(f"{ERASING} {top}", EVERYTHING if everything else b"")\n',
        "",
        ERASING,
        "test_an_erasure_that_was_cut_off",
    ),
    "the store knows that the history goes, too": Check(
        ERASURES,
        "EVERYTHING if everything else b",
        "b",
        ERASING,
        "test_an_erasure_that_was_cut_off",
    ),
    "what the store has refused is tried again before anybody begins there": Check(
        ERASURES,
        "            self._refused[one.top] = one.everything\n",
        "",
        ERASING,
        "test_what_the_store_has_refused",
    ),
    "few addresses are erased in one step": Check(
        ERASURES,
        "AT_ONCE = 8\n",
        "AT_ONCE = 8_000\n",
        ERASING,
        "test_others_get_their_turns",
    ),
    "the records of who has moved away are not those of the address that was left": Check(
        "checkpoint/home/homes.py",
        "        if not self.addresses.is_lent(path):",
        "        if True:",
        ERASING,
        "test_who_has_moved_away",
    ),
    "nobody who lives is erased": Check(
        "system/recorded.py",
        "        await self._vacated(path)\n",
        "",
        ERASING,
        "test_who_lives_or_comes_back",
    ),
    "what was put aside before, and is not any more, leaves the store": Check(
        "checkpoint/home/quarantine.py",
        "                self._tidy(most=0)\n",
        "                pass\n",
        ERASING,
        "test_what_was_put_aside",
    ),
    "the history goes with the address": Check(
        ERASURES,
        "            events = self.history(top, False) if self.history is not None else 0\n",
        "",
        ERASING,
        "test_nothing_is_left and plain",
    ),
    "an address is erased without a look at all snapshots": Check(
        "checkpoint/sqlite/engine.py",
        "        files = self._delete_snapshots(db, chain.kept)\n",
        '        owned = db.execute("SELECT id FROM snapshots WHERE address = ?", (chain.id,)).fetchall()\n'
        "        files = self._delete_snapshots(db, [number for (number,) in owned])\n",
        ERASING,
        "test_each_address_costs",
    ),
}

test_the_table_is_true, test_each_check_is_missed = as_tests(CHECKS)
