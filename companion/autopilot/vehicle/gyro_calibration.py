"""ArduPilot's own gyro calibration, by command: only this resets the EKF's gyro bias (docs/reference/autopilots 1.7).

The calibration also measures the gyros of all IMUs to some 10 deg/h, with the Earth's rotation in the result
(docs/reference/autopilots 1.5, 3, 9.3.1). It writes their offsets, calibration temperatures and device ids, and zeros
the values of absent gyros. The answer comes at its end, after 0.5 to 30 s; while it runs the offsets read zero. A
second command meanwhile gets an early answer, as if all were done. So the command is sent once, and the offsets show
when the calibration ends.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Mapping
from typing import Final, Literal

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.firmware.ardupilot import INSTANCES, ArduPilotParameters
from companion.autopilot.parameters.change import same_float32
from companion.autopilot.vehicle.parameter_client import ParameterClient
from companion.errors import AutopilotError, NotDisarmedError
from companion.messages import message

logger = logging.getLogger(__name__)

TIMEOUT_S: Final = 40.0  # longest wait: ArduPilot gives up after some 30 s
_LOST_AFTER_S: Final = 3.0  # if the old offsets are still there after this time, the command was lost or refused
_LOOK_S: Final = 0.25
_AFTERWARDS_S: Final = 0.5  # time from the last offset to the end of the calibration, for saving and the EKF's reset

GyroOutcome = Literal["reset", "not converged", "unanswered", "not run"]
"""Outcome of the calibration.

