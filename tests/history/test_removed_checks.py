"""Each bound and each check of the history is there for a reason: take it out, and a test fails.

`HOLDFAST_REMOVED=1 python -m pytest tests/history/test_removed_checks.py` does so, in a copy; otherwise it is only
looked whether the checks and the tests are where this table says.
"""

from __future__ import annotations

from tests.removing import Check, as_tests

BOUNDS = "tests/history/test_bounds.py"
LIVES = "tests/history/test_lives.py"
KILLED = "tests/history/test_root_killed.py"
LIVE = "tests/history/test_why_live.py"
WHY = "tests/history/test_why.py"
OUTSIDE = "tests/history/test_from_outside.py"

CHECKS = {
    "a supervisor tells of the restarts that are not its own children's": Check(
        "system/history/evidence.py",
        'question(f"{literal(address)}/*/*/**", kinds=DEEPER_KINDS',
        'question(f"{literal(address)}/*", kinds=DEEPER_KINDS',
        LIVE,
        "trouble_at_any_depth and task",
    ),
    "a process that does not answer is told": Check(
        "system/history/calls.py",
        "            return Told(silence=self._silence(cell.ref, timeout))\n",
        "            return Told()\n",
        LIVE,
        "test_a_process_that_stands_still and unrecorded",
    ),
    "a supervisor tells of few who are in trouble further below": Check(
        "system/history/why_children.py",
        "for path, (_, words) in worst[:MOST_NAMED]]",
        "for path, (_, words) in worst]",
        WHY,
        "test_the_worst_trouble",
    ),
    "in a storm a part is recorded": Check(
        "system/history/tracks.py",
        "        return self._quota.take(now, least=max(1.0, leaving * self._burst))\n",
        "        return True\n",
        BOUNDS,
        "test_a_storm_is_recorded_in_part_and_no_more_events_are_made",
    ),
    "what a mailbox drops by its policy is counted": Check(
        "system/history/intake/alike_events.py",
        "EventQuota(1 if is_meant else FIRST, 1.0 / EVERY, now)",
        "EventQuota(FIRST, 1.0 / EVERY, now)",
        BOUNDS,
        "test_what_a_mailbox_drops_by_its_policy_is_counted",
    ),
    "events that are alike are counted after the first": Check(
        "system/history/recorder.py",
        "if kind in UNKEPT or self._is_counted(event) or not self._admits(event, kind):",
        "if kind in UNKEPT or not self._admits(event, kind):",
        BOUNDS,
        "test_one_rule_holds_for_all_that_may_come_as_often_as_messages",
    ),
    "many events that go on are written more seldom": Check(
        "system/history/writer.py",
        "            self._due = now + self._spent.add(written, now)\n",
        "            self._due = now + PACE\n",
        BOUNDS,
        "test_many_events_that_go_on_are_written_more_seldom",
    ),
    "what is rare has a quota of its own": Check(
        "system/history/tracks.py",
        '    if kind in RARE:\n        return "rare"\n',
        "",
        BOUNDS,
        "test_what_is_rare_is_recorded_in_the_middle_of_a_storm",
    ),
    "what is rare has a ring of its own": Check(
        "system/history/recorder.py",
        "        self._tracks[track_of(event.kind)].ring.add(event)\n",
        '        self._tracks["others"].ring.add(event)\n',
        BOUNDS,
        "test_a_storm_does_not_drive_out_what_is_rare",
    ),
    "dead letters have a quota of their own": Check(
        "system/history/tracks.py",
        '    return "letters" if kind in LETTERS else "others"\n',
        '    return "others"\n',
        BOUNDS,
        "test_dead_letters_leave_the_others_alone",
    ),
    "ends that never come are forgotten": Check(
        "system/history/recorder.py",
        "            del self._expected[next(iter(self._expected))]\n",
        "            pass\n",
        BOUNDS,
        "test_ends_that_never_come_are_forgotten",
    ),
    "a follower that goes is forgotten": Check(
        "system/last_lines/followers.py",
        "        future.add_done_callback(self._forget)\n",
        "",
        OUTSIDE,
        "test_a_follower_that_goes_leaves_nothing_behind",
    ),
    "a ring is bounded by bytes": Check(
        "system/history/ring.py",
        " or (self._bytes > most_bytes and len(events) > 1)",
        "",
        BOUNDS,
        "test_a_ring_keeps_the_newest_within_its_bounds",
    ),
    "addresses are bounded": Check(
        "system/history/lives.py",
        "                self._known.popitem(last=False)\n",
        "                pass\n",
        BOUNDS,
        "test_lives_are_bounded_at_each_address_and_altogether",
    ),
    "the process that died has to be that of the life": Check(
        "system/history/lives.py",
        '    if life.pid in (0, _number(event, "pid")):\n',
        "    if True:\n",
        LIVES,
        "test_the_end_of_an_earlier_process_does_not_end_a_later_life",
    ),
    "all lives end with the root": Check(
        "system/history/lives.py",
        "                _root_ended(known, event)\n",
        "                pass\n",
        KILLED,
        "test_the_next_root_knows_what_was_before_the_kill",
    ),
    "the store is bounded": Check(
        "system/history/shelf.py",
        "            self._write(self._sizes[0][0], None)\n",
        "",
        BOUNDS,
        "test_a_shelf_keeps_the_newest_and_goes_on_behind_an_earlier_one",
    ),
    "a damaged note is passed over": Check(
        "system/history/shelf.py",
        "        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):\n            continue\n",
        "        except RecursionError:\n            continue\n",
        BOUNDS,
        "test_a_damaged_note_is_passed_over",
    ),
    "a store that refuses is told of once": Check(
        "system/history/writer.py",
        "            if not self._has_failed:\n",
        "            if True:\n",
        BOUNDS,
        "test_a_store_that_is_full_hurts_nobody_and_is_told_of_once",
    ),
    "what a store has refused is written later": Check(
        "system/history/writer.py",
        "            self._unwritten.extend(events)\n",
        "",
        BOUNDS,
        "test_a_store_that_is_full_hurts_nobody_and_is_told_of_once",
    ),
    "an event is kept once": Check(
        "system/history/writer.py",
        "    return [by_number[number] for number in sorted(by_number)]\n",
        "    return found\n",
        KILLED,
        "test_an_event_that_was_written_twice_is_there_once",
    ),
    "texts have a bounded size": Check(
        "system/history/past_event.py",
        'shortened(dotted(value) if name == "message" else value)',
        "value",
        BOUNDS,
        "test_a_text_of_any_size_is_kept_in_a_bounded_one",
    ),
    "the content of messages is kept only if that is wanted": Check(
        "system/history/past_event.py",
        "    if payloads:\n        message = message_of(value)\n",
        "    if True:\n        message = message_of(value)\n",
        BOUNDS,
        "test_of_a_message_its_type_is_kept_and_its_content_only_if_wanted",
    ),
    "no frame stays in memory": Check(
        "system/history/past_event.py",
        '            fields[f"{name}_kind"] = kind.__name__\n',
        '            fields[f"{name}_kind"] = value\n',
        BOUNDS,
        "test_an_error_leaves_no_frame_in_memory",
    ),
    "a text that cannot be shown hurts nobody": Check(
        "system/history/past_event.py",
        "    try:\n        return str(value)\n    except Exception as error:\n",
        "    return str(value)\n    try:\n        pass\n    except Exception as error:\n",
        BOUNDS,
        "test_what_cannot_be_shown_or_written_hurts_nobody",
    ),
    "half a pair of surrogates is written all the same": Check(
        "system/history/past_event.py",
        "    if not text.isascii():\n",
        "    if False:\n",
        BOUNDS,
        "test_what_cannot_be_shown_or_written_hurts_nobody",
    ),
    "an address is no pattern": Check(
        "system/history/paths.py",
        "    return literal(target.path) if isinstance(target, ActorRef) else target\n",
        "    return target.path if isinstance(target, ActorRef) else target\n",
        BOUNDS,
        "test_an_address_with_the_signs_of_patterns_is_just_itself",
    ),
    "a question from outside is checked": Check(
        "system/history/pages.py",
        "    if isinstance(limit, bool) or not isinstance(limit, int) or not 1 <= limit <= MOST_ON_PAGE:\n",
        "    if isinstance(limit, bool):\n",
        OUTSIDE,
        "test_a_question_from_outside_is_checked_there",
    ),
    "an operator is named": Check(
        "console/client_session.py",
        "        ACTING.set(OPERATOR)  # In the context of the task of this request.\n",
        "",
        OUTSIDE,
        "test_an_operator_is_named_as_who_stopped_it",
    ),
    "a transaction is named": Check(
        "system/transaction/transaction.py",
        '        context.run(ACTING.set, f"a transaction of {author()}")\n',
        "",
        LIVE,
        "test_who_has_stopped_it",
    ),
    "a terminal obeys no event": Check(
        "console/operate/remembering.py",
        "    shown = [printable(line) for line in lines]\n",
        "    shown = list(lines)\n",
        OUTSIDE,
        "test_what_a_terminal_would_obey_is_not_printed",
    ),
    "an end over a link is told": Check(
        "actors/kernel/links.py",
        "            cell.node.emit(EndedByLink(cell.path, item.name, item.reason))\n",
        "            pass\n",
        LIVE,
        "test_a_link",
    ),
    "whoever kills is named": Check(
        "actors/kernel/address_host.py",
        "            cell.node.emit(ActorKilled(cell.path, by))\n",
        "            pass\n",
        LIVE,
        "test_whoever_kills_is_named",
    ),
    "whoever kills from another process is named": Check(
        "actors/process/wire/peer.py",
        '            cell.host.home.faulted(cell, by if isinstance(by, str) else "")\n',
        '            cell.host.home.faulted(cell, "")\n',
        LIVE,
        "test_whoever_kills_is_named",
    ),
    "turns before the life are not its own": Check(
        "system/history/lives.py",
        "        life.turns = turns - life.turns_before\n",
        "        life.turns = turns\n",
        LIVE,
        "test_the_turns_of_a_life",
    ),
    "a life that began before anybody counted has no count": Check(
        "system/history/lives.py",
        "isinstance(turns, int) and life.turns_before is not None and turns >= life.turns_before",
        "isinstance(turns, int)",
        LIVE,
        "test_the_turns_of_a_life",
    ),
    "a replica that is back was lost all the same": Check(
        "system/history/why.py",
        "    if lost is not None:\n",
        "    if lost is not None and not is_back:\n",
        WHY,
        "test_a_replica_that_was_lost_is_told_of_also_when_it_is_back",
    ),
    "of many children some are named": Check(
        "system/history/why_children.py",
        "    return [*said[:MOST_NAMED], ",
        "    return [*said, ",
        WHY,
        "test_of_many_children_some_are_named",
    ),
    "who ends with the whole system is not ended by its supervisor": Check(
        "supervision/children.py",
        "if root is not None and root.state is not RUNNING:",
        "if False:",
        KILLED,
        "orderly_restart",
    ),
    "a turn that rests says so": Check(
        "actors/kernel/context.py",
        "        task.add_done_callback(rests.pop)\n",
        "        rests.clear()\n",
        LIVE,
        "rests_as_it_has_said and none and task",
    ),
    "an effect that is out is known to the home": Check(
        "checkpoint/home/pending_asks.py",
        'self.effects[place] = TurnRest("effect", out.to, self._home.node.clock.wall())',
        "pass",
        LIVE,
        "rests_as_it_has_said and hybrid",
    ),
    "a turn that hangs is killed for KILLED": Check(
        "system/controls.py",
        "        if reason == KILLED:\n",
        "        if False:\n",
        LIVE,
        "test_an_actor_that_is_terminated_at_once_does_not_end_its_turn",
    ),
    "a sibling's end is told": Check(
        "supervision/supervisor.py",
        "                tell_stopped(cell, self.ctx.path if by is None else by, because)\n",
        "                pass\n",
        LIVE,
        "test_a_sibling_s_restart",
    ),
}

test_the_table_is_true, test_each_check_is_missed = as_tests(CHECKS)
