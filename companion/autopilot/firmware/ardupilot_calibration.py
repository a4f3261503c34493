"""ArduPilot's parameters of each IMU, and its own calibrations: over temperature, and of the gyros at rest.

Temperature, INS_TCALn_* (AP_InertialSensor_tempcal.cpp, autopilots 10.1): in the IMU's axes, with d the temperature
less 35 degC, both of them held between TMIN and TMAX,

    raw - (P(d) - P(d at CALTEMP)) - offset,    P(d) = (c1 d + c2 d^2 + c3 d^3) 1e-6

so a curve, CALTEMP and the offset belong together. Gyros and accelerometers have coefficients and a CALTEMP each, but
one ENABLE, TMIN and TMAX.

The gyro calibration is used for what only it can do: reset the EKF's gyro bias (autopilots 1.7). Besides (autopilots
1.5, 3, 9.3.1) it measures the gyros of all instances to some 10 deg/h with the Earth's rotation in them, writes their
offsets, calibration temperatures and device ids, and sets to zero what belongs to no gyro. It is answered at its end,
after 0.5 to 30 s; while it runs the offsets read zero. A second command meanwhile is answered early, as if all were
done: so the command leaves once, and its end shows in the offsets.
"""

from __future__ import annotations

import asyncio
import dataclasses
import logging
from collections.abc import Callable, Mapping
from typing import Final, Literal

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.firmware.imu_calibration import ImuCalibration, ImuParameters, Thermal, vector_changes
from companion.autopilot.parameters.change import Change
from companion.autopilot.parameters.reading import LiveParameters, Parameters, read_integer
from companion.autopilot.parameters.wire import same_float32
from companion.errors import AutopilotError, AutopilotRebootedError, NotDisarmedError
from companion.estimation.temperature.curve import ZERO, Polynomial
from companion.physics.frames import vector
from companion.samples import Vector

logger = logging.getLogger(__name__)

INSTANCES: Final = (1, 2, 3, 4, 5)
"""4 and 5 exist from 4.4 on boards with auxiliary instances; no message carries them, so none can be measured."""

REFERENCE_DEGC: Final = 35.0
_UNIT: Final = 1e-6
_ON: Final = 1
_LEARNING: Final = 2

TIMEOUT_S: Final = 40.0
"""Longest wait for the gyro calibration: ArduPilot gives up after some 30 s."""
_LOST_AFTER_S: Final = 3.0
"""Time after the command at which old offsets still in force mean that it was lost or refused."""
_LOOK_S: Final = 0.25
_AFTERWARDS_S: Final = 0.5
"""Time from the last offset to the end of the command: the saving, and the EKF's reset."""

AT_START: Final = "INS_GYR_CAL"
"""1: every start measures the gyros anew."""

Names = tuple[str, str, str]


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class TcalParameters:
    """Parameter names of one IMU's temperature calibration."""

    enable: str
    """0 off, 1 on, 2 learning until the next boot."""
    low: str
    high: str
    gyro: tuple[Names, Names, Names]
    """Coefficients by power of the temperature."""
    accel: tuple[Names, Names, Names]
    gyro_caltemp: str
    """Temperature at which nothing is taken off, deg C; -300: unknown, which is held at TMIN."""
    accel_caltemp: str

    @property
    def deciding(self) -> tuple[str, ...]:
        """All names but the CALTEMPs, which the firmware's own calibrations set; the switch comes last."""
        coefficients = (name for names in (*self.accel, *self.gyro) for name in names)
        return (self.low, self.high, *coefficients, self.enable)


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ArduPilotParameters(ImuParameters):
    """Parameter names of one IMU; the first instance is irregular, 4 and 5 are again (autopilots 1.1)."""

    tcal: TcalParameters
    use: str


