"""Each safety check of recovery is there for a reason: take it out, and a test fails.

`HOLDFAST_REMOVED=1 python -m pytest tests/checkpoint/test_removed.py` does so, in a copy; otherwise it is only looked
whether the checks and the tests are where this table says.
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.removing import Check, copied, is_true, missed, without

CHECKS = {
    "T13: after a failed sync nothing takes effect": Check(
        "checkpoint/commits.py",
        "        if error is not None:\n            failure =",
        "        if False:\n            failure =",
        "tests/checkpoint/test_commits.py",
        "test_a_failed_sync_stops_it_for_good",
    ),
    "T13: a store whose sync failed refuses": Check(
        "checkpoint/sqlite/store.py",
        "        self.failure = self.failure or translated\n",
        "",
        "tests/checkpoint/sqlite/test_cuts.py",
        "test_a_failed_sync_of_the_rows",
    ),
    "fsync: what is not synced does not count": Check(
        "checkpoint/commits.py",
        "            if number:\n                self._written",
        "            if False:\n                self._written",
        "tests/checkpoint/test_commits.py",
        "test_nothing_counts_before_the_sync and task",
    ),
    "a lane is not left while something waits in it": Check(
        "checkpoint/commits.py",
        " or self._slow.get(path, 0) > self._synced",
        "",
        "tests/checkpoint/test_commits.py",
        "test_each_has_its_own_lane",
    ),
    "fsync: the journal is on the disk": Check(
        "checkpoint/sqlite/store.py",
        "            os.fdatasync(self._wal)\n",
        "            pass\n",
        "tests/checkpoint/sqlite/test_power.py",
        "test_a_power_loss and fsync",
    ),
    "T10: a snapshot file is on the disk before its row": Check(
        "checkpoint/sqlite/files.py",
        "            os.fsync(file.fileno())\n",
        "",
        "tests/checkpoint/sqlite/test_power.py",
        "test_a_power_loss",
    ),
    "a row is gone for good before its file is": Check(
        "checkpoint/sqlite/engine.py",
        "        if self._packs.names(address):\n            self._store.sync_rows()\n",
        "",
        "tests/checkpoint/sqlite/test_cuts.py",
        "test_what_was_erased_is_on_the_disk",
    ),
    "only the owner writes": Check(
        "checkpoint/sqlite/store.py",
        "                if current != self.claim.epoch:\n                    raise",
        "                if False:\n                    raise",
        "tests/checkpoint/sqlite/test_owners.py",
        "test_an_owner_whose_epoch_is_stale",
    ),
    "a damaged entry is not read": Check(
        "checkpoint/sqlite/reading.py",
        " and crc == row_crc(position, address, number, data)",
        "",
        "tests/checkpoint/sqlite/test_damage.py",
        "test_each_bit_of_an_entry_counts",
    ),
    "what was acknowledged is missed": Check(
        "checkpoint/sqlite/store.py",
        "        self._mark.check(self.last, synced=self._fsync)\n",
        "",
        "tests/checkpoint/sqlite/test_damage.py",
        "test_a_wal_that_lost_acknowledged",
    ),
    "log: a new owner seals it": Check(
        "checkpoint/sqlite/log.py",
        "os.pwrite(fd, _SEAL.pack(1), 0)",
        "pass",
        "tests/checkpoint/sqlite/test_log.py",
        "test_what_a_stale_owner_writes",
    ),
    "log: who writes looks at the seal": Check(
        "checkpoint/sqlite/log.py",
        "        if file.seal.at[0]:",
        "        if False:",
        "tests/checkpoint/sqlite/test_log.py",
        "test_what_is_written_before_the_new_owner",
    ),
    "log: what is behind the seal is not read": Check(
        "checkpoint/sqlite/log.py",
        "            os.pwrite(file.fd, bytes(len(self._head) + _RECORD.size), at)\n",
        "",
        "tests/checkpoint/sqlite/test_log.py",
        "test_what_a_stale_owner_writes",
    ),
    "log: what is behind a gap is cut": Check(
        "checkpoint/sqlite/store.py",
        "            if batch[0][0] == self.last + 1:\n",
        "            if True:\n",
        "tests/checkpoint/sqlite/test_log.py",
        "test_after_a_power_loss",
    ),
    "log: a file stays for what was promised of it": Check(
        "checkpoint/sqlite/log.py",
        "        self._file.is_promised = True\n",
        "",
        "tests/checkpoint/sqlite/test_log.py",
        "test_what_was_promised",
    ),
    "log: it is on the disk": Check(
        "checkpoint/sqlite/log.py",
        "            os.fdatasync(file.fd)\n",
        "",
        "tests/checkpoint/sqlite/test_power.py",
        "test_a_power_loss and fsync",
    ),
    "log: half a record does not count": Check(
        "checkpoint/sqlite/log.py",
        "        if crc != expected or not length or len(body) != length:\n            return\n",
        "",
        "tests/checkpoint/sqlite/test_log.py",
        "test_each_byte",
    ),
    "log: who knows of none is kept out": Check(
        "checkpoint/sqlite/store.py",
        '            db.execute(f"PRAGMA user_version = {VERSION_WITH_LOG}")\n',
        "            pass\n",
        "tests/checkpoint/sqlite/test_log.py",
        "test_a_store_that_may_have_a_log",
    ),
    "log: it is missed": Check(
        "checkpoint/sqlite/store.py",
        "            if version == VERSION_WITH_LOG:\n",
        "            if False:\n",
        "tests/checkpoint/sqlite/test_log.py",
        "test_a_log_that_is_gone",
    ),
    "log: it does not count when the store was closed": Check(
        "checkpoint/sqlite/store.py",
        "        if left and version == VERSION:",
        "        if False:",
        "tests/checkpoint/sqlite/test_log.py",
        "test_a_log_of_a_closed_store",
    ),
    "log: nothing moves twice": Check(
        "checkpoint/sqlite/store.py",
        "        if rows and rows[0][0] <= self.last:",
        "        if False:",
        "tests/checkpoint/sqlite/test_log.py",
        "test_a_transaction_that_is_broken_off",
    ),
    "T19: what has left does not leave again": Check(
        "checkpoint/switch.py",
        "            if out.k <= len(known):\n",
        "            if False:\n",
        "tests/checkpoint/test_recovery.py",
        "test_what_left_before_the_kill",
    ),
    "T21: a replay that sends something else is stopped": Check(
        "checkpoint/switch.py",
        "        if end.state != past.state and end.state and past.state:\n",
        "        if False:\n",
        "tests/checkpoint/test_strict.py",
        "test_the_first_turn_that_a_replay and task",
    ),
    "T16: attempts are counted": Check(
        "checkpoint/switch.py",
        "        source.deliveries += 1\n",
        "",
        "tests/checkpoint/test_quarantine.py",
        "test_what_kills_again and process and memory",
    ),
    "T16: what is put aside outlives the root": Check(
        "checkpoint/quarantine.py",
        '            batch.add(PLACE, ("held", *msgspec.structs.astuple(one)), self._positions)\n',
        "",
        "tests/checkpoint/test_quarantine.py",
        "test_it_survives_restarts_of_the_root and process",
    ),
    "R78: a way back that was begun is finished": Check(
        "checkpoint/groups.py",
        "        journal.note(RESTORING, name.encode())\n",
        "",
        "tests/checkpoint/test_groups.py",
        "test_a_root_that_dies_on_the_way_back",
    ),
    "R78: nobody of a group begins before all are there": Check(
        "checkpoint/groups.py",
        "        self._waiting.update(paths)\n",
        "",
        "tests/checkpoint/test_groups.py",
        "test_no_sum_is_lost and task",
    ),
    "R78: messages under way belong to the cut": Check(
        "checkpoint/groups.py",
        " | home.open\n",
        "\n",
        "tests/checkpoint/test_groups.py",
        "test_no_sum_is_lost and task",
    ),
    "R77: what somebody may have read is not left out": Check(
        "checkpoint/skipping.py",
        "turn.digests:\n                later.clear()\n",
        "turn.digests:\n",
        "tests/checkpoint/test_skipping.py",
        "test_superseded_turns or come_to_the_same",
    ),
    "S1: a crash makes the receivers safe before the restart": Check(
        "checkpoint/recovery/register.py",
        '        if stage == "restart" and recovery.has_crashed and recovery.method.safe_state is not None:\n'
        "            return True\n",
        "",
        "tests/checkpoint/test_controller_safe_state.py",
        "test_named_addresses_are_told and task",
    ),
    "S1: an orderly restart makes nobody safe": Check(
        "checkpoint/recovery/register.py",
        "state is not None and recovery.has_crashed and not",
        "state is not None and not",
        "tests/checkpoint/test_controller_safe_state.py",
        "test_what_is_restarted_in_good_order and task",
    ),
    "T27: safe state is entered by the first of several recoveries": Check(
        "checkpoint/recovery/safety.py",
        "            if not receiver.is_told:\n",
        "            if True:\n",
        "tests/checkpoint/test_controller_safe_state.py",
        "test_of_two_recoveries_at_a_time and task",
    ),
    "T27: safe state is left by the last of several recoveries": Check(
        "checkpoint/recovery/safety.py",
        " and not receiver.holders:",
        ":",
        "tests/checkpoint/test_controller_safe_state.py",
        "test_of_two_recoveries_at_a_time and task",
    ),
    "T17: safe state stays when the recovery is given up": Check(
        "checkpoint/recovery/register.py",
        "        if not receivers:\n            del",
        "        if True:\n            del",
        "tests/checkpoint/test_controller_safe_state.py",
        "test_it_stays_when_the_recovery_fails and task",
    ),
    "T26: a receiver that begins anew is told again": Check(
        "checkpoint/recovery/safety.py",
        "        if ended and switch_of(cell) is None:\n",
        "        if False:\n",
        "tests/checkpoint/test_controller_safe_state.py",
        "test_a_receiver_that_is_restarted_meanwhile",
    ),
    "T18: the receiver has a watchdog of its own": Check(
        "actors/safe.py",
        "        safe[path] = cell.node.loop.call_later(change.timeout, _overdue, cell, change)\n",
        "        pass\n",
        "tests/checkpoint/test_controller_safe_state.py",
        "test_a_receiver_that_hears_of_no_end and process",
    ),
    "T18: the watchdog is quiet once the end is told": Check(
        "actors/safe.py",
        "    if timer is not None:\n        timer.cancel()\n",
        "",
        "tests/checkpoint/test_controller_safe_state.py",
        "test_the_alarm_is_raised_once",
    ),
    "S2: nothing new reaches an actor that is recovered": Check(
        "checkpoint/switch.py",
        "        if self.is_released and self.port is not None and",
        "        if self.port is not None and",
        "tests/checkpoint/test_controller_held.py",
        "test_tells_beyond_the_capacity and task",
    ),
    "S2: nothing of a life that was killed gets out": Check(
        "checkpoint/life.py",
        "        if more is not None and more.turn is not None and more.turn.killed:\n",
        "        if False:\n",
        "tests/checkpoint/test_outward.py",
        "test_what_a_killed_life_says and memory",
    ),
    "S2: no more is held than the policy says": Check(
        "checkpoint/recovery/held.py",
        "self._count(topic) >= rule.capacity:\n            match",
        "False:\n            match",
        "tests/checkpoint/test_controller_held.py",
        "test_tells_beyond_the_capacity and task",
    ),
    "S3: the life begins when the hooks before it are done": Check(
        "checkpoint/homes.py",
        "                await asyncio.shield(wait)",
        "                pass",
        "tests/checkpoint/test_controller_phases.py",
        "test_hooks_are_called_in_order and task",
    ),
    "S3: a recovery goes on without its controller": Check(
        "checkpoint/recovery/register.py",
        "                if not is_passed:\n                    self._alone",
        "                if False:\n                    self._alone",
        "tests/checkpoint/test_controller_phases.py",
        "test_a_controller_that_ends_for_good and task",
    ),
    "S3: a recovery does not wait for a controller that does nothing": Check(
        "checkpoint/recovery/register.py",
        "            self._later(longest, lambda: self._too_late(recovery, attempt, stage))\n",
        "",
        "tests/checkpoint/test_controller_phases.py",
        "test_a_controller_that_does_not_come and task",
    ),
    "S4: the release waits for the hooks before it": Check(
        "checkpoint/homes.py",
        '            switch.waits_for_release = recoveries.needs(self.recovery, "release")',
        "            switch.waits_for_release = False",
        "tests/checkpoint/test_controller_phases.py",
        "test_hooks_are_called_in_order and task",
    ),
    "S4: who waits for room is let in behind what was held": Check(
        "checkpoint/recovery/held.py",
        "        while self._waiting:\n            ask",
        "        while False:\n            ask",
        "tests/checkpoint/test_controller_held.py",
        "test_sends_and_asks_wait_at_block and task",
    ),
}


@pytest.mark.parametrize("name", CHECKS)
def test_the_table_is_true(name: str) -> None:
    assert is_true(CHECKS[name])


@pytest.fixture(scope="module")
def copy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The package and its tests, to be broken."""
    return copied(tmp_path_factory.mktemp("removed"))


@pytest.mark.skipif("HOLDFAST_REMOVED" not in os.environ, reason="HOLDFAST_REMOVED=1 has the checks removed")
@pytest.mark.parametrize("name", CHECKS)
def test_without_the_check_a_test_fails(copy: Path, name: str) -> None:
    with without(copy, CHECKS[name]):
        assert missed(copy, CHECKS[name]), f"{CHECKS[name].test} does not miss it"
