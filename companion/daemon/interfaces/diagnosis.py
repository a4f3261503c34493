"""Diagnosis: why the autopilot refuses to arm, which sensor is the cause, and what mends it."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import time
from collections.abc import AsyncIterator
from typing import Final

import numpy as np

from companion.autopilot.firmware.imu_calibration import MAX_ACCEL_RESIDUAL_M_S2, MAX_GYRO_RESIDUAL_RAD_S
from companion.autopilot.vehicle import prearm
from companion.autopilot.vehicle.prearm import DEGC, Limits, Means, OddSensor, Sensor
from companion.commands import Calibrate, Fix
from companion.daemon.calibrating.subsystem import Calibrating, accepted
from companion.daemon.core import Core
from companion.daemon.devices.subsystem import Devices
from companion.daemon.heading.subsystem import PoseNow
from companion.daemon.job import FIRMWARE, Job
from companion.daemon.offsets.subsystem import Offsets
from companion.errors import AutopilotError, CalibrationRefusedError
from companion.estimation.machine import What
from companion.formats import Object
from companion.messages import message
from companion.physics.frames import Array, body_from_ned
from companion.physics.units import DEG, G
from companion.samples import Triad, rows_of

logger = logging.getLogger(__name__)

AGREES: Final = 0.5  # Error over the firmware's threshold below which a sensor is no culprit
CHANGED: Final = {"gyro": 1.0 * DEG, "accel": 0.3}  # Changes of a bias, rad/s and m/s^2, that no usual part shows
MENDED: Final = {"gyro": MAX_GYRO_RESIDUAL_RAD_S, "accel": MAX_ACCEL_RESIDUAL_M_S2}
_UNITS: Final = {"gyro": (DEG, " deg/s", 1), "accel": (1.0, " m/s^2", 2), "compass": (DEG, " deg", 0)}
_FIX: Final = {"gyro": "gyros", "accel": "accelerometers"}


class Diagnosis:
    """Explains the autopilot's reasons against arming; `run` updates `findings`."""

    def __init__(self, core: Core, devices: Devices, offsets: Offsets, calibrating: Calibrating, pose: PoseNow) -> None:
        self._core, self._vehicle, self._imus, self._pose = core, core.vehicle, devices.imus, pose
        self._offsets, self._calibrating = offsets, calibrating
        self._watch = prearm.PrearmWatch(core.vehicle)
        self._limits: dict[str, float] = {}
        self.findings: list[Object] = []  # One for each reason against arming, the most important first

    async def run(self) -> None:
        while True:
            try:
                now_s = asyncio.get_running_loop().time()
                reasons = self._watch.step(now_s)
                means = self._watch.compare(now_s) if any(one.cause and one.cause.sensors for one in reasons) else {}
                self._limits = self._limits if reasons else {}
                self.findings = [await self._explain(reason, means, now_s) for reason in reasons]
            except Exception:
                self.findings = []
                logger.exception("the diagnosis failed")
                await asyncio.sleep(60.0)  # a fault here must not fill the log
            await asyncio.sleep(0.5)

    async def answer_fix(self, _asked: Fix, face: str) -> AsyncIterator[Object]:
        fix = next((finding["fix"] for finding in self.findings if finding["fix"]), None)
        if fix is None:
            none = "no remedy that the companion can carry out: type `companion status`"
            raise CalibrationRefusedError(none if self.findings else "nothing to fix: the autopilot names no reason")
        if fix == FIRMWARE:
            job, work = Job(FIRMWARE, What.GYROS, f"{face} fix"), self._offsets.calibrate_by_firmware
            job = accepted(self._calibrating.manager.start_job(job, work, None))
            replies = self._calibrating.to_end(job, "product")
        else:
            replies = self._calibrating.commands()["calibrate"](Calibrate.read({"what": fix, "wait": True}), face)
        async for reply in replies:
            yield reply

    async def _explain(self, reason: prearm.Reason, means: Means, now_s: float) -> Object:
        """Return text, line for people, remedy (empty: none known), and the work of `companion fix` (empty: none)."""
        cause, minutes = reason.cause, int((now_s - reason.since_s) / 60.0)
        words, remedy, fix, waits = "", "", "", False
        if cause is not None:
            remedy, fix, waits = cause.remedy + (": type `companion fix`" if cause.fix else ""), cause.fix, cause.waits
            for sensor, limits in cause.sensors.items():
                odd, limit = self._odd(sensor, means), await self._limit(sensor, limits)
                if odd is not None and abs(odd[2]) > AGREES * limit:
                    words, remedy, fix = self._blame(sensor, odd, means, limit, cause.remedy)
                    break
        line = ": ".join(filter(None, (reason.text, words))) + (f"; for {minutes} min" if minutes else "")
        return {"text": reason.text, "line": line, "remedy": remedy, "fix": fix, "waits": waits}

    async def _limit(self, sensor: Sensor, limits: Limits) -> float:
        """Return the firmware's threshold, rad/s, m/s^2 or rad; infinite: it has none."""
        name, value = limits.get(str(self._vehicle.firmware), ("", math.inf))
        if name and name not in self._limits:
            with contextlib.suppress(AutopilotError):
                self._limits[name] = await self._core.parameters.read_optional(name) or value
        return self._limits.get(name, value) * (DEG if sensor == "compass" else 1.0)

    def _odd(self, sensor: Sensor, means: Means) -> OddSensor | None:
        if sensor != "compass":
            return prearm.odd_imu(means, sensor, self._up())
        heading_deg = None if self._core.config.compass is None else (self._pose.now() or {}).get("heading_deg")
        return prearm.odd_compass(means, None if heading_deg is None else heading_deg * DEG)

    def _up(self) -> Array | None:
        """Return the unit vector up, (3,), vehicle FRD, by the gradienter; None: there is none."""
        pose = None if self._core.config.gradienter is None else self._pose.now()
        return None if pose is None else -body_from_ned(pose["roll_deg"] * DEG, pose["pitch_deg"] * DEG, 0.0)[:, 2]

    def _blame(self, sensor: Sensor, odd: OddSensor, means: Means, limit: float, remedy: str) -> tuple[str, str, str]:
        """Return description, remedy and fix of a wrong sensor; `remedy`: for one that is undecided."""
        what, (number, axis, size, rest) = "compass" if sensor == "compass" else "IMU", odd
        off, more = _figure(size, sensor), ""
        over = "" if sensor == "compass" else f" (limit {_figure(limit, sensor).partition(' ')[0]})"
        if number is not None and rest:
            more = f", {what} {' and '.join(map(str, rest))} agree{'s' if len(rest) == 1 else ''}"
        if number is not None and sensor != "compass" and (degc := means[number][DEGC]):
            more += f", at {degc:.0f} degC"
        named = f"{what} {number or ' or '.join(map(str, rest))}"
        words = message("prearm_sensor_off", sensor=named, axis=axis, off=off, limit=over, more=more)
        if number is None:
            return words, *self._mending(sensor, size, remedy)
        use = self._vehicle.kind.sensor_switches[sensor].format(number if number > 1 else "", number - 1) + " = 0"
        if sensor == "compass":
            return words, f"check the orientation of compass {number} and calibrate it, or set {use}", ""
        name = next((name for name, imu in self._imus.items() if imu.instance == number), None)
        if name is None:
            return words, f"add an [[imu]] with instance = {number} to companion.toml and calibrate, or set {use}", ""
        remedy = f"replace IMU {number} or set {use}"
        if change := self._change(name, sensor, means[number]):
            return f"{words}; {change}", remedy, ""
        return words, *self._mending(sensor, size, remedy)

    def _mending(self, sensor: str, size: float, otherwise: str) -> tuple[str, str]:
        """Return remedy and fix: our calibration, ArduPilot's own one of gyros, or `otherwise`."""
        kind, fix, seconds = self._vehicle.kind, _FIX.get(sensor, ""), self._core.wanted.settings.min_still_s
        if abs(size) >= MENDED.get(sensor, 0.0):
            on_deck = self._core.config.vehicle.platform == "deck"
            fix = FIRMWARE if sensor == "gyro" and kind.gyro_calibration_resets_ekf and not on_deck else ""
        seconds += kind.write_s
        return (f"calibrating mends it ({seconds:.0f} s, hold still): type `companion fix`" if fix else otherwise), fix

    def _change(self, name: str, triad: Triad, mean: Array) -> str | None:
        """Describe the change of an IMU's whole bias since its last calibration; None if it is usual or unknown."""
        point, calibration = self._calibrating.memory.last(name, triad), self._imus[name].calibration
        truth = np.zeros(3) if triad == "gyro" else self._up()
        if point is None or calibration is None or truth is None:
            return None
        whole = mean[rows_of(triad)] + calibration.subtracted(mean[DEGC] or None)[rows_of(triad)] - G * truth
        change = float(np.abs(whole - point.measured(triad).bias).max())
        if change < CHANGED[triad]:
            return None
        age_h = (time.time() - point.unix_s) / 3600.0
        return f"changed by {_figure(change, triad)} since its calibration (age {age_h:.1f} h)"


def _figure(value: float, sensor: str) -> str:
    scale, unit, digits = _UNITS[sensor]
    return f"{abs(value) / scale:.{digits}f}{unit}"
