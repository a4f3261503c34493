"""The autopilot's IMU samples out of its raw bytes: which messages counted, the recording says."""

from __future__ import annotations

from collections import deque
from typing import Any, Final

import msgspec

from companion.autopilot.telemetry import imu_messages
from companion.autopilot.telemetry.imu_messages import ImuMessage, Reading
from companion.links.mavlink.link import MavlinkLink
from companion.recording import topics
from companion.samples import ImuSample

PENDING: Final = 4000
"""Telemetry that nobody has counted yet is remembered so long."""

_NOT_THE_SAME: Final = "a sample does not decode as it did"
_NOT_THERE: Final = "a sample is not in the MAVLink bytes"


class Telemetry:
    """Decodes what came over the link, and finds in it the samples that went into the collector."""

    def __init__(self) -> None:
        self._link = MavlinkLink()
        self._pending: dict[str, deque[tuple[float, Reading]]] = {}
        for each in {*sum(imu_messages.ARDUPILOT.values(), ()), *sum(imu_messages.PX4.values(), ())}:
            self._listen(each)

    def _listen(self, kind: ImuMessage) -> None:
        pending = self._pending[kind.kind.message] = deque(maxlen=PENDING)

        def take(message: Any, t_s: float) -> None:
            reading = kind.decode(message)
            if isinstance(reading, Reading):
                pending.append((t_s, reading))

        self._link.subscribe(kind.message, take)

    def receive(self, data: bytes | None, t_s: float) -> None:
        """Bytes that came; None: the link was opened anew."""
        if data is None:
            self._link.attach(None)
        else:
            self._link.receive(data, t_s)

    def sample(self, entry: topics.ImuEntry) -> tuple[ImuSample, str | None]:
        """The sample of the autopilot that was recorded so, from its message; and what is strange about that, if so."""
        pending = self._pending.get(entry.message or "")
        while pending:
            t_s, reading = pending.popleft()
            if reading.t_device_s == entry.t_device_s:
                sample = ImuSample(
                    t_s, reading.gyro_rad_s, reading.accel_m_s2, entry.temperature_degc, None, reading.t_device_s
                )
                # As the recording wrote it.
                again = msgspec.json.decode(topics.imu_json(sample, entry.message), type=topics.ImuEntry)
                return sample, _NOT_THE_SAME if again != entry else None
        sample = ImuSample(
            entry.t_s, entry.gyro_rad_s, entry.accel_m_s2, entry.temperature_degc, None, entry.t_device_s
        )
        return sample, _NOT_THERE
