"""What stands on all sides have told of the accelerometers: kept, and given for the offsets that are in force now."""

from __future__ import annotations

import datetime
from typing import Final

import numpy as np

from companion.autopilot.firmware.imu_calibration import ImuCalibration
from companion.calibration.alignment.faces import BIAS, FIGURES, SCALE, Accelerometer
from companion.calibration.solution.faces_record import FacesImuRecord, FacesRecord
from companion.config.sections import Config
from companion.daemon.core import Offload
from companion.physics.frames import Array
from companion.physics.units import MG
from companion.storage.learned import FacesStore

FRESH_S: Final = 3600.0
AGED_MG: Final = 0.3
"""One sigma of what another power-up or hours make of a bias; the ordinary parts' own figure is not known better."""
PER_KELVIN_MG: Final = 0.2
UNKNOWN_K: Final = 5.0
"""Change of temperature that is assumed where it is not known."""


class FacesInForce:
    """The latest measurement, on disk and in memory."""

    def __init__(self, config: Config, offload: Offload) -> None:
        self._store, self._offload = FacesStore(config.storage.path), offload
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

    def known(self, name: str, calibration: ImuCalibration, temperature_degc: float | None) -> Accelerometer | None:
        """Of one IMU's output under what corrects it now, in its own axes; None where nothing is known of this part."""
        if self.record is None:
            return None
        kept = next((imu for imu in self.record.imus if imu.name == name), None)
        if kept is None or kept.accel_id != calibration.accel_id:
            return None
        names = calibration.parameters
        try:
            offset = np.array([kept.corrections[one] for one in names.accel_offset])
            scale = np.array([kept.corrections[one] for one in names.accel_scale])
        except KeyError:
            return None
        return _under(calibration, kept, offset, scale, self._widened(self.record, kept, temperature_degc))

    def _widened(self, record: FacesRecord, kept: FacesImuRecord, temperature_degc: float | None) -> float:
        """What has come to the biases' sigma since, m/s^2."""
        measured = datetime.datetime.fromisoformat(record.measured_at)
        age_s = (datetime.datetime.now(tz=datetime.UTC) - measured).total_seconds()
        if kept.temperature_degc is None or temperature_degc is None:
            kelvin = UNKNOWN_K if age_s > FRESH_S else 0.0
        else:
            kelvin = temperature_degc - kept.temperature_degc
        return float(np.hypot(AGED_MG if abs(age_s) > FRESH_S else 0.0, PER_KELVIN_MG * kelvin)) * MG


def _under(
    calibration: ImuCalibration,
    kept: FacesImuRecord,
    offset: Array,
    scale: Array,
    widened_m_s2: float,
) -> Accelerometer:
    """Figures under other offsets and scales: output = scale (raw - offset), then and now."""
    bias, error = np.array(kept.accel_bias_mg.value) * MG, np.array(kept.accel_scale.value)
    right_offset, right_scale = offset + bias / scale, scale / (1.0 + error)
    now, taken_off = np.array(calibration.accel_scale), np.array(calibration.accel_offset_m_s2)
    figures, sigma = np.zeros(FIGURES), np.zeros(FIGURES)
    figures[BIAS], figures[SCALE] = now * (right_offset - taken_off), now / right_scale - 1.0
    sigma[BIAS] = np.hypot(np.array(kept.accel_bias_mg.sigma) * MG, widened_m_s2)
    sigma[SCALE] = kept.accel_scale.sigma
    return Accelerometer(figures, np.diag(sigma**2))
