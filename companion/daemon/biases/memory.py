"""Biases of each IMU from earlier calibrations and still windows, and their prediction for today.

A change of sensor, profile or mounting voids them. The last calibration since the power-up predicts best.
"""

from __future__ import annotations

import asyncio
import dataclasses
import logging
import math
import time
from collections.abc import Collection, Mapping, Sequence
from typing import Final

import msgspec
import numpy as np

from companion.daemon.biases.identity import ImuIdentities, changed
from companion.daemon.core import Core
from companion.daemon.devices.autopilot_imu import AutopilotImu
from companion.daemon.devices.subsystem import Devices
from companion.daemon.stands.alignment import ActiveAlignment
from companion.errors import AutopilotError, StorageError
from companion.estimation.means.warming import Warming
from companion.estimation.noise.allan import noise_profile
from companion.estimation.records.history import Point, by_power_up, kept
from companion.estimation.solution.curve import Along, Curve, settling
from companion.estimation.solution.doubt import Doubt
from companion.estimation.solution.joint import weigh
from companion.estimation.solution.prior import (
    Expectation,
    ExpectedImu,
    Prediction,
    curve_of,
    expect,
    expect_today,
    pose_effect,
)
from companion.estimation.solution.results import points
from companion.estimation.solution.solve import ImuSolution, Shared, Solution
from companion.formats import Object
from companion.physics.frames import Array, vector
from companion.samples import TRIADS, Triad, Vector
from companion.storage.records import BiasStore, KnownImu

logger = logging.getLogger(__name__)

LOOK_K: Final = 1.0
"""Temperatures nearer than this count as equal."""
WRITE_EVERY_S: Final = 60.0
"""Least time between writes of still windows to the disk."""
_MUCH_BETTER: Final = 0.7
"""Share of its sigma below which a still window replaces another one of the same temperature."""


class Curves:
    """Bias over temperature of each IMU."""

    def __init__(self, core: Core, imus: Mapping[str, AutopilotImu]) -> None:
        self._profiles, self._imus = core.profiles, imus
        self._names = {imu.name for imu in core.config.imu}
        self._of: dict[tuple[str, Triad], Curve | None] = {}
        self._settling: dict[str, tuple[float, float] | None] = {}

    def follow(self, known: Mapping[str, KnownImu]) -> None:
        """Fit the curves; blocking."""
        of: dict[tuple[str, Triad], Curve | None] = {}
        settles: dict[str, tuple[float, float] | None] = {}
        for name in known.keys() & self._names:
            seen, profile = known[name].points, noise_profile(self._profiles.of(name))
            of |= {(name, triad): curve_of(seen, triad, profile.of(triad)) for triad in TRIADS}
            groups = by_power_up([point for point in seen if point.temperature_degc is not None])
            settles[name] = settling([[(p.temperature_degc or 0.0, p.k_s) for p in group] for group in groups])
        self._of, self._settling = of, settles

    def forget(self, name: str) -> None:
        """Forget the curves of an IMU that was replaced."""
        self._of = {key: curve for key, curve in self._of.items() if key[0] != name}
        self._settling.pop(name, None)

    def of(self, name: str, triad: Triad) -> Curve | None:
        """Return the curve of one triad; None: not known."""
        return self._of.get((name, triad))

    def along(self, name: str, triad: Triad, warming: Warming | None) -> Along | None:
        """Predict the bias within a window; None without a curve or a known change of temperature."""
        curve, path = self.of(name, triad), None if warming is None else warming.path
        if curve is None or path is None:
            return None
        profile = noise_profile(self._profiles.of(name))
        found = curve.along(path, self._settling.get(name), profile.of(triad))
        (start, _), _, (end, _) = path.states
        shift, slope = (self.taken_off(name, triad, degc, end) for degc in (path.mean_degc, start))
        if not shift.any() and not slope.any():
            return found
        left = {"shift": vector(found.shift - shift), "slope": vector(found.slope - slope / path.span_s)}
        return msgspec.structs.replace(found, warm=None, **left)

    def drift(
        self, name: str, triad: Triad, degc: float | None, now_degc: float | None
    ) -> tuple[Vector, Vector] | None:
        """Predict the change of the output since a temperature, and its variance; None: not known."""
        curve = self.of(name, triad)
        if curve is None or degc is None or now_degc is None:
            return None
        mean, variance = curve.change((degc, 0.0), (now_degc, 0.0))
        return vector(mean - self.taken_off(name, triad, degc, now_degc)), vector(variance)

    def taken_off(self, name: str, triad: Triad, degc: float, now_degc: float) -> Array:
        """Return the change that the autopilot compensates by temperature itself, (3,)."""
        calibration = self._imus[name].calibration if name in self._imus else None
        return np.zeros(3) if calibration is None else calibration.thermal_change(triad, degc, now_degc)


