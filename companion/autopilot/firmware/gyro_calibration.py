"""ArduPilot's own gyro calibration, for the one thing that only it can do: reset the EKF's gyro bias (autopilots 1.7).

What the command does besides (autopilots 1.5, 3, 9.3.1): it measures the gyros of all instances to some 10 deg/h with
the Earth's rotation in them, writes their offsets, calibration temperatures and device ids, and sets what belongs to
no gyro to zero. It is answered only at its end, after 0.5 to 30 s. While it runs the offsets read zero. A second one
meanwhile is answered early, as if all were done: so the command leaves once, whatever becomes of it, and its end is
told by the offsets.
"""

from __future__ import annotations

import asyncio
import dataclasses
import logging
from collections.abc import Callable, Mapping
from typing import Final, Literal

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.firmware.ardupilot import INSTANCES, parameters_of
from companion.autopilot.parameters.client import ParameterClient
from companion.autopilot.parameters.wire import same_float32
from companion.autopilot.vehicle.vehicle import Vehicle
from companion.errors import AutopilotError, AutopilotRebootedError, NotDisarmedError

logger = logging.getLogger(__name__)

TIMEOUT_S: Final = 40.0
"""ArduPilot gives up after some 30 s."""

_LOST_AFTER_S: Final = 3.0
"""How long after the command old offsets still in force mean that it has not arrived, or was refused."""

_LOOK_S: Final = 0.25
_AFTERWARDS_S: Final = 0.5
"""Time from the last offset to the end of the command: the saving, and the EKF's reset."""

Outcome = Literal["reset", "not converged", "unanswered", "not run"]


@dataclasses.dataclass(frozen=True, slots=True)
class GyroParameters:
    """Everything that the calibration writes, of all instances that the firmware has."""

    values: Mapping[str, float]
    gyros: tuple[int, ...]
    """Instances with a gyro behind them."""
    tcal: tuple[str, ...]
    """INS_TCALn_ENABLE and the like that are not 0: there the calibration changes what an offset means."""


@dataclasses.dataclass(frozen=True, slots=True)
class GyroCalibration:
    """How it ended, and what it left behind.

    "reset": converged, the EKF's gyro bias is reset. "not converged": the firmware stored its best guess, did not
    reset the EKF, and refuses to arm ("Gyros not calibrated") until a gyro calibration succeeds or it restarts.
    "unanswered": it ran, and the answer was lost. "not run": refused or lost, nothing has changed.
    """

    outcome: Outcome
    words: str
    """For people; empty for "reset"."""
    after: GyroParameters


async def read_gyro_parameters(parameters: ParameterClient) -> GyroParameters:
    """Read afresh everything that the firmware's gyro calibration writes.

    Raises:
        AutopilotError: no answer, or it restarted meanwhile.
    """
    vehicle = parameters.vehicle
    boots = vehicle.boots
    instances = {number: parameters_of(number) for number in INSTANCES}
    first = await parameters.read_many((names.gyro_offset[0] for names in instances.values()), optional=True)
    present = {number: names for number, names in instances.items() if names.gyro_offset[0] in first}
    if not present:
        raise AutopilotError("the autopilot has no gyro offsets")
    rest = await parameters.read_many(name for names in present.values() for name in names.gyro_offset[1:])
    more = [name for names in present.values() for name in (names.tcal.gyro_caltemp, names.gyro_id, names.tcal.enable)]
    found = await parameters.read_many(more, optional=True)
    if vehicle.boots != boots:
        raise AutopilotRebootedError(f"{vehicle.name} restarted while its gyro parameters were read")
    tcal = tuple(names.tcal.enable for names in present.values() if found.get(names.tcal.enable))
    values = {name: value for name, value in {**first, **rest, **found}.items() if not name.endswith("_ENABLE")}
    gyros = tuple(number for number, names in present.items() if found.get(names.gyro_id, 1.0))
    return GyroParameters(values, gyros, tcal)


