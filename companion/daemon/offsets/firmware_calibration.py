"""ArduPilot's own gyro calibration as a step of a write: nothing else resets the gyro bias in ArduPilot's EKF.

The best order (docs/reference/autopilots.md section 9.3.1) is accelerometer offsets, then the firmware's coarse gyro
calibration, then our fine gyro offsets. We write the fine offsets also before the firmware's calibration. If the
autopilot refuses them, all can still be restored. If the calibration command is lost, only the reset is missing.

The fine offsets are known in advance. The output is R (raw - offset), R from board to vehicle axes. So the whole bias,
offset + R^-1 residual in board axes, does not depend on the present offset. With ArduPilot's temperature calibration
the gyro calibration sets CALTEMP and so changes `raw`. Then we skip the gyro calibration; the EKF settles by itself.

The firmware's calibration also overwrites gyro offsets that are not part of the plan. All of them are saved before it,
and restored by every roll-back and undo.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Mapping, Sequence
from typing import Final

import msgspec

from companion.autopilot.firmware.ardupilot import AT_START
from companion.autopilot.parameters.change import Change, WriteFailedError
from companion.autopilot.vehicle import gyro_calibration
from companion.autopilot.vehicle.ekf import SETTLED_RAD_S, EkfWatch
from companion.autopilot.vehicle.gyro_calibration import GyroOutcome
from companion.autopilot.vehicle.parameter_writer import ParameterWriter, kind_of
from companion.daemon.core import Core
from companion.daemon.offsets.journal import WriteJournal
from companion.daemon.offsets.plan import Plan, WriteLog
from companion.errors import AutopilotError, CompanionError
from companion.estimation.records.record import WrittenParameter
from companion.messages import message
from companion.physics.units import DEG_H
from companion.storage.changes import ChangeSet

logger = logging.getLogger(__name__)

WORTH_RAD_S: Final = 20.0 * DEG_H
"""Gyro offset change, on any axis, above which the firmware's calibration is worth the wear of the flash. A stale EKF
bias turns the heading by the change times 17 to 25 s (docs/reference/autopilots.md section 9.3.1), here 0.14 deg."""
SETTLE_RESET_S: Final = 60.0
"""Longest wait for the EKF after the reset of its gyro bias. While the tilt error of the old accelerometer offsets
fades, the EKF mistakes it for gyro bias: after a step of 30 mg up to 850 deg/h, gone after 26 s on real firmware."""
SETTLE_ALONE_S: Final = 150.0
"""Longest wait for the EKF without a reset. EKF3 needs about 140 s (docs/reference/autopilots.md section 9.3.1)."""


class FirmwareCalibration:
    """Write of offsets with the firmware's own gyro calibration in between, if the EKF needs it."""

    def __init__(self, core: Core, writer: ParameterWriter, journal: WriteJournal) -> None:
        self._vehicle, self._parameters = core.vehicle, core.parameters
        self._on_deck = core.config.vehicle.platform == "deck"
        self._writer, self._journal, self._ekf = writer, journal, EkfWatch(core.vehicle)

    async def prepare(self, gyros: Sequence[Change], warn: Callable[[str], None]) -> dict[str, float] | None:
        """Read the values that the firmware's gyro calibration would overwrite; return None if we do not start it.

        `warn` is called if the reason is that ArduPilot's temperature calibration (TCAL) is on.
        """
        if not self._vehicle.kind.gyro_calibration_resets_ekf or not gyros or self._on_deck:
            # On a deck, the firmware would average half a second of the deck's motion into all gyro offsets.
            return None
        step = max(abs(change.after - change.before) for change in gyros)
        if step <= WORTH_RAD_S and (await self._ekf.bias_rad_s() or 0.0) <= SETTLED_RAD_S:
            return None
        before = await gyro_calibration.read_overwritten(self._parameters)
        if active := await gyro_calibration.read_active_tcal(self._parameters, before):
            result = f"skipped: {', '.join(active)} is on, the EKF settles by itself"
            warn(message("firmware_gyro_calibration", result=result))
            return None
        return before

    async def write(self, plan: Plan, before: Mapping[str, float], log: WriteLog, go_on: Callable[[str], None]) -> Plan:
        """Write all offsets, start the firmware's gyro calibration, and write our gyro offsets again over its result.

        A failure restores all old values and raises an error of `ParameterWriter.apply`. Call it in a transaction of
        the write journal. The returned plan includes the firmware's own changes and the outcome of its calibration.
        """
        boots, changes, system_id = self._vehicle.boots, plan.changes, self._vehicle.system_id
        written = await self._writer.apply(changes)
        wanted = {change.parameter: change.after for change in changes}
        now = {name: wanted.get(name, value) for name, value in before.items()}
        try:
            ours = [change for change in changes if change.parameter not in before]
            await self._journal.update_pending(ChangeSet.of(system_id, ours, before))
            outcome, warning, coarse = await gyro_calibration.calibrate(self._parameters, now, go_on)
            go_on(message("write_in_progress", count=len(plan.gyros), what="fine gyro offsets"))
            fine = await self._writer.apply([Change(c.parameter, coarse[c.parameter], c.after) for c in plan.gyros])
            others = gyro_calibration.changed(before, coarse).items()
            collateral = tuple(Change(name, old, new) for name, (old, new) in others if name not in wanted)
            await self._journal.update_pending(ChangeSet.of(system_id, (*changes, *collateral)))
        except CompanionError as error:
            await self._restore(changes, before, boots, error)
            raise
        # The record holds the values from before the write, not the firmware's coarse values in between.
        written |= {c.parameter: msgspec.structs.replace(fine[c.parameter], before=c.before) for c in plan.gyros}
        plan.note(log, written)
        if warning:
            log.warnings.append(warning)
        if collateral:
            result = f"also changed {', '.join(change.parameter for change in collateral)}; undo restores them"
            log.warnings.append(message("firmware_gyro_calibration", result=result))
        return dataclasses.replace(plan, collateral=collateral, firmware=outcome)

    async def settle(self, plan: Plan, go_on: Callable[[str], None]) -> str | None:
        """Wait until the EKF agrees with new gyro offsets; return a warning for the pilot if it does not."""
        if not self._vehicle.kind.gyro_calibration_resets_ekf or not plan.gyros:
            return None
        try:
            return await self._ekf.settle(settles_within_s(plan.firmware), go_on)
        finally:
            self._ekf.stop()

    async def _restore(
        self, changes: Sequence[Change], before: Mapping[str, float], boots: int, error: CompanionError
    ) -> None:
        """Restore the values that we or the firmware changed, then raise `error` as a WriteFailedError."""
        logger.warning("%s", message("restoring_old_values", reason=error))
        reason = error.reason if isinstance(error, WriteFailedError) else str(error)
        back = [change for change in changes if change.parameter not in before]
        left: tuple[str, ...] = ()
        try:
            if self._vehicle.boots != boots and await self._parameters.read_optional(AT_START):
                reason += f"; gyro offsets of the restart kept ({AT_START})"
            else:
                now = await gyro_calibration.read_overwritten(self._parameters)
                back += [Change(name, old, new) for name, (old, new) in gyro_calibration.changed(before, now).items()]
            await self._writer.restore(back)
        except WriteFailedError as failure:
            left = failure.left_changed
        except AutopilotError:
            left = tuple(dict.fromkeys((*(change.parameter for change in back), *before)))
        outcomes = {
            change.parameter: WrittenParameter(
                before=change.before,
                after=change.after,
                read_back=None if change.parameter in left else change.before,
                outcome="failed" if change.parameter in left else "rolled_back",
            )
            for change in changes
        }
        raise WriteFailedError(kind_of(error, self._vehicle, boots), reason, outcomes, left) from error


def settles_within_s(outcome: GyroOutcome | None) -> float:
    return SETTLE_RESET_S if outcome == "reset" else SETTLE_ALONE_S
