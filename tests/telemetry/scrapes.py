"""Reads what a scrape says, as Prometheus would."""

import asyncio
from typing import TypeVar

from prometheus_client import generate_latest
from prometheus_client.parser import text_string_to_metric_families
from prometheus_client.registry import Collector
from prometheus_client.samples import Sample

import holdfast as hf


class Scrape:
    """The samples of one scrape."""

    def __init__(self, text: str) -> None:
        self.samples = [sample for family in text_string_to_metric_families(text) for sample in family.samples]

    def of(self, name: str, **labels: str) -> list[Sample]:
        return [one for one in self.samples if one.name == name and labels.items() <= one.labels.items()]

    def value(self, name: str, **labels: str) -> float:
        (found,) = self.of(name, **labels)
        return found.value


async def scraped(collector: Collector) -> Scrape:
    """Scrape it as a server does, in a thread."""
    return Scrape((await asyncio.to_thread(generate_latest, collector)).decode())


E = TypeVar("E", bound=hf.events.Event)


async def until(events: hf.events.EventStream, kind: type[E]) -> E:
    """The next event of this kind."""
    async with asyncio.timeout(20.0):
        async for event in events:
            if isinstance(event, kind):
                return event
    raise AssertionError("the system has ended")
