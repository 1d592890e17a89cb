"""Each safety check of the mechanisms is there for a reason: take it out, and a test fails.

`HOLDFAST_REMOVED=1 python -m pytest tests/ftm/test_removed_checks.py` does so, in a copy; otherwise it is only looked
whether the checks and the tests are where this table says.
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.removing import Check, copied, is_true, missed, without

JOINING = "tests/ftm/test_pbr_joining.py"
PBR, LFR, SEC = "tests/ftm/test_pbr.py", "tests/ftm/test_lfr.py", "tests/ftm/test_sec.py"
FAILOVER, CHECKS_ALONE = "tests/ftm/test_failover.py", "tests/ftm/test_checks.py"
CHECKS = {
    "T36: a batch of an earlier epoch is refused": Check(
        "ftm/protocol.py",
        "        if work.epoch != standing.epoch or work.config",
        "        if work.config",
        PBR,
        "test_lower_epochs",
    ),
    "T36: orders and states of an earlier epoch are refused": Check(
        "ftm/standing.py",
        "        if epoch < self.epoch:\n",
        "        if False:\n",
        PBR,
        "test_lower_epochs",
    ),
    "another stack of mechanisms is refused": Check(
        "ftm/standing.py",
        "        if config is not None and config != self.config:\n",
        "        if False:\n",
        PBR,
        "test_lower_epochs",
    ),
    "T1: who was replaced says nothing more": Check(
        "ftm/standing.py",
        "        self.is_fenced = True\n        self.set_peer",
        "        self.set_peer",
        PBR,
        "test_an_old_primary_that_wakes_up",
    ),
    "who was not told that it follows takes nothing": Check(
        "ftm/letters.py",
        "            if not (follows and self.follows_at_once):\n",
        "            if False:\n",
        CHECKS_ALONE,
        "test_who_was_not_told",
    ),
    "at home, outcomes of an earlier epoch count for nothing": Check(
        "ftm/group.py",
        "        if epoch == self.epoch and not self.is_over and",
        "        if not self.is_over and",
        CHECKS_ALONE,
        "test_what_an_earlier_epoch_says",
    ),
    "at home, each outcome counts once": Check(
        "ftm/group.py",
        "        if self.is_live and (end.turn <= switch.turn or end.id not in switch.open):\n",
        "        if False:\n",
        CHECKS_ALONE,
        "test_what_an_earlier_epoch_says",
    ),
    "T4: PBR: a reply leaves when the backup has its state": Check(
        "ftm/mechanisms/pbr.py",
        "        elif self.mechanism.acknowledge:\n            await self._hand_over(checkpoint, said, state)\n",
        "        elif self.mechanism.acknowledge:\n            self._send(checkpoint, said, state)\n",
        PBR,
        "test_a_reply_leaves_only_when",
    ),
    "LFR: a reply leaves when the follower has the request": Check(
        "ftm/mechanisms/lfr.py",
        '        if standing.peer_state == "live":\n            for task',
        "        if False:\n            for task",
        LFR,
        "test_a_reply_leaves_only_when",
    ),
    "T38: the old primary is dead before the next one leads": Check(
        "ftm/failover.py",
        "            await bury(group, name, life)\n            group.condemned",
        "            group.condemned",
        CHECKS_ALONE,
        "test_who_led_before_is_dead",
    ),
    "who alone has the state is not killed on suspicion": Check(
        "ftm/group.py",
        "        return is_alive and not self.backups() and waited",
        "        return False and waited",
        FAILOVER,
        "test_a_silent_primary_that_nobody",
    ),
    "T5: duplicates are answered from the reply log": Check(
        "ftm/protocol.py",
        "            end = log.find(number)\n",
        "            end = None\n",
        PBR,
        "test_a_duplicate_is_answered",
    ),
    "T6: what was evicted from the log is not run again": Check(
        "ftm/protocol.py",
        "            elif request.feed.turn < 0 and log.was_evicted(number):\n",
        "            elif False:\n",
        CHECKS_ALONE,
        "test_a_request_whose_outcome_was_evicted",
    ),
    "the reply log is part of what the backup has": Check(
        "ftm/mechanisms/pbr.py",
        "        if turn != MISFIT:\n            standing.log.add(message.log)\n",
        "",
        PBR,
        "test_what_was_acknowledged_but_not_heard",
    ),
    "T8b: differences that do not fit leave no outcomes": Check(
        "ftm/mechanisms/pbr.py",
        "        if turn != MISFIT:\n            standing.log",
        "        if True:\n            standing.log",
        CHECKS_ALONE,
        "test_outcomes_without_their_state",
    ),
    "an outcome is said until the backup has it": Check(
        "ftm/mechanisms/pbr.py",
        "Checkpoint(captured.change or state, list(self._unheard))",
        "Checkpoint(captured.change or state, standing.entries(done.ends))",
        JOINING,
        "test_an_outcome_whose_checkpoint_is_overtaken",
    ),
    "a state that was overtaken is not taken": Check(
        "ftm/mechanisms/pbr.py",
        "        if message.state.turn < standing.server.turn:\n",
        "        if False:\n",
        CHECKS_ALONE,
        "test_a_state_that_was_overtaken",
    ),
    "a delta is put upon the state that it belongs to": Check(
        "ftm/points.py",
        "        if point is None or point.turn != state.base:\n",
        "        if point is None:\n",
        CHECKS_ALONE,
        "test_what_has_changed_since",
    ),
    "T8c: who joins counts when it has all that has left": Check(
        "ftm/transfer.py",
        "            await self._drain_bricks()  # What left while",
        "            pass  # What left while",
        JOINING,
        "test_a_backup_counts_only_when",
    ),
    "a life at an address that is known is brought to the state": Check(
        "ftm/transfer.py",
        "        if standing.peer == path:  # It follows anew",
        "        if standing.peer == path:\n            return server.turn\n        if False:  # It follows anew",
        JOINING,
        "test_a_backup_that_lives_anew or test_a_backup_that_follows_anew",
    ),
    "a batch is computed once, however often it comes": Check(
        "ftm/bricks.py",
        "        if self._refuses() or self._knows(work):\n",
        "        if self._refuses():\n",
        CHECKS_ALONE,
        "test_a_batch_that_comes_to_proceed_twice",
    ),
    "what cannot be undone leaves at the front only": Check(
        "ftm/server.py",
        "        return self.standing.leads and not self.ends and self.confirmed >= self.handed\n",
        "        return self.standing.leads\n",
        PBR,
        "test_a_turn_that_asks_is_undone",
    ),
    "what a follower hears does not stand in the way of its state": Check(
        "ftm/mechanisms/lfr.py",
        "    answers_later = True  # What has to wait for the leader's state must not hold up the order",
        "    answers_later = False  # What has to wait for the leader's state must not hold up the order",
        CHECKS_ALONE,
        "test_what_a_follower_hears",
    ),
    "T8: outcomes of leader and follower are compared": Check(
        "ftm/mechanisms/lfr.py",
        "                if ours[:3] != theirs:\n",
        "                if False:\n",
        LFR,
        "test_hidden_nondeterminism",
    ),
    "TR: two runs are compared": Check(
        "ftm/mechanisms/tr.py",
        "        if outcome(first) == outcome(second):\n",
        "        if True:\n",
        "tests/ftm/test_tr.py",
        "test_one_fault_is_masked",
    ),
    "TR: without a majority nothing leaves": Check(
        "ftm/mechanisms/tr.py",
        "        best = next((one for one in (first, second) if outcome(one) == outcome(third)), None)\n",
        "        best = third\n",
        "tests/ftm/test_tr.py",
        "test_without_a_majority",
    ),
    "AD: an objection is heard": Check(
        "ftm/mechanisms/ad.py",
        "        if not own.objections:\n",
        "        if True:\n",
        "tests/ftm/test_ad.py",
        "test_value_faults_of_the_one_that_leads",
    ),
    "AD: what the other replica has come to is checked too": Check(
        "ftm/mechanisms/ad.py",
        "        if isinstance(other, Run) and (not other.objections or (alike and is_crash(own))):\n",
        "        if isinstance(other, Run):\n",
        "tests/ftm/test_ad.py",
        "test_what_is_wrong_on_both",
    ),
    "RB: alternates are tested too": Check(
        "ftm/mechanisms/rb.py",
        "            if isinstance(run, Run) and not run.objections:\n",
        "            if isinstance(run, Run):\n",
        "tests/ftm/test_rb.py",
        "test_alternates_are_tried or test_if_none_is_accepted",
    ),
    "NVP: without a majority nothing leaves": Check(
        "ftm/mechanisms/nvp.py",
        "            return NoMajority(standing.address, decided.why)\n",
        "            return own\n",
        "tests/ftm/test_nvp.py",
        "test_a_strict_voter",
    ),
    "TMR: a leader that was outvoted gives way": Check(
        "ftm/mechanisms/tmr.py",
        "        if 0 in wrong:  #",
        "        if False:  #",
        "tests/ftm/test_tmr.py",
        "test_a_leader_that_is_wrong",
    ),
    "TMR: a follower that was outvoted begins again": Check(
        "ftm/mechanisms/tmr.py",
        "        if not message.right and not self.leads:\n",
        "        if False:\n",
        "tests/ftm/test_tmr.py",
        "test_a_follower_that_is_wrong",
    ),
    "TMR: what is stopped in the middle has no vote": Check(
        "ftm/runs.py",
        "        if self._is_stopping:  # Stopped",
        "        if False:  # Stopped",
        "tests/ftm/test_tmr.py",
        "test_a_replica_that_is_stopped_while",
    ),
    "T47: a frame counts once": Check(
        "ftm/sec/session.py",
        "        refusal = TOO_OLD if sequence >= MOST_FRAMES else self._window.refusal(sequence)\n",
        '        refusal = ""\n',
        "tests/ftm/sec/test_session.py",
        "test_a_frame_is_accepted_once",
    ),
    "T47: what is said again is done once": Check(
        "ftm/sec/link.py",
        "        if known is not None:\n            return",
        "        if False:\n            return",
        SEC,
        "test_what_comes_twice",
    ),
    "T47: what comes before its time waits": Check(
        "ftm/sec/link.py",
        "        if call.stream != ORDERS and call.number > stream.next:\n",
        "        if False:\n",
        SEC,
        "test_what_comes_twice",
    ),
    "plain words are not admitted over a secured link": Check(
        "ftm/gate.py",
        "        link.plain()\n        return False\n",
        "        link.plain()\n        return True\n",
        SEC,
        "test_what_is_forged",
    ),
    "plain words are not admitted at the proxy": Check(
        "ftm/securing.py",
        "        return self.link is None\n",
        "        return True\n",
        SEC,
        "test_what_is_forged",
    ),
    "a certificate alone does not open a door": Check(
        "ftm/sec/link.py",
        "        if name not in self._replicas and (self._enrols is not None or name != self._proxy):\n",
        "        if False:\n",
        SEC,
        "test_what_is_forged",
    ),
    "a session ends with its epoch": Check(
        "ftm/sec/handshake.py",
        "            self._close(STALE_EPOCH, lambda session: session.epoch < epoch)\n",
        "",
        "tests/ftm/sec/test_handshake.py",
        "test_a_higher_epoch_ends",
    ),
    "the observer's own lag is nobody's silence": Check(
        "ftm/detector.py",
        "        late = max(0.0, now - self._real - self._period)\n",
        "        late = 0.0\n",
        "tests/ftm/test_detector.py",
        "test_an_observer_that_was_held_up",
    ),
    "a message that kills is found out": Check(
        "ftm/group.py",
        "        return out.requests[0].feed.id\n",
        "        return -1\n",
        FAILOVER,
        "test_a_message_that_kills",
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
