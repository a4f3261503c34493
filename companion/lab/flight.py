"""Analysis of flights in a log: active offsets, biases in the air, and the drift of free inertial navigation."""

from __future__ import annotations

import datetime
import hashlib
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

import msgspec
import numpy as np

from companion.autopilot.firmware.base import SlotMemory
from companion.autopilot.firmware.firmwares import firmware_named, read_calibration
from companion.autopilot.firmware.imu_calibration import ImuCalibration, output_step
from companion.autopilot.parameters.change import Change, FirmwareName, Parameters, same_float32
from companion.errors import AutopilotError, StorageError
from companion.estimation.noise.allan import PROFILES, noise_profile
from companion.estimation.records.flight_record import Drift, Flight, ImuFlight, Split, Stages, Term
from companion.estimation.records.record import Record
from companion.estimation.solution.prior import curve_of
from companion.lab import ardupilot_log, inertial, px4_log
from companion.lab.autopilot_logs import Boot, FlownImu
from companion.lab.inertial import LENGTH_S, NO_WINDOWS, SHORT_S, Increments, Navigation
from companion.lab.log_files import format_of
from companion.physics.earth import earth_rate_ned_rad_s, gravity_m_s2
from companion.physics.frames import Floats
from companion.physics.statistics import MAD_TO_SIGMA
from companion.physics.units import DEG_H, MG
from companion.samples import Triad
from companion.storage.records import KnownImu

SPANS_S: Final = (10.0, 30.0, 60.0)
_SETTLED_S: Final = 3.0
"""Time after the take-off and before the landing that is not analysed, s."""
_STOOD_S: Final = 30.0
"""Longest time before the motors' start that is analysed, s."""
_STILL_RAD_S: Final = 0.005
_OUTLIER: Final = 6.0
_USUAL: Final = np.array([30.0 * DEG_H] * 3 + [1.0 * MG])
"""Least assumed scatter of window results: gyro x y z in rad/s, vertical accelerometer in m/s^2."""
_LIFTED_M: Final = 1.5
_LEAST_AIR_S: Final = 15.0
_SLOW_HZ: Final = 80.0
_SYSTEM_ID: Final = ("SYSID_THISMAV", "MAV_SYSID", "MAV_SYS_ID")
"""Names of the parameter with the MAVLink system id: ArduPilot up to 4.6, ArduPilot from 4.7, PX4."""
_UNKNOWN: Final[Sequence[Term | None]] = (None,) * 4

Knowledge = tuple[Sequence[Record], Mapping[str, KnownImu]]
"""Calibration records, the newest first, and learned biases of each IMU, from the companion's disk."""


def read(path: Path) -> Iterator[Boot]:
    match format_of(path):
        case "ulog":
            return px4_log.read(path)
        case "dataflash":
            return ardupilot_log.read(path)
        case _:
            raise StorageError(f"{path}: no log of ArduPilot (.bin) or PX4 (.ulg)")


async def flights(boot: Boot, known: Knowledge) -> list[Flight]:
    reference = boot.truth or boot.solution
    if reference is None:
        return []
    reference = _on_earth(boot, reference)
    # Filters delay the readings; shift them to compare them with the solution of the same instant.
    late: dict[int, Increments] = {}
    for imu in boot.imus:
        rows = inertial.whole(np.column_stack([imu.t_s, imu.readings]))
        if len(rows) > 2:
            found = inertial.increments(rows[:, 0], rows[:, 1:], means=imu.means)
            late[imu.number] = found._replace(t_s=found.t_s - inertial.lag_s(found, reference))
    return [
        Flight(
            key=_key(boot, stages),
            system_id=_system_id(boot.parameters_at(stages.armed_s)),
            began_at=_iso(None if boot.unix_offset_s is None else boot.unix_offset_s + stages.armed_s),
            stages=stages,
            reference="ekf" if boot.truth is None else "truth",
            imus=tuple(
                [
                    await _imu(boot, imu, _during(late[imu.number], stages), stages, reference, known)
                    for imu in boot.imus
                    if imu.number in late
                ]
            ),
            notes=(
                *boot.notes,
                *(f"IMU {imu.number} has nothing to go by in it" for imu in boot.imus if imu.number not in late),
            ),
        )
        for stages in _stages(boot, reference)
    ]


def _key(boot: Boot, stages: Stages) -> str:
    """Make a flight's key by a hash of its parameters, in which both firmwares count their starts and run time."""
    sensors = [(imu.number, imu.gyro_id, imu.accel_id) for imu in boot.imus]
    told = [boot.firmware, stages.armed_s, sensors, sorted(boot.parameters_at(stages.armed_s).items())]
    return hashlib.sha256(msgspec.json.encode(told)).hexdigest()[:16]


