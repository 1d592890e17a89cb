"""Each safety check of the console is there for a reason: take it out, and a test fails.

`HOLDFAST_REMOVED=1 python -m pytest tests/console/test_removed_checks.py` does so, in a copy; otherwise it is only
looked whether the checks and the tests are where this table says.
"""

from __future__ import annotations

from tests.removing import Check, as_tests

OPERATE = "tests/console/test_operate.py"
DECLARE = "tests/console/test_declare.py"
SERVICE = "tests/console/test_service.py"
APPLY = "tests/console/test_apply.py"
HEALTH = "tests/console/test_health.py"
EMBEDDED = "tests/examples/embedding/test_surroundings.py"

CHECKS = {
    "a state too large for a frame from its process is told as such": Check(
        "actors/control/orders_lane.py",
        "    if len(data) > MOST_TOLD:",
        "    if False:",
        "tests/console/test_operate.py",
        "too_large_to_be_sent",
    ),
    "what the next program cannot have is not kept": Check(
        "system/specification.py",
        "            _refuse_of_scripts(one)\n",
        "            pass\n",
        APPLY,
        "test_what_the_next_program_could_not_have",
    ),
    "a module from beside a script is not one that the program finds": Check(
        "system/script.py",
        "        _BROUGHT.append(folder)",
        "        pass",
        APPLY,
        "test_what_the_next_program_could_not_have",
    ),
    "a server ends when its tree fails": Check(
        "console/service/health.py",
        "        if self._ends_server and system.has_failed:",
        "        if False:",
        HEALTH,
        "test_if_the_tree_fails_the_server_ends",
    ),
    "a service is not ready while children wait for whom they are bound to": Check(
        "supervision/dynamic.py",
        "            tell_wait(self.ctx._cell)\n",
        "            pass\n",
        "tests/supervision/test_expected.py",
        "not_ready_while_they_wait",
    ),
    "what is not known to be over is looked at again": Check(
        "console/service/health.py",
        "    waiting.update(cell for cell, found in zip(asked, told, strict=True) if found)\n",
        "",
        "tests/supervision/test_expected.py",
        "not_ready_while_they_wait",
    ),
    "a service is not ready while a child of the root is silent": Check(
        "console/service/health.py",
        '        return [*problems, *(f"the process of {path} does not answer" for path in silent), *waits]\n',
        "        return [*problems, *waits]\n",
        HEALTH,
        "is_silent",
    ),
    "a worker waits for a store that is becoming free": Check(
        "console/service/health.py",
        "if number == self._workers - 1 and time.monotonic() > until:",
        "if number == self._workers - 1:",
        HEALTH,
        "test_each_worker_has_a_store",
    ),
    "a worker does not say that it is the main process": Check(
        "console/service/health.py",
        "Notifier(environment if workers == 1 else {})",
        "Notifier(environment)",
        HEALTH,
        "test_only_the_master",
    ),
    "a store that takes nothing makes a program not ready": Check(
        "console/service/health.py",
        "        problems = [blocked] if blocked else []",
        "        problems = list[str]()",
        HEALTH,
        "test_a_store_that_is_full",
    ),
    "a store that has failed makes a program not live": Check(
        "console/service/health.py",
        "        if stopped:\n",
        "        if False:\n",
        HEALTH,
        "test_a_store_that_is_full",
    ),
    "a probe has an end": Check(
        "console/service/probe_server.py",
        "            async with asyncio.timeout(LONGEST):",
        "            async with asyncio.timeout(None):",
        HEALTH,
        "test_a_probe_that_says_nothing",
    ),
    "there are only so many probes at a time": Check(
        "console/service/probe_server.py",
        "        if len(self._tasks) >= MOST_PROBES:",
        "        if False:",
        HEALTH,
        "test_a_probe_that_says_nothing",
    ),
    "PID 1 reaps orphans": Check(
        "system/run.py",
        "    leave_init()\n",
        "",
        EMBEDDED,
        "test_as_pid_1",
    ),
    "PID 1 passes signals on": Check(
        "system/init_process.py",
        "                os.kill(program, number)",
        "                pass",
        EMBEDDED,
        "test_as_pid_1",
    ),
    "a system that does not answer is not waited for": Check(
        "console/operate/reaching.py",
        "        remote.greet(GREETING_SECONDS)\n",
        "",
        OPERATE,
        "test_a_system_that_is_there_and_does_not_answer",
    ),
    "a number that no request can have is told": Check(
        "console/wire.py",
        "    except OverflowError as error:",
        "    except ZeroDivisionError as error:",
        OPERATE,
        "test_a_number_that_is_too_large",
    ),
    "nobody else may look into the folder of sockets": Check(
        "console/runtime_folder.py",
        "    if info.st_mode & (stat.S_IRWXG | stat.S_IRWXO):",
        "    if False:",
        OPERATE,
        "test_a_folder_that_others_may_enter_is_refused",
    ),
    "a main that does not end holds up nobody": Check(
        "console/service/service_run.py",
        "timeout=MAIN_TIMEOUT))[0]:",
        "timeout=None))[0]:",
        SERVICE,
        "test_a_main_that_does_not_end",
    ),
    "a module that raises what is no error ends no program that reads it again": Check(
        "console/service/reloading.py",
        "                except BaseException as error:  # A module",
        "                except Exception as error:  # A module",
        SERVICE,
        "test_a_reload_that_fails",
    ),
    "a module that raises what is no error ends no program that is asked for it": Check(
        "actors/values/classes.py",
        "    except BaseException as error:  # A module may raise anything",
        "    except Exception as error:  # A module may raise anything",
        OPERATE,
        "test_a_module_that_raises_anything",
    ),
    "an address is one line": Check(
        "actors/values/path_parts.py",
        """ or "/" in name or has_control(name):""",
        """ or "/" in name:""",
        OPERATE,
        "test_a_name_that_a_terminal_would_obey",
    ),
    "a name beside an address is one line": Check(
        "actors/values/path_parts.py",
        " <= LONGEST or has_control(name):",
        " <= LONGEST:",
        OPERATE,
        "test_a_name_that_a_terminal_would_obey",
    ),
    "who suspends many is asked": Check(
        "console/operate/changing.py",
        "[] if dry_run else held_up_by(rows, all_rows)",
        "[]",
        OPERATE,
        "test_who_suspends_the_root",
    ),
    "nobody is ended whom a suspended supervisor would not start again": Check(
        "console/restarting.py",
        """.state == "suspended":""",
        """.state == "never":""",
        OPERATE,
        "test_who_suspends_the_root",
    ),
    "a recorded state that is left behind is told": Check(
        "console/declare/tree_plan.py",
        "        change.lose(lost)\n",
        "",
        DECLARE,
        "test_what_is_recorded_of_one_that_moves",
    ),
    "a reload leaves no recorded state behind": Check(
        "console/declare/tree_plan.py",
        "    if keep_all and lost:\n",
        "    if False:\n",
        SERVICE,
        "leaves_nothing_behind",
    ),
    "who types an address at which nobody was is told": Check(
        "console/operate/remembering.py",
        "        if not remote.lives(path) and path not in remote.tree():\n",
        "        if False:\n",
        "tests/history/test_from_outside.py",
        "test_the_commands_in_words",
    ),
    "a page for a terminal is not shown elsewhere": Check(
        "console/operate/looking.py",
        "    if not (sys.stdin.isatty() and sys.stdout.isatty()):\n",
        "    if False:\n",
        OPERATE,
        "test_top_needs_a_terminal",
    ),
    "the folder of sockets is no link": Check(
        "console/runtime_folder.py",
        "    if not stat.S_ISDIR(info.st_mode):",
        "    if False:",
        OPERATE,
        "test_a_link_in_the_place_of_the_folder_is_refused",
    ),
    "a supervisor does not give up over a restart by order": Check(
        "console/restarting.py",
        "    check_allowed(above, path)\n",
        "",
        OPERATE,
        "test_a_restart_that_would_end_the_supervisor_is_refused",
    ),
    "who would not come back is not restarted": Check(
        "console/restarting.py",
        "        if not cell.spec.restarts(reason):",
        "        if False:",
        OPERATE,
        "test_a_restart_of_who_would_not_come_back_is_refused",
    ),
    "a client that goes follows nobody any more": Check(
        "console/client_session.py",
        "            self._followed.close()\n",
        "            pass\n",
        OPERATE,
        "test_trace_follows_one_actor_and_gives_back_what_it_has_switched_on",
    ),
    "nothing is lost without a yes": Check(
        "console/operate/reaching.py",
        "    if yes or not lost:",
        "    if True:",
        OPERATE,
        "test_a_restart_asks_before_state_is_lost or test_stop_start_and_remove",
    ),
    "modules of a tree are of nobody else": Check(
        "console/declare/tree_plan.py",
        "    with trusted_imports(system._node, Needed(None, [])):\n        wanted",
        "    if True:\n        wanted",
        DECLARE,
        "test_a_module_that_others_may_write_is_not_imported_for_a_tree",
    ),
    "children of dynamic supervisors are not the file's": Check(
        "console/declare/tree_plan.py",
        " or (free and not is_named)",
        "",
        DECLARE,
        "test_what_is_not_in_the_file_is_removed_and_children_of_dynamic_supervisors_stay",
    ),
    "only the arguments of the next lives change": Check(
        "console/declare/tree_plan.py",
        "ReplaceActorCode(path, start, keep_state)",
        "ReplaceActorCode(path, start, lambda state, old: {})",
        DECLARE,
        "test_each_difference_is_one_step_and_state_is_kept",
    ),
    "who is unbound may be started before its target": Check(
        "system/transaction/living.py",
        "            owner.spec = dataclasses.replace(owner.spec, bindings=left)",
        "            pass",
        DECLARE,
        "test_the_order_of_the_file_is_the_order_of_starts",
    ),
    "new code that would not reach a process is refused": Check(
        "console/declare/tree_plan.py",
        "    if is_reloaded and place.cell is not None and is_far(place.cell):",
        "    if False:",
        SERVICE,
        "test_code_that_would_not_reach_a_process_is_refused",
    ),
    "messages that may wait are of the classes that there are": Check(
        "console/service/reloading.py",
        "            if any(one.__module__ == name for one in messages):",
        "            if False:",
        SERVICE,
        "test_a_reload_that_fails_changes_nothing and words",
    ),
    "modules are as before when a reload fails": Check(
        "console/service/reloading.py",
        "                vars(modules[name]).update(kept)\n",
        "                vars(modules[name]).update(kept, hf=None, Clock=None)\n",
        SERVICE,
        "test_a_reload_that_fails_changes_nothing and clock",
    ),
    "a service manager that has no room is told again": Check(
        "console/service/notify.py",
        "                self._again = asyncio.get_running_loop().call_later(SEND_AGAIN, self._send)\n"
        "                return\n",
        "                pass\n",
        SERVICE,
        "test_a_manager_that_does_not_listen_holds_nothing_up",
    ),
    "a script that calls what there is not is told the line": Check(
        "console/operate/scripts.py",
        "if not isinstance(error.obj, (RemoteChange, RemoteRef, RemoteSystem)):",
        "if True:",
        APPLY,
        "goes_wrong",
    ),
    "imports for a request are told of": Check(
        "system/script.py",
        "            tell(path, sha256)\n",
        "            pass\n",
        APPLY,
        "test_a_module_that_others_may_write_is_not_imported",
    ),
}

test_the_table_is_true, test_without_the_check_a_test_fails = as_tests(CHECKS)
