"""The firmware's own gyro calibration between the two halves of a write, so that its EKF is right afterwards.

The order that leaves ArduPilot's EKF right (autopilots 9.3.1): accelerometer offsets, the firmware's gyro calibration,
which alone resets the EKF's gyro bias, then our fine gyro offsets over its coarse ones. Ours are written before it as
well: what the autopilot refuses is known while all can still be put back, and if the one command that is sent gets
lost, nothing else is missing than the reset.

The fine offsets are known beforehand: per sample the output is R (raw - offset), so the whole bias in board axes,
offset + R^-1 residual, does not depend on the offset in force. With a temperature calibration it would: the firmware's
calibration sets CALTEMP too, and with it what is taken off `raw`. There it is left out and the EKF settles by itself.

The calibration also overwrites gyro offsets that nobody asked us to change. All of them are kept before and come back
with every roll-back and undo.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Sequence
from typing import Final

import msgspec

from companion.autopilot.firmware.base import GyroOutcome, GyroParameters
from companion.autopilot.parameters.change import Change, WriteFailedError
from companion.autopilot.vehicle.ekf import SETTLED_RAD_S, EkfWatch
from companion.autopilot.vehicle.parameter_client import ParameterClient
from companion.autopilot.vehicle.parameter_writer import ParameterWriter, kind_of
from companion.autopilot.vehicle.vehicle import Vehicle
from companion.config.sections import Platform
from companion.daemon.offsets.ledger import Ledger
from companion.daemon.offsets.plan import Plan, WriteLog
from companion.errors import AutopilotError, CompanionError
from companion.estimation.records.record import WrittenParameter
from companion.physics.units import DEG_H
from companion.storage.changes import ChangeSet

logger = logging.getLogger(__name__)

WORTH_RAD_S: Final = 20.0 * DEG_H
"""A step on any axis beyond this: a stale EKF bias turns the heading by the step times 17 to 25 s (autopilots
9.3.1), here 0.14 deg; and the firmware's calibration rewrites the flash of all instances."""

SETTLE_RESET_S: Final = 60.0
"""After the reset what is left is the tilt error of the old accelerometer offsets: while it fades the EKF takes a part
of it for gyro bias (a step of 30 mg: 850 deg/h for a moment, settled after 26 s on the real firmware)."""

SETTLE_ALONE_S: Final = 150.0
"""By itself EKF3 takes about two minutes (autopilots 9.3.1: 140 s)."""


