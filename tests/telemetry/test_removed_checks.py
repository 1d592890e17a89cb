"""Each check of what is told of a system is there for a reason: take it out, and a test fails.

`HOLDFAST_REMOVED=1 python -m pytest tests/telemetry/test_removed_checks.py` does so, in a copy; otherwise it is only
looked whether the checks and the tests are where this table says.
"""

from __future__ import annotations

from tests.removing import Check, as_tests

METRICS = "tests/telemetry/test_metrics.py"
TRACES = "tests/telemetry/test_traces.py"

CHECKS = {
    "a tracer that raises when a span ends hurts no actor": Check(
        "actors/control/spans.py",
        "        span.end(at)\n    except Exception as error:\n",
        "        span.end(at)\n    except ZeroDivisionError as error:\n",
        TRACES,
        "test_a_tracer_that_raises and end",
    ),
    "a tracer that raises when a span begins hurts no actor": Check(
        "actors/control/spans.py",
        "kind, {ADDRESS: cell.path})\n        except Exception as error:\n",
        "kind, {ADDRESS: cell.path})\n        except ZeroDivisionError as error:\n",
        TRACES,
        "test_a_tracer_that_raises and start",
    ),
    "what is handled again is in no trace": Check(
        "checkpoint/life/recorded_life.py",
        "if feed.chain and feed.turn < 0:  # What",
        "if feed.chain:  # What",
        TRACES,
        "test_a_replay_makes_no_spans_of_old_work",
    ),
    "the span in which a system was entered is that of no turn": Check(
        "actors/control/spans.py",
        "if here and (ctx is None or here is not self._base):",
        "if here:",
        TRACES,
        "test_who_enters_a_system_in_a_span",
    ),
    "a turn leaves no span to the next one": Check(
        "actors/control/spans.py",
        "        _detach(token)\n    if span is None",
        "        pass\n    if span is None",
        TRACES,
        "test_what_is_in_no_trace_is_in_none",
    ),
    "what is sent in a span that is not sampled is in no trace": Check(
        "actors/control/spans.py",
        "            return None  # Whoever waits for this turn has decided.",
        "            pass",
        TRACES,
        "test_whoever_waits_for_a_turn_has_decided",
    ),
    "the runtime's own messages begin no trace": Check(
        "actors/control/spans.py",
        "        if not around and _is_ours(ask.message):\n            return\n",
        "",
        TRACES,
        "test_the_messages_of_the_runtime_begin_no_trace",
    ),
    "a trace is no address": Check(
        "actors/kernel/envelope.py",
        'return tuple(path for path, _ in chain if path.startswith("/"))',
        "return tuple(path for path, _ in chain)",
        TRACES,
        "test_a_circle_is_told_without_the_trace",
    ),
    "a begun trace is not begun again": Check(
        "actors/control/spans.py",
        "            item.chain = (*item.chain[:-1], (spans.tail(span.get_span_context(), around), 0))",
        "            pass",
        TRACES,
        "test_a_trace_is_begun_once",
    ),
    "who ends is traced no more": Check(
        "actors/control/spans.py",
        "        self._leave()\n        return left",
        "        return left",
        TRACES,
        "test_a_simulated_end_leaves_nobody_traced",
    ),
    "labels are bounded": Check(
        "console/telemetry/series.py",
        "if len(self._known) >= self._most:",
        "if False:",
        METRICS,
        "test_labels_are_bounded",
    ),
    "events are counted from 0 on": Check(
        "console/telemetry/tally.py",
        "Tallies((kind,) for kind in KINDS)",
        "Tallies()",
        METRICS,
        "test_crashes_refusals_and_letters_are_counted",
    ),
    "a scrape gives the loop back": Check(
        "console/telemetry/survey.py",
        "            await self._rest()\n",
        "",
        METRICS,
        "test_a_scrape_of_many_actors_gives_the_loop_back",
    ),
}

test_the_table_is_true, test_without_the_check_a_test_fails = as_tests(CHECKS)
