"""Base class of the PX4 double: ports, sensors with their estimators, parameters, and texts."""

from __future__ import annotations

import abc
from collections.abc import Mapping, Sequence
from typing import Literal, Protocol

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.aircraft import VirtualAircraft
from sim.earth import Array
from sim.firmware.compass import SimCompass
from sim.firmware.double import AutopilotDouble
from sim.imu_model import Bias, ImuModel
from sim.px4.calibration import MagCalibration
from sim.px4.parameters import (
    EXTERNAL_COMPASS_IDS,
    EXTERNAL_IDS,
    SIMULATED_COMPASS_IDS,
    SIMULATED_IDS,
    SLOTS,
    PX4Parameters,
    default_parameters,
)
from sim.px4.port import NORMAL_RATES, ONBOARD_RATES, PX4Port
from sim.px4.vehicle_imu import VehicleImu, VehicleImuSample

Version = Literal["1.18", "1.16"]


class Orders(Protocol):
    """Interface of the commander for the other parts of the double."""

    blocked: bool
    """True: the commander waits for an authorisation and does nothing else."""

    def receives_own_request(self, number: int) -> None:
        """Handle a command that the autopilot sent to itself."""


class PX4Board(AutopilotDouble):
    """A PX4 without its servers for parameters and commands.

    Args:
        aircraft: the truth.
        imus: one to four models in the order of their uORB instances; the first is IMU 1. Their `mounting_deg` is the
            true orientation of the board, which SENS_BOARD_ROT (default none) or CAL_x_ROT is meant to undo.
        compasses: one to four in the order of their uORB instances; compass n has the slot CAL_MAGn_.
        version: "1.18": PARAM_ERROR. "1.16": silence instead.
        vehicle: "copter" or "plane".
        parameters: values that differ from the defaults, such as {"IMU_GYRO_CAL_EN": 0}; set before the first boot.
        slots: number n of the CAL_GYROn_/CAL_ACCn_ slot of each IMU, None for no slot; default 0, 1, 2, ...
        external: numbers (0..) of IMUs that are external: they turn with CAL_x_ROT.
        imu_rate_hz: rate of the integrated samples; streams are quantised by it.
        default_streams: False: only heartbeats and TIMESYNC run by themselves (quick tests).
        up_s: time since the autopilot's boot at the beginning of the simulation.
        console: `listener` is built, which some small boards leave out.
    """

    commander: Orders

    def __init__(
        self,
        aircraft: VirtualAircraft,
        imus: Sequence[ImuModel],
        *,
        compasses: Sequence[SimCompass] | None = None,
        system_id: int = 1,
        version: Version = "1.18",
        vehicle: Literal["copter", "plane"] = "copter",
        parameters: Mapping[str, float] | None = None,
        slots: Sequence[int | None] | None = None,
        external: Sequence[int] = (),
        imu_rate_hz: float = 250.0,
        default_streams: bool = True,
        up_s: float = 30.0,
        console: bool = True,
        seed: int = 0,
    ) -> None:
        if not 1 <= len(imus) <= SLOTS:
            raise ValueError(f"imus: found {len(imus)}; allowed: 1 to {SLOTS}")
        if slots is not None and len(slots) != len(imus):
            raise ValueError(f"slots: found {len(slots)}; allowed: one for each of the {len(imus)} IMUs")
        quiet = {mavlink.MAVLINK_MSG_ID_HEARTBEAT: 1.0, mavlink.MAVLINK_MSG_ID_TIMESYNC: 10.0}
        period_s = 1.0 / imu_rate_hz
        self.ports = (
            PX4Port(
                system_id, self._handle,
                defaults=ONBOARD_RATES if default_streams else quiet, period_s=period_s,
            ),
            PX4Port(
                system_id, self._handle,
                defaults=NORMAL_RATES if default_streams else quiet, period_s=period_s,
            ),
        )  # fmt: skip
        super().__init__(
            aircraft,
            imus,
            self.ports,
            compasses=compasses,
            up_s=up_s,
            seed=seed,
            tunes_go_on=True,
        )
        self.system_id, self.version, self.vehicle = system_id, version, vehicle
        self.console = console
        self._mag_ids = [
            (EXTERNAL_COMPASS_IDS if one.external else SIMULATED_COMPASS_IDS)[n] for n, one in enumerate(self.compasses)
        ]
        ids = [EXTERNAL_IDS[n] if n in external else SIMULATED_IDS[n] for n in range(len(imus))]
        table = default_parameters()
        self.parameters = self._new_store(table, parameters or {}, ids, slots or range(len(imus)))
        self.vehicle_imus = [
            VehicleImu(model, n, ids[n], self.parameters, external=n in external, rate_hz=imu_rate_hz, seed=seed)
            for n, model in enumerate(imus)
        ]
        self.primary_imu = 0
        """Number of the IMU that flies the aircraft, which HIGHRES_IMU shows."""
        self._frozen: dict[int, VehicleImuSample] = {}
        self.mag_bias_gauss = np.zeros(3)
        """Bias (3,) of the selected compass that EKF2 has learned, vehicle FRD; a new correction deletes it."""
        self.mags: list[MagCalibration] = self.new_mags()

    def residual(self, instance: int, loop_s: float) -> Bias:
        """Error left in the output of IMU `instance` (1..) after offsets and scales: output minus truth, FRD."""
        t_s = self.aircraft.time_at(loop_s)
        output, truth = self.vehicle_imus[instance - 1].corrected(t_s), self.aircraft.truth_at(t_s)
        return Bias(output[:3] - truth.rate_rad_s, output[3:] - truth.force_m_s2)

    def imu_output(self, index: int, loop_s: float) -> VehicleImuSample:
        """Return the newest corrected sample of IMU index 0.. in vehicle FRD."""
        if self.faults.frozen_imu and index in self._frozen:
            return self._frozen[index]
        sample = self.vehicle_imus[index].sample(self.aircraft.time_at(loop_s))
        self._frozen[index] = sample
        return sample

    def compass_output(self, t_s: float) -> Array:
        """Return the corrected field (3,) in vehicle FRD, gauss, of the enabled compass with the highest priority."""
        best = max((mag for mag in self.mags if mag.enabled), key=lambda mag: mag.priority, default=None)
        if best is None:
            return np.zeros(3)
        return best.correct(1e-3 * self.compass_reading(self.mags.index(best), t_s)) - self.mag_bias_gauss

    def restart_sensors(self) -> None:
        """Read the calibrations as at a boot."""
        for imu in self.vehicle_imus:
            imu.restart()
        self.mags, self.mag_bias_gauss = self.new_mags(), np.zeros(3)

    def update_mags(self) -> None:
        """Read the calibrations of the compasses again, unless armed."""
        for mag in () if self.armed else self.mags:
            before = mag.count
            mag.parameters_update()
            if mag.count != before:
                self.mag_bias_gauss = np.zeros(3)

    def new_mags(self) -> list[MagCalibration]:
        """Return the corrections as somebody who begins now reads them."""
        sensors = zip(self._mag_ids, self.compasses, strict=True)
        return [MagCalibration(own, self.parameters, external=one.external) for own, one in sensors]

    def update_estimators(self, loop_s: float) -> None:
        """Advance the estimators to this time; call it before anything changes the output."""
        t_s = self.aircraft.time_at(loop_s)
        for imu in self.vehicle_imus:
            if imu.estimator.time_s == t_s:
                continue  # another message of the same instant has done it
            error = self.residual(imu.index + 1, loop_s)
            imu.estimator.update(t_s, error.gyro_rad_s, error.accel_m_s2)

    @abc.abstractmethod
    def parameters_changed(self, *, consumers: bool = True) -> None:
        """Notify the users of the parameters, every port, and the storage."""

    @abc.abstractmethod
    def say(self, severity: int, text: str) -> None:
        """Send STATUSTEXT on every port with a ground station; on other ports a text waits up to 5 s for one."""

    def _new_store(
        self,
        table: dict[str, float],
        overrides: Mapping[str, float],
        ids: Sequence[int],
        slots: Sequence[int | None],
    ) -> PX4Parameters:
        for device_id, slot in zip(ids, slots, strict=True):
            if slot is not None:
                table |= {f"CAL_GYRO{slot}_ID": device_id, f"CAL_ACC{slot}_ID": device_id}
        for number, (own, one) in enumerate(zip(self._mag_ids, self.compasses, strict=True)):
            table |= {f"CAL_MAG{number}_ID": own, f"CAL_MAG{number}_ROT": 0 if one.external else -1}
        table["MAV_SYS_ID"] = self.system_id
        table["MAV_TYPE"] = 2 if self.vehicle == "copter" else 1
        store = PX4Parameters(table)
        for name, value in overrides.items():
            store.preset(name, value)
        return store
