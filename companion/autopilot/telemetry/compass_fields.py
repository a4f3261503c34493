"""Fields of the autopilot's compasses, from its IMU messages, while an alignment of them runs."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections import defaultdict, deque
from collections.abc import AsyncIterator, Iterator
from typing import Any, Final, NamedTuple

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.vehicle.vehicle import Vehicle
from companion.links.mavlink.link import MavlinkLink, Message
from companion.physics.frames import Array

SELECTED: Final = 0
"""Number of the corrected field of the compass in use, which both firmwares send in HIGHRES_IMU, in gauss."""
_CORRECTED: Final = mavlink.MAVLink_highres_imu_message
_RIVAL: Final = -1
_RIVAL_S: Final = 3.0  # Age of the latest message of a rival up to which it counts as running
RATE_HZ: Final = 5.0
LISTEN_S: Final = 1.0
LEAST: Final = 5
_MOST_GAUSS: Final = 100.0  # ArduPilot before 4.8 sends 1e6 times the gauss in HIGHRES_IMU
_KEPT: Final = 8192
_MILLIGAUSS: Final = 1e-3
_CUT_GAUSS: Final = 0.5 * _MILLIGAUSS
"""Mean share that is lost by cutting milligauss off toward zero; the sigma of what is cut off is 0.29 mG."""
_DIGIT_SIGMA_GAUSS: Final = 0.29 * _MILLIGAUSS
_STEP_GAUSS: Final = 0.006
_STEP_SIGMAS: Final = 5.0


class MeanField(NamedTuple):
    """Mean field of a compass with one sigma, gauss, (3,) each, and its largest change between thirds of the time."""

    mean_gauss: Array
    sigma_gauss: Array
    change_gauss: float
    """0 if it may be chance."""


class CompassFields:
    """Collects the messages with fields while `heard`; `asked` requests those that do not come by themselves."""

    def __init__(self, link: MavlinkLink, vehicle: Vehicle) -> None:
        self._link, self._vehicle = link, vehicle
        self._seen: dict[int, deque[tuple[float, Array]]] = defaultdict(lambda: deque(maxlen=_KEPT))
        self._rival_s = -math.inf

    @contextlib.contextmanager
    def heard(self) -> Iterator[dict[int, type[Message]]]:
        """Collect the messages that arrive; yield the message of each compass."""
        self._seen.clear()
        kind = self._vehicle.kind
        wanted = {**kind.compass_messages, **({SELECTED: _CORRECTED} if kind.compass_messages else {})}
        if kind.compass_rival is not None:
            wanted[_RIVAL] = kind.compass_rival
        with contextlib.ExitStack() as stack:
            for message in set(wanted.values()):
                stack.callback(self._link.subscribe(message, self._on_message))
            yield wanted

    @contextlib.asynccontextmanager
    async def asked(self) -> AsyncIterator[None]:
        """Collect messages; request those that do not arrive, and restore the firmware's own rates at the end."""
        commands, missing = self._vehicle.commands, list[type[Message]]()
        with self.heard() as wanted:
            try:
                await asyncio.sleep(LISTEN_S)
                if not self._vehicle.kind.raw_fields:
                    wanted.pop(SELECTED, None)
                missing += [message for number, message in wanted.items() if number not in self._seen]
                for message in missing:
                    commands.request_message_interval(message.id, RATE_HZ)
                yield
            finally:
                for message in missing:
                    commands.send(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, message.id, 0.0)  # the firmware's own rate

    @property
    def rival_runs(self) -> bool:
        """True while the autopilot's own calibration of a compass runs; it would replace what we write."""
        return asyncio.get_running_loop().time() < self._rival_s + _RIVAL_S

    def mean(self, number: int, since_s: float, until_s: float = math.inf) -> MeanField | None:
        """Return the mean field of a compass over a time; None: too few messages."""
        taken = [field for t_s, field in self._seen[number] if since_s <= t_s <= until_s]
        if len(taken) < LEAST:
            return None
        fields = np.array(taken)
        scatter = fields.std(axis=0, ddof=1)
        sigma = np.hypot(scatter / math.sqrt(len(fields)), _DIGIT_SIGMA_GAUSS)
        thirds = np.array([third.mean(axis=0) for third in np.array_split(fields, 3)])
        change = float(np.ptp(thirds, axis=0).max())
        chance = _STEP_SIGMAS * float(scatter.max()) * math.sqrt(3.0 / len(fields))
        return MeanField(fields.mean(axis=0), sigma, change if change > max(chance, _STEP_GAUSS) else 0.0)

    def _on_message(self, message: Any, t_s: float) -> None:
        if not self._vehicle.sent(message):
            return
        kind = self._vehicle.kind
        if type(message) is kind.compass_rival:
            self._rival_s = t_s
            return
        field = np.array([message.xmag, message.ymag, message.zmag], dtype=np.float64)
        if not np.isfinite(field).all() or not field.any():
            return
        if type(message) is _CORRECTED:
            self._seen[SELECTED].append((t_s, field * (1e-6 if np.abs(field).max() > _MOST_GAUSS else 1.0)))
        for number, of in kind.compass_messages.items():
            if type(message) is of:
                self._seen[number].append((t_s, field * _MILLIGAUSS + _CUT_GAUSS * np.sign(field)))