async def calibrate_gyros(
    parameters: ParameterClient, before: GyroParameters, go_on: Callable[[str], None]
) -> GyroCalibration:
    """Let the firmware calibrate its gyros, once; returns when it is surely over.

    `before`: as read just now; `go_on`: told now and then what is going on.

    Raises:
        NotDisarmedError: not disarmed when the command was about to leave: nothing was done.
        AutopilotRebootedError: the autopilot restarted meanwhile; any of its gyro parameters may have changed.
        AutopilotError: it does not answer any more; any of its gyro parameters may have changed.
    """
    vehicle = parameters.vehicle
    loop = asyncio.get_running_loop()
    boots = vehicle.boots
    go_on("the autopilot calibrates its gyros: keep the aircraft still")
    try:
        await vehicle.disarmed.ensure()
    except NotDisarmedError as error:
        raise NotDisarmedError(f"the firmware's gyro calibration was not started: {error}") from error
    answer = vehicle.commands.send(mavlink.MAV_CMD_PREFLIGHT_CALIBRATION, 1.0, timeout_s=TIMEOUT_S)
    sent_s = loop.time()
    try:
        while loop.time() < sent_s + TIMEOUT_S:
            await _pause(answer)
            _require_same_boot(vehicle, boots)
            state = await _look(parameters, before)
            result = answer.result() if answer.done() else None
            if state == "ended":
                # An acknowledgement that is still on its way says more than its absence.
                await asyncio.wait([answer], timeout=_AFTERWARDS_S)
                break
            if state == "untouched" and (result is not None or loop.time() > sent_s + _LOST_AFTER_S):
                break
            if loop.time() > sent_s + 1.0:
                go_on(f"the autopilot calibrates its gyros for {loop.time() - sent_s:.0f} s: keep the aircraft still")
        await asyncio.sleep(_AFTERWARDS_S)
        after = await read_gyro_parameters(parameters)
        _require_same_boot(vehicle, boots)
        return _judge(before, after, answer.result() if answer.done() else None)
    finally:
        answer.cancel()


async def wait_until_over(parameters: ParameterClient, before: Mapping[str, float]) -> None:
    """After an interruption: wait until a calibration that may have been started has surely ended, or never ran.

    Offsets of before, or zero, tell nothing while it may run: it stores what it has found at its end.

    Raises:
        AutopilotError: the autopilot does not answer.
    """
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


async def _pause(answer: asyncio.Future[int | None]) -> None:
    """Until the answer or the next look; no earlier answer shortens that: looking without a pause fills the line."""
    if answer.done():
        await asyncio.sleep(_LOOK_S)
    else:
        await asyncio.wait([answer], timeout=_LOOK_S)


def _judge(before: GyroParameters, after: GyroParameters, result: int | None) -> GyroCalibration:
    ran = changed(before, after)
    said = "no answer" if result is None else f"result {result}"
    outcome: Outcome
    if result == mavlink.MAV_RESULT_ACCEPTED:
        outcome, words = "reset", ""
    elif not ran:
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


def changed(before: GyroParameters, after: GyroParameters) -> dict[str, tuple[float, float]]:
    """What differs, by name: before and after."""
    return {
        name: (old, after.values[name])
        for name, old in before.values.items()
        if name in after.values and not same_float32(old, after.values[name])
    }


async def _look(parameters: ParameterClient, before: GyroParameters) -> Literal["running", "ended", "untouched"]:
    """Where it stands, told by the offsets: zero while it runs, set together at its end."""
    names = [name for instance in before.gyros for name in parameters_of(instance).gyro_offset]
    now = await parameters.read_many(names)
    vectors = [[now.get(name, 0.0) for name in parameters_of(instance).gyro_offset] for instance in before.gyros]
    if not all(any(vector) for vector in vectors):
        return "running"
    old = [before.values[name] for name in names]
    return "untouched" if all(map(same_float32, (now.get(n, 0.0) for n in names), old)) else "ended"


def _require_same_boot(vehicle: Vehicle, boots: int) -> None:
    if vehicle.boots != boots:
        raise AutopilotRebootedError(f"{vehicle.name} restarted during its gyro calibration")