def parameters_of(instance: int) -> ArduPilotParameters:
    """Return the parameter names of one IMU, `instance` counting from 1.

    Raises:
        AutopilotError: no such instance.
    """
    if instance not in INSTANCES:
        raise AutopilotError(f"IMU {instance} is not known; allowed are {', '.join(map(str, INSTANCES))}")
    # INS_GYROFFS, INS_GYR2OFFS, INS4_GYROFFS; but INS_GYR1_CALTEMP, INS_TCAL1_ENABLE.
    ins, n = (f"INS{instance}_", "") if instance > 3 else ("INS_", "" if instance == 1 else str(instance))
    tcal = f"INS{instance}_TCAL_" if instance > 3 else f"INS_TCAL{instance}_"
    caltemp = f"INS{instance}_{{}}_CALTEMP" if instance > 3 else f"INS_{{}}{instance}_CALTEMP"

    def xyz(pattern: str) -> Names:
        x, y, z = (pattern.format(axis) for axis in "XYZ")
        return x, y, z

    def coefficients(triad: str) -> tuple[Names, Names, Names]:
        one, two, three = (xyz(f"{tcal}{triad}{power}_{{}}") for power in (1, 2, 3))
        return one, two, three

    return ArduPilotParameters(
        gyro_offset=xyz(f"{ins}GYR{n}OFFS_{{}}"),
        accel_offset=xyz(f"{ins}ACC{n}OFFS_{{}}"),
        accel_scale=xyz(f"{ins}ACC{n}SCAL_{{}}"),
        gyro_id=f"{ins}GYR{n}_ID",
        accel_id=f"{ins}ACC{n}_ID",
        use=f"{ins}USE{n}",
        tcal=TcalParameters(
            enable=f"{tcal}ENABLE",
            low=f"{tcal}TMIN",
            high=f"{tcal}TMAX",
            gyro=coefficients("GYR"),
            accel=coefficients("ACC"),
            gyro_caltemp=caltemp.format("GYR"),
            accel_caltemp=caltemp.format("ACC"),
        ),
    )


# --- temperature


async def read_thermal(parameters: Parameters, instance: int) -> Thermal:
    """Read the temperature calibration of one IMU; it takes nothing off where it is switched off or not built in.

    Raises:
        AutopilotError: it is learning, or as `Parameters.read`.
    """
    names = parameters_of(instance).tcal
    enable = await read_integer(parameters, names.enable)
    if enable is None:
        return Thermal()
    if enable == _LEARNING:
        raise AutopilotError(
            f"{names.enable} = 2: IMU {instance} is learning its temperature calibration;"
            " let it finish, or set it to 0 or 1"
        )
    if enable != _ON:
        return Thermal(values={names.enable: float(enable)})
    found = await parameters.read_many((*names.deciding, names.gyro_caltemp, names.accel_caltemp))

    def polynomial(coefficients: tuple[Names, Names, Names]) -> Polynomial:
        one, two, three = (vector(np.array([found[name] for name in each]) * _UNIT) for each in coefficients)
        return Polynomial(
            coefficients=(ZERO, one, two, three),
            reference_degc=REFERENCE_DEGC,
            low_degc=found[names.low],
            high_degc=found[names.high],
        )

    return Thermal(
        enabled_by=names.enable,
        values={name: found[name] for name in names.deciding},
        gyro=polynomial(names.gyro).zero_at(found[names.gyro_caltemp]),
        accel=polynomial(names.accel).zero_at(found[names.accel_caltemp]),
    )


async def thermal_changes(
    parameters: Parameters, calibration: ImuCalibration, gyro: Polynomial, accel: Polynomial | None, degc: float
) -> list[Change]:
    """Plan curves about 35 degC, as `Firmware.thermal_changes`.

    The offsets belong to this temperature from then on. Without a curve of the accelerometers, one that is in force
    stays, held at the ends of the new span; one that is not is cleared, for it would come into force with the gyros'.
    """
    assert gyro.reference_degc == REFERENCE_DEGC
    names, thermal, own = parameters_of(calibration.instance).tcal, calibration.thermal, calibration.parameters
    if not thermal.values:
        raise AutopilotError(
            f"{names.enable} does not exist: this firmware has no temperature calibration (boards of 1 MB have none)"
        )
    acts = accel is not None or any(map(any, thermal.accel.coefficients))
    caltemps = [names.gyro_caltemp, *([names.accel_caltemp] if acts else [])]
    before = await parameters.read_many((*names.deciding, *caltemps))
    wanted = {name: before[name] if thermal.enabled_by else 0.0 for each in names.accel for name in each}
    for of, curve in ((names.gyro, gyro), *(((names.accel, accel),) if accel is not None else ())):
        for each, values in zip(of, curve.coefficients[1:], strict=True):
            wanted |= zip(each, (value / _UNIT for value in values), strict=True)
    wanted |= {names.low: gyro.low_degc, names.high: gyro.high_degc, names.enable: float(_ON)}
    wanted |= dict.fromkeys(caltemps, degc)

    def moved(of: Names, offset: Vector, by: Vector) -> list[Change]:
        return vector_changes(of, offset, vector(np.add(offset, by)), None)

    taken_gyro, taken_accel = thermal.taken_off(degc)
    changes = [
        *moved(own.accel_offset, calibration.accel_offset_m_s2, vector(taken_accel)),
        *moved(own.gyro_offset, calibration.gyro_offset_rad_s, vector(taken_gyro)),
        # The switch comes last, and is restored first.
        *(Change(name, before[name], wanted[name]) for name in (*caltemps, *names.deciding)),
    ]
    return [change for change in changes if change.before != change.after]


