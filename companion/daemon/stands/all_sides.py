"""The alignment on all sides: bias and scale of the autopilot's accelerometers from stands in any orientation.

It needs neither a gradienter nor a level spot. After each stand it says what is still unknown, and ends by itself.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final

import numpy as np

from companion.autopilot.firmware.imu_calibration import whole_accelerometer
from companion.autopilot.parameters.change import Change
from companion.daemon.devices.autopilot_imu import AutopilotImu
from companion.daemon.offsets.plan import WriteLog
from companion.daemon.stands.alignment import ActiveSixPosition
from companion.daemon.stands.session import PoseTask, SessionState
from companion.errors import CalibrationRefusedError
from companion.estimation.alignment.faces import BIAS, SCALE, Face, FacesEstimate, faces, missing, seen_before
from companion.estimation.alignment.poses import LEVEL, AlignmentRequest, HeldPose, Hold, Wish
from companion.estimation.means.windows import ImuWindow, Window
from companion.estimation.records.align_record import FaceRecord, FacesRecord, HandRecord, faces_imu_record
from companion.estimation.solution.site import LocalEarth
from companion.physics.frames import Array, vector
from companion.physics.units import MG

EXPECTED: Final = 12
"""Usual number of stands."""
MOST: Final = 24
_FIRST: Final = Wish("any side down, propped up, hands off", Hold(LEVEL))


class SidesTask(PoseTask):
    """Accelerometers held on all sides."""

    def __init__(self, request: AlignmentRequest, imus: Mapping[str, AutopilotImu], kept: ActiveSixPosition) -> None:
        self._request, self._imus, self._kept = request, imus, kept
        self.total, self.fit_from = EXPECTED, 1
        self._by_imu: dict[str, FacesEstimate] = {}
        self._missing: Wish | None = _FIRST

    def wish(self, state: SessionState) -> Wish | None:  # noqa: D102 - as in the base class
        return self._missing if len(state.poses) < MOST else None

    def examine(self, state: SessionState, now: Window) -> tuple[HeldPose, str | None]:  # noqa: D102
        del state
        pose = HeldPose(np.array(now.imus[0].accel_m_s2))
        imu = next((imu for imu in now.imus if imu.name in self._by_imu), None)
        if imu is None or self._missing is None:
            return pose, None
        found = self._by_imu[imu.name]
        up = self._face(imu).accel_m_s2 - found.figures[BIAS]
        again = seen_before(found, up / np.linalg.norm(up), self._imus[imu.name].in_force.orientation)
        return pose, None if again is None else f"it stands as in stand {again + 1}: {self._missing.words}"

    def fit(self, state: SessionState, local: LocalEarth) -> list[str]:  # noqa: D102
        windows = state.windows
        before, self._by_imu, self._missing = self._by_imu, {}, None
        for name, imu in self._imus.items():
            means = [one for window in windows for one in window.imus if one.name == name and not one.refused("accel")]
            if len(means) < len(windows) or imu.calibration is None:
                continue
            wander = np.median(np.array([_wander(one) for one in means]), axis=0)
            found = faces([self._face(one) for one in means], local.gravity_m_s2, local.gravity_sigma_m_s2, wander)
            self._by_imu[name] = found
            self._missing = self._missing or missing(found, imu.calibration.orientation)
        if not self._by_imu:
            raise CalibrationRefusedError("no IMU whose accelerometers can be read")
        return [
            f"Stand {stand + 1} is left out: it is {float(found.off_m_s2[stand]) / MG:+.1f} mg off"
            for name, found in self._by_imu.items()
            for stand in set(found.left_out) - set(before[name].left_out if name in before else ())
        ]

    def record(self, state: SessionState, local: LocalEarth, log: WriteLog) -> FacesRecord:  # noqa: D102
        if self._missing is not None:
            self.shortfall = f"after {MOST} stands {self._missing.words.partition(': ')[2]}"
            log.warnings.append(self.shortfall)
        elif self._request.write:
            log.warnings += self._scales_left()
        first = next(iter(self._by_imu))
        ups = self._by_imu[first].up @ self._imus[first].in_force.orientation.T
        degrees = {imu.name: imu.temperature_degc for imu in state.windows[-1].imus}
        return FacesRecord(
            measured_at=log.started,
            gravity_m_s2=local.gravity_m_s2,
            stands=tuple(
                FaceRecord(up=vector(np.round(up, 5)), seconds=window.end_s - window.start_s)
                for up, window in zip(ups, state.windows, strict=True)
            ),
            imus=tuple(
                faces_imu_record(
                    found,
                    name=name,
                    accel_id=calibration.accel_id,
                    corrections=calibration.corrections,
                    temperature_degc=degrees.get(name),
                    running=self._kept.running(name),
                    # Bias without any offset, in the sensor's own scale, as an offset corrects it.
                    whole_m_s2=np.asarray(calibration.accel_offset_m_s2) + found.figures[BIAS] / calibration.in_use(),
                )
                for name, found in self._by_imu.items()
                for calibration in (self._imus[name].in_force,)
            ),
        )

    def changes(self) -> dict[str, list[Change]]:  # noqa: D102
        return {
            name: whole_accelerometer(
                self._imus[name].in_force, vector(found.figures[BIAS]), vector(found.figures[SCALE])
            )
            for name, found in self._by_imu.items()
        }

    async def keep(self, record: HandRecord) -> None:  # noqa: D102
        assert isinstance(record, FacesRecord)
        await self._kept.keep(record)

    def summary(self) -> str:  # noqa: D102
        bias_mg = max(float(found.sigma[BIAS].max()) for found in self._by_imu.values()) / MG
        scale = max(float(found.sigma[SCALE].max()) for found in self._by_imu.values())
        end = "written" if self._request.write else "not written (--write does)"
        return f"accel bias known to {bias_mg:.2f} mg, scale to {100.0 * scale:.3f} %: {end}"

    def _face(self, imu: ImuWindow) -> Face:
        """Return a mean in the sensor's own axes, in which firmwares scale."""
        turn = self._imus[imu.name].in_force.orientation.T
        sigma = np.sqrt(np.diag(turn @ np.diag(np.square(imu.accel_sigma_use_m_s2)) @ turn.T))
        return Face(turn @ np.array(imu.accel_m_s2), sigma)

    def _scales_left(self) -> Iterator[str]:
        """Warn of scales that the firmware would not keep."""
        for name, found in self._by_imu.items():
            calibration = self._imus[name].in_force
            right = calibration.in_use() / (1.0 + found.figures[SCALE])
            if calibration.scale_unused_within and (calibration.in_use(vector(right)) == 1.0).all():
                off_mg = 2e3 * float(np.abs(right - 1.0).max())
                yield (
                    f"imu {name}: scales stay 1, for PX4 starts without such as are within 1 % of it; the offsets are"
                    f" right when level, on another side up to {off_mg:.1f} mg off"
                )


def _wander(imu: ImuWindow) -> Array:
    """Return one sigma of the change of the bias in the next minutes, (3,)."""
    use, stat = np.array(imu.accel_sigma_use_m_s2), np.array(imu.accel_sigma_stat_m_s2)
    return np.asarray(np.sqrt(np.maximum(use**2 - stat**2, 0.0)))
