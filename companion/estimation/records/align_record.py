"""Records of alignments: the gradienter's zero, six-position calibrations, and turns of the aircraft on the spot.

The keys are a public interface. An unknown figure is None, never zero.
"""

from __future__ import annotations

from typing import Literal

import msgspec
import numpy as np

from companion.estimation.alignment.align import DETERMINED, Figures, ImuAlignment
from companion.estimation.alignment.align_model import PRIOR_BIAS_M_S2, PRIOR_SCALE, PRIOR_SHEAR, PoseMeans
from companion.estimation.alignment.faces import BIAS, SCALE, SHEAR, FacesEstimate, Mounting
from companion.estimation.records.record import WrittenParameter
from companion.physics.frames import Array, Matrix, roll_pitch_from_up, vector
from companion.physics.units import DEG, DEG_H, MG
from companion.samples import Vector

FORMAT_VERSION = 1
_MOST_DEG = 90.0  # Limit of a gradienter's zero and of its sigma
SAME_START_S = 30.0
"""Largest difference of two start times, s, that count as one start: two clocks drift so far apart in weeks. A restart
changes the start time by at least the uptime before it."""

Pair = tuple[float, float]
Kind = Literal["zero", "tilts"]


class GradienterSettings(msgspec.Struct, frozen=True, kw_only=True):
    """Configuration of the gradienter during an alignment; the alignment is used with this configuration only."""

    port: str
    protocol: str
    law: str
    mounting: str | Vector
    offset_deg: Pair


class Determined(msgspec.Struct, frozen=True, kw_only=True):
    """Three figures, mostly one per axis, with one sigma each.

    `known` is False for a figure that the poses do not determine; the figure's sigma is then about its prior's.
    """

    value: Vector
    sigma: Vector
    known: tuple[bool, bool, bool]


class LevelRecord(msgspec.Struct, frozen=True, kw_only=True):
    """Biases of one IMU in vehicle axes (FRD), after the offsets that the autopilot subtracts.

    `level_bias_mg` is the effective accelerometer bias on a horizontal base, as by a firmware's level calibration.
    """

    name: str
    temperature_degc: float | None
    level_bias_mg: Vector  # With scale errors and misalignment, which look like a bias there
    level_sigma_mg: Vector
    gyro_bias_deg_h: Determined


class ImuAlignmentRecord(LevelRecord, frozen=True, kw_only=True):
    """Alignment result of one IMU against a gradienter (tilt sensor).

    `accel_bias_mg` is the bias alone, without scale, shear and misalignment, which look like a bias at one attitude.
    """

    accel_bias_mg: Determined
    accel_scale: Determined
    accel_shear: Determined  # xy, xz, yz
    misalignment_deg: Determined  # Small rotation from the gradienter's axes to this IMU's


class StandRecord(msgspec.Struct, frozen=True, kw_only=True):
    x_deg: float | None
    y_deg: float | None
    roll_deg: float
    pitch_deg: float
    heading_deg: float
    on_spot: bool
    seconds: float


class SpotRecord(msgspec.Struct, frozen=True, kw_only=True):
    format_version: int = FORMAT_VERSION
    measured_at: str
    slope_deg: float
    checked: bool  # True if the poses would have revealed a moved parking place
    chi_square: float
    freedom: int
    stands: tuple[StandRecord, ...]
    warnings: tuple[str, ...] = ()


class AlignmentRecord(SpotRecord, frozen=True, kw_only=True):
    kind: Kind
    gradienter: GradienterSettings
    offset_deg: Pair
    """Measured zero of the gradienter on its axes x and y; it adds to the configured `gradienter.offset_deg`."""
    sigma_deg: float
    covariance_deg2: tuple[Pair, Pair]
    temperature_degc: float | None
    imus: tuple[ImuAlignmentRecord, ...]


class FaceRecord(msgspec.Struct, frozen=True, kw_only=True):
    up: Vector
    seconds: float


class Running(msgspec.Struct, frozen=True, kw_only=True):
    """Identity of one power-up of a sensor; biases change with each power-up."""

    host: str  # Identity of the companion computer's start; times are on its clock
    started_s: float
    up_s: float

    def is_same(self, other: Running) -> bool:
        return self.host == other.host != "" and abs(self.started_s - other.started_s) < SAME_START_S