def _system_id(values: Mapping[str, float]) -> int | None:
    return next((int(values[name]) for name in _SYSTEM_ID if math.isfinite(values.get(name, math.nan))), None)


def _during(found: Increments, stages: Stages) -> Increments:
    start_s, end_s = stages.armed_s - _STOOD_S, stages.disarmed_s or math.inf
    inside = (found.t_s > start_s) & (found.t_s < end_s)
    return Increments(*(each[inside] for each in found))


def _on_earth(boot: Boot, reference: Navigation) -> Navigation:
    if boot.place is None:
        return reference
    gravity = reference.gravity_m_s2 if boot.standard_gravity else gravity_m_s2(*boot.place)
    rate = earth_rate_ned_rad_s(boot.place[0]) if boot.earth_turns else reference.earth_rate_ned_rad_s
    return reference._replace(gravity_m_s2=gravity, earth_rate_ned_rad_s=rate)


def _stages(boot: Boot, reference: Navigation) -> list[Stages]:
    """List the stages of each flight, one per arming; without a logged arming, the whole log is one flight."""
    logged = [at_s for at_s, state in boot.armed if state]
    armed = logged or [float(reference.t_s[0])]
    found = []
    for k, armed_s in enumerate(armed):
        next_s = armed[k + 1] if k + 1 < len(armed) else math.inf
        disarmed_s = next((at_s for at_s, state in boot.armed if not state and armed_s < at_s < next_s), None)
        end_s = disarmed_s if disarmed_s is not None else min(next_s, float(reference.t_s[-1]))
        motors_s = next((at_s for at_s, state in boot.motors if state and armed_s - 1.0 <= at_s < end_s), None)
        air = [(at_s, state) for at_s, state in boot.airborne if armed_s <= at_s <= end_s + 1.0]
        up_s = next((at_s for at_s, state in air if state), None)
        down_s = next((at_s for at_s, state in reversed(air) if not state), None) if up_s is not None else None
        if up_s is None:
            up_s, down_s = _lifted(reference, armed_s, end_s)
        found.append(Stages(armed_s, motors_s, up_s, down_s, disarmed_s, bool(logged)))
    return found


def _lifted(reference: Navigation, armed_s: float, end_s: float) -> tuple[float | None, float | None]:
    inside = (reference.t_s >= armed_s) & (reference.t_s <= end_s)
    t_s, down = reference.t_s[inside], reference.position[inside, 2]
    high_s = t_s[down < down[:1] - _LIFTED_M]
    return (float(high_s[0]), float(high_s[-1])) if len(high_s) else (None, None)


async def _imu(
    boot: Boot, imu: FlownImu, found: Increments, stages: Stages, reference: Navigation, known: Knowledge
) -> ImuFlight:
    notes: list[str] = []
    calibration = None
    try:
        calibration = await _calibration_in(boot.firmware, boot.parameters_at(stages.armed_s), imu)
    except AutopilotError as error:
        notes.append(str(error))
    records, biases = known
    match = None if calibration is None else _written_in(calibration, records)
    if match is not None and boot.unix_offset_s is not None:
        began_s = datetime.datetime.fromisoformat(match[0].started_at).timestamp()
        after_s = began_s - boot.unix_offset_s - stages.armed_s
        if after_s > 0.0:
            after = datetime.timedelta(seconds=round(after_s))
            notes.append(f"clocks differ: by them its calibration began {after} h after this arming")
    up_s, down_s = stages.take_off_s, stages.landing_s or stages.disarmed_s or float(reference.t_s[-1])
    in_air = None if up_s is None else (up_s + _SETTLED_S, down_s - _SETTLED_S)
    if in_air is None or in_air[1] - in_air[0] < _LEAST_AIR_S:
        in_air = None
        notes.append("it did not fly, or too shortly to tell anything")
    failed_s = imu.failed_s[(imu.failed_s >= stages.armed_s) & (imu.failed_s <= down_s)]
    if len(failed_s):
        after_s = failed_s[0] - stages.armed_s
        notes.append(f"the autopilot found it failed {after_s:.0f} s after arming: what it read then is left aside")
    faster_log = firmware_named(boot.firmware).faster_log
    if imu.rate_hz < _SLOW_HZ and faster_log and not imu.means:
        notes.append(f"logged at {imu.rate_hz:.0f} Hz only: {faster_log} would tell more")
    if len(found.t_s) < 2:
        in_air = None
    ground = NO_WINDOWS if in_air is None else _stood(found, stages, reference)
    stretches = NO_WINDOWS if in_air is None else inertial.windows(found, reference, in_air, LENGTH_S)
    flown = _kept(stretches)
    if aside := len(stretches) - len(flown):
        of = f"{aside} of {len(stretches)} stretches of {LENGTH_S:.0f} s"
        notes.append(f"{of} left aside, far off the others: the EKF has jumped, or the IMU")
    drift: dict[str, list[Drift]] = {}
    ekf = warmth = _UNKNOWN
    if in_air is not None:
        offsets = _offset_sets(calibration, match and match[1], found, in_air)
        drift = inertial.drift(found, reference, in_air, SPANS_S, offsets)
        ekf = _ekf(imu, in_air)
        if calibration is not None:
            warmth = _warmth(imu, calibration, biases, stages, in_air)
    axes = tuple(inertial.split(ground, flown, _means(imu.vibration, flown[:, 0]), warmth, ekf))
    if calibration is not None and (name := calibration.parameters.hover_bias):
        notes += _hover_bias(name, boot.parameters_at(stages.armed_s), axes[-1])
    return ImuFlight(
        imu=imu.number,
        rate_hz=imu.rate_hz,
        calibration=None if match is None else match[0].started_at,
        gyro_id=imu.gyro_id if calibration is None else calibration.gyro_id,
        accel_id=imu.accel_id if calibration is None else calibration.accel_id,
        set_gyro_rad_s=None if calibration is None else calibration.gyro_offset_rad_s,
        set_accel_m_s2=None if calibration is None else calibration.accel_offset_m_s2,
        axes=axes,
        drift=drift,
        notes=tuple(notes),
    )


