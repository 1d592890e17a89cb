"""Each safety check of transactions is there for a reason: take it out, and a test fails.

`HOLDFAST_REMOVED=1 python -m pytest tests/system/test_removed_checks.py` does so, in a copy; otherwise it is only
looked whether the checks and the tests are where this table says.
"""

from __future__ import annotations

from tests.removing import Check, as_tests

COMMIT = "tests/system/test_transaction_commit.py"
KEPT = "tests/system/test_specification.py"
MOVED = "tests/system/test_readdressed.py"
TIES = "tests/system/test_moved_ties.py"
FAR = "tests/migration/test_far_moves.py"

CHECKS = {
    "the states are in the store together": Check(
        "system/transaction/transaction.py",
        "            with self._system.homes.journal.together():\n",
        "            if True:\n",
        COMMIT,
        "test_a_root_that_is_killed and commit and task",
    ),
    "the specification is in the store with the states": Check(
        "system/transaction/transaction.py",
        "        system.specifications.changed(*self._draft.below_root(), mechanisms)\n",
        "        pass\n",
        KEPT,
        "test_a_root_that_is_killed and finish",
    ),
    "a mechanism on trial is not in it": Check(
        "system/specification.py",
        "self._packed(_with_mechanisms(address, spec, before))",
        "self._packed(spec)",
        KEPT,
        "test_a_mechanism_that_was_on_trial",
    ),
    "the home keeps the new state though its process has not heard of it": Check(
        "system/transaction/rework.py",
        "            for piece in self._saved:\n                switch.from_life(SNAPSHOT.decode(piece))\n",
        "            pass\n",
        COMMIT,
        "test_a_root_that_is_killed and finish and process",
    ),
    "a life that was not prepared is prepared": Check(
        "system/transaction/rework.py",
        "            is_held = hold is not None and hold.attempt == self._attempt\n",
        "            is_held = True\n",
        COMMIT,
        "test_a_life_that_ends_in_the_middle and plain",
    ),
    "a user does not release what a transaction holds": Check(
        "actors/kernel/mailbox.py",
        "    more.suspended &= ~who\n    if more.suspended:\n        return\n",
        "    more.suspended = 0\n",
        COMMIT,
        "test_what_is_held_handles_nothing",
    ),
    "what was held goes on without another message": Check(
        "actors/kernel/mailbox.py",
        "            queue[index] = NOTHING\n            cell.schedule()\n",
        "            queue[index] = NOTHING\n",
        COMMIT,
        "test_what_is_held_handles_nothing and plain",
    ),
    "a child that was added belongs to a life of its supervisor": Check(
        "system/transaction/structure.py",
        '            return f"{above.path} has been restarted"\n',
        '            return ""\n',
        COMMIT,
        "test_what_is_committed_is_in_force and add",
    ),
    "a request that is asked again is known": Check(
        "supervision/supervisor.py",
        "one is not None and candidate and one.candidate == candidate",
        "False",
        COMMIT,
        "test_a_request_that_waited",
    ),
    "an address that somebody else has leads nowhere else": Check(
        "checkpoint/addresses.py",
        "        if path in self._left:\n",
        "        if False:\n",
        COMMIT,
        "test_an_address_that_somebody_else_has",
    ),
    "what is recorded is found under the new address": Check(
        "checkpoint/home/homes.py",
        "        self.addresses.rename(paths)\n",
        "        pass\n",
        MOVED,
        "test_a_root_that_is_killed and finish-task",
    ),
    "an address that was left has another journal": Check(
        "checkpoint/addresses.py",
        "        if path in self._keys or path not in taken:\n",
        "        if True:\n",
        MOVED,
        "test_who_comes_to_live and task",
    ),
    "no turn is repeated under another address": Check(
        "system/transaction/reparenting.py",
        "            if switch is not None and switch.method.replays and one not in self._rests:\n",
        "            if False:\n",
        MOVED,
        "test_what_is_recorded and task",
    ),
    "what a process says of who has left is void": Check(
        "actors/process/wire/worker_gate.py",
        "            if not self._is_of_lost(frame):\n",
        "            if True:\n",
        FAR,
        "test_what_its_old_supervisor_says",
    ),
    "a name that was left is given anew": Check(
        "actors/process/worker_node.py",
        "        self.connection.names.give_anew(old)\n",
        "",
        FAR,
        "test_who_comes_to_the_address",
    ),
    "an end that a process has not heard of is told there": Check(
        "actors/process/wire/peer.py",
        '            if data.get("life", cell.life) != cell.life:',
        "            if False:",
        FAR,
        "test_an_end_that_its_old",
    ),
    "who watches it from there is known by the root": Check(
        "actors/process/worker_node.py",
        '            cell.host.told(cell, "monitor", data)\n',
        "            pass\n",
        TIES,
        "test_it_hears_of_the_end_of_who_goes",
    ),
    "who is linked with it from there knows its new address": Check(
        "actors/process/stand_ins.py",
        "            peer.extra().ties.links[cell] = cell.path\n",
        "            pass\n",
        TIES,
        "test_it_hears_of_the_end_though",
    ),
    "a supervisor within a process has its recipe as it is now": Check(
        "system/transaction/arrangement.py",
        "            if start is not None:\n",
        "            if False:\n",
        FAR,
        "test_a_supervisor_within_a_process",
    ),
    "a process that is started anew knows who has left": Check(
        "actors/process/worker_node.py",
        '        self._left.update(frame.options.get("left", ()))\n',
        "",
        FAR,
        "test_a_process_that_is_started_anew",
    ),
    "a supervisor that has lost a child says so": Check(
        "supervision/supervisor.py",
        "        return one.cell is not None and one.cell.parent is not self.ctx.cell\n",
        "        return False\n",
        FAR,
        "test_what_its_old_supervisor_says",
    ),
    "a supervisor does not stop who was given to another": Check(
        "supervision/supervisor.py",
        "            if child.parent is self.ctx.cell:  # Else",
        "            if True:  # Else",
        FAR,
        "test_a_supervisor_that_stops",
    ),
    "a supervisor does not retire who was given to another": Check(
        "actors/kernel/node.py",
        "        if cell.parent is parent:  # Else",
        "        if True:  # Else",
        FAR,
        "test_a_supervisor_that_stops",
    ),
    "who was lodged in a process lives where it did if the move is given up": Check(
        "system/transaction/handing.py",
        "        if self._is_lodged and cell is not None:\n",
        "        if False:\n",
        FAR,
        "test_a_move_that_is_given_up",
    ),
    "a restart that would fail is refused also in a process": Check(
        "system/transaction/handing.py",
        "            if port := next(",
        '            if port := "" and next(',
        TIES,
        "test_who_is_bound_to_one_that_goes",
    ),
    "a process is told its address": Check(
        "system/transaction/arrangement.py",
        "                    cell.host.place.readdress(cell)\n",
        "                    pass\n",
        MOVED,
        "test_what_a_process_says",
    ),
    "what a process names for the first time is meant as it is now": Check(
        "actors/process/wire/worker_gate.py",
        "        if self._left:\n            text = self._now(text)\n",
        "",
        MOVED,
        "test_what_a_process_says",
    ),
    "what a process tells is meant as it is now": Check(
        "actors/process/wire/worker_gate.py",
        "        if self._left and isinstance(frame, (frames.Command, frames.Note)):\n",
        "        if False:\n",
        MOVED,
        "test_what_a_process_says",
    ),
    "who is watched is known by its new address": Check(
        "checkpoint/home/homes.py",
        "                switch.ties.rename(lambda one: renamed(names, one))\n",
        "                pass\n",
        MOVED,
        "test_who_knows_it and task",
    ),
    "who rests is let go of when others have to be waited for": Check(
        "system/transaction/reparenting.py",
        "            if waits:  # Perhaps for what those here have to answer.\n",
        "            if False:\n",
        MOVED,
        "test_it_waits_for_nobody",
    ),
    "a binding follows the actor and not its address": Check(
        "system/transaction/arrangement.py",
        "            settle_bindings(system.node.root)\n",
        "            pass\n",
        COMMIT,
        "test_who_was_bound_to_a_life_that_is_over",
    ),
    "a tree that could not be started again is refused": Check(
        "system/transaction/draft.py",
        "self._started_too_early() - self._early:\n",
        "():\n",
        COMMIT,
        "test_a_tree_that_could_not_be_started_again",
    ),
    "what came back with its supervisor is not stopped again": Check(
        "system/transaction/running.py",
        "            return  # It was stopped by a message alone: it has come back with its supervisor.\n",
        "            pass\n",
        COMMIT,
        "test_who_was_stopped_by_a_message_and_came_back",
    ),
    "a signal names its source as the watcher knows it": Check(
        "actors/process/wire/peer.py",
        '            "source": item.watch.name,\n',
        '            "source": item.watch.target.path,\n',
        TIES,
        "test_it_hears_of_the_end_once and monitor and before",
    ),
    "a link names the actor as the other side knows it": Check(
        "actors/process/wire/peer.py",
        '{"source": item.name, "reason"',
        '{"source": item.source.path, "reason"',
        TIES,
        "test_it_hears_of_the_end_once and link and before",
    ),
    "processes are told where those are that they are bound to": Check(
        "system/transaction/arrangement.py",
        "            tell_bindings(system.node.root, {new: old for old, new in now.items()})\n",
        "            pass\n",
        TIES,
        "test_who_is_bound_to_it",
    ),
    "nobody waits for a snapshot of who takes none": Check(
        "system/transaction/reparenting.py",
        "    if not (method.replays or method.snapshots):",
        "    if False:",
        TIES,
        "test_who_is_bound_to_it and replicas",
    ),
    "two looks at threads are alike": Check(
        "testing/threads.py",
        "        if not at_work and before:\n",
        "        if False:\n",
        "tests/testing/test_clock.py",
        "test_a_thread_that_was_woken_behind_the_first_look",
    ),
    "the children stand as the steps say": Check(
        "system/transaction/arrangement.py",
        "{**children, **{name: one for name, one in known.items() if name not in children}}",
        "{**known, **children}",
        COMMIT,
        "test_the_children_stand_in_the_order",
    ),
    "what was stopped is not started with the others": Check(
        "supervision/supervisor.py",
        "(one for one in self._children.values() if one.spec.autostart)",
        "self._children.values()",
        COMMIT,
        "test_who_is_stopped_stays_so",
    ),
    "what was stopped is not restarted with the others": Check(
        "supervision/supervisor.py",
        "(other.state != STARTING and (other.spec.autostart or other.is_running))",
        "other.state != STARTING",
        COMMIT,
        "test_who_is_stopped_stays_so",
    ),
    "a name is not taken from its new holder": Check(
        "system/transaction/arrangement.py",
        "(before is None or holder is not before.now(node)):\n",
        "False:\n",
        COMMIT,
        "test_a_name_that_somebody_else_took",
    ),
}

test_the_table_is_true, test_without_the_check_a_test_fails = as_tests(CHECKS)
