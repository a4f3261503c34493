"""Biases of each IMU from earlier calibrations and windows without motion, and the prediction of its present biases.

A change of sensor, profile or mounting voids the stored biases. The last calibration since power-up predicts best.
"""

from __future__ import annotations

import asyncio
import dataclasses
import logging
import math
import os
import time
from collections.abc import Collection, Mapping, Sequence
from typing import Final

import msgspec
import numpy as np

from companion.config.sections import NoiseProfile
from companion.daemon.core import Core
from companion.daemon.devices.subsystem import Devices
from companion.daemon.poses.alignment import ActiveAlignment
from companion.errors import AutopilotError, StorageError
from companion.estimation.means.warming import Warming
from companion.estimation.noise.allan import noise_profile
from companion.estimation.records.history import Point, PowerUp, by_power_up, kept
from companion.estimation.solution import prior
from companion.estimation.solution.curve import Curve, WindowDrift, settling
from companion.estimation.solution.doubt import Inconsistency
from companion.estimation.solution.joint import weigh
from companion.estimation.solution.results import points
from companion.estimation.solution.solve import ImuSolution, Shared, Solution
from companion.formats import Object
from companion.messages import message
from companion.physics.frames import Array, vector
from companion.samples import TRIADS, Triad, Vector
from companion.storage.records import BiasStore, KnownImu, this_boot

logger = logging.getLogger(__name__)

LOOK_K: Final = 1.0  # Temperatures closer than this count as equal
WRITE_EVERY_S: Final = 60.0  # Minimum time between writes of windows without motion to the disk
_MUCH_BETTER: Final = 0.7
"""Limit on new sigma / stored sigma: below it, a new window replaces the stored window of equal temperature."""
_IN_WORDS: Final = {  # Keys of an identity, as text for people
    "system": "vehicle",
    "gyro": "gyro (device id)",
    "accel": "accelerometer (device id)",
    "scale": "accelerometer scale",
}


