"""Correction that an autopilot applies to one of its compasses, and the algebra that both firmwares share.

With the raw field r in the axes of the sensor, in gauss, and Q, the rotation to the vehicle's axes (FRD):

    ArduPilot   field = D (scale (Q r + offset))          AP_Compass_Backend.cpp, correct_field; milligauss
    PX4         field = Q S (r - offset)                  Magnetometer.hpp, Correct; gauss

In vehicle axes both are D (raw + c): ArduPilot's raw is scale Q r and c = scale offset; PX4's raw is Q r, c = -Q offset
and D = Q S Q^T. ArduPilot's RAW_IMU, SCALED_IMU2 and SCALED_IMU3 carry the corrected fields of compass 1 to 3 by
priority, PX4's SCALED_IMU, SCALED_IMU2 and SCALED_IMU3 the raw ones in the order of the drivers, both as whole
milligauss cut off toward zero. The motors' share (COMPASS_MOT*, CAL_MAGn_COMP) is zero while they stand still.
"""

from __future__ import annotations

import dataclasses
from typing import Final

import numpy as np

from companion.autopilot.firmware.imu_calibration import Range, vector_changes
from companion.autopilot.parameters.change import Change, Names, Parameters, same_float32
from companion.errors import AutopilotError, CalibrationRefusedError
from companion.estimation.alignment.compass import CompassFigures
from companion.messages import message
from companion.physics.frames import Array, Matrix, symmetric, vector
from companion.samples import Vector

COMPASSES: Final = (1, 2, 3)
_FAR_GAUSS: Final = 0.012
"""Step that makes PX4 use new offsets: over twice the 5 mG that it ignores (Magnetometer.cpp, set_offset)."""
_FAR_SOFT: Final = 0.022  # Over twice what PX4 ignores of SCALE and of ODIAG
DIAGONAL: Final = Range(0.0, 5.0)  # ArduPilot: three zeros are no correction
BESIDE: Final = Range(-1.0, 1.0)


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CompassCalibration:
    """Parameters of compass `number` (1 to 3): values as stored, offsets in `unit_gauss` of the corrected field.

    `in_vehicle` (3, 3): rotation from the axes of the parameters to the vehicle's. `reads_raw`: the telemetry is the
    raw field in the sensor's axes, otherwise the corrected one in the vehicle's.
    """

    number: int
    device_id: int
    names: tuple[Names, Names, Names]  # Offsets, diagonal, off-diagonal elements xy xz yz
    offset: Vector
    diagonal: Vector
    beside: Vector
    unit_gauss: float
    in_vehicle: Matrix
    reads_raw: bool
    offset_range: Range
    far_axis: int | None = None
    warnings: tuple[str, ...] = ()

    @property
    def stored(self) -> tuple[int, Vector, Vector, Vector]:
        return self.device_id, self.offset, self.diagonal, self.beside

    @property
    def figures(self) -> CompassFigures:
        soft = np.diag(self.diagonal) + symmetric(np.array(self.beside)) if any(self.diagonal) else np.eye(3)
        turn = self.in_vehicle
        return CompassFigures(turn @ np.array(self.offset) * self.unit_gauss, turn @ soft @ turn.T)

    def raw_gauss(self, read_gauss: Array) -> Array:
        """Return the raw field in vehicle axes, (3,), from a mean of the telemetry, (3,)."""
        if self.reads_raw:
            return np.asarray(self.in_vehicle @ read_gauss)
        now = self.figures
        return np.asarray(np.linalg.solve(now.soft, read_gauss) - now.offset_gauss)

    def changes(self, figures: CompassFigures) -> list[Change]:
        """Plan the changes to a new correction.

        Raises:
            CalibrationRefusedError: a value beyond the firmware's limits.
        """
        turn = self.in_vehicle
        soft, offset = turn.T @ figures.soft @ turn, turn.T @ figures.offset_gauss / self.unit_gauss
        after = vector(offset), vector(np.diag(soft)), vector(soft[[0, 0, 1], [1, 2, 2]])
        before, found = (self.offset, self.diagonal, self.beside), []
        steps = abs(_FAR_GAUSS / self.unit_gauss), _FAR_SOFT, _FAR_SOFT
        for names, old, new, step, allowed in zip(
            self.names, before, after, steps, (self.offset_range, DIAGONAL, BESIDE), strict=True
        ):
            for name, value in zip(names, new, strict=True):
                if not allowed.holds(value):
                    raise CalibrationRefusedError(f"{name} would be {value:.4g}; allowed: {allowed}")
            if not all(map(same_float32, old, new)):
                found += vector_changes(names, old, new, self.far_axis, step)
        return found


async def read_vectors(parameters: Parameters, names: tuple[Names, Names, Names]) -> tuple[Vector, Vector, Vector]:
    offset, diagonal, beside = [await parameters.read_vector(each) for each in names]
    return offset, diagonal, beside


def no_compass(number: int, reason: str) -> AutopilotError:
    return AutopilotError(message("autopilot_has_no_compass", compass=number, reason=reason))


def compass_ranges(names: tuple[Names, Names, Names], offset: Range) -> dict[str, Range]:
    ranges = zip(names, (offset, DIAGONAL, BESIDE), strict=True)
    return {name: allowed for each, allowed in ranges for name in each}
