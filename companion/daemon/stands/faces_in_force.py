"""What stands on all sides have told of the accelerometers: kept, and given for the offsets that are in force now."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping

import numpy as np

from companion.autopilot.firmware.imu_calibration import ImuCalibration
from companion.daemon.core import Core
from companion.daemon.devices.autopilot_imu import AutopilotImu
from companion.estimation.alignment.faces import BIAS, FIGURES, SCALE, SHEAR, Sides
from companion.estimation.means.windows import Window
from companion.estimation.noise.allan import noise_profile
from companion.estimation.records.align_record import FacesImuRecord, FacesRecord, Running
from companion.estimation.solution.otherwise import aged_m_s2
from companion.formats import Object
from companion.physics.frames import Array
from companion.physics.units import MG
from companion.storage.learned import faces_in, this_boot


class FacesInForce:
    """The latest measurement, on disk and in memory."""

    def __init__(self, core: Core, imus: Mapping[str, AutopilotImu]) -> None:
        self._store, self._offload = faces_in(core.config.storage.path), core.offload
        self._collector, self._profiles, self._imus = core.collector, core.profiles, imus
        self._host = this_boot()
        self.record: FacesRecord | None = None

    def load(self) -> None:
        """Read what was kept before this start; blocking. What cannot be used is set aside."""
        self.record = self._store.load()

    async def keep(self, record: FacesRecord) -> None:
        """From now on this is known.

        Raises:
            StorageError: it could not be kept; what was known before still is.
        """
        await self._offload(self._store.write, record)
        self.record = record

    def status(self) -> list[Object]:
        """By IMU, what its output has left of bias and scale under what corrects it now, and how well that is known."""
        found: list[Object] = []
        record = self.record
        for kept in () if record is None else record.imus:
            now = self._now(kept.name, kept.temperature_degc)
            if record is None or now is None:
                continue
            found.append(
                {
                    "name": kept.name,
                    "measured_at": record.measured_at,
                    "temperature_degc": kept.temperature_degc,
                    "bias_left_mg": (now.figures[BIAS] / MG).round(4).tolist(),
                    "bias_sigma_mg": (now.sigma[BIAS] / MG).round(4).tolist(),
                    "scale_left": now.figures[SCALE].round(7).tolist(),
                    "scale_sigma": now.sigma[SCALE].round(7).tolist(),
                }
            )
        return found

    def running(self, name: str) -> Running | None:
        """Since when an IMU has been on; None where it does not tell."""
        up_s = self._collector.up_s(name)
        if up_s is None or not self._host:
            return None
        return Running(host=self._host, started_s=asyncio.get_running_loop().time() - up_s, up_s=up_s)

    def sides(self, window: Window) -> dict[str, Sides]:
        """By IMU, for a tilt from these means."""
        found = {imu.name: self._now(imu.name, imu.temperature_degc) for imu in window.imus}
        return {name: now for name, now in found.items() if now is not None}

    def _now(self, name: str, temperature_degc: float | None) -> Sides | None:
        """As `known`, under what is in force; None also where that is not known."""
        calibration = self._imus[name].calibration if name in self._imus else None
        return None if calibration is None else self.known(name, calibration, temperature_degc)

    def known(self, name: str, calibration: ImuCalibration, temperature_degc: float | None) -> Sides | None:
        """Of one IMU's output under what corrects it now, in its own axes; None where nothing is known of this part."""
        if self.record is None:
            return None
        kept = next((imu for imu in self.record.imus if imu.name == name), None)
        if kept is None or kept.accel_id != calibration.accel_id:
            return None
        names = calibration.parameters
        try:
            offset = np.array([kept.corrections[one] for one in names.accel_offset])
            x, y, z = (kept.corrections[one] for one in names.accel_scale)
        except KeyError:
            return None
        return _under(calibration, kept, offset, calibration.in_use((x, y, z)), self._widened(kept, temperature_degc))

    def _widened(self, kept: FacesImuRecord, temperature_degc: float | None) -> float:
        """What has come to the biases' sigma since, m/s^2: drift and temperature, or another power-up."""
        now, before = self.running(kept.name), kept.running
        gap_s = now.up_s - before.up_s if now is not None and before is not None and before.is_same(now) else None
        degrees = kept.temperature_degc, temperature_degc
        kelvin = None if degrees[0] is None or degrees[1] is None else degrees[1] - degrees[0]
        return aged_m_s2(noise_profile(self._profiles.of(kept.name)).accel, gap_s, kelvin)


def _under(
    calibration: ImuCalibration,
    kept: FacesImuRecord,
    offset: Array,
    scale: Array,
    widened_m_s2: float,
) -> Sides:
    """Figures under other offsets and scales: output = scale (raw - offset), then and now."""
    bias, error = np.array(kept.accel_bias_mg.value) * MG, np.array(kept.accel_scale.value)
    right_offset, right_scale = offset + bias / scale, scale / (1.0 + error)
    now, taken_off = calibration.in_use(), np.array(calibration.accel_offset_m_s2)
    figures, sigma = np.zeros(FIGURES), np.zeros(FIGURES)
    figures[BIAS], figures[SCALE] = now * (right_offset - taken_off), now / right_scale - 1.0
    figures[SHEAR] = kept.accel_shear.value
    sigma[BIAS] = np.hypot(np.array(kept.accel_bias_mg.sigma) * MG, widened_m_s2)
    sigma[SCALE], sigma[SHEAR] = kept.accel_scale.sigma, kept.accel_shear.sigma
    return Sides(figures, sigma, calibration.orientation)