# --- gyros


@dataclasses.dataclass(frozen=True, slots=True)
class GyroParameters:
    """Every parameter that the firmware's own gyro calibration writes."""

    values: Mapping[str, float]
    gyros: tuple[int, ...]
    """Instances with a gyro behind them."""
    tcal: tuple[str, ...]
    """Switches of temperature calibrations that are on: there the calibration changes what an offset means."""

    def changed_in(self, after: GyroParameters) -> dict[str, tuple[float, float]]:
        """Return what differs later: values before and after, by name."""
        return {
            name: (old, after.values[name])
            for name, old in self.values.items()
            if name in after.values and not same_float32(old, after.values[name])
        }


GyroOutcome = Literal["reset", "not converged", "unanswered", "not run"]


@dataclasses.dataclass(frozen=True, slots=True)
class GyroCalibration:
    """End of the firmware's own gyro calibration.

    "reset": converged, the EKF's gyro bias is reset. "not converged": the firmware stored its best guess, did not
    reset the EKF, and refuses to arm ("Gyros not calibrated") until a gyro calibration succeeds or it restarts.
    "unanswered": it ran, and the answer was lost. "not run": refused or lost, nothing has changed.
    """

    outcome: GyroOutcome
    words: str
    """For people; empty for "reset"."""
    after: GyroParameters