class BiasMemory:
    """Predicts biases before a result is used, and remembers the result."""

    def __init__(self, core: Core, devices: Devices, used: ActiveAlignment) -> None:
        self._config, self._profiles, self._offload = core.config, core.profiles, core.offload
        self._imus, self._alignment = devices.imus, used
        self.identities = ImuIdentities(core, devices, used)
        self.curves = Curves(core, devices.imus)
        self._store = BiasStore(core.config.storage.path)
        self._known: dict[str, KnownImu] = {}
        self._today: dict[tuple[str, Triad], tuple[str, Point, int]] = {}
        """Session, point and count of contradictions of the last good calibration in this power-up, by triad."""
        self._now_degc: dict[str, float | None] = {}
        self._written_s = -math.inf

    def load(self) -> None:
        """Load the stored biases; blocking."""
        self._known = self._store.read()
        self.follow()

    def follow(self) -> None:
        """Fit the curves to all known biases; blocking."""
        self.curves.follow(dict(self._known))

    # --- before a result is used

    def with_offsets(self, solution: Solution) -> Solution:
        """Add the offsets that the autopilot subtracts; AutopilotError while they are not known."""
        imus = tuple(
            dataclasses.replace(imu, subtracted=self._imus[imu.name].in_force.subtracted(imu.temperature_degc))
            if imu.name in self._imus
            else imu
            for imu in solution.imus
        )
        return dataclasses.replace(solution, imus=imus)

    def device_ids(self) -> dict[str, tuple[int | None, int | None]]:
        """Return the known device ids of gyro and accelerometer, by IMU of the autopilot."""
        known = {name: imu.calibration for name, imu in self._imus.items()}
        return {name: (each.gyro_id, each.accel_id) for name, each in known.items() if each is not None}

    def forgotten(self) -> dict[str, str]:
        """Forget the biases of replaced sensors; return the reason by IMU, in one line."""
        found: dict[str, str] = {}
        for name in (imu.name for imu in self._config.imu):
            what = self._changed(name)
            if not what:
                continue
            known = self._known.pop(name)
            self.curves.forget(name)
            self._today = {key: each for key, each in self._today.items() if key[0] != name}
            if known.points:
                found[name] = f"imu {name}: {what} changed since then: its earlier biases are forgotten"
                logger.info("%s", found[name])
        return found

    def why_not_now(self, name: str, started_at: str) -> str | None:
        """Return why the bias of a calibration may have changed since; None without a reason.

        An autopilot may have run on while our board was off.
        """
        if (point := self._point(name, started_at)) is None:
            return "its calibration is not known of"
        if what := self._changed(name):
            return f"another IMU than was calibrated ({what})"
        same = name in self._imus or point.power_up.is_same(self.identities.power_up(name, time.time()))
        return None if same else "the IMU was without power since its calibration"

    def on_since(self, name: str, started_at: str) -> bool:
        """Return whether an IMU is the one of a calibration, and has run ever since."""
        point = None if self._changed(name) else self._point(name, started_at)
        return point is not None and point.power_up.started_with(self.identities.power_up(name, time.time()))

    def expectation(self, solution: Solution, unix_s: float) -> Expectation:
        """Predict the biases of these IMUs today."""
        gradienter = self._config.gradienter
        return Expectation(
            imus=tuple(self._expected(imu, solution.shared, unix_s) for imu in solution.imus),
            zero_is_known=self._alignment.used is not None
            or (gradienter is not None and gradienter.sigma_deg is not None),
        )

    def _expected(self, imu: ImuSolution, shared: Shared, unix_s: float) -> ExpectedImu:
        name = imu.name
        record = self._alignment.record if self._alignment.unused is None else None
        aligned = () if record is None else record.imus
        effect = pose_effect(next((each for each in aligned if each.name == name), None))
        if not self._config.calibration.prior:
            return ExpectedImu(name=name, effect=effect)
        now = Point(
            started_at="",
            unix_s=unix_s,
            power_up=self.identities.power_up(name, unix_s),
            temperature_degc=imu.temperature_degc,
            k_s=imu.k_s,
            up=vector(shared.up),
            zero=self.identities.zero(),
        )
        earlier, session = self._points(name), self.identities.session(name)
        profile = noise_profile(self._profiles.of(name))

        def today(triad: Triad) -> Prediction | None:
            then, point, _ = self._today.get((name, triad), (None, now, 0))
            if then != session:
                return None
            return expect_today(point, triad, now, effect, profile.of(triad), self.curves.of(name, triad))

        return ExpectedImu(
            name=name,
            earlier={triad: expect(earlier, triad, now, effect, profile.of(triad)) for triad in TRIADS},
            today={triad: today(triad) for triad in TRIADS},
            along={triad: self.curves.along(name, triad, imu.warming) for triad in TRIADS},
            effect=effect,
        )

    # --- and afterwards

    def measured(self, solution: Solution, doubts: Sequence[Doubt], started_at: str, unix_s: float) -> dict[str, Point]:
        """Make the points of the history from a solution by the readings alone."""
        return points(
            dataclasses.replace(solution, imus=tuple(map(self._at_mean, solution.imus))),
            doubts,
            started_at=started_at,
            unix_s=unix_s,
            power_ups={imu.name: self.identities.power_up(imu.name, unix_s) for imu in solution.imus},
            zero=self.identities.zero(),
        )

    def _at_mean(self, imu: ImuSolution) -> ImuSolution:
        """Subtract the offsets of the window's mean temperature, not those of its end."""
        degc, end_degc = imu.mean_degc, imu.temperature_degc
        if degc is None or end_degc is None or degc == end_degc:
            return imu
        return imu.shifted(-np.concatenate([self.curves.taken_off(imu.name, t, degc, end_degc) for t in TRIADS]))

    async def keep(self, found: Mapping[str, Point]) -> None:
        """Remember a good calibration; a failure of the disk is only logged."""
        for name, point in found.items():
            # A point without a temperature fits no curve.
            if point.temperature_degc is not None or all(one.temperature_degc is None for one in self._points(name)):
                self._remember(name, (*self._points(name), point))
            for triad in TRIADS:
                self._refer(name, triad, point)
        await self._write()

    async def look(self, solution: Solution) -> None:
        """Remember the best still window of each kelvin of a power-up."""
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
        """Return whether a window is the first at its temperature in this power-up, or much better."""
        degc, power_up = imu.mean_degc, self.identities.power_up(imu.name, unix_s)
        if imu.gyro_rad_s is None or degc is None or self._changed(imu.name):
            return False
        near = [each for each in self._points(imu.name) if each.power_up.is_same(power_up) and _is_near(each, degc)]
        best = min((max(each.gyro.sigma_stat) for each in near if each.gyro is not None), default=math.inf)
        return bool(imu.sigma_stat[:3].max() < _MUCH_BETTER * best)

    async def forget(self, started: Collection[str]) -> None:
        """Forget calibrations that were undone, by their start."""
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
            logger.warning("%s; later calibrations will not know of this one", error)

    def _refer(self, name: str, triad: Triad, point: Point) -> None:
        """Set the reference of this power-up; a contradiction becomes the reference the third time."""
        found = point.of(triad)
        if found is None:
            return
        session = self.identities.session(name)
        then, before, contradicted = self._today.get((name, triad), (None, point, 0))
        if found.is_outlier and then == session and before.zero == point.zero and contradicted < 2:
            self._today[name, triad] = session, before, contradicted + 1
        else:
            self._today[name, triad] = session, point, 0

    # --- what is known

    def temperature(self) -> list[Object]:
        """Summarise the biases over temperature; blocking."""
        # Imported here: the start is shorter without.
        from companion.estimation.solution.by_temperature import by_temperature

        self.follow()
        unix_s, found = time.time(), []
        for name in (imu.name for imu in self._config.imu):
            what = self._changed(name)
            shown = by_temperature(
                name,
                () if what else self._points(name),
                *(None if what else self.curves.of(name, triad) for triad in TRIADS),
                power_up=self.identities.power_up(name, unix_s),
                now_degc=self._now_degc.get(name),
            )
            if what:
                shown = msgspec.structs.replace(
                    shown, needs=f"{what} changed: earlier biases count no more, a calibration begins anew"
                )
            found.append(msgspec.to_builtins(shown))
        return found

    def _points(self, name: str) -> tuple[Point, ...]:
        return self._known[name].points if name in self._known else ()

    def _point(self, name: str, started_at: str) -> Point | None:
        return next((each for each in self._points(name) if each.started_at == started_at), None)

    def _remember(self, name: str, known: Sequence[Point]) -> None:
        """Keep as many points of an IMU as the disk does: predictions must not change with a restart."""
        imu = self._known.get(name) or KnownImu(identity=self.identities.identity(name, {}))
        self._known[name] = msgspec.structs.replace(imu, points=kept(known))

    def _changed(self, name: str) -> str:
        """Name the differences to the known sensor; empty: none."""
        known = self._known.get(name)
        return "" if known is None else changed(known.identity, self.identities.identity(name, known.identity))


def _is_near(point: Point, degc: float) -> bool:
    return point.temperature_degc is not None and abs(point.temperature_degc - degc) < LOOK_K
