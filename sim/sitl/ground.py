"""A ground station for tests and tables: its own heartbeat, parameters of both firmwares, means of telemetry."""

from __future__ import annotations

import asyncio
import struct
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from typing import Literal

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.earth import STANDARD_GRAVITY_M_S2, Array
from sim.station import M, Station

Firmware = Literal["ardupilot", "px4"]
ANSWER_S = 1.0
TRIES = 4
KEPT_MESSAGES = 200_000
_AT_ONCE = 20
_INTEGERS = (
    mavlink.MAV_PARAM_TYPE_INT8,
    mavlink.MAV_PARAM_TYPE_UINT8,
    mavlink.MAV_PARAM_TYPE_INT16,
    mavlink.MAV_PARAM_TYPE_UINT16,
    mavlink.MAV_PARAM_TYPE_INT32,
    mavlink.MAV_PARAM_TYPE_UINT32,
)


class GroundStation(Station):
    """A `Station` that a firmware accepts as a ground station (or, with `kind` 18, as a companion).

    Args:
        firmware: sets the encoding of integers in PARAM_VALUE: as numbers (ArduPilot) or byte by byte (PX4);
            autopilots 7.5.
        kind: MAV_TYPE in its heartbeat; PX4 sends STATUSTEXT only where it hears MAV_TYPE_GCS (autopilots 9.3.2).
    """

    def __init__(
        self,
        firmware: Firmware,
        *,
        system_id: int = 255,
        component_id: int = 190,
        kind: int = mavlink.MAV_TYPE_GCS,
        vehicle: int = 1,
    ) -> None:
        super().__init__(system_id, component_id, vehicle)
        self.firmware, self.kind = firmware, kind
        self._types: dict[str, int] = {}

    def texts_since(self, since_s: float) -> str:
        """Return all STATUSTEXT of the vehicle after an instant (loop time), with chunks joined."""
        return "".join(message.text for message in self.all(mavlink.MAVLink_statustext_message, since_s=since_s))

    async def run(self) -> None:
        """Send a heartbeat a second until cancelled; drop the oldest messages when there are too many."""
        while True:
            self.heartbeat(self.kind)
            if len(self.heard) > KEPT_MESSAGES:
                del self.heard[: KEPT_MESSAGES // 2]
            await asyncio.sleep(1.0)

    async def wait_for(self, condition: Callable[[], bool], within_s: float, what: str) -> None:
        loop = asyncio.get_running_loop()
        deadline_s = loop.time() + within_s
        while not condition():
            if loop.time() > deadline_s:
                raise TimeoutError(f"{what}: not within {within_s:g} s")
            await asyncio.sleep(0.01)

    async def wait_message(self, kind: type[M], within_s: float, *, since_s: float = 0.0) -> M:
        """Return the newest message of a kind after `since_s` (loop time), waiting for it."""
        await self.wait_for(lambda: bool(self.all(kind, since_s=since_s)), within_s, kind.__name__)
        return self.all(kind, since_s=since_s)[-1]

    def vehicle_heartbeats(self, since_s: float = 0.0) -> list[mavlink.MAVLink_heartbeat_message]:
        return [
            message
            for message in self.all(mavlink.MAVLink_heartbeat_message, since_s=since_s)
            if message.get_srcSystem() == self.vehicle and message.get_srcComponent() == 1
        ]

    # Parameters.

    async def get(self, name: str) -> float:
        request = mavlink.MAVLink_param_request_read_message(self.vehicle, 1, name.encode(), -1)
        return await self._answer_to(name, lambda: self.send(request))

    async def put(self, name: str, value: float) -> float:
        """Set a parameter; return the firmware's value afterwards."""
        if name not in self._types:
            await self.get(name)
        return await self._answer_to(name, lambda: self.send_put(name, value))

    async def _answer_to(self, name: str, request: Callable[[], None]) -> float:
        """Send a request until a PARAM_VALUE of this name comes; raise KeyError if none comes, or an error."""
        for _ in range(TRIES):
            since_s = asyncio.get_running_loop().time()
            request()
            try:
                await self.wait_for(lambda: bool(self._answers(name, since_s)), ANSWER_S, name)  # noqa: B023
            except TimeoutError:
                if self.parameter_errors(name, since_s):
                    break
                continue
            return self._answers(name, since_s)[-1]
        raise KeyError(name)

    def send_put(self, name: str, value: float, kind: int | None = None) -> None:
        """Send PARAM_SET in the firmware's encoding, with the type received before (else REAL32), without waiting."""
        kind = self._types.get(name, mavlink.MAV_PARAM_TYPE_REAL32) if kind is None else kind
        if self.firmware == "px4" and kind in _INTEGERS:
            value = struct.unpack("<f", struct.pack("<i", round(value)))[0]
        self.send(mavlink.MAVLink_param_set_message(self.vehicle, 1, name.encode(), value, kind))

    async def put_all(self, values: dict[str, float]) -> None:
        for name, value in values.items():
            await self.put(name, value)

    async def whole_list(self, within_s: float = 60.0) -> dict[str, float]:
        """Read every parameter that the autopilot lists; request lost ones by index."""
        loop = asyncio.get_running_loop()
        since_s, deadline_s = loop.time(), loop.time() + within_s
        self.send(mavlink.MAVLink_param_request_list_message(self.vehicle, 1))
        seen = 0
        while loop.time() < deadline_s:
            await asyncio.sleep(1.0)
            listed = self._listed(since_s)
            missing = set(range(max((m.param_count for m in listed.values()), default=0))) - {
                message.param_index for message in listed.values()
            }
            if listed and not missing:
                return {name: self._value(message) for name, message in listed.items()}
            if not listed:
                self.send(mavlink.MAVLink_param_request_list_message(self.vehicle, 1))
            elif len(listed) == seen:
                for index in sorted(missing)[:_AT_ONCE]:
                    self.send(mavlink.MAVLink_param_request_read_message(self.vehicle, 1, b"", index))
            seen = len(listed)
        raise TimeoutError(f"the list of parameters is not complete after {within_s:g} s")

    def _listed(self, since_s: float) -> dict[str, mavlink.MAVLink_param_value_message]:
        return {
            _text(message.param_id): message
            for message in self.all(mavlink.MAVLink_param_value_message, since_s=since_s)
            if message.param_index != 65535 and message.get_srcComponent() == 1
        }

    @asynccontextmanager
    async def restored(self, *names: str) -> AsyncIterator[dict[str, float]]:
        """Store parameters, and restore them at the end in the same order."""
        before = {name: await self.get(name) for name in names}
        try:
            yield dict(before)
        finally:
            await self.put_all(before)

    def parameter_errors(self, name: str, since_s: float = 0.0) -> list[int]:
        return [
            int(message.error)
            for message in self.all(mavlink.MAVLink_param_error_message, since_s=since_s)
            if _text(message.param_id) == name
        ]

    def _answers(self, name: str, since_s: float) -> list[float]:
        values = []
        for message in self.all(mavlink.MAVLink_param_value_message, since_s=since_s):
            if _text(message.param_id) == name and message.get_srcComponent() == 1:
                self._types[name] = message.param_type
                values.append(self._value(message))
        return values

    def _value(self, message: mavlink.MAVLink_param_value_message) -> float:
        if self.firmware == "px4" and message.param_type in _INTEGERS:
            return float(struct.unpack("<i", struct.pack("<f", message.param_value))[0])
        return float(message.param_value)

    # Telemetry.

    async def stream(self, message_id: int, rate_hz: float) -> int:
        """Send SET_MESSAGE_INTERVAL on this link; return the result. Rate 0 stops the stream."""
        interval_us = 1e6 / rate_hz if rate_hz > 0.0 else -1.0
        return await self.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, message_id, interval_us)

    async def arm(self, *, arm: bool = True, force: bool = False, wait_s: float = 10.0) -> int:
        """Send MAV_CMD_COMPONENT_ARM_DISARM; return the result, -1 without an answer."""
        return await self.command(
            mavlink.MAV_CMD_COMPONENT_ARM_DISARM, float(arm), 21196.0 if force else 0.0,
            wait_s=wait_s,
        )  # fmt: skip

    async def collect(self, kind: type[M], seconds: float) -> list[M]:
        loop = asyncio.get_running_loop()
        since_s = loop.time()
        await asyncio.sleep(seconds)
        return self.all(kind, since_s=since_s)

    async def imu(self, kind: type[mavlink.MAVLink_message], seconds: float, *, rate_hz: float = 100.0) -> Array:
        """Return readings (n, 6) of an IMU message: rates in rad/s, specific forces in m/s^2. The stream stays on."""
        result = await self.stream(kind.id, rate_hz)
        await asyncio.sleep(0.1)
        seen = await self.collect(kind, seconds)
        if len(seen) < 0.25 * seconds * rate_hz:
            raise RuntimeError(f"{kind.msgname}: {len(seen)} in {seconds:g} s; result of the request: {result}")
        return np.array([imu_row(message) for message in seen])


def imu_row(message: mavlink.MAVLink_message) -> Sequence[float]:
    """Return three rates (rad/s) and three specific forces (m/s^2) of HIGHRES_IMU, RAW_IMU or SCALED_IMU*."""
    row = [getattr(message, name) for name in ("xgyro", "ygyro", "zgyro", "xacc", "yacc", "zacc")]
    if message.get_type() == "HIGHRES_IMU":
        return row
    return [value * 1e-3 for value in row[:3]] + [value * 1e-3 * STANDARD_GRAVITY_M_S2 for value in row[3:]]


def _text(name: str | bytes) -> str:
    return name.decode(errors="replace").rstrip("\0") if isinstance(name, bytes) else name.rstrip("\0")
