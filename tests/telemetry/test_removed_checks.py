"""Each check of what is told of a system is there for a reason: take it out, and a test fails.

`HOLDFAST_REMOVED=1 python -m pytest tests/telemetry/test_removed_checks.py` does so, in a copy; otherwise it is only
looked whether the checks and the tests are where this table says.
"""

from __future__ import annotations

from tests.removing import Check, as_tests

METRICS = "tests/telemetry/test_metrics.py"
TRACES = "tests/telemetry/test_traces.py"

CHECKS = {
    "what became a dead letter in another process is counted": Check(
        "actors/process/worker_pool.py",
        "            self.node.numbers.dead_letters += 1\n",
        "            pass\n",
        METRICS,
        "test_letters_are_counted_once and subtree",
    ),
    "what was refused in another process is no dead letter": Check(
        "actors/process/worker_pool.py",
        "isinstance(event, DeadLetter) and not event.why.startswith(REFUSED)",
        "isinstance(event, DeadLetter)",
        METRICS,
        "test_letters_are_counted_once and subtree",
    ),
    "a tracer that raises when a span ends hurts no actor": Check(
        "actors/control/spans.py",
        "        span.end(at)\n    except Exception as error:\n",
        "        span.end(at)\n    except ZeroDivisionError as error:\n",
        TRACES,
        "test_a_tracer_that_raises and end",
    ),
    "a tracer that raises when a span begins hurts no actor": Check(
        "actors/control/spans.py",
        "{ADDRESS: cell.path}, start_time=begun)\n        except Exception as error:\n",
        "{ADDRESS: cell.path}, start_time=begun)\n        except ZeroDivisionError as error:\n",
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
    "an ask of a recorded turn has a span": Check(
        "checkpoint/home/outputs.py",
        "        if out.trace:\n            tail, hears",
        "        if False:\n            tail, hears",
        TRACES,
        "test_what_a_recorded_turn_asks_is_below_it",
    ),
    "the span of an ask of a recorded turn hears its outcome": Check(
        "checkpoint/home/pending_asks.py",
        "ask.hears(ask.failure(answer))",
        "ask.hears(None)",
        TRACES,
        "test_an_ask_of_a_recorded_turn_that_fails",
    ),
    "the span in which a system was entered is that of no turn": Check(
        "actors/control/spans.py",
        "if (ctx is None or here is not self._base) and self._decides(here):",
        "if self._decides(here):",
        TRACES,
        "test_who_enters_a_system_in_a_span",
    ),
    "a turn leaves no span to the next one": Check(
        "actors/control/spans.py",
        "            _detach(self.token)\n",
        "            pass\n",
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
        "            elif tail_of(item.chain) == BEGIN:",
        "            elif False:",
        TRACES,
        "test_a_trace_is_begun_once",
    ),
    "what has ended is in the traces when a system is traced no more": Check(
        "actors/control/spans.py",
        "        spans.late.flush()\n",
        "        pass\n",
        TRACES,
        "test_a_span_that_nobody_looks_at_is_made_later",
    ),
    "a span that was not looked at is made after a while": Check(
        "actors/control/late_spans.py",
        "        elif self._timer is None:\n",
        "        elif False:\n",
        TRACES,
        "test_a_span_that_nobody_looks_at_is_made_later",
    ),
    "spans that wait are bounded": Check(
        "actors/control/late_spans.py",
        "if len(self._spans) >= MOST:",
        "if len(self._spans) >= 2 * MOST:",
        TRACES,
        "test_a_span_that_nobody_looks_at_is_made_later",
    ),
    "a stashed ask begins no second trace": Check(
        "actors/control/trace_tail.py",
        "        _goes_on()(item)\n",
        "        pass\n",
        TRACES,
        "test_a_stashed_ask_goes_on_in_its_trace",
    ),
    "a forwarded ask begins no second trace": Check(
        "actors/control/spans.py",
        "            goes_on(item)\n",
        "            pass\n",
        TRACES,
        "test_a_forwarded_ask_goes_on_in_its_trace",
    ),
    "only the cells of the traced node are": Check(
        "actors/kernel/cell.py",
        'made = type(kind.__name__, (kind,), {"__slots__": (), "__module__": kind.__module__, **self._methods})',
        "made = kind",
        TRACES,
        "test_a_system_beside_a_traced_one_is_not_traced",
    ),
    "a recorded turn leaves no trace to the next one": Check(
        "actors/control/spans.py",
        '            self.ctx._continue_trace("")',
        "            pass",
        TRACES,
        "test_a_recorded_turn_leaves_no_trace_to_the_next_one",
    ),
    "what a recorded turn sends carries its trace": Check(
        "checkpoint/home/outputs.py",
        "return ((out.trace, 0),) if out.trace else ()",
        "return ()",
        TRACES,
        "test_what_a_turn_sends_is_below_it and recorded",
    ),
    "what a recorded turn asks is below it": Check(
        "checkpoint/home/outputs.py",
        "            chain = with_tail(chain, tail)",
        "            pass",
        TRACES,
        "test_what_a_recorded_turn_asks_is_below_it",
    ),
    "what a recorded turn forwards is below it": Check(
        "checkpoint/home/outputs.py",
        "            ask.chain = with_tail(ask.chain, out.trace)",
        "            pass",
        TRACES,
        "test_what_a_recorded_turn_forwards_is_below_it",
    ),
    "a forwarded ask has one span for each turn": Check(
        "actors/control/trace_tail.py",
        "if tail_of(item.chain) and not item.is_followed:",
        "if tail_of(item.chain):",
        TRACES,
        "test_what_a_recorded_turn_forwards_is_below_it",
    ),
    "what a process sends carries its trace": Check(
        "actors/process/wire/peer.py",
        "frames.Offer(key, to, name, body, source, chain_of(item))",
        "frames.Offer(key, to, name, body, source)",
        TRACES,
        "test_what_a_turn_sends_is_below_it and send",
    ),
    "what a process publishes carries its trace": Check(
        "actors/process/worker_node.py",
        "frames.Publish(key, topic, name, body, source, item.chain)",
        "frames.Publish(key, topic, name, body, source)",
        TRACES,
        "test_what_a_turn_sends_is_below_it and publish",
    ),
    "a cancelled timer has no span": Check(
        "actors/control/spans.py",
        "if item.is_cancelled or (",
        "if (",
        TRACES,
        "test_a_cancelled_timer_makes_no_span",
    ),
    "a timer that repeats goes on in no trace": Check(
        "actors/control/spans.py",
        "if is_once and here is not self._base",
        "if here is not self._base",
        TRACES,
        "test_a_timer_that_repeats",
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