def _hover_bias(name: str, values: Mapping[str, float], vertical: Split) -> Iterator[str]:
    """Compare the hover bias that ArduPilot learned before this flight with the bias in the air; both are whole."""
    learned = values.get(name, 0.0)
    if learned and math.isfinite(learned):
        used = "subtracted in flight" if values.get("ACC_ZBIAS_LEARN", 0.0) % 4.0 >= 2.0 else "not in use"
        seen = vertical.in_flight
        beside = "" if seen is None else f"; here in the air {seen.value / MG:+.1f} ± {seen.sigma / MG:.1f} mg"
        yield f"accel z: {name}, learned in hover, {used}, is {learned / MG:+.1f} mg{beside}"


def _stood(found: Increments, stages: Stages, reference: Navigation) -> Floats:
    """Compare windows of readings before the motors' start with zero motion: it is more exact than logged motion."""
    end_s = (stages.motors_s or stages.armed_s) - 0.5
    start_s = max(end_s - _STOOD_S, float(reference.t_s[0]))
    if end_s - start_s < 3 * SHORT_S:
        return NO_WINDOWS
    times = np.arange(start_s - 1.0, end_s + 1.0, 0.25)
    attitude = reference.attitude[min(int(np.searchsorted(reference.t_s, end_s)), len(reference.t_s) - 1)]
    zeros = np.zeros((len(times), 3))
    still = reference._replace(t_s=times, attitude=np.tile(attitude, (len(times), 1)), velocity=zeros, position=zeros)
    rows = _kept(inertial.windows(found, still, (start_s, end_s), SHORT_S))
    return rows if len(rows) and rows[:, 1:4].std(axis=0).max() < _STILL_RAD_S else NO_WINDOWS


def _kept(rows: Floats) -> Floats:
    """Remove windows in which the navigation solution has jumped, such as at a reset of its heading."""
    if len(rows) < 4:
        return rows
    off = np.abs(rows[:, 1:5] - np.median(rows[:, 1:5], axis=0))
    usual = np.maximum(MAD_TO_SIGMA * np.median(off, axis=0), _USUAL)
    return np.asarray(rows[(off <= _OUTLIER * usual).all(axis=1)])


def _means(table: Floats, times_s: Floats) -> Floats | None:
    if len(table) < 2:
        return None
    edges = [table[:-1, 0].searchsorted([at_s - LENGTH_S / 2, at_s + LENGTH_S / 2]) for at_s in times_s]
    return np.array([table[a : max(b, a + 1), 1].mean() for a, b in edges])


def _ekf(imu: FlownImu, in_air: tuple[float, float]) -> Sequence[Term | None]:
    """Average the EKF's biases over the flight's second half; sigma: the EKF's, the log's rounding, and the scatter."""
    found = imu.estimated
    if found is None:
        return _UNKNOWN
    late = (found[:, 0] >= 0.5 * (in_air[0] + in_air[1])) & (found[:, 0] <= in_air[1])
    values, sigmas = found[late, 1:5], found[late, 5:]
    if not late.any() or not np.isfinite(sigmas).all():
        return _UNKNOWN
    return _terms(values.mean(axis=0), np.hypot(values.std(axis=0), sigmas.mean(axis=0)))


