"""Section "Was it still?" of a report: the verdicts of a calibration second by second."""

from __future__ import annotations

from typing import Final, Literal

import msgspec

from companion.estimation.collector.trace import Trace, VerdictTrace
from companion.report import svg
from companion.report.markup import Child, Markup, tag
from companion.report.page import card

State = Literal["still", "moving", "fault", "unknown"]


class Run(msgspec.Struct, frozen=True):
    """Seconds of one kind in a row; `last` is included."""

    first: int
    last: int
    state: State
    words: str
    """Words of the first second."""


def runs(trace: Trace, verdict: VerdictTrace) -> list[Run]:
    """Join the verdicts of one source where neighbours are of one kind."""
    found: list[Run] = []
    for second, words, fault in zip(trace.second, verdict.words, verdict.fault, strict=True):
        state: State = "still" if words is None else "unknown" if not words else "fault" if fault else "moving"
        if found and found[-1].state == state and found[-1].last == second - 1:
            found[-1] = msgspec.structs.replace(found[-1], last=second)
        else:
            found.append(Run(second, second, state, words or ""))
    return found


MAX_SOURCES: Final = 8
MAX_RUNS: Final = 300
MAX_EVENTS: Final = 15
_ROW: Final = 26.0


def stillness(trace: Trace | None, no_trace: str) -> Markup:
    """Show every second's verdict of every source."""
    parts: list[Child] = [tag("h2", "Was it still?")]
    if trace is None:
        parts.append(card("", f"Not shown: {no_trace}"))
        return tag("section", *parts)
    if not trace.second:
        parts.append(card("", "Not one second was judged: no sensor sent anything."))
        return tag("section", *parts)
    if trace.cut:
        parts.append(card("caution", f"Only the last {len(trace.second)} s are kept; what came before is missing."))
    sources = [(verdict, runs(trace, verdict)) for verdict in trace.verdicts[:MAX_SOURCES]]
    across = svg.linear([float(trace.second[0]), trace.second[-1] + 1.0], least=5.0)
    last = len(sources)
    ticks = [
        (last - 1.0 - k, verdict.name if len(verdict.name) <= 10 else f"{verdict.name[:9]}…")
        for k, (verdict, _) in enumerate(sources)
    ]
    plot = svg.Plot(
        across,
        svg.Axis(-0.6, last + 0.2, (*ticks, (float(last) - 0.15, "used"))),
        name="stillness second by second",
        height=_ROW * (last + 1),
        x_label="seconds since it was asked for",
        left=84.0,
    )
    if trace.measured is not None:
        plot.band(trace.measured[0], trace.measured[1])
        for first, end in _used(trace):
            plot.draw(_block(plot, first, end, last - 0.15, 6.0, "used"))
    for k, (_, found) in enumerate(sources):
        for run in found[:MAX_RUNS]:
            height = {"still": 5.0, "unknown": 2.0}.get(run.state, 18.0)
            plot.draw(_block(plot, run.first, run.last + 1, last - 1.0 - k, height, run.state))
    parts.append(
        tag(
            "figure",
            plot.svg(),
            svg.legend(("still", "still"), ("moving", "moved"), ("fault", "sensor fault"), ("unknown", "no verdict")),
            tag("figcaption", _summary(trace)),
        )
    )
    parts.append(_events([run for _, found in sources for run in found]))
    return tag("section", *parts)


def _block(plot: svg.Plot, first: float, end: float, row: float, height: float, class_: str) -> Markup:
    left, middle = plot.at(first, row)
    return svg.strip(left, plot.at(end, row)[0], middle, height, class_)


def _used(trace: Trace) -> list[tuple[int, int]]:
    """Join the seconds in the mean; the second of each pair is not included."""
    first, last = trace.measured or (0, 0)
    found: list[tuple[int, int]] = []
    for second, good in zip(trace.second, trace.good, strict=True):
        if good and first <= second < last:
            if found and found[-1][1] == second:
                found[-1] = (found[-1][0], second + 1)
            else:
                found.append((second, second + 1))
    return found


def _summary(trace: Trace) -> str:
    if trace.measured is None:
        return f"{sum(trace.good)} of {len(trace.second)} s were still for all sensors. No result came of them."
    used = sum(end - first for first, end in _used(trace))
    first, last = trace.measured
    rejected = last - first - used
    words = f"The result is the mean of {used} still seconds, from {first} s to {last} s"
    return words + (f"; {rejected} in between were left out." if rejected else ".")


def _events(found: list[Run]) -> Markup | None:
    events = sorted((run for run in found if run.state in {"moving", "fault"}), key=lambda run: run.first)
    if not events:
        return None
    items = []
    for run in events[:MAX_EVENTS]:
        when, words = f"{run.first} s: ", run.words
        if run.first != run.last:
            # The words of the first second, without its length.
            when, words = f"{run.first} s to {run.last + 1} s: ", words.replace(" silent for a second", " silent")
        items.append(tag("li", tag("strong", when), words))
    more = len(events) - MAX_EVENTS
    return tag("ul", *items, tag("li", f"and {more} more") if more > 0 else None)