"reset": converged, the EKF's gyro bias is reset. "not converged": the firmware stored its best guess, did not reset the
EKF, and refuses to arm ("Gyros not calibrated") until a gyro calibration succeeds or it restarts. "unanswered": the
calibration ran, but the answer was lost. "not run": the command was refused or lost, and nothing has changed.
"""


async def read_overwritten(parameters: ParameterClient) -> dict[str, float]:
    """Read every parameter that the calibration writes, of all IMUs; raise AutopilotError after a restart."""
    boots, every = parameters.boots, [ArduPilotParameters(instance) for instance in INSTANCES]
    found = await parameters.read_many((names.gyro_offset[0] for names in every), optional=True)
    present = [names for names in every if names.gyro_offset[0] in found]
    if not present:
        raise AutopilotError(message("autopilot_has_no_imu", imu=1, reason=f"{every[0].gyro_offset[0]} does not exist"))
    found |= await parameters.read_many(name for names in present for name in names.gyro_offset[1:])
    more = (name for names in present for name in (names.gyro_caltemp, names.gyro_id))
    found |= await parameters.read_many(more, optional=True)
    parameters.require_same_boot(boots, "its parameters were read")
    return found


async def read_active_tcal(parameters: ParameterClient, values: Mapping[str, float]) -> list[str]:
    """Return the switches of active temperature calibrations; a gyro calibration changes CALTEMP, thus their effect."""
    switches = [names.tcal_enable for names in _present(values)]
    return [name for name, value in (await parameters.read_many(switches, optional=True)).items() if value]


def changed(before: Mapping[str, float], after: Mapping[str, float]) -> dict[str, tuple[float, float]]:
    both = {name: (old, after[name]) for name, old in before.items() if name in after}
    return {name: pair for name, pair in both.items() if not same_float32(*pair)}


async def calibrate(
    parameters: ParameterClient, before: Mapping[str, float], go_on: Callable[[str], None]
) -> tuple[GyroOutcome, str, dict[str, float]]:
    """Run the firmware's calibration once; return the outcome, a warning ("": none) and the present values.

    `before`: the values just before the calibration; `go_on` is called with the progress as text.

    Raises:
        NotDisarmedError: not disarmed just before the command; nothing was done.
        AutopilotError: the autopilot stopped answering or restarted; any of the parameters may have changed.
    """
    vehicle, loop = parameters.vehicle, asyncio.get_running_loop()
    boots = vehicle.boots
    go_on(message("firmware_gyro_calibration_runs", seconds="0"))
    try:
        await vehicle.disarmed.ensure()
    except NotDisarmedError as error:
        words = message("firmware_gyro_calibration_failed", failure="did not run", reason=error)
        raise NotDisarmedError(words) from error
    answer = vehicle.commands.send(mavlink.MAV_CMD_PREFLIGHT_CALIBRATION, 1.0, timeout_s=TIMEOUT_S)
    sent_s = loop.time()
    try:
        while loop.time() < sent_s + TIMEOUT_S:
            if answer.done():
                await asyncio.sleep(_LOOK_S)  # reads without a pause would fill the line
            else:
                await asyncio.wait([answer], timeout=_LOOK_S)
            parameters.require_same_boot(boots, "it calibrated its gyros")
            state = await _state(parameters, before)
            if state == "ended":
                # Wait for the ACK, which may still be on its way and has the result.
                await asyncio.wait([answer], timeout=_AFTERWARDS_S)
                break
            answered = answer.done() and answer.result() is not None
            if state == "untouched" and (answered or loop.time() > sent_s + _LOST_AFTER_S):
                break
            if loop.time() > sent_s + 1.0:
                go_on(message("firmware_gyro_calibration_runs", seconds=f"{loop.time() - sent_s:.0f}"))
        await asyncio.sleep(_AFTERWARDS_S)
        after = await read_overwritten(parameters)
        parameters.require_same_boot(boots, "it calibrated its gyros")
        outcome, words = _judge(answer.result() if answer.done() else None, ran=bool(changed(before, after)))
        return outcome, words, after
    finally:
        answer.cancel()


async def wait_until_over(parameters: ParameterClient, before: Mapping[str, float]) -> None:
    """Wait, after an interruption, until a calibration that may have started has ended, or surely did not run."""
    # Old offsets or zeros prove nothing yet, as the calibration stores its result at its end.
    vehicle, loop = parameters.vehicle, asyncio.get_running_loop()
    boots, since_s = vehicle.boots, loop.time()
    while loop.time() < since_s + TIMEOUT_S and vehicle.boots == boots:
        state = await _state(parameters, before)
        if state == "ended" or (state == "untouched" and loop.time() > since_s + _LOST_AFTER_S):
            break
        await asyncio.sleep(_LOOK_S)
    await asyncio.sleep(_AFTERWARDS_S)


async def _state(parameters: ParameterClient, before: Mapping[str, float]) -> Literal["running", "ended", "untouched"]:
    """Read the calibration's state from the offsets of present gyros: zero while it runs, all set at its end."""
    vectors = [names.gyro_offset for names in _present(before) if before.get(names.gyro_id, 1.0)]
    offsets = [name for vector in vectors for name in vector]
    now = dict.fromkeys(offsets, 0.0) | await parameters.read_many(offsets, optional=True)
    if not all(any(now[name] for name in vector) for vector in vectors):
        return "running"
    return "untouched" if all(same_float32(now[name], before[name]) for name in offsets) else "ended"


def _present(values: Mapping[str, float]) -> list[ArduPilotParameters]:
    return [names for names in map(ArduPilotParameters, INSTANCES) if set(names.gyro_offset) <= values.keys()]


def _judge(result: int | None, *, ran: bool) -> tuple[GyroOutcome, str]:
    answer = "no answer" if result is None else f"result {result}"
    outcome: GyroOutcome
    if result == mavlink.MAV_RESULT_ACCEPTED:
        return "reset", ""
    if not ran:
        outcome, failure = "not run", "did not run"
    elif result is None:
        outcome, failure = "unanswered", "ran"
    else:
        outcome, failure = "not converged", "failed"
        answer += '; no arming ("Gyros not calibrated") until a gyro calibration succeeds or ArduPilot restarts'
    words = message("firmware_gyro_calibration_failed", failure=failure, reason=answer)
    logger.warning("%s", words)
    return outcome, words