class FirmwareCalibration:
    """Decides whether the firmware's gyro calibration is wanted, and writes around it."""

    def __init__(
        self,
        vehicle: Vehicle,
        parameters: ParameterClient,
        writer: ParameterWriter,
        ledger: Ledger,
        ekf: EkfWatch,
        platform: Platform,
    ) -> None:
        self._vehicle, self._parameters, self._platform = vehicle, parameters, platform
        self._writer, self._ledger, self._ekf = writer, ledger, ekf

    async def prepare(self, gyros: Sequence[Change], warn: Callable[[str], None]) -> GyroParameters | None:
        """What it would overwrite, or None when it is not worth it or not allowed (then `warn` is told).

        Raises:
            AutopilotError: the autopilot does not answer.
        """
        if not gyros or self._platform == "deck":
            # On a deck its mean of half a second is the deck's rate, and would be written to all its gyros.
            return None
        step = max(abs(change.after - change.before) for change in gyros)
        kind = self._vehicle.kind
        if not kind.resets_ekf_by_gyro_calibration:
            return None
        if step <= WORTH_RAD_S and (await self._ekf.bias_rad_s() or 0.0) <= SETTLED_RAD_S:
            return None
        before = await kind.read_gyro_parameters(self._parameters)
        if before.tcal:
            warn(
                f"{', '.join(before.tcal)} is on: the firmware's own gyro calibration, which would reset its EKF, would"
                " also change what the offsets mean, so it was left out; the EKF settles by itself"
            )
            return None
        return before

    async def write(self, plan: Plan, before: GyroParameters, draft: WriteLog, go_on: Callable[[str], None]) -> Plan:
        """All offsets, the firmware's calibration, the gyro offsets again: all, or all the old values are back.

        In a transaction of these changes, which grows with what the firmware may change besides. The plan with that,
        and how the calibration ended.

        Raises:
            NothingWrittenError: as `ParameterWriter.apply`.
            WriteFailedError: as `ParameterWriter.apply`.
        """
        boots, changes = self._vehicle.boots, plan.changes
        written = await self._writer.apply(changes)
        wanted = {change.parameter: change.after for change in changes}
        now = dataclasses.replace(before, values={n: wanted.get(n, value) for n, value in before.values.items()})
        try:
            ours = [change for change in changes if change.parameter not in before.values]
            await self._ledger.widen(ChangeSet.of(self._vehicle.system_id, ours, before.values))
            calibration = await self._vehicle.kind.calibrate_gyros(self._parameters, now, go_on)
            go_on(f"writing {len(plan.gyros)} fine gyro offsets")
            coarse = calibration.after.values
            fine = await self._writer.apply([Change(c.parameter, coarse[c.parameter], c.after) for c in plan.gyros])
            collateral = tuple(
                Change(name, old, new)
                for name, (old, new) in before.changed_in(calibration.after).items()
                if name not in wanted
            )
            await self._ledger.widen(ChangeSet.of(self._vehicle.system_id, (*changes, *collateral)))
        except CompanionError as error:
            await self._put_back(changes, before, boots, error)
            raise
        # What was in force before all this is what the record says, not the firmware's coarse value in between.
        written |= {c.parameter: msgspec.structs.replace(fine[c.parameter], before=c.before) for c in plan.gyros}
        plan.note(draft, written)
        if calibration.words:
            draft.warnings.append(calibration.words)
        if collateral:
            draft.warnings.append(
                "the firmware's gyro calibration, which resets its EKF, has changed others too:"
                f" {', '.join(c.parameter for c in collateral)}; undo puts them back"
            )
        return dataclasses.replace(plan, collateral=collateral, firmware=calibration.outcome)

    async def settle(self, plan: Plan, go_on: Callable[[str], None]) -> str | None:
        """After new gyro offsets: wait until the EKF agrees with them.

        Returns:
            What a pilot should know when it has not settled; None when it has, or when nothing is to settle.
        """
        if not self._vehicle.kind.resets_ekf_by_gyro_calibration or not plan.gyros:
            return None
        try:
            return await self._ekf.settle(settles_within_s(plan.firmware), go_on)
        finally:
            self._ekf.stop()

    async def _put_back(
        self, changes: Sequence[Change], before: GyroParameters, boots: int, error: CompanionError
    ) -> None:
        """Our old values, and everything that the firmware's calibration may have changed.

        Raises:
            WriteFailedError: always; what went wrong, and what could not be put back.
        """
        logger.warning("writing around the firmware's gyro calibration: %s; putting everything back", error)
        reason = error.reason if isinstance(error, WriteFailedError) else str(error)
        back = [change for change in changes if change.parameter not in before.values]
        left: tuple[str, ...]
        try:
            kind = self._vehicle.kind
            again = await kind.gyros_measured_at_start(self._parameters) if self._vehicle.boots != boots else None
            if again is not None:
                reason += f"; the restart has measured the gyros anew ({again}), so those stay"
            else:
                now = await kind.read_gyro_parameters(self._parameters)
                back += [Change(name, old, new) for name, (old, new) in before.changed_in(now).items()]
            await self._writer.restore(back)
            left = ()
        except WriteFailedError as failure:
            left = failure.left_changed
        except AutopilotError:
            left = tuple(dict.fromkeys((*(change.parameter for change in back), *before.values)))
        raise WriteFailedError(kind_of(error, self._vehicle, boots), reason, _outcomes(changes, left), left) from error


def settles_within_s(outcome: GyroOutcome | None) -> float:
    """How long the EKF is waited for after a write, at most, by what became of the firmware's calibration."""
    return SETTLE_RESET_S if outcome == "reset" else SETTLE_ALONE_S


def _outcomes(changes: Sequence[Change], left: Sequence[str]) -> dict[str, WrittenParameter]:
    """After everything was put back, but for what is left."""
    return {
        change.parameter: WrittenParameter(
            before=change.before,
            after=change.after,
            read_back=None if change.parameter in left else change.before,
            outcome="failed" if change.parameter in left else "rolled_back",
        )
        for change in changes
    }
