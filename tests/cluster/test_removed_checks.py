"""Each safety check of the log of a fleet is there for a reason: take it out, and a test fails.

`HOLDFAST_REMOVED=1 python -m pytest tests/cluster/test_removed_checks.py` does so, in a copy; otherwise it is only
looked whether the checks and the tests are where this table says.
"""

from __future__ import annotations

from tests.removing import Check, as_tests

RECORDS = "tests/cluster/test_log_records.py"
LEADERSHIP = "tests/cluster/test_leadership.py"
FLEETS = "tests/cluster/test_takeover.py"

CHECKS = {
    "a silent connection is not closed in good order": Check(
        "cluster/nats/connecting.py",
        "            transport._io_writer.transport.abort()\n",
        "            pass\n",
        "tests/cluster/test_engine_on_nats.py",
        "silent_is_let_go_of_at_once",
    ),
    "a large snapshot is asked for again while servers do not answer": Check(
        "cluster/replicated_journal.py",
        "self._loop.wait(insist(lambda: self._engine.blobs.get(name)), READ_SECONDS)",
        "self._loop.wait(self._engine.blobs.get(name), READ_SECONDS)",
        LEADERSHIP,
        "asked_for_again_until_it_comes",
    ),
    "a blob whose parts are late is not taken for one that is not there": Check(
        "cluster/nats/nats_engine.py",
        'raise Unanswered(self._name, f"{wanted - len(parts)} parts of {name} do not come") from error',
        "return None",
        "tests/cluster/test_engine_on_nats.py",
        "whose_parts_do_not_come",
    ),
    "a reader sees that a record is missing": Check(
        "cluster/log_records.py",
        "if part.previous != self.at and not begins:",
        "if False:",
        RECORDS,
        "a_missing_record_is_seen",
    ),
    "epochs rise, and nobody writes in another's": Check(
        "cluster/log_records.py",
        "if not (begins or (part.epoch > self.epoch if part.kind == EPOCH else part.epoch == self.epoch)):",
        "if False:",
        RECORDS,
        "epochs_rise",
    ),
    "an epoch begins once": Check(
        "cluster/log_records.py",
        "part.epoch > self.epoch if part.kind == EPOCH",
        "part.epoch >= self.epoch if part.kind == EPOCH",
        RECORDS,
        "an_epoch_begins_once",
    ),
    "the checksum of a record is compared": Check(
        "cluster/log_records.py",
        "if zlib.crc32(part.data) != part.crc:",
        "if False:",
        RECORDS,
        "a_damaged_record_is_refused",
    ),
    "parts come in order": Check(
        "cluster/log_records.py",
        "if part.part != len(parts):",
        "if False:",
        RECORDS,
        "parts_come_in_order",
    ),
    "what a leader did not finish never was": Check(
        "cluster/log_records.py",
        "            self._parts.clear()  # What was not finished never was.\n",
        "",
        RECORDS,
        "what_a_leader_did_not_finish",
    ),
    "a newer format is not read": Check(
        "cluster/log_records.py",
        "if part.kind == EPOCH and decode_epoch(part.data).format > FORMAT:",
        "if False:",
        RECORDS,
        "a_newer_format",
    ),
    "a base that was never finished is no beginning": Check(
        "cluster/log_records.py",
        "            self.check_whole()\n",
        "",
        RECORDS,
        "a_base_that_the_log_begins_with",
    ),
    "what comes behind the first part of a base waits for its last one": Check(
        "cluster/log_records.py",
        "            self._held.append(said)\n            return []\n",
        "            return [said]\n",
        RECORDS,
        "changes_between_the_parts",
    ),
    "an unfinished base hides no growth": Check(
        "cluster/log_records.py",
        "self.grown += self._grown_before + ",
        "self.grown += 0 * self._grown_before + ",
        RECORDS,
        "hides_no_growth",
    ),
    "a candidate reads all before it begins": Check(
        "cluster/leadership.py",
        "        await follower.catch_up()\n        reader = follower.reader\n",
        "        reader = follower.reader\n        await asyncio.sleep(0.1)\n",
        LEADERSHIP,
        "nobody_leads_before",
    ),
    "an epoch names the last record that was read": Check(
        "cluster/leadership.py",
        "append_behind(engine, record, reader.at)",
        'append_behind(engine, record, (await engine.log.last() or LogRecord(0, b"")).sequence)',
        FLEETS,
        "was_safe_is_there",
    ),
    "whoever missed records that are gone begins again": Check(
        "cluster/leadership.py",
        "                    self._begin_again(record)\n",
        "                    pass\n",
        LEADERSHIP,
        "away_begins_again",
    ),
    "a log that has lost its beginning is damaged": Check(
        "cluster/leadership.py",
        "if self._wrong_beginnings == MOST_READERS:",
        "if False:",
        LEADERSHIP,
        "has_lost_its_beginning",
    ),
    "a reader that shows nothing is replaced": Check(
        "cluster/leadership.py",
        "await self.begin_anew()  # What the engine keeps",
        "pass  # What the engine keeps",
        LEADERSHIP,
        "nobody_leads_before",
    ),
    "whoever reads a long log renews its lease": Check(
        "cluster/leadership.py",
        "            if follower.reader.at == at:\n",
        "            if True:\n",
        LEADERSHIP,
        "whoever_reads_long",
    ),
    "whoever led goes first after an outage": Check(
        "cluster/leadership.py",
        "                if not has_failed:\n",
        "                if True:\n",
        LEADERSHIP,
        "goes_on_over_an_outage",
    ),
    "whoever holds the lease again looks, and writes": Check(
        "cluster/leadership.py",
        "                    go_on()\n",
        "                    pass\n",
        LEADERSHIP,
        "the_other_never_leads",
    ),
    "nothing is written while another has the lease": Check(
        "cluster/log_writer.py",
        "if not self._may_write.is_set():",
        "if False:",
        LEADERSHIP,
        "held_back_learns",
    ),
    "whoever is held back looks for another's epoch": Check(
        "cluster/log_writer.py",
        "                await self._look()\n",
        "                await self._may_write.wait()\n",
        LEADERSHIP,
        "held_back_learns",
    ),
    "a refused append that stands there is one's own": Check(
        "cluster/log_writer.py",
        "return found.sequence if found.data == record else found",
        "return found",
        LEADERSHIP,
        "is_ones_own",
    ),
    "a refused append behind which another stands is not": Check(
        "cluster/log_writer.py",
        "return found.sequence if found.data == record else found",
        "return found.sequence",
        LEADERSHIP,
        "deposed_refuses",
    ),
    "an append that was refused is sent again while nothing stands there": Check(
        "cluster/log_writer.py",
        "            if found is not None:\n                return",
        "            if True:\n                assert found is not None\n                return",
        LEADERSHIP,
        "is_ones_own",
    ),
    "what a record refers to is kept before it": Check(
        "cluster/log_writer.py",
        "for name, data in write.puts:",
        "for name, data in write.puts[:0]:",
        LEADERSHIP,
        "kept_since_is_no_orphan",
    ),
    "what a record frees is dropped behind it": Check(
        "cluster/log_writer.py",
        "            for name, data in write.puts:\n",
        "            self._freed.extend(write.drops)\n            self._has_freed.set()\n"
        "            await asyncio.sleep(0.01)\n            for name, data in write.puts:\n",
        FLEETS,
        "was_safe_is_there",
    ),
    "only what is older than a base is forgotten": Check(
        "cluster/log_writer.py",
        "self._engine.log.forget(self._base_begins)",
        "self._engine.log.forget(self._maker.after)",
        LEADERSHIP,
        "away_begins_again",
    ),
    "a base is what there was at one time": Check(
        "cluster/replicated_journal.py",
        "self._queue(LogWrite(base=self._contents.copy()))",
        "self._queue(LogWrite(base=self._contents))",
        FLEETS,
        "was_safe_is_there",
    ),
    "a look is written before orphans are dropped": Check(
        "cluster/replicated_journal.py",
        "            self._queue(LogWrite(drops=sorted(orphans)))\n",
        "            await asyncio.gather(*(self._engine.blobs.drop(name) for name in orphans))\n",
        LEADERSHIP,
        "orphans_stay",
    ),
    "what was kept since is no orphan": Check(
        "cluster/write_progress.py",
        "            self._known.add(name)\n",
        "            pass\n",
        LEADERSHIP,
        "kept_since_is_no_orphan",
    ),
    "orphans are dropped": Check(
        "cluster/replicated_journal.py",
        "        if orphans:  #",
        "        if False:  #",
        LEADERSHIP,
        "kept_since_is_no_orphan",
    ),
    "a sync waits for the log": Check(
        "cluster/replicated_journal.py",
        "            if self._progress.wait(tell):\n",
        "            if False:\n",
        FLEETS,
        "was_safe_is_there",
    ),
    "whoever is deposed leaves the lease": Check(
        "cluster/replicated_journal.py",
        "        await self._keeper.release()  # Whoever leads next need not wait for its end.\n",
        "",
        LEADERSHIP,
        "deposed_leaves_the_lease",
    ),
    "what an engine was not to raise is told": Check(
        "cluster/replicated_journal.py",
        "        if causes:\n",
        "        if [one for one in causes if isinstance(one, HoldfastError)]:\n",
        LEADERSHIP,
        "was_not_to_raise",
    ),
    "the end tells whoever waits": Check(
        "cluster/replicated_journal.py",
        "            self._fail(StoreFailed(self.path, problem))\n",
        "",
        LEADERSHIP,
        "the_end_tells",
    ),
    "the engine's loop does not wait for who writes": Check(
        "cluster/replicated_journal.py",
        "        with self._count_lock:\n            ready =",
        "        with self._lock:\n            ready =",
        LEADERSHIP,
        "a_transaction_keeps_nobody",
    ),
}

test_the_table_is_true, test_somebody_misses_it = as_tests(CHECKS)
