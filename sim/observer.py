"""A second pair of eyes: a ground station that looks at the autopilot itself, past the companion.

It believes nothing but what the autopilot sends on its second link.
"""

from __future__ import annotations

import asyncio
from typing import Final, cast

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.earth import Array

RATE_HZ: Final = 100.0
ANSWER_WITHIN_S: Final = 5.0


class Observer(asyncio.DatagramProtocol):
    """Speaks to the autopilot as system 255 over UDP."""

    def __init__(self, autopilot: tuple[str, int]) -> None:
        self._autopilot = autopilot
        self._codec = mavlink.MAVLink(None, srcSystem=255, srcComponent=mavlink.MAV_COMP_ID_MISSIONPLANNER)
        self._codec.robust_parsing = True
        self._transport: asyncio.DatagramTransport | None = None
        self._readings: list[tuple[float, ...]] | None = None
        self._answers: dict[str, asyncio.Future[float]] = {}

    async def open(self) -> None:
        """Open a socket and say hello, so that the autopilot knows where to answer."""
        await asyncio.get_running_loop().create_datagram_endpoint(lambda: self, local_addr=("127.0.0.1", 0))
        self._send(
            mavlink.MAVLink_heartbeat_message(
                mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE, 3
            )
        )

    def close(self) -> None:
        """Close the socket."""
        if self._transport is not None:
            self._transport.close()

    async def mean_imu(self, seconds: float) -> Array:
        """The mean of HIGHRES_IMU over some seconds: three rates (rad/s), three specific forces (m/s^2), FRD.

        Raises:
            TimeoutError: the autopilot does not send it.
        """
        message_id: int = mavlink.MAVLINK_MSG_ID_HIGHRES_IMU
        command: int = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
        self._send(mavlink.MAVLink_command_long_message(1, 1, command, 0, message_id, 1e6 / RATE_HZ, 0, 0, 0, 0, 0))
        self._readings = []
        await asyncio.sleep(seconds)
        readings, self._readings = self._readings, None
        if len(readings) < 0.5 * seconds * RATE_HZ:
            raise TimeoutError(f"only {len(readings)} HIGHRES_IMU came in {seconds:g} s")
        return np.asarray(np.mean(readings, axis=0), dtype=np.float64)

    async def parameter(self, name: str) -> float:
        """Ask for a parameter.

        Raises:
            TimeoutError: the autopilot does not answer.
        """
        answer = self._answers[name] = asyncio.get_running_loop().create_future()
        self._send(mavlink.MAVLink_param_request_read_message(1, 1, name.encode(), -1))
        async with asyncio.timeout(ANSWER_WITHIN_S):
            value: float = await answer
        return value

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Keep the socket."""
        self._transport = cast("asyncio.DatagramTransport", transport)

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        """Take what the autopilot says."""
        del addr
        for message in self._codec.parse_buffer(data) or ():
            if isinstance(message, mavlink.MAVLink_highres_imu_message) and self._readings is not None:
                self._readings.append(
                    (message.xgyro, message.ygyro, message.zgyro, message.xacc, message.yacc, message.zacc)
                )
            elif isinstance(message, mavlink.MAVLink_param_value_message):
                answer = self._answers.get(message.param_id)
                if answer is not None and not answer.done():
                    answer.set_result(float(message.param_value))

    def error_received(self, exc: Exception) -> None:
        """Nobody listens at the moment: the next request tells."""

    def _send(self, message: mavlink.MAVLink_message) -> None:
        assert self._transport is not None
        data = message.pack(self._codec)
        self._codec.seq = (self._codec.seq + 1) % 256
        self._transport.sendto(data, self._autopilot)