class FacesImuRecord(msgspec.Struct, frozen=True, kw_only=True):
    """Six-position calibration of one IMU, in its own axes, after the offsets that the autopilot subtracts.

    `left_out`: numbers, from 1, of the positions that do not fit the others. `scatter_mg` is the rms of the corrected
    readings' length minus gravity. `whole_bias_mg` is the bias of the output without any offset, as it is written;
    None: the record is of an earlier version.
    """

    name: str
    accel_id: int | None
    corrections: dict[str, float]
    temperature_degc: float | None
    running: Running | None = None
    accel_bias_mg: Determined
    accel_scale: Determined
    accel_shear: Determined  # xy, xz, yz; no firmware corrects it
    left_out: tuple[int, ...]
    scatter_mg: float
    written: dict[str, WrittenParameter]
    whole_bias_mg: Vector | None = None


class FacesRecord(msgspec.Struct, frozen=True, kw_only=True):
    format_version: int = FORMAT_VERSION
    kind: Literal["faces"] = "faces"
    measured_at: str
    gravity_m_s2: float
    stands: tuple[FaceRecord, ...]
    imus: tuple[FacesImuRecord, ...]
    warnings: tuple[str, ...] = ()


def check(record: AlignmentRecord | FacesRecord) -> None:
    """Verify that the figures of an alignment record are possible.

    Raises:
        msgspec.ValidationError: a figure that no sensor has.
    """
    if isinstance(record, FacesRecord):
        found = [(imu.accel_bias_mg.value, imu.accel_bias_mg.sigma, 1e4) for imu in record.imus]
        found += [(imu.accel_scale.value, imu.accel_scale.sigma, 0.5) for imu in record.imus]
    else:
        found = [((*record.offset_deg, 0.0), (record.sigma_deg,) * 3, _MOST_DEG)]
    for value, sigma, most in found:
        if not np.abs([*value, *sigma]).max() < most or min(sigma) <= 0.0:
            raise msgspec.ValidationError(f"{value} with a sigma of {sigma} is impossible")


class TurnImuRecord(LevelRecord, frozen=True, kw_only=True):
    written: dict[str, WrittenParameter] = {}
    whole_bias_mg: Vector | None = None
    """Effective accelerometer bias on a horizontal base, without the autopilot's offsets; None: older record."""


class BoardRecord(msgspec.Struct, frozen=True, kw_only=True):
    """Tilt of the autopilot's board in the aircraft: the board's roll (right side down) and pitch on a horizontal base.

    The accelerometers of `imu` measured the tilt; a six-position calibration measured their bias and scale before.
    """

    imu: str
    faces_measured_at: str
    roll_deg: float
    pitch_deg: float
    sigma_deg: tuple[float, float]
    written: dict[str, WrittenParameter] = {}


class TurnRecord(SpotRecord, frozen=True, kw_only=True):
    kind: Literal["turn"] = "turn"
    imus: tuple[TurnImuRecord, ...]
    board: BoardRecord | None = None  # None without a six-position calibration


class CompassFiguresRecord(msgspec.Struct, frozen=True, kw_only=True):
    """Correction of one of the autopilot's compasses, in vehicle axes (FRD): soft @ (raw + offset).

    `heading_sigma_deg`: one sigma of its heading, all round, on the level and leaned by 10 degrees. `scatter_mgauss`:
    of the field from pose to pose. `strength`: horizontal field over the Earth's.
    """

    number: int
    device_id: int
    offset_mgauss: Vector
    offset_sigma_mgauss: Vector
    soft_diagonal: Vector
    soft_beside: Vector  # xy, xz, yz
    heading_sigma_deg: float
    heading_sigma_leaned_deg: float
    heading_before_deg: float  # Largest heading error, all round, that the present correction leaves
    scatter_mgauss: float
    strength: float
    written: dict[str, WrittenParameter] = {}


class CompassRecord(msgspec.Struct, frozen=True, kw_only=True):
    format_version: int = FORMAT_VERSION
    kind: Literal["compass"] = "compass"
    measured_at: str
    field_gauss: float
    inclination_deg: float
    declination_deg: float
    tilt_deg: float  # Largest of all poses
    heading_deg: float  # True heading of the first pose, as found
    heading_sigma_deg: float
    turns_deg: tuple[float, ...]
    compasses: tuple[CompassFiguresRecord, ...]
    warnings: tuple[str, ...] = ()


HandRecord = AlignmentRecord | FacesRecord | TurnRecord | CompassRecord


