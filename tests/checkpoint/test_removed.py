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
        "                    self._mark.check(self.last, synced=self._fsync)\n",
        "",
        "tests/checkpoint/sqlite/test_damage.py",
        "test_a_wal_that_lost_acknowledged",
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
