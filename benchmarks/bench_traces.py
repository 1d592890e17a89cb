"""What does it cost to trace a system? Asks with and without, in turn.

The baseline is the same system that nobody traces. Spans go to a processor of the SDK that drops them in batches.
`sampled`: one ask in a hundred begins a trace (the default). `none`: traces are on, and none is begun. `continued`:
every ask continues the trace that it is made in, so each makes two spans.

Command: python benchmarks/bench_traces.py [--quick]
"""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable, Sequence

from harness import Job, Run, ask_all, main
from opentelemetry.sdk.trace import ReadableSpan, TracerProvider
from opentelemetry.sdk.trace.export import BatchSpanProcessor, SpanExporter, SpanExportResult
from opentelemetry.trace import Tracer
from workload import Ping, Responder

import holdfast as hf


class Dropped(SpanExporter):
    """Takes spans and does nothing with them."""

    def export(self, spans: Sequence[ReadableSpan]) -> SpanExportResult:
        return SpanExportResult.SUCCESS


async def measured(run: Run, job: str, one_in: float, target: float, *, inside: bool = False) -> None:
    """Asks of one client, traced and not, in turn."""
    provider = TracerProvider()
    provider.add_span_processor(BatchSpanProcessor(Dropped()))
    tracer: Tracer = provider.get_tracer("bench")
    async with hf.ActorSystem("bench", log=False) as system:
        echo = await system.start(hf.child("echo", hf.start(Responder)))
        count = run.size(100_000) // (10 if inside else 1)

        def with_tracer(used: Tracer | None) -> Callable[[], Awaitable[float]]:
            async def rate() -> float:
                system.trace_with(used, one_in=one_in)
                if not inside:
                    return (await ask_all(echo.ask, Ping(), count)).rate
                with tracer.start_as_current_span("request"):
                    return (await ask_all(echo.ask, Ping(), count)).rate

            return rate

        await run.compare(job, with_tracer(tracer), with_tracer(None), unit="asks/s", target=target)
    provider.shutdown()


async def sampled(run: Run) -> None:
    await measured(run, "sampled", 100, 0.9)


async def none(run: Run) -> None:
    await measured(run, "none", math.inf, 0.9)


async def continued(run: Run) -> None:
    await measured(run, "continued", math.inf, 0.05, inside=True)


JOBS: tuple[Job, ...] = (sampled, none, continued)

if __name__ == "__main__":
    main(JOBS)