def stand_record(stand: PoseMeans, attitude: Matrix, seconds: float, configured: Pair) -> StandRecord:
    roll, pitch = roll_pitch_from_up(-attitude[:, 2])
    tilt = stand.tilt_deg
    return StandRecord(
        x_deg=None if tilt is None else round(tilt[0] + configured[0], 5),
        y_deg=None if tilt is None else round(tilt[1] + configured[1], 5),
        roll_deg=round(roll / DEG, 4),
        pitch_deg=round(pitch / DEG, 4),
        heading_deg=round(float(np.degrees(np.arctan2(attitude[0, 1], attitude[0, 0]))) % 360.0, 2),
        on_spot=stand.on_spot,
        seconds=seconds,
    )


def imu_record(imu: ImuAlignment, temperature_degc: float | None) -> ImuAlignmentRecord:
    return ImuAlignmentRecord(
        name=imu.name,
        temperature_degc=temperature_degc,
        level_bias_mg=_axes(imu.level_bias_m_s2 / MG),
        level_sigma_mg=_axes(np.sqrt(np.diag(imu.level_covariance_m2_s4)) / MG),
        accel_bias_mg=_determined(imu.accel_bias_m_s2, MG),
        accel_scale=_determined(imu.scale, 1.0),
        accel_shear=_determined(imu.shear, 1.0),
        misalignment_deg=_determined(imu.misalignment_rad, DEG),
        gyro_bias_deg_h=_determined(imu.gyro_bias_rad_s, DEG_H),
    )


def turn_imu_record(imu: ImuAlignment, temperature_degc: float | None, whole_m_s2: Array) -> TurnImuRecord:
    level = msgspec.convert(imu_record(imu, temperature_degc), TurnImuRecord, from_attributes=True)
    return msgspec.structs.replace(level, whole_bias_mg=_axes(whole_m_s2 / MG))


def board_record(board: Mounting, imu: str, faces_measured_at: str) -> BoardRecord:
    roll_sigma, pitch_sigma = np.round(board.sigma_rad / DEG, 4).tolist()
    return BoardRecord(
        imu=imu,
        faces_measured_at=faces_measured_at,
        roll_deg=round(board.roll_rad / DEG, 4),
        pitch_deg=round(board.pitch_rad / DEG, 4),
        sigma_deg=(roll_sigma, pitch_sigma),
    )


def faces_imu_record(
    found: FacesEstimate,
    *,
    name: str,
    accel_id: int | None,
    corrections: dict[str, float],
    temperature_degc: float | None,
    running: Running | None,
    whole_m_s2: Array,
) -> FacesImuRecord:
    def part(place: slice, unit: float, prior: float) -> Determined:
        sigma = found.sigma[place]
        return _determined(Figures(found.figures[place], sigma, sigma < DETERMINED * prior), unit)

    kept = [k for k in range(len(found.off_m_s2)) if k not in found.left_out]
    return FacesImuRecord(
        name=name,
        accel_id=accel_id,
        corrections=corrections,
        temperature_degc=temperature_degc,
        running=running,
        accel_bias_mg=part(BIAS, MG, PRIOR_BIAS_M_S2),
        accel_scale=part(SCALE, 1.0, PRIOR_SCALE),
        accel_shear=part(SHEAR, 1.0, PRIOR_SHEAR),
        left_out=tuple(k + 1 for k in found.left_out),
        scatter_mg=round(float(np.sqrt(np.mean(np.square(found.off_m_s2[kept])))) / MG, 4),
        written={},
        whole_bias_mg=_axes(whole_m_s2 / MG),
    )


def completed(
    record: HandRecord,
    warnings: tuple[str, ...],
    written: dict[str, dict[str, WrittenParameter]],
    level: dict[str, WrittenParameter],
) -> HandRecord:
    """Add warnings and written parameters to a record: `written` by name of the IMU, `level` for the board's tilt."""
    replace = msgspec.structs.replace
    if isinstance(record, CompassRecord):
        found = tuple(replace(one, written=written.get(f"compass {one.number}", {})) for one in record.compasses)
        return replace(record, compasses=found, warnings=warnings)
    if isinstance(record, AlignmentRecord):
        return replace(record, warnings=warnings)
    imus = tuple(replace(imu, written=written.get(imu.name, {})) for imu in record.imus)
    if isinstance(record, FacesRecord):
        return replace(record, imus=imus, warnings=warnings)
    board = None if record.board is None else replace(record.board, written=level)
    return replace(record, imus=imus, board=board, warnings=warnings)


def _determined(figures: Figures, unit: float) -> Determined:
    x, y, z = (bool(one) for one in figures.determined)
    return Determined(value=_axes(figures.value / unit), sigma=_axes(figures.sigma / unit), known=(x, y, z))


def _axes(values: Array) -> Vector:
    return vector(np.round(values, 7))
