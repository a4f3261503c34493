"""Countdown to the end of a warm-up: a calibration made earlier does not last.

A warm-up ends when its rest stays below the limits of `validity.judge`: by the curve over temperature, otherwise a
number of kelvins. Gyros are no thermometer: their curve bends, and their wander hides the end.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
from collections import deque
from collections.abc import Mapping
from functools import partial
from typing import Final

import numpy as np

from companion.autopilot.vehicle.vehicle import ArmState
from companion.component.statustext import Severity
from companion.daemon.biases import BiasMemory
from companion.daemon.core import Core
from companion.errors import AutopilotError
from companion.estimation.means.until_steady import UntilSteady, lasting_k, until_steady
from companion.estimation.records.validity import DRIFT_SIGMAS
from companion.formats import Object
from companion.messages import message
from companion.physics.frames import Array
from companion.samples import TRIADS, Triad

logger = logging.getLogger(__name__)

MEAN_S: Final = 10  # Seconds in one mean, and between two predictions
SAY_EVERY_S: Final = 30.0
_HISTORY_S: Final = 600


class WarmUp:
    """Predicts the end of a warm-up while the aircraft is disarmed; `run` also announces it."""

    def __init__(self, core: Core, memory: BiasMemory) -> None:
        self._core, self._memory = core, memory
        self._history: dict[str, deque[tuple[int, float]]] = {}  # By IMU, each second: its number, and temperature
        self._heater: tuple[int, dict[str, float]] = (-1, {})  # Number of autopilot starts, and parameters read then
        self._last: tuple[str, float, UntilSteady] | None = None
        """IMU that is steady last, event-loop time of its latest temperature, and the prediction from then on."""
        self._said, self._said_s = "", -math.inf
        core.collector.on_second.append(self._add_second)

    def _add_second(self) -> None:
        for name, batch in self._core.collector.imu_seconds().items():
            history = self._history.setdefault(name, deque(maxlen=_HISTORY_S))
            if history and batch.slot > history[-1][0] + MEAN_S:
                history.clear()  # The board may have been off.
            if batch.temperature_degc is not None and (not history or batch.slot > history[-1][0]):
                history.append((batch.slot, batch.temperature_degc))

    def _predict(self, tables: Mapping[str, Array]) -> tuple[str, float, UntilSteady] | None:
        """Predict for every IMU, and return the one that is steady last; None: none is warming. Takes milliseconds."""
        found = []
        for name, table in tables.items():
            at_s, degc = table[len(table) % MEAN_S :].reshape(-1, MEAN_S, 2).mean(axis=1).T
            tau_s, target = self._memory.settling.get(name), self._heater_of(name).get("target")
            one = until_steady(at_s, degc, partial(self._limit_k, name), tau_s=tau_s, target=target)
            if one is not None:
                found.append((name, float(at_s[-1]), one))
        return max(found, key=lambda each: each[1] + each[2].high_s, default=None)

    def _limit_k(self, name: str, end_degc: float) -> float:
        """Return the distance from the end of a warm-up, K, within which a calibration lasts."""
        wanted, config = self._core.wanted.settings, self._core.config
        goals: dict[Triad, float] = {"gyro": wanted.target_gyro_sigma_rad_s, "accel": wanted.target_accel_sigma_m_s2}
        limits_k = [self._heater_of(name).get("margin", math.inf)]
        for triad in TRIADS if config.gradienter is not None else TRIADS[:1]:
            drift, allowed = partial(self._memory.drift, name, triad), DRIFT_SIGMAS * goals[triad]
            limits_k.append(lasting_k(drift, end_degc, allowed, config.calibration.max_temperature_change_degc))
        return min(limits_k)

    def _heater_of(self, name: str) -> dict[str, float]:
        """Return `target`, degC, and `margin`, K, of the autopilot's heater for one of its IMUs, as far as set."""
        own = any(imu.name == name and imu.source == "autopilot" for imu in self._core.config.imu)
        return self._heater[1] if own else {}

    async def _read_heater(self) -> None:
        names = self._core.vehicle.kind.heater_parameters
        self._heater = self._core.vehicle.boots, {}
        with contextlib.suppress(AutopilotError):
            found = await self._core.parameters.read_many(names.values(), optional=True)
            self._heater[1].update({key: found[name] for key, name in names.items() if found.get(name, 0.0) > 0.0})

    async def run(self) -> None:
        while True:
            await asyncio.sleep(MEAN_S)
            try:
                tables = {name: np.array(rows) for name, rows in self._history.items()}
                is_disarmed = self._core.vehicle.arm_state is ArmState.DISARMED
                self._last = await self._core.offload(self._predict, tables) if is_disarmed else None
                self._announce(asyncio.get_running_loop().time(), is_disarmed=is_disarmed)
                if self._last is not None and self._heater[0] != self._core.vehicle.boots:
                    await self._read_heater()
            except Exception:
                logger.exception("predicting the end of a warm-up failed")

    def _announce(self, now_s: float, *, is_disarmed: bool) -> None:
        """Send the time left at most every 30 s, and once the end."""
        words = self.words() or ""
        if not is_disarmed or self._core.wanted.at_arm == "off":
            self._said = ""
        elif words != self._said and now_s - self._said_s >= SAY_EVERY_S:
            self._said, self._said_s = words, now_s
            self._core.say(Severity.INFO if words else Severity.NOTICE, words or "Warm-up over")

    def _now(self) -> tuple[str, UntilSteady] | None:
        if self._last is None:
            return None
        name, at_s, found = self._last
        found = found.later(asyncio.get_running_loop().time() - at_s)
        return (name, found) if found.high_s > 0.0 else None

    def words(self) -> str | None:
        """Return the time left as text; None: no warm-up is seen, or it no longer matters."""
        if (now := self._now()) is None:
            return None
        name, found = now
        if (figure := found.figure_s) is not None:
            words = f"{figure[0] / 60.0:.1f} +- {max(figure[1] / 60.0, 0.1):.1f} min"
        else:
            low, high = math.floor(found.low_s / 60.0), math.ceil(found.high_s / 60.0)
            words = f"{f'{low} to' if low else '<'} {high} min"
        change = f"{'warms' if found.k_s > 0.0 else 'cools'} {abs(found.k_s) * 60.0:.1f} K"
        return message("warm_up_left", left=words, imu=name, change=change)

    def status(self) -> Object | None:
        if (now := self._now()) is None:
            return None
        return {"imu": now[0], "low_s": round(now[1].low_s), "high_s": round(now[1].high_s), "words": self.words()}