def _terms(values: Floats, sigmas: Floats) -> list[Term]:
    return [Term(*each) for each in zip(values.tolist(), sigmas.tolist(), strict=True)]


def _offset_sets(
    calibration: ImuCalibration | None,
    before: Mapping[str, float] | None,
    found: Increments,
    in_air: tuple[float, float],
) -> dict[str, tuple[Floats, Floats]]:
    """Return the output changes (SI) to compare: "before", as if the earlier offsets were active; "flown", zero."""
    sets: dict[str, tuple[Floats, Floats]] = {}
    if calibration is not None and before:
        inside = (found.t_s >= in_air[0]) & (found.t_s <= in_air[1])
        accel = found.velocity[inside].sum(axis=0) / max(float(found.dt_s[inside].sum()), 1e-9)
        own = calibration.corrections
        changes = [Change(name, own[name], value) for name, value in before.items() if name in own]
        gyro, force = output_step(calibration, changes, tuple(accel.tolist()))
        sets["before"] = np.array(gyro), np.array(force)
    return {**sets, "flown": (np.zeros(3), np.zeros(3))}


def _warmth(
    imu: FlownImu,
    calibration: ImuCalibration,
    biases: Mapping[str, KnownImu],
    stages: Stages,
    in_air: tuple[float, float],
) -> Sequence[Term | None]:
    own = next((one for one in biases.values() if _is_same(one.identity, imu, calibration)), None)
    start_s = stages.motors_s or stages.armed_s
    seen = [
        imu.degc[(imu.degc[:, 0] >= a) & (imu.degc[:, 0] <= b), 1] for a, b in ((start_s - _STOOD_S, start_s), in_air)
    ]
    if own is None or not all(map(len, seen)):
        return _UNKNOWN
    part = own.identity.get("profile", "")
    curve = curve_of(own.points, "gyro", noise_profile(part if part in PROFILES else None).gyro)
    then, now = (float(degc.mean()) for degc in seen)
    if curve is None or max(curve.beyond_k(then), curve.beyond_k(now)) > 0.0:
        return _UNKNOWN
    step, variance = curve.change((then, 0.0), (now, 0.0))
    return [*_terms(step - calibration.thermal_change("gyro", then, now), np.sqrt(variance)), None]


def _is_same(identity: Mapping[str, str], imu: FlownImu, calibration: ImuCalibration) -> bool:
    if identity.get("source") != "autopilot" or identity.get("instance") != str(imu.number):
        return False
    return identity.get("gyro", "") in ("", str(calibration.gyro_id))


# --- active offsets


class _LoggedParameters(Parameters):
    firmware: FirmwareName | None = None
    boots = 1

    def __init__(self, firmware: FirmwareName, values: Mapping[str, float]) -> None:
        self.firmware, self._values = firmware, values

    async def ensure_same_boot(self, boots: int, doing: str) -> None:
        pass

    async def read(self, name: str) -> float:
        if name not in self._values:
            raise AutopilotError(f"the log has no parameter {name}")
        return self._values[name]

    async def read_optional(self, name: str) -> float | None:
        return self._values.get(name)

    async def read_many(self, names: Iterable[str], *, optional: bool = False) -> dict[str, float]:
        return {name: await self.read(name) for name in names if not optional or name in self._values}


async def _calibration_in(firmware: FirmwareName, values: Mapping[str, float], imu: FlownImu) -> ImuCalibration:
    memory = SlotMemory()
    ids: dict[Triad, int | None] = {"gyro": imu.gyro_id, "accel": imu.accel_id}
    for sensor, device_id in ids.items():
        if device_id is not None:
            memory.learn(sensor, device_id, imu.number)
    return await read_calibration(_LoggedParameters(firmware, values), imu.number, memory)


def _written_in(calibration: ImuCalibration, records: Sequence[Record]) -> tuple[Record, dict[str, float]] | None:
    """Find the latest calibration that wrote the active offsets, and the values before it; `records`: newest first.

    Records are matched by offsets and not by time: the clocks of companion and autopilot may be years apart.
    """
    in_force = calibration.offsets
    for record in records:
        if record.state != "done" or record.undone_at:
            continue
        written = {name: one for imu in record.imus for name, one in imu.written.items() if name in in_force}
        if written and all(same_float32(one.after, in_force[name]) for name, one in written.items()):
            return record, {name: one.before for name, one in written.items() if one.before is not None}
    return None


def _iso(unix_s: float | None) -> str | None:
    """Format a time in UTC, ISO 8601; None for an unknown or impossible time."""
    if unix_s is None or not 0.0 < unix_s < 1e11:
        return None
    return datetime.datetime.fromtimestamp(unix_s, tz=datetime.UTC).isoformat(timespec="seconds")
