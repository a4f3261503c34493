"""What is kept of the biases of each IMU, and what they say of today.

A change of sensor, profile or mounting forgets them. What was calibrated in this run of the daemon, with the sensor
powered all the while, is remembered besides: it says most.
"""

from __future__ import annotations

import asyncio
import logging
import math
import time
from collections.abc import Collection, Mapping, Sequence
from typing import Final

import msgspec

from companion.autopilot.firmware.imu_calibration import whole_of
from companion.daemon.biases.curves import Curves
from companion.daemon.biases.whose import Whose, changed
from companion.daemon.core import Core
from companion.daemon.devices.autopilot_imu import AutopilotImu
from companion.daemon.devices.sensors import SerialSensor
from companion.daemon.stands.alignment import AlignmentInForce
from companion.errors import AutopilotError, StorageError
from companion.estimation.noise.allan import noise_profile
from companion.estimation.records.history import Point, kept
from companion.estimation.solution.doubt import Doubt
from companion.estimation.solution.joint import Weighed, Whole, points, weigh
from companion.estimation.solution.prior import (
    Expectation,
    Expected,
    ExpectedImu,
    Now,
    expect,
    expect_today,
    pose_effect,
)
from companion.estimation.solution.solve import ImuSolution, Shared, Solution
from companion.formats import Object
from companion.physics.frames import vector
from companion.samples import TRIADS, Triad
from companion.storage.learned import BiasStore, KnownImu

logger = logging.getLogger(__name__)

LOOK_K: Final = 1.0
WRITE_EVERY_S: Final = 60.0
"""What still windows tell is written so often at most: a power cut costs no more of it."""
_MUCH_BETTER: Final = 0.7


class _Reference(msgspec.Struct):
    """The last good calibration of one triad in this power-up."""

    session: str
    point: Point
    contradicted: int = 0


