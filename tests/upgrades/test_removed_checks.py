"""Each check of upgrades is there for a reason: take it out, and a test fails, as `tests/removing.py` does."""

from __future__ import annotations

from tests.removing import Check, as_tests

TABLE = "tests/upgrades/test_what_a_change_does.py"
READ = "tests/upgrades/test_where_records_are_read.py"
MAPPING = "tests/upgrades/test_mapping.py"
UNFIT = "tests/checkpoint/test_unfit_states.py"
BEYOND = "tests/upgrades/test_beyond_recovery.py"

CODE = "tests/control/test_code.py"

CHECKS = {
    "another class of a live actor has its new variables": Check(
        "actors/control/other_class.py",
        "        state = {**values, **given}\n",
        "",
        CODE,
        "test_a_variable_that_only_the_new_class_has",
    ),
    "a variable of a live actor that may have been renamed is not lost": Check(
        "actors/control/other_class.py",
        "        if not is_said:\n",
        "        if False:\n",
        CODE,
        "test_a_variable_that_may_have_been_renamed",
    ),
    "an init in the middle of a life does nothing but set variables": Check(
        "actors/control/other_class.py",
        '        raise SpecError(self.path, "only a life',
        '        return\n        raise SpecError(self.path, "only a life',
        CODE,
        "test_an_init_that_does_more",
    ),
    "a transaction puts in force what init has set beside the state": Check(
        "actors/control/orders.py",
        "            add_variables(actor, prepared.tried.added)\n",
        "",
        CODE,
        "test_a_variable_that_only_the_new_class_has",
    ),
    "a recorded actor remembers which variables its new class begins with": Check(
        "actors/control/other_class.py",
        "    actor.ctx._first_variables = list(values or ())\n",
        "",
        CODE,
        "test_a_variable_that_a_change_keeps",
    ),
    "what was recorded is mapped before its home is used": Check(
        "checkpoint/home/homes.py",
        "            mapped = take_over(switch)\n",
        '            mapped = ""\n',
        TABLE,
        "test_messages",
    ),
    "what was mapped is decoded before anything is changed": Check(
        "checkpoint/upgrade/mapping.py",
        "            self._codec.decode(self._kind, made)\n",
        "",
        TABLE,
        "test_messages",
    ),
    "a table is in force for what follows it": Check(
        "checkpoint/upgrade/old_records.py",
        "        self._mappers.pop(name, None)\n",
        "",
        READ,
        "test_what_is_told_to_somebody",
    ),
    "what is kept for somebody stands behind its own table": Check(
        "checkpoint/home/ask_recovery.py",
        "        if shape is not None:  # Its",
        "        if False:  # Its",
        READ,
        "test_what_is_told_to_somebody",
    ),
    "timers in a snapshot have the newest table": Check(
        "checkpoint/schema.py", "as_shape(known[-1])", "as_shape(known[0])", READ, "test_the_timers_of_a_snapshot"
    ),
    "a snapshot says which table its entries begin with": Check(
        "checkpoint/schema.py",
        "    return known if first == known[0] else [first, *known]\n",
        "    return known[-1:]\n",
        READ,
        "test_what_is_put_aside",
    ),
    "the table of what is left stays in the journal": Check(
        "checkpoint/schema.py",
        "left is not None and self._name_now(name) not in left",
        "left is not None",
        READ,
        "test_what_is_put_aside",
    ),
    "a copy of a home is coded as the present classes have it": Check(
        "checkpoint/schema.py", "_from(known[-1], known)", "_from(known[0], known)", READ, "test_the_cut_of_a_group"
    ),
    "what a turn has sent is compared with the table that it had": Check(
        "checkpoint/home/replay.py",
        "itertools.chain(((name, body),), home.shapes.older_forms(name, body))",
        "[(name, body)]",
        READ,
        "test_what_turns_have_sent",
    ),
    "what has lost a field is not compared": Check(
        "checkpoint/home/replay.py",
        "    except NotMapped:\n        return True\n",
        "    except NotMapped:\n        return False\n",
        READ,
        "test_what_turns_have_sent",
    ),
    "a whole float is the int that it was": Check(
        "checkpoint/home/replay.py",
        " or is_same(old, in_whole_numbers(one))",
        "",
        READ,
        "test_what_turns_have_sent",
    ),
    "a field does not take what was another's": Check(
        "checkpoint/upgrade/mapping.py", '"" if own in taken else own', "own", MAPPING, "test_named_tuples"
    ),
    "a value of one class is not taken for one of another": Check(
        "checkpoint/upgrade/mapping.py",
        "(tag and value[:1] != [tag[1]])",
        "False",
        MAPPING,
        "test_a_class_that_contains_itself",
    ),
    "a message in quarantine is mapped": Check(
        "checkpoint/home/quarantine.py",
        "        return (one.name, one.body) if mapper is None else",
        "        return (one.name, one.body) if True else",
        READ,
        "test_messages_in_quarantine",
    ),
    "a snapshot has the next message looked at anew": Check(
        "checkpoint/schema.py", "        self.noted.clear()\n", "", READ, "test_code_that_is_loaded_once_more"
    ),
    "a variable that may have been renamed is not dropped": Check(
        "actors/state_hooks.py", "    if gone and come:\n", "    if False:\n", TABLE, "test_states"
    ),
    "a replica goes back to a state of the class as it is now": Check(
        "ftm/replica/protected_actor.py",
        "        if life.restored.is_mapped:",
        "        if False:",
        TABLE,
        "test_states",
    ),
    "a replica's snapshot says which variables its class had": Check(
        "ftm/replica/actor_state.py", "kind=kind, variables=names", "", TABLE, "test_states"
    ),
    "a replica hears which variables the class had": Check(
        "ftm/replica/protected_actor.py", ", variables=point.variables", "", TABLE, "test_states"
    ),
    "only other code helps a child that does not fit": Check(
        "supervision/supervisor.py",
        "        if is_in_vain(str(reason)):\n",
        "        if False:\n",
        UNFIT,
        "test_a_supervisor_gives_up_at_once",
    ),
    "who waits at a child that does not fit is told why": Check(
        "supervision/supervisor.py",
        "                one.cell.extra().reason = reason",
        "                pass",
        UNFIT,
        "test_a_supervisor_gives_up_at_once",
    ),
    "a class that fits is tried for a child that cannot be recovered": Check(
        "system/transaction/rework.py",
        "        self._begun_with = own\n        respec(",
        '        raise ControlFailed(cell.path, "prepare", why)\n        respec(',
        BEYOND,
        "test_a_class_that_fits",
    ),
    "an attempt by order does not count": Check(
        "supervision/children.py",
        "        actor._start_now(item.child, item.number)\n",
        "        actor._retry(item.child, item.number, item.reason)\n",
        BEYOND,
        "test_a_class_that_fits",
    ),
    "a child that cannot be recovered is not waited for": Check(
        "system/transaction/rework.py",
        "                if why := why_in_vain(cell):\n",
        '                if why := "":\n',
        BEYOND,
        "test_what_cannot_be_tried",
    ),
    "what a process says of a failed start is remembered": Check(
        "actors/kernel/address_host.py",
        "            up.add_done_callback(self._started)\n",
        "            pass\n",
        BEYOND,
        "test_what_was_tried",
    ),
    "a class that was tried is taken back": Check(
        "system/transaction/rework.py",
        "                    respec(cell, self._begun_with, is_lent=True)\n",
        "",
        BEYOND,
        "test_what_was_tried",
    ),
    "a supervisor elsewhere hears of its child's class": Check(
        "supervision/respec.py",
        "    cell.host.parent.begins_with(cell, start)\n",
        "",
        CODE,
        "process",
    ),
    "senders are refused by the class of the next lives": Check(
        "supervision/respec.py",
        "        cell.table = start.kind._table  # Who sends",
        "        pass  # Who sends",
        CODE,
        "process",
    ),
    "a turn in hand waits for whoever can read its effect": Check(
        "checkpoint/life/recorded_life.py",
        "            if isinstance(awaited, EffectCall):  # It was read",
        "            if False:  # It was read",
        READ,
        "what_an_effect_has_returned",
    ),
    "a key that need not be there is left out": Check(
        "checkpoint/upgrade/mapping.py",
        "            elif not may_be_missing(field):\n",
        "            else:\n",
        MAPPING,
        "key_that_need_not",
    ),
    "the error of an effect is the one that was raised": Check(
        "checkpoint/life/recorded_life.py",
        "        if isinstance(awaited, EffectCall):  # Its handler may know the very class.\n",
        "        if False:\n",
        READ,
        "test_what_effects_have_ended_with and gone",
    ),
    "a turn is not as far as it was while it acts on an outcome": Check(
        "checkpoint/life/recorded_life.py",
        "            self._say_it_waits_in(STEPS)",
        "            self._say_it_waits_in(0)",
        READ,
        "test_what_effects_have_ended_with and error",
    ),
    "the subscriptions of a recorded actor are not those of its life": Check(
        "checkpoint/life/recorded_context.py",
        '        """Its home subscribes, for the address: subscriptions of this life would end with it."""\n',
        "        super()._has_class(old, new)\n",
        CODE,
        "test_a_recorded_actor_hears_the_topics and process",
    ),
    "a home subscribes as the class that its actor has become": Check(
        "supervision/respec.py",
        "    cell.host.home.has_class(cell, start.kind)\n",
        "",
        CODE,
        "test_a_recorded_actor_hears_the_topics",
    ),
    "a home hears the topics of the class before no more": Check(
        "checkpoint/home/journal_home.py",
        "        switch.leave_topics(before)\n",
        "",
        CODE,
        "test_a_recorded_actor_hears_the_topics",
    ),
}

test_the_table_is_true, test_without_the_check_a_test_fails = as_tests(CHECKS)
