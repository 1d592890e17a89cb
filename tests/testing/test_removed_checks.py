"""Each look of the guard is there for a reason: take it out, and a test fails.

`HOLDFAST_REMOVED=1 python -m pytest tests/testing/test_removed_checks.py` does so, in a copy; otherwise it is only
looked whether the looks and the tests are where this table says.
"""

from __future__ import annotations

from tests.removing import Check, as_tests

GUARD = "tests/testing/test_guard.py"
PLUGIN = "tests/testing/test_plugin.py"
LOOPS = "tests/testing/test_loop_methods.py"
REPLAYS = "tests/testing/schedules/test_replays.py"
SCHEDULES = "tests/testing/schedules/test_schedules.py"
ESCAPES = "tests/testing/schedules/test_escapes.py"

CHECKS = {
    "a turn has time between two outcomes": Check(
        "testing/schedules/due.py",
        "Fence(lane) if type(owner) is OutcomeOrder else lane",
        "lane",
        "tests/effects/test_race_programs.py",
        "test_so_it_does_in_any_order_of_steps and task",
    ),
    "nobody looks at what a killed root still tells": Check(
        "testing/guarded.py",
        "        of_the_killed.expect(None)",
        "        of_the_killed.expect(0)",
        "tests/effects/test_race_programs.py",
        "test_every_life_goes_the_same_way and task",
    ),
    "faults strike no turn that has ended before": Check(
        "testing/injectors.py",
        "        if isinstance(item, Fed) and item.feed.turn >= 0 and not self._strikes.replays:\n",
        "        if False:\n",
        "tests/testing/test_faults.py",
        "test_turns_of_a_replay_are_struck_only_if_that_is_said",
    ),
    "a descriptor that is open by another number is looked for": Check(
        "testing/guard/leaks.py",
        "        return found if len(found) == count > 0 else _identified([*map(int, os.listdir(OPEN_FILES))])\n",
        "        return found\n",
        GUARD,
        "test_each_leak_is_found and descriptors",
    ),
    "a number that has become another file is told": Check(
        "testing/guard/leaks.py",
        "        new = [number for number, file in found.items() if self._files.get(number) != file]\n",
        "        new = [number for number in found if number not in self._files]\n",
        GUARD,
        "test_a_number_that_has_become_another_file",
    ),
    "futures are noted as they are made": Check(
        "testing/guard/loop_methods.py",
        "                one.future_made(made)\n",
        "                pass\n",
        LOOPS,
        "test_two_who_note",
    ),
    "timers are noted as they are made": Check(
        "testing/guard/loop_methods.py",
        "                one.timer_made(handle, origin(loop) + time, callback)\n",
        "                pass\n",
        LOOPS,
        "test_two_who_note",
    ),
    "a method is looked up where it comes from, at each call": Check(
        "testing/guard/loop_methods.py",
        "    return next(base for base in kind.__mro__ if name in vars(base))\n",
        "    return types.SimpleNamespace(**{name: getattr(kind, name)})\n",
        LOOPS,
        "test_what_a_test_exchanges",
    ),
    "threads that the test has started are told": Check(
        "testing/guard/thread_leaks.py",
        "                for one in notes:\n",
        "                for one in ():\n",
        GUARD,
        "test_each_leak_is_found and threads",
    ),
    "what is compared is looked at after each turn": Check(
        "testing/guard/sends.py",
        "                if not one.turns and len(one.body) <= SMALL:\n",
        "                if not one:\n",
        GUARD,
        "test_what_two_share and replier",
    ),
    "a message is compared when its turn is over": Check(
        "testing/guard/sends.py",
        "            self._require_same(sent, cell)\n",
        "",
        PLUGIN,
        "test_a_message_that_is_mutated_by_its_receiver",
    ),
    "types are looked at within containers": Check(
        "testing/guard/sends.py",
        "        if not self.are_types_expected and (problem := wrong_field(message)) is not None:\n",
        "        if (problem := None) is not None:\n",
        GUARD,
        "test_types_are_looked_at",
    ),
    "the class of a message is no struct": Check(
        "testing/guard/declared.py",
        "    return kind.__struct_fields__ if issubclass(kind, msgspec.Struct) else ()\n",
        '    return getattr(kind, "__struct_fields__", ())\n',
        GUARD,
        "test_what_is_no_message",
    ),
    "the guard ends with the fixture that was the first": Check(
        "testing/plugin.py",
        "            await self._own.close()\n",
        "",
        PLUGIN,
        "test_a_leak_fails_the_test",
    ),
    "a test that is refused spoils no other": Check(
        "testing/plugin.py",
        "        put.func = _raising(refused)  # Where the fixture is made: pytest has to see that it was begun.\n",
        "        raise refused\n",
        PLUGIN,
        "test_a_test_that_is_refused_spoils_no_other",
    ),
    "a schedule is repeated under its own hash seed": Check(
        "testing/simulation.py",
        "            require_hash_seed(said, self._command())\n",
        "",
        REPLAYS,
        "test_a_schedule_is_repeated_under_its_hash_seed_only",
    ),
    "what fails in another process stays kept": Check(
        "testing/simulation.py",
        "            if found in (None, RANDOM, here()):\n",
        "            if True:\n",
        REPLAYS,
        "test_a_kept_failure_that_passes_under_another",
    ),
    "names that were imported follow the world": Check(
        "testing/schedules/world.py",
        "        self._swaps.follow(self._names.functions)\n",
        "",
        ESCAPES,
        "test_what_a_module_has_by_name",
    ),
    "generators made at import are the seed's": Check(
        "testing/schedules/world.py",
        "        self._generators.put()\n",
        "        self._generators = OwnStates((), 0)\n",
        ESCAPES,
        "test_what_a_module_has_by_name",
    ),
    "a tap opens what one process sends another": Check(
        "testing/probing/taps.py",
        "        message = _opened(self._cell, found) if isinstance(found, Parcel) else message_of(found)\n",
        "        message = message_of(found)\n",
        "tests/testing/test_probe_kit.py",
        "test_a_tap_sees_what_one_actor_sends_another and asyncio-process-process",
    ),
    "a tap sees what recorded actors send each other": Check(
        "testing/probing/taps.py",
        '            self._swaps.put(switch, "record", self._recorded)\n',
        "",
        "tests/testing/test_probe_kit.py",
        "test_a_tap_sees_what_one_actor_sends_another and asyncio-recorded-recorded",
    ),
    "a tap is refused where it would see nothing": Check(
        "testing/probing/taps.py",
        "            _require_seen(self._cell, self._sender)\n",
        "            pass\n",
        "tests/testing/test_probe_kit.py",
        "test_a_tap_is_refused_where",
    ),
    "a time limit is no failure": Check(
        "testing/simulation.py",
        " and not is_of_time_limit(error)\n",
        "\n",
        "tests/testing/test_plugins_together.py",
        "test_a_time_limit_while_a_failure",
    ),
    "a time limit ends the run wherever it strikes": Check(
        "testing/schedules/time_limits.py",
        "            self._loop.end_by(error)\n",
        "",
        "tests/testing/test_plugins_together.py",
        "test_a_time_limit_is_no_failure",
    ),
    "a pool that is at work is told": Check(
        "testing/guard/thread_leaks.py",
        '("threading", pools.__name__, __name__)',
        '("threading", __name__)',
        GUARD,
        "test_a_pool_that_the_test_has_made",
    ),
    "a pool that is idle is none": Check(
        "testing/guard/thread_leaks.py",
        "    return frame is None or frame.f_code is not pools._worker.__code__\n",
        "    return True\n",
        GUARD,
        "test_a_pool_that_the_test_has_made",
    ),
    "exceptions of threads are told": Check(
        "testing/guard/thread_leaks.py",
        '        self._swaps.put(threading, "excepthook", ended)\n',
        "",
        GUARD,
        "test_an_exception_that_ends_a_thread",
    ),
    "handlers of signals are told": Check(
        "testing/guard/leaks.py",
        "if now[number] != before",
        "if False",
        GUARD,
        "test_each_leak_is_found and signals",
    ),
    "open generators are told": Check(
        "testing/guard/loop_leaks.py",
        "        left = self._open_generators() - self._generators\n",
        "        left = set[AsyncGeneratorType[Any, Any]]()\n",
        GUARD,
        "test_an_async_generator",
    ),
    "priorities fall at their moments": Check(
        "testing/schedules/strategies.py",
        "        falls_to = self._changes.pop(self.steps, None)\n",
        "        falls_to = None\n",
        SCHEDULES,
        "test_priorities_that_change",
    ),
    "pct learns how long a run is": Check(
        "testing/schedules/strategies.py",
        "        self._length = max(self._length, choices.steps, 1)\n",
        "        self._length = 2**LONG\n",
        SCHEDULES,
        "test_priorities_that_change",
    ),
    "coverage builds on what was new": Check(
        "testing/schedules/strategies.py",
        "            self._corpus.append(choices.kept())\n",
        "            pass\n",
        SCHEDULES,
        "test_what_was_new_is_built_on",
    ),
    "what has failed is tried first": Check(
        "testing/simulation.py",
        "        passed = self._try_kept() if self._settings.seed is None and len(said) > 1 else []\n",
        "        passed = list[str]()\n",
        REPLAYS,
        "test_what_has_failed_is_tried_first",
    ),
    "a profile has its number": Check(
        "testing/simulation.py",
        'NIGHTLY if wanted.option("profile") == "nightly" else 1',
        "1",
        REPLAYS,
        "test_a_profile_has_its_number",
    ),
    "a set of refs has one order": Check(
        "actors/kernel/ref.py",
        "            found = self._hash = hash_of_address(self._cell.path)\n",
        "            found = self._hash = hash(self._cell.path)\n",
        SCHEDULES,
        "test_a_set_of_refs",
    ),
}

test_the_table_is_true, test_each_look_is_missed = as_tests(CHECKS)