class BiasMemory:
    """Asked before a result is used, and told of it afterwards."""

    def __init__(
        self, core: Core, imus: Mapping[str, AutopilotImu], sensors: Sequence[SerialSensor], used: AlignmentInForce
    ) -> None:
        self._config, self._profiles, self._offload = core.config, core.profiles, core.offload
        self._imus, self._alignment = imus, used
        self.whose = Whose(core, imus, sensors, used)
        self.curves = Curves(core, imus)
        self._store = BiasStore(core.config.storage.path)
        self._known: dict[str, KnownImu] = {}
        self._today: dict[tuple[str, Triad], _Reference] = {}
        self._now_degc: dict[str, float | None] = {}
        self._written_s = -math.inf

    def load(self) -> None:
        """Read what was kept before this start; blocking."""
        self._known = self._store.read()
        self.follow()

    def follow(self) -> None:
        """Work out the curves of what is known by now; blocking."""
        self.curves.follow(dict(self._known))

    # --- before a result is used

    def whole(self, solution: Solution) -> Whole:
        """Whole biases by the readings alone.

        Raises:
            AutopilotError: the offsets in force are not known at the moment.
        """
        return {
            found.name: whole_of(self._imus[found.name].in_force, found)
            if found.name in self._imus
            else (found.gyro_rad_s, found.accel_m_s2)
            for found in solution.imus
        }

    def device_ids(self) -> dict[str, tuple[int | None, int | None]]:
        """By IMU of the autopilot: those of gyro and accelerometer, where they are known at the moment."""
        known = {name: imu.calibration for name, imu in self._imus.items()}
        return {name: (each.gyro_id, each.accel_id) for name, each in known.items() if each is not None}

    def forgotten(self) -> dict[str, str]:
        """Forget what belongs to another sensor than there is now; by IMU, why, in one line."""
        found: dict[str, str] = {}
        for name in self.whose.names:
            what = self._changed(name)
            if not what:
                continue
            known = self._known.pop(name)
            self.curves.forget(name)
            for triad in TRIADS:
                self._today.pop((name, triad), None)
            if known.points:
                found[name] = f"imu {name}: {what} changed since then: its earlier biases are forgotten"
                logger.info("%s", found[name])
        return found

    def why_not_now(self, name: str, started_at: str) -> str | None:
        """Why what a calibration has found in an IMU may be its bias no more; None: as far as anybody knows, it is.

        An autopilot outlives our board's power, and without a clock nobody knows since when it has been on.
        """
        known, point = self._known.get(name), self._point(name, started_at)
        if known is None or point is None:
            return "its calibration is not known of"
        if what := changed(known.identity, self.whose.identity(name, known.identity)):
            return f"another IMU than was calibrated ({what})"
        same = name in self._imus or point.power_up.is_same(self.whose.power_up(name, time.time()))
        return None if same else "the IMU was without power since its calibration"

    def on_since(self, name: str, started_at: str) -> bool:
        """Whether an IMU is the one that a calibration has measured, and its device has run ever since."""
        point = self._point(name, started_at)
        return (
            point is not None
            and not self._changed(name)
            and point.power_up.started_with(self.whose.power_up(name, time.time()))
        )

    def _point(self, name: str, started_at: str) -> Point | None:
        known = self._known.get(name)
        return None if known is None else next((each for each in known.points if each.started_at == started_at), None)

    def expectation(self, solution: Solution, unix_s: float) -> Expectation:
        """What earlier calibrations say of these IMUs today."""
        return Expectation(
            imus=tuple(self._expected(imu, solution.shared, unix_s) for imu in solution.imus),
            zero_is_known=self._alignment.used is not None
            or (self._config.gradienter is not None and self._config.gradienter.sigma_deg is not None),
        )

    def _expected(self, imu: ImuSolution, shared: Shared, unix_s: float) -> ExpectedImu:
        name = imu.name
        effect = pose_effect(self.whose.aligned(name))
        if not self._config.calibration.prior:
            return ExpectedImu(name=name, effect=effect)
        now = Now(
            unix_s=unix_s,
            power_up=self.whose.power_up(name, unix_s),
            temperature_degc=imu.temperature_degc,
            k_s=imu.k_s,
            up=vector(shared.up),
            gravity_m_s2=shared.gravity_m_s2,
            zero=self.whose.zero(),
        )
        earlier = self._known[name].points if name in self._known else ()
        profile = noise_profile(self._profiles.of(name))

        def today(triad: Triad) -> Expected | None:
            last, curve = self._reference(name, triad), self.curves.of(name, triad)
            return None if last is None else expect_today(last, triad, now, effect, profile.of(triad), curve)

        return ExpectedImu(
            name=name,
            earlier={triad: expect(earlier, triad, now, effect, profile.of(triad)) for triad in TRIADS},
            today={triad: today(triad) for triad in TRIADS},
            along={triad: self.curves.along(name, triad, imu.warming) for triad in TRIADS},
            effect=effect,
        )

    # --- and afterwards

    def measured(
        self, solution: Solution, whole: Whole, doubts: Sequence[Doubt], started_at: str, unix_s: float
    ) -> dict[str, Point]:
        """What later calibrations may know of this one; `solution` by the readings alone."""
        at_mean = dict(whole)
        for imu in solution.imus:
            degc, end_degc = imu.mean_degc, imu.temperature_degc
            if degc is not None and end_degc is not None and degc != end_degc:
                gyro, accel = (
                    bias if bias is None else bias - self.curves.taken_off(imu.name, triad, degc, end_degc)
                    for triad, bias in zip(TRIADS, whole[imu.name], strict=True)
                )
                at_mean[imu.name] = gyro, accel
        return points(
            solution,
            at_mean,
            doubts,
            started_at=started_at,
            unix_s=unix_s,
            power_ups={imu.name: self.whose.power_up(imu.name, unix_s) for imu in solution.imus},
            zero=self.whose.zero(),
        )

    async def keep(self, found: Mapping[str, Point]) -> None:
        """Remember a calibration that has come to a good end; that it cannot be kept on disk is only logged."""
        for name, point in found.items():
            known = self._of(name)
            # Without a temperature, of an IMU whose curve is known, it would fit to none.
            if point.temperature_degc is not None or all(one.temperature_degc is None for one in known.points):
                # As many as the disk keeps: what is asked must not depend on when the daemon was started.
                self._known[name] = msgspec.structs.replace(known, points=kept((*known.points, point)))
            for triad in TRIADS:
                self._refer(name, triad, point)
        await self._write()

    async def look(self, solution: Solution) -> None:
        """Remember what a still window tells that nobody calibrated from: of each kelvin of a power-up the best."""
        unix_s = time.time()
        self._now_degc |= {imu.name: imu.temperature_degc for imu in solution.imus}
        news = [imu.name for imu in solution.imus if self._tells_more(imu, unix_s)]
        if not news:
            return
        try:
            whole = self.whole(solution)
        except AutopilotError:
            return
        expectation = await self._offload(self.expectation, solution, unix_s)
        weighed: Weighed = await self._offload(weigh, solution, whole, expectation)
        found = self.measured(solution, whole, weighed.doubts, "", unix_s)
        for name in news:
            point, known = found[name], self._of(name)
            if any(of is not None and of.is_outlier for of in (point.gyro, point.accel)):
                continue
            others = [earlier for earlier in known.points if not _is_window_like(earlier, point)]
            self._known[name] = msgspec.structs.replace(known, points=kept((*others, point)))
        now_s = asyncio.get_running_loop().time()
        if now_s - self._written_s >= WRITE_EVERY_S:
            await self._write()

    def _tells_more(self, imu: ImuSolution, unix_s: float) -> bool:
        """Whether a window is the first at its temperature since the power came, or much better than that one."""
        known, power_up = self._known.get(imu.name), self.whose.power_up(imu.name, unix_s)
        if imu.gyro_rad_s is None or imu.mean_degc is None:
            return False
        if known is None:
            return True
        same = [
            point.gyro
            for point in known.points
            if point.gyro is not None and point.power_up.is_same(power_up) and _is_near(point, imu.mean_degc)
        ]
        best = min((max(one.sigma_stat) for one in same), default=math.inf)
        return not self._changed(imu.name) and imu.sigma_stat[:3].max() < _MUCH_BETTER * best

    async def forget(self, started: Collection[str]) -> None:
        """Forget calibrations that were undone, by when they had begun."""
        if not any(point.started_at in started for known in self._known.values() for point in known.points):
            return
        self._known = {
            name: msgspec.structs.replace(
                known, points=tuple(point for point in known.points if point.started_at not in started)
            )
            for name, known in self._known.items()
        }
        self._today = {key: ref for key, ref in self._today.items() if ref.point.started_at not in started}
        await self._write()

    async def _write(self) -> None:
        await self._offload(self.follow)
        self._written_s = asyncio.get_running_loop().time()
        try:
            await self._offload(self._store.write, dict(self._known))
        except StorageError as error:
            logger.warning("%s; later calibrations will not know of this one", error)

    def _refer(self, name: str, triad: Triad, point: Point) -> None:
        """The reference of this power-up is the last calibration that was believed, or that has become a habit."""
        found = point.of(triad)
        if found is None:
            return
        session = self.whose.session(name)
        before = self._today.get((name, triad))
        same = before is not None and before.session == session and before.point.zero == point.zero
        if before is not None and same and found.is_outlier and before.contradicted < 2:
            before.contradicted += 1
            return
        self._today[name, triad] = _Reference(session, point)

    def _of(self, name: str) -> KnownImu:
        return self._known.get(name) or KnownImu(identity=self.whose.identity(name, {}))

    def _changed(self, name: str) -> str:
        """What makes it another sensor than the one that is known, in words; empty: nothing."""
        known = self._known.get(name)
        return "" if known is None else changed(known.identity, self.whose.identity(name, known.identity))

    def temperature(self) -> list[Object]:
        """For `companion temperature`; blocking."""
        # What nobody asked for costs the start nothing.
        from companion.estimation.solution.temperature_summary import by_temperature

        self.follow()
        unix_s = time.time()
        found = []
        for name in self.whose.names:
            what = self._changed(name)
            known = None if what else self._known.get(name)
            shown = by_temperature(
                name,
                () if known is None else known.points,
                *(None if known is None else self.curves.of(name, triad) for triad in TRIADS),
                power_up=self.whose.power_up(name, unix_s),
                now_degc=self._now_degc.get(name),
            )
            if what:
                shown = msgspec.structs.replace(
                    shown, needs=f"{what} changed: earlier biases count no more, a calibration begins anew"
                )
            found.append(msgspec.to_builtins(shown))
        return found

    def _reference(self, name: str, triad: Triad) -> Point | None:
        found = self._today.get((name, triad))
        return found.point if found is not None and found.session == self.whose.session(name) else None


def _is_near(point: Point, degc: float) -> bool:
    return point.temperature_degc is not None and abs(point.temperature_degc - degc) < LOOK_K


def _is_window_like(earlier: Point, now: Point) -> bool:
    """Whether it is a window that nobody calibrated from, of the same power-up and temperature."""
    near = now.temperature_degc is not None and _is_near(earlier, now.temperature_degc)
    return not earlier.started_at and near and earlier.power_up.is_same(now.power_up)
