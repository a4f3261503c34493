"""What a collector counts of itself, in Prometheus' text format (version 0.0.4).

By hand: a dozen numbers without labels are less than the import of prometheus_client, 75 ms and 13 MB.
"""

from __future__ import annotations

import datetime
import time
from collections.abc import Iterator
from typing import Final

import sqlalchemy as sa

from companion.fleet import schema
from companion.fleet.store import Outcome

CONTENT_TYPE: Final = "text/plain; version=0.0.4; charset=utf-8"
BUCKETS_S: Final = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0)


def heard(connection: sa.Connection, now: datetime.datetime) -> int:
    """How many aircraft were heard within a day."""
    lately = schema.aircraft.c.heard_at > now - datetime.timedelta(days=1)
    return connection.execute(sa.select(sa.func.count()).where(lately)).scalar_one()


class Metrics:
    """Counts since the start."""

    def __init__(self) -> None:
        self.connections = 0
        self.connected = False
        self._items = self._duplicates = self._rejected = 0
        self._last_commit_s = 0.0
        self._within = [0] * len(BUCKETS_S)
        self._batches, self._commits_s = 0, 0.0

    def committed(self, outcome: Outcome, took_s: float) -> None:
        """A batch is in the database."""
        self._items += outcome.new
        self._duplicates += sum(map(len, outcome.confirmed.values())) - outcome.new
        self._rejected += len(outcome.rejected)
        self._last_commit_s = time.time()
        self._batches, self._commits_s = self._batches + 1, self._commits_s + took_s
        self._within = [count + (took_s <= most_s) for count, most_s in zip(self._within, BUCKETS_S, strict=True)]

    def text(self, heard: int | None) -> bytes:
        """All of it; `heard`: how many aircraft were within a day, None: the database does not say."""
        return "".join(f"{line}\n" for line in self._lines(heard)).encode()

    def _lines(self, heard: int | None) -> Iterator[str]:
        for name, kind, value, words in (
            ("items_total", "counter", self._items, "Items written into the database, each once."),
            ("items_duplicate_total", "counter", self._duplicates, "Items that were there already, or came twice."),
            ("payloads_rejected_total", "counter", self._rejected, "Payloads kept aside in the table rejected."),
            ("connections_total", "counter", self.connections, "Connections to the broker."),
            ("connected", "gauge", int(self.connected), "Whether the broker is reached."),
            ("last_commit_timestamp_seconds", "gauge", self._last_commit_s, "When a batch was written last; 0: never."),
            ("aircraft_heard", "gauge", heard, "Aircraft heard within the last day, by any collector."),
        ):
            if value is not None:
                yield from _head(name, kind, words)
                yield f"companion_fleet_{name} {value}"
        yield from _head("commit_seconds", "histogram", "Time that a batch took to be committed.")
        for most_s, count in (*zip(BUCKETS_S, self._within, strict=True), ("+Inf", self._batches)):
            yield f'companion_fleet_commit_seconds_bucket{{le="{most_s}"}} {count}'
        yield f"companion_fleet_commit_seconds_sum {self._commits_s}"
        yield f"companion_fleet_commit_seconds_count {self._batches}"


def _head(name: str, kind: str, words: str) -> tuple[str, str]:
    return f"# HELP companion_fleet_{name} {words}", f"# TYPE companion_fleet_{name} {kind}"
