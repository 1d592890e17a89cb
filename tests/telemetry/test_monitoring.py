"""The dashboard and the alerts ask for what a system under kills really tells, by name, label and value."""

import json
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import promql_parser
import pytest
import yaml

import holdfast as hf
from holdfast.console.telemetry.metrics import Metrics
from tests.telemetry.scrapes import Scrape, scraped, until
from tests.telemetry.shop import Account, Add, Boom, Deny

FILES = Path(__file__).parents[2] / "examples" / "monitoring"
OF_PROMETHEUS = {"job", "instance"}
"""Labels that a scrape gets from the configuration."""


def panels() -> list[dict[str, Any]]:
    return [one for one in json.loads((FILES / "dashboard.json").read_text())["panels"] if one["type"] != "row"]


def rules() -> list[dict[str, Any]]:
    (group,) = yaml.safe_load((FILES / "alerts.yml").read_text())["groups"]
    return list(group["rules"])


def expressions() -> Iterator[str]:
    for panel in panels():
        yield from (target["expr"] for target in panel["targets"])
    for note in json.loads((FILES / "dashboard.json").read_text())["annotations"]["list"]:
        yield note["expr"]
    for rule in rules():
        yield rule["expr"]


def filled(text: str) -> str:
    """What Grafana sends: its variables have values."""
    return text.replace("$__rate_interval", "1m").replace("$job", "app").replace("$instance", "one")


def selectors(node: Any) -> Iterator[promql_parser.VectorSelector]:
    """The series that an expression asks for."""
    match node:
        case promql_parser.VectorSelector():
            yield node
        case promql_parser.MatrixSelector(vector_selector=inner) | promql_parser.AggregateExpr(expr=inner):
            yield from selectors(inner)
        case promql_parser.ParenExpr(expr=inner) | promql_parser.UnaryExpr(expr=inner):
            yield from selectors(inner)
        case promql_parser.SubqueryExpr(expr=inner):
            yield from selectors(inner)
        case promql_parser.BinaryExpr(lhs=left, rhs=right):
            yield from selectors(left)
            yield from selectors(right)
        case promql_parser.Call(args=args):
            for one in args:
                yield from selectors(one)
        case promql_parser.NumberLiteral() | promql_parser.StringLiteral():
            pass
        case _:
            raise AssertionError(f"{node!r} is not known here")


def groupings(node: Any) -> Iterator[str]:
    """The labels that an expression groups by."""
    yield from re.findall(r"\w+", " ".join(re.findall(r"by\s*\(([^)]*)\)", node.prettify())))


def missing(scrape: Scrape, text: str) -> list[str]:
    """What an expression asks for and the scrape does not have."""
    node, found = promql_parser.parse(filled(text)), list[str]()
    told: set[str] = set()
    for selector in selectors(node):
        assert selector.name is not None
        samples = scrape.of(selector.name)
        labels = {name for one in samples for name in one.labels}
        told |= labels
        if not samples:
            found.append(selector.name)
        for matcher in selector.matchers.matchers:
            if matcher.name in OF_PROMETHEUS:
                continue
            if matcher.name not in labels:
                found.append(f"{selector.name}: {matcher.name}")
            elif matcher.name == "event":
                found += sorted(set(matcher.value.split("|")) - set(hf.events.__all__))
            elif matcher.value not in VALUES[matcher.name]:
                found.append(f"{matcher.name}={matcher.value}")
    return [*found, *(one for one in groupings(node) if one not in told | OF_PROMETHEUS)]


VALUES = {"operation": ("append", "sync", "cut", "load"), "whole": ("true", "false")}
"""What labels may be, besides events."""


async def under_kills(folder: Path) -> Scrape:
    """A scrape of a system that has had what it counts happen to it."""
    async with hf.ActorSystem("app", log=False, store=f"sqlite:{folder}/app.db", intensity=100) as system:
        metrics = Metrics(system, addresses=["/app/bob"])
        alice = await system.start(hf.child("alice", hf.start(Account), isolation="process", recovery=hf.hybrid()))
        bob = await system.start(hf.child("bob", hf.start(Account)))
        carol = await system.start(hf.child("carol", hf.start(Account), mechanism=hf.ftm.PBR()))
        await system.statistics(bob, True)
        await alice.ask(Add())
        await bob.ask(Add())
        for victim in (alice, carol):
            with system.events() as events:
                os.kill(system.pid_of(victim), 9)
                await victim.ask(Add())
                await until(events, hf.events.Recovered if victim is alice else hf.events.FailedOver)
        with pytest.raises(hf.errors.RemoteCrash):
            await bob.ask(Boom())
        bob.tell(Deny())
        await bob.ask(Add())
        return await scraped(metrics)


async def test_every_expression_asks_for_what_there_is(tmp_path: Path) -> None:
    scrape = await under_kills(tmp_path)
    assert {text: gone for text in expressions() if (gone := missing(scrape, text))} == {}
    assert missing(scrape, "sum by (place) (holdfast_actor_total)") == ["holdfast_actor_total", "place"]
    assert missing(scrape, 'holdfast_events_total{event="SupervisorGoneUp"}') == ["SupervisorGoneUp"]


def test_every_panel_says_what_it_shows() -> None:
    assert len(panels()) > 10
    for panel in panels():
        assert panel["description"].endswith("."), panel["title"]
        assert [target["refId"] for target in panel["targets"]] == sorted({one["refId"] for one in panel["targets"]})
    places = [(panel["gridPos"]["x"], panel["gridPos"]["y"]) for panel in panels()]
    assert len(set(places)) == len(places)


def test_every_alert_has_a_severity_and_a_summary() -> None:
    names = [rule["alert"] for rule in rules()]
    assert len(set(names)) == len(names)
    for rule in rules():
        assert rule["labels"]["severity"] in ("critical", "warning")
        assert rule["annotations"]["summary"]
