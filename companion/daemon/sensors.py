"""The companion's own devices: a port, a decoder, and where the samples go."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Final, Literal

from companion.daemon.sensor_health import SensorHealth
from companion.links.budget import Budget
from companion.links.bytestream import ByteLink, PortSettings
from companion.protocols.registry import PROTOCOLS, make_decoder
from companion.samples import Sample

RATE_SPAN_S: Final = 2.0


class SerialSensor:
    """One serial device."""

    def __init__(
        self,
        name: str,
        kind: Literal["imu", "gradienter", "compass"],
        *,
        port: str,
        protocol: str,
        baud: int | None,
        parity: Literal["none", "even", "odd"] | None,
        take: Callable[[Sample], None],
    ) -> None:
        info = PROTOCOLS[kind][protocol]
        settings = PortSettings(port, baud or info.baud, parity or info.parity)
        self.name, self.kind, self.protocol = name, kind, protocol
        self.decoder = make_decoder(kind, protocol, settings.seconds_per_byte)
        self.link = ByteLink(settings, self.receive, name=name, on_state=self._on_state, budget=Budget())
        self.link.on_gap = self._on_gap
        self.health = SensorHealth(self.link, kind, protocol, self.decoder, polled=info.dialogue is not None)
        self.tap: Callable[[str, bytes | None, float], object] | None = None
        """Called with (name, bytes, time) before they are decoded; without bytes: some are missing."""
        self._take = take
        self._counted = (0.0, 0)
        self._rate_hz = 0.0

    async def run(self) -> None:
        """Read until cancelled."""
        await self.link.run()

    def _on_state(self, connected: bool, reason: str) -> None:  # noqa: FBT001 - ByteLink's signature
        del reason
        if connected:
            if self.tap is not None:
                self.tap(self.name, None, asyncio.get_running_loop().time())
            self.decoder.interrupted()
            self.health.opened()

    def _on_gap(self) -> None:
        """Bytes are missing from here on."""
        if self.tap is not None:
            self.tap(self.name, None, asyncio.get_running_loop().time())
        self.decoder.interrupted()

    def receive(self, data: bytes, t_s: float) -> None:
        """Take bytes that were read at `t_s`."""
        if self.tap is not None:
            self.tap(self.name, data, t_s)
        samples = self.decoder.feed(data, t_s)
        self.health.stream.took(data, samples, t_s)
        if not samples:
            return
        since_s, before = self._counted
        if t_s - since_s >= RATE_SPAN_S:
            self._rate_hz = (self.decoder.accepted - before) / (t_s - since_s) if before else 0.0
            self._counted = (t_s, self.decoder.accepted)
        for sample in samples:
            self._take(sample)

    @property
    def problem(self) -> str | None:
        """What is wrong with it in one line, or None while samples come."""
        return self.health.words(asyncio.get_running_loop().time())

    def status(self) -> dict[str, object]:
        """For `companion status` and `check`."""
        problem = self.problem
        summary = problem or f"{self.protocol} on {self.link.settings.url}, {self._rate_hz:.0f} frames/s"
        if problem is None and self.health.counts:
            summary += f"; so far {', '.join(f'{count} {key}' for key, count in self.health.counts.items())}"
        return {
            "name": self.name,
            "kind": self.kind,
            "good": problem is None,
            "summary": summary,
            "frames": self.decoder.accepted,
            "rejected": dict(self.decoder.rejected),
            "reconnects": self.link.reconnects,
            **self.health.status(),
        }