class BiasMemory:
    """Predicts the biases of each IMU before a calibration, and stores the measured ones after it."""

    def __init__(self, core: Core, devices: Devices, used: ActiveAlignment) -> None:
        self._config, self._profiles, self._offload = core.config, core.profiles, core.offload
        self._vehicle, self._collector, self._imus, self._alignment = core.vehicle, core.collector, devices.imus, used
        self._sensors = {role.name: sensor for sensor in devices.sensors for role in sensor.roles if role.kind == "imu"}
        self._sources = {imu.name: imu for imu in core.config.imu}
        self._host = this_boot() or os.urandom(8).hex()
        self._curves: dict[tuple[str, Triad], Curve | None] = {}
        self.settling: dict[str, tuple[float, float] | None] = {}  # Warm-up time of each board and its sigma, s
        self._store = BiasStore(core.config.storage.path)
        self._known: dict[str, KnownImu] = {}
        self._today: dict[tuple[str, Triad], tuple[str, Point, int]] = {}
        """Accepted bias by IMU and triad (gyro, accel): power-up id, history point, number of contradictions since."""
        self._now_degc: dict[str, float | None] = {}
        self._written_s = -math.inf

    def load(self) -> None:
        self._known = self._store.read()
        self.follow()

    def follow(self) -> None:
        """Fit curves of bias over temperature to all stored biases; blocking."""
        curves: dict[tuple[str, Triad], Curve | None] = {}
        settles: dict[str, tuple[float, float] | None] = {}
        known = dict(self._known)
        for name in known.keys() & self._sources.keys():
            seen, profile = known[name].points, noise_profile(self._profiles.of(name))
            curves |= {(name, triad): prior.curve_of(seen, triad, profile.of(triad)) for triad in TRIADS}
            groups = by_power_up([point for point in seen if point.temperature_degc is not None])
            settles[name] = settling([[(p.temperature_degc or 0.0, p.k_s) for p in group] for group in groups])
        self._curves, self.settling = curves, settles

    # --- bias over temperature

    def curve(self, name: str, triad: Triad) -> Curve | None:
        return self._curves.get((name, triad))

    def drift(
        self, name: str, triad: Triad, degc: float | None, now_degc: float | None
    ) -> tuple[Vector, Vector] | None:
        """Predict the output's change between two temperatures, and its variance, by axis; None if unknown."""
        curve = self.curve(name, triad)
        if curve is None or degc is None or now_degc is None:
            return None
        mean, variance = curve.change((degc, 0.0), (now_degc, 0.0))
        return vector(mean - self._taken_off(name, triad, degc, now_degc)), vector(variance)

    def _along(self, name: str, triad: Triad, warming: Warming | None) -> WindowDrift | None:
        curve, path = self.curve(name, triad), None if warming is None else warming.path
        if curve is None or path is None:
            return None
        profile = noise_profile(self._profiles.of(name))
        found = curve.along(path, self.settling.get(name), profile.of(triad))
        (start, _), _, (end, _) = path.states
        shift, slope = (self._taken_off(name, triad, degc, end) for degc in (path.mean_degc, start))
        if not shift.any() and not slope.any():
            return found
        left = {"shift": vector(found.shift - shift), "slope": vector(found.slope - slope / path.span_s)}
        return msgspec.structs.replace(found, warm=None, **left)

    def _taken_off(self, name: str, triad: Triad, degc: float, now_degc: float) -> Array:
        """Return the bias change (3,) between two temperatures that the autopilot's thermal calibration removes."""
        calibration = self._imus[name].calibration if name in self._imus else None
        return np.zeros(3) if calibration is None else calibration.thermal_change(triad, degc, now_degc)

    # --- before a result is used

    def with_offsets(self, solution: Solution) -> Solution:
        """Return the solution with the offsets of the autopilot's IMUs; raise AutopilotError if they are unknown."""
        imus = tuple(
            dataclasses.replace(imu, subtracted=self._imus[imu.name].in_force.subtracted(imu.temperature_degc))
            if imu.name in self._imus
            else imu
            for imu in solution.imus
        )
        return dataclasses.replace(solution, imus=imus)

    def forgotten(self) -> dict[str, str]:
        """Delete the stored biases of replaced sensors; return the reason by IMU, as one line of text."""
        found: dict[str, str] = {}
        for name in self._sources:
            if not (what := self._changed(name)):
                continue
            known = self._known.pop(name)
            self._curves = {key: curve for key, curve in self._curves.items() if key[0] != name}
            self.settling.pop(name, None)
            self._today = {key: each for key, each in self._today.items() if key[0] != name}
            if known.points:
                found[name] = message("biases_no_longer_count", changed=f"imu {name}: {what}")
                logger.info("%s", found[name])
        return found

    def why_not_now(self, name: str, started_at: str) -> str | None:
        """Return a reason to doubt that an IMU's bias is unchanged since the calibration of `started_at`, or None."""
        if (point := self._point(name, started_at)) is None:
            return message("imu_changed_since_calibration", event="has lost its history")
        if what := self._changed(name):
            return message("imu_changed_since_calibration", event=f"was changed ({what})")
        # IMUs of the autopilot are not checked: it may have stayed powered while our board was off.
        same = name in self._imus or point.power_up.is_same(self.power_up(name, time.time()))
        return None if same else message("imu_changed_since_calibration", event="was without power")

    def on_since(self, name: str, started_at: str) -> bool:
        point = None if self._changed(name) else self._point(name, started_at)
        return point is not None and point.power_up.started_with(self.power_up(name, time.time()))

    def expectation(self, solution: Solution, unix_s: float) -> prior.Expectation:
        gradienter = self._config.gradienter
        return prior.Expectation(
            imus=tuple(self._expected(imu, solution.shared, unix_s) for imu in solution.imus),
            zero_is_known=self._alignment.used is not None
            or (gradienter is not None and gradienter.sigma_deg is not None),
        )

    def _expected(self, imu: ImuSolution, shared: Shared, unix_s: float) -> prior.ExpectedImu:
        name = imu.name
        record = self._alignment.record if self._alignment.unused is None else None
        aligned = () if record is None else record.imus
        effect = prior.pose_effect(next((each for each in aligned if each.name == name), None))
        if not self._config.calibration.prior:
            return prior.ExpectedImu(name=name, effect=effect)
        now = Point(
            started_at="",
            unix_s=unix_s,
            power_up=self.power_up(name, unix_s),
            temperature_degc=imu.temperature_degc,
            k_s=imu.k_s,
            up=vector(shared.up),
            zero=self._zero(),
        )
        earlier, session = self._points(name), self._session(name)
        profile = noise_profile(self._profiles.of(name))

        def today(triad: Triad) -> prior.Prediction | None:
            then, point, _ = self._today.get((name, triad), (None, now, 0))
            if then != session:
                return None
            return prior.expect_today(point, triad, now, effect, profile.of(triad), self.curve(name, triad))

        return prior.ExpectedImu(
            name=name,
            earlier={triad: prior.expect(earlier, triad, now, effect, profile.of(triad)) for triad in TRIADS},
            today={triad: today(triad) for triad in TRIADS},
            along={triad: self._along(name, triad, imu.warming) for triad in TRIADS},
            effect=effect,
        )

    # --- after a calibration

    def measured(
        self, solution: Solution, doubts: Sequence[Inconsistency], started_at: str, unix_s: float
    ) -> dict[str, Point]:
        """Return a history point for each IMU, from a solution that uses the readings alone and no earlier biases."""
        return points(
            dataclasses.replace(solution, imus=tuple(map(self._at_mean, solution.imus))),
            doubts,
            started_at=started_at,
            unix_s=unix_s,
            power_ups={imu.name: self.power_up(imu.name, unix_s) for imu in solution.imus},
            zero=self._zero(),
        )

    def _at_mean(self, imu: ImuSolution) -> ImuSolution:
        """Apply the autopilot's temperature compensation at the window's mean temperature instead of its last one."""
        degc, end_degc = imu.mean_degc, imu.temperature_degc
        if degc is None or end_degc is None or degc == end_degc:
            return imu
        return imu.shifted(-np.concatenate([self._taken_off(imu.name, t, degc, end_degc) for t in TRIADS]))

    async def keep(self, found: Mapping[str, Point]) -> None:
        """Store the biases of a good calibration; a failure of the disk is only logged."""
        for name, point in found.items():
            # A point without a temperature fits no curve.
            if point.temperature_degc is not None or all(one.temperature_degc is None for one in self._points(name)):
                self._remember(name, (*self._points(name), point))
            for triad in TRIADS:
                self._refer(name, triad, point)
        await self._write()

    async def look(self, solution: Solution) -> None:
        """Store biases if this power-up has none, or only far worse ones, within 1 K of the window's temperature."""
        unix_s = time.time()
        self._now_degc |= {imu.name: imu.temperature_degc for imu in solution.imus}
        news = [imu.name for imu in solution.imus if self._tells_more(imu, unix_s)]
        if not news:
            return
        try:
            solution = self.with_offsets(solution)
        except AutopilotError:
            return
        expectation = await self._offload(self.expectation, solution, unix_s)
        weighed: Solution = await self._offload(weigh, solution, expectation)
        found = self.measured(solution, weighed.doubts, "", unix_s)
        for name in news:
            point = found[name]
            if any(of is not None and of.is_outlier for of in (point.gyro, point.accel)):
                continue
            degc, power_up = point.temperature_degc, point.power_up
            others = [
                earlier
                for earlier in self._points(name)
                if earlier.started_at
                or degc is None
                or not (_is_near(earlier, degc) and earlier.power_up.is_same(power_up))
            ]
            self._remember(name, (*others, point))
        now_s = asyncio.get_running_loop().time()
        if now_s - self._written_s >= WRITE_EVERY_S:
            await self._write()

    def _tells_more(self, imu: ImuSolution, unix_s: float) -> bool:
        """Return whether a window is this power-up's first at its temperature, or much better than earlier windows."""
        degc, power_up = imu.mean_degc, self.power_up(imu.name, unix_s)
        if imu.gyro_rad_s is None or degc is None or self._changed(imu.name):
            return False
        near = [each for each in self._points(imu.name) if each.power_up.is_same(power_up) and _is_near(each, degc)]
        best = min((max(each.gyro.sigma_stat) for each in near if each.gyro is not None), default=math.inf)
        return bool(imu.sigma_stat[:3].max() < _MUCH_BETTER * best)

    async def forget(self, started: Collection[str]) -> None:
        """Delete the biases of undone calibrations, given by their start times."""
        if not any(point.started_at in started for known in self._known.values() for point in known.points):
            return
        for name, known in self._known.items():
            left = tuple(point for point in known.points if point.started_at not in started)
            self._known[name] = msgspec.structs.replace(known, points=left)
        self._today = {key: ref for key, ref in self._today.items() if ref[1].started_at not in started}
        await self._write()

    async def _write(self) -> None:
        await self._offload(self.follow)
        self._written_s = asyncio.get_running_loop().time()
        try:
            await self._offload(self._store.write, dict(self._known))
        except StorageError as error:
            logger.warning("%s", message("history_not_kept", what="biases of this calibration", reason=error))

    def _refer(self, name: str, triad: Triad, point: Point) -> None:
        """Accept a point as this power-up's bias; one contradicting the accepted bias must be the third in a row."""
        found = point.of(triad)
        if found is None:
            return
        session = self._session(name)
        then, before, contradicted = self._today.get((name, triad), (None, point, 0))
        if found.is_outlier and then == session and before.zero == point.zero and contradicted < 2:
            self._today[name, triad] = session, before, contradicted + 1
        else:
            self._today[name, triad] = session, point, 0

    # --- stored biases

    def temperature(self) -> list[Object]:
        """Summarise the biases of each IMU over temperature; blocking."""
        # Imported here to keep the start short.
        from companion.estimation.solution.by_temperature import by_temperature

        self.follow()
        unix_s, found = time.time(), []
        for name in self._sources:
            what = self._changed(name)
            shown = by_temperature(
                name,
                () if what else self._points(name),
                *(None if what else self.curve(name, triad) for triad in TRIADS),
                power_up=self.power_up(name, unix_s),
                now_degc=self._now_degc.get(name),
            )
            if what:
                shown = msgspec.structs.replace(shown, needs=message("biases_no_longer_count", changed=what))
            found.append(msgspec.to_builtins(shown))
        return found

    def last(self, name: str, triad: Triad) -> Point | None:
        """Return the bias of an IMU's latest calibration; None if there is none of the present sensor."""
        points = () if self._changed(name) else reversed(self._points(name))
        return next((point for point in points if point.started_at and point.of(triad) is not None), None)

    def _points(self, name: str) -> tuple[Point, ...]:
        return self._known[name].points if name in self._known else ()

    def _point(self, name: str, started_at: str) -> Point | None:
        return next((each for each in self._points(name) if each.started_at == started_at), None)

    def _remember(self, name: str, known: Sequence[Point]) -> None:
        """Replace an IMU's history, limited as on disk, so that predictions do not change at a restart."""
        imu = self._known.get(name) or KnownImu(identity=self._identity(name, {}))
        self._known[name] = msgspec.structs.replace(imu, points=kept(known))

    # --- identity of the sensor behind each IMU

    def _changed(self, name: str) -> str:
        """Return the differences between the present and the stored sensor, as text; empty if there are none."""
        if name not in self._known:
            return ""
        before = self._known[name].identity
        now = self._identity(name, before)
        keys = sorted(key for key in {*before, *now} if before.get(key) != now.get(key))
        return ", ".join(_IN_WORDS.get(key, key) for key in keys)

    def power_up(self, name: str, unix_s: float) -> PowerUp:
        up_s = self._collector.up_s(name)
        return PowerUp(host=self._host, since_unix_s=None if up_s is None else round(unix_s - up_s, 1))

    def _session(self, name: str) -> str:
        """Return a text that changes whenever the sensor may have lost power."""
        if name in self._imus:
            return f"boot {self._vehicle.boots}"
        sensor = self._sensors.get(name)
        if sensor is None:
            return ""
        return f"{sensor.link.reconnects} {sensor.decoder.times.clock.breaks} {sorted(sensor.health.counts.items())}"

    def _zero(self) -> str | None:
        gradienter, used = self._config.gradienter, self._alignment.used
        if gradienter is None:
            return None
        at = used.measured_at if used is not None else "configured"
        mounting = _plain(gradienter.mounting)
        return f"{gradienter.protocol} {gradienter.law} {mounting} {_plain(gradienter.offset_deg)} {at}"

    def _identity(self, name: str, before: Mapping[str, str]) -> dict[str, str]:
        """Return the properties whose change voids an IMU's biases; `before` supplies those that are unknown now."""
        source = self._sources[name]
        profile = source.profile.name if isinstance(source.profile, NoiseProfile) else source.profile
        found: dict[str, str] = {"source": source.source, "profile": profile or "unknown"}
        if source.source == "serial":
            return {**found, "protocol": source.protocol or "", "mounting": _plain(source.mounting)}
        calibration = self._imus[name].calibration if name in self._imus else None
        found |= {
            "instance": str(source.instance or 1),
            "system": str(self._vehicle.system_id),
            "firmware": str(self._vehicle.firmware),
        }
        if calibration is None:
            # A property that is unknown now counts as unchanged.
            return {**before, **found}
        return found | {
            "gyro": str(calibration.gyro_id),
            "accel": str(calibration.accel_id),
            "orientation": _plain((np.round(calibration.orientation, 4) + 0.0).ravel().tolist()),
            "scale": _plain(calibration.accel_scale),
        }


def _is_near(point: Point, degc: float) -> bool:
    return point.temperature_degc is not None and abs(point.temperature_degc - degc) < LOOK_K


def _plain(value: object) -> str:
    return " ".join(f"{each:.6g}" for each in value) if isinstance(value, list | tuple) else str(value)
