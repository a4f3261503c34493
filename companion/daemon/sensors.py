"""The companion's own devices: a port, a decoder, and where the samples go."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from typing import Final, Literal

from companion.links.bytestream import ByteLink, PortSettings
from companion.protocols.registry import PROTOCOLS, make_decoder
from companion.samples import Sample

SILENT_AFTER_S: Final = 3.0
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
        self.link = ByteLink(settings, self.receive, name=name, on_state=self._on_state)
        self.tap: Callable[[str, bytes | None, float], object] | None = None
        """Called with (name, bytes, time) before they are decoded; without bytes: some are missing."""
        self._take = take
        self.on_samples: Callable[[Sequence[Sample]], object] | None = None
        """Called with all samples of a read before anybody else gets them: for what must not wait."""
        self._last_sample_s: float | None = None
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

    def receive(self, data: bytes, t_s: float) -> None:
        """Take bytes that were read at `t_s`."""
        if self.tap is not None:
            self.tap(self.name, data, t_s)
        samples = self.decoder.feed(data, t_s)
        if not samples:
            return
        if self.on_samples is not None:
            self.on_samples(samples)
        self._last_sample_s = t_s
        since_s, before = self._counted
        if t_s - since_s >= RATE_SPAN_S:
            self._rate_hz = (self.decoder.accepted - before) / (t_s - since_s) if before else 0.0
            self._counted = (t_s, self.decoder.accepted)
        for sample in samples:
            self._take(sample)

    @property
    def problem(self) -> str | None:
        """What is wrong with it in one line, or None while samples come."""
        now_s = asyncio.get_running_loop().time()
        port = self.link.settings
        if not self.link.connected:
            return self.link.last_error or f"{port.url}: not open yet"
        if self._last_sample_s is not None and now_s - self._last_sample_s < SILENT_AFTER_S:
            return None
        line = f"{port.url} at {port.baud} baud, parity {port.parity}" if not port.is_tcp else port.url
        if self.link.last_byte_s is None or now_s - self.link.last_byte_s >= SILENT_AFTER_S:
            return f"{line}: silent (power? wiring? told to stop?)"
        rejected = ", ".join(f"{count} {reason}" for reason, count in self.decoder.rejected.most_common(3))
        return (
            f"{line}: bytes come, but no {self.protocol} frames ({rejected or 'none begun'}); wrong baud or protocol?"
        )

    def status(self) -> dict[str, object]:
        """For `companion status` and `check`."""
        problem = self.problem
        summary = problem or f"{self.protocol} on {self.link.settings.url}, {self._rate_hz:.0f} frames/s"
        return {
            "name": self.name,
            "kind": self.kind,
            "good": problem is None,
            "summary": summary,
            "frames": self.decoder.accepted,
            "rejected": dict(self.decoder.rejected),
            "reconnects": self.link.reconnects,
        }