class GyrosAtRest:
    """Gyro calibration by command; raises AutopilotError where no answer comes."""

    async def read(self, parameters: LiveParameters) -> GyroParameters:
        """Read every parameter that it writes, of all instances."""
        vehicle = parameters.vehicle
        boots = vehicle.boots
        instances = {number: parameters_of(number) for number in INSTANCES}
        first = await parameters.read_many((names.gyro_offset[0] for names in instances.values()), optional=True)
        present = {number: names for number, names in instances.items() if names.gyro_offset[0] in first}
        if not present:
            raise AutopilotError("the autopilot has no gyro offsets")
        rest = await parameters.read_many(name for names in present.values() for name in names.gyro_offset[1:])
        more = [
            name for names in present.values() for name in (names.tcal.gyro_caltemp, names.gyro_id, names.tcal.enable)
        ]
        found = await parameters.read_many(more, optional=True)
        if vehicle.boots != boots:
            raise AutopilotRebootedError(f"{vehicle.name} restarted while its gyro parameters were read")
        tcal = tuple(names.tcal.enable for names in present.values() if found.get(names.tcal.enable))
        values = {name: value for name, value in {**first, **rest, **found}.items() if not name.endswith("_ENABLE")}
        gyros = tuple(number for number, names in present.items() if found.get(names.gyro_id, 1.0))
        return GyroParameters(values, gyros, tcal)

    async def run(
        self, parameters: LiveParameters, before: GyroParameters, go_on: Callable[[str], None]
    ) -> GyroCalibration:
        """Let the firmware calibrate, once; `before` was read just now, `go_on` is called with the progress in words.

        Raises:
            NotDisarmedError: not disarmed when the command was about to leave: nothing was done.
            AutopilotError: no answer any more, or a restart; any of its parameters may have changed.
        """
        vehicle = parameters.vehicle
        loop = asyncio.get_running_loop()
        boots = vehicle.boots

        def require_same_boot() -> None:
            if vehicle.boots != boots:
                raise AutopilotRebootedError(f"{vehicle.name} restarted during its gyro calibration")

        def result() -> int | None:
            return answer.result() if answer.done() else None

        go_on("the autopilot calibrates its gyros: keep the aircraft still")
        try:
            await vehicle.disarmed.ensure()
        except NotDisarmedError as error:
            raise NotDisarmedError(f"the firmware's gyro calibration was not started: {error}") from error
        answer = vehicle.commands.send(mavlink.MAV_CMD_PREFLIGHT_CALIBRATION, 1.0, timeout_s=TIMEOUT_S)
        sent_s = loop.time()
        try:
            while loop.time() < sent_s + TIMEOUT_S:
                if answer.done():
                    await asyncio.sleep(_LOOK_S)  # reading without a pause would fill the line
                else:
                    await asyncio.wait([answer], timeout=_LOOK_S)
                require_same_boot()
                state = await _look(parameters, before)
                if state == "ended":
                    # An acknowledgement that is still on its way says more than its absence.
                    await asyncio.wait([answer], timeout=_AFTERWARDS_S)
                    break
                if state == "untouched" and (result() is not None or loop.time() > sent_s + _LOST_AFTER_S):
                    break
                if loop.time() > sent_s + 1.0:
                    go_on(
                        f"the autopilot calibrates its gyros for {loop.time() - sent_s:.0f} s: keep the aircraft still"
                    )
            await asyncio.sleep(_AFTERWARDS_S)
            after = await self.read(parameters)
            require_same_boot()
            return _judge(before, after, result())
        finally:
            answer.cancel()

    async def wait_until_over(self, parameters: LiveParameters, before: Mapping[str, float]) -> None:
        """After an interruption, wait until one that may have been started has ended, or never ran."""
        # Old offsets, or zeros, tell nothing while it may run: it stores its result at its end.
        vehicle = parameters.vehicle
        loop = asyncio.get_running_loop()
        boots, since_s = vehicle.boots, loop.time()
        vectors = [names for number in INSTANCES if set(names := parameters_of(number).gyro_offset) <= before.keys()]
        while loop.time() < since_s + TIMEOUT_S and vehicle.boots == boots:
            now = await parameters.read_many([name for names in vectors for name in names], optional=True)
            fitted = [names for names in vectors if any(before[name] or now.get(name) for name in names)]
            same = all(same_float32(now.get(name, 0.0), before[name]) for names in fitted for name in names)
            runs = not all(any(now.get(name) for name in names) for names in fitted)
            if fitted and not runs and (not same or loop.time() > since_s + _LOST_AFTER_S):
                break
            await asyncio.sleep(_LOOK_S)
        await asyncio.sleep(_AFTERWARDS_S)

    async def runs_at_start(self, parameters: Parameters) -> str | None:
        """Return the parameter by which it runs at every start, or None."""
        return AT_START if await parameters.read_optional(AT_START) else None


def _judge(before: GyroParameters, after: GyroParameters, result: int | None) -> GyroCalibration:
    said = "no answer" if result is None else f"result {result}"
    outcome: GyroOutcome
    if result == mavlink.MAV_RESULT_ACCEPTED:
        outcome, words = "reset", ""
    elif not before.changed_in(after):
        outcome, words = "not run", f"the firmware's gyro calibration did not run ({said})"
    elif result is None:
        outcome, words = "unanswered", "the firmware's gyro calibration ran, its answer did not arrive"
    else:
        outcome = "not converged"
        words = (
            f"the firmware's gyro calibration failed ({said}): it will not arm (Gyros not calibrated) until a gyro"
            " calibration succeeds or it restarts"
        )
    if words:
        logger.warning("%s", words)
    return GyroCalibration(outcome, words, after)


async def _look(parameters: LiveParameters, before: GyroParameters) -> Literal["running", "ended", "untouched"]:
    """Tell the state by the offsets: zero while it runs, set together at its end."""
    names = [name for instance in before.gyros for name in parameters_of(instance).gyro_offset]
    now = await parameters.read_many(names)
    vectors = [[now.get(name, 0.0) for name in parameters_of(instance).gyro_offset] for instance in before.gyros]
    if not all(any(vector) for vector in vectors):
        return "running"
    return "untouched" if all(same_float32(now.get(name, 0.0), before.values[name]) for name in names) else "ended"
