"""The metrics that there are: name, type, text and labels. docs/metrics-and-traces.md shows the same table."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, NamedTuple

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily
from prometheus_client.metrics_core import Metric

from .series import Spread


class Family(NamedTuple):
    """One metric, without its values."""

    kind: Literal["counter", "gauge", "histogram"]
    text: str
    labels: tuple[str, ...] = ()


FAMILIES: Mapping[str, Family] = {
    "holdfast_info": Family("gauge", "1; the version of holdfast and the system's name", ("version", "system")),
    "holdfast_actors": Family("gauge", "Actors that the root process knows, by where they live", ("place", "state")),
    "holdfast_mailbox_messages": Family("gauge", "Messages that wait or are in hand, by actor class", ("class",)),
    "holdfast_mailbox_longest_messages": Family("gauge", "As before, of the actor that has most", ("class",)),
    "holdfast_actor_mailbox_messages": Family("gauge", "As before, of one chosen address", ("address",)),
    "holdfast_actor_messages_total": Family("counter", "Messages in and out, if counted", ("address", "direction")),
    "holdfast_actor_turn_seconds": Family("histogram", "How long turns take, with waiting, if counted", ("address",)),
    "holdfast_actor_longest_turn_seconds": Family("gauge", "The longest turn of an actor, if counted", ("address",)),
    "holdfast_asks_outstanding": Family("gauge", "Asks made in the root process that have no outcome yet"),
    "holdfast_late_replies_total": Family("counter", "Replies that came when nobody waited any more"),
    "holdfast_dead_letters_total": Family("counter", "Messages that nobody has handled"),
    "holdfast_refused_total": Family("counter", "Messages answered with no, held ones refused, frames", ("what",)),
    "holdfast_no_room_total": Family("counter", "Refused or lost for want of room", ("where", "class")),
    "holdfast_events_total": Family("counter", "Events of the system, by kind", ("event",)),
    "holdfast_crashes_total": Family("counter", "Lives that user code has ended, by type of the error", ("error",)),
    "holdfast_restarts_total": Family("counter", "Restarts by supervisor and exit reason", ("supervisor", "reason")),
    "holdfast_slow_turn_max_seconds": Family("gauge", "The longest turn told by watch_turns"),
    "holdfast_quarantined_messages": Family("gauge", "Messages that are put aside"),
    "holdfast_recovery_seconds": Family("histogram", "From the notice of a crash until the actor takes messages"),
    "holdfast_recovery_phase_seconds_total": Family("counter", "Time in each phase of recoveries", ("phase",)),
    "holdfast_replayed_turns_total": Family("counter", "Turns that recoveries have run again"),
    "holdfast_recorded_actors": Family("gauge", "Addresses with a journal"),
    "holdfast_journal_bytes": Family("gauge", "What recoveries would read besides snapshots, of all actors"),
    "holdfast_journal_open_messages": Family("gauge", "Accepted inputs of recorded actors that are not done"),
    "holdfast_snapshot_pause_seconds": Family("histogram", "How long an actor stood still for a snapshot"),
    "holdfast_snapshot_bytes_total": Family("counter", "Bytes of the snapshots that were taken"),
    "holdfast_snapshot_written_bytes_total": Family("counter", "Bytes of them that had to be written"),
    "holdfast_store_bytes": Family("gauge", "Bytes of the store on the disk", ("file",)),
    "holdfast_store_state": Family("gauge", "1: the store writes, 0: not at the moment, -1: not any more"),
    "holdfast_store_seconds": Family("histogram", "How long the store takes", ("operation",)),
    "holdfast_protected_actors": Family("gauge", "Actors under mechanisms; whole: all replicas", ("stack", "whole")),
    "holdfast_failover_seconds": Family("histogram", "From the notice of a leader's end until another leads"),
    "holdfast_process_resident_memory_bytes": Family("gauge", "Resident memory, shared pages included", ("process",)),
    "holdfast_process_cpu_seconds_total": Family("counter", "User and system time", ("process",)),
    "holdfast_processes": Family("gauge", "Processes of the system, the root's included"),
    "holdfast_loop_lag_seconds": Family("gauge", "How late the event loop has come to this scrape"),
    "holdfast_scrape_seconds": Family("gauge", "Time that this scrape took on the event loop"),
    "holdfast_scrape_slice_seconds": Family("gauge", "The longest time for which it held the loop"),
}


class Filled:
    """The families of one scrape, and their values so far."""

    def __init__(self) -> None:
        self._made: dict[str, Metric] = {}
        for name, family in FAMILIES.items():
            match family.kind:
                case "counter":
                    self._made[name] = CounterMetricFamily(name, family.text, labels=family.labels)
                case "gauge":
                    self._made[name] = GaugeMetricFamily(name, family.text, labels=family.labels)
                case "histogram":
                    self._made[name] = HistogramMetricFamily(name, family.text, labels=family.labels)

    def put(self, name: str, value: float, *labels: str) -> None:
        """A value of a counter or gauge."""
        made = self._made[name]
        assert isinstance(made, (CounterMetricFamily, GaugeMetricFamily))
        made.add_metric(labels, value)

    def put_all(self, name: str, values: Mapping[tuple[str, ...], float]) -> None:
        """The values of a family by their labels."""
        for labels, value in values.items():
            self.put(name, value, *labels)

    def spread(self, name: str, values: Spread, *labels: str) -> None:
        """Put a histogram into its family."""
        made = self._made[name]
        assert isinstance(made, HistogramMetricFamily)
        buckets, total = values.buckets()
        made.add_metric(labels, buckets, total)

    def all(self) -> list[Metric]:
        """The families, in the order of the table."""
        return list(self._made.values())
