"""Level without a gradienter, from turning the aircraft on its spot: horizontal accelerometers, and the slope."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple

import msgspec
import numpy as np

from companion.autopilot.firmware.imu_calibration import changes_for, whole_bias
from companion.component.statustext import Severity
from companion.daemon.core import Core
from companion.daemon.devices.autopilot_imu import AutopilotImu
from companion.daemon.job import Job
from companion.daemon.offsets.plan import WriteLog
from companion.daemon.stands.accel_writes import AccelWrites
from companion.daemon.stands.align_steps import Plan
from companion.daemon.stands.faces_in_force import FacesInForce
from companion.daemon.stands.level_writes import LevelWrites
from companion.daemon.stands.stands import Stands
from companion.daemon.stands.taken import Taken, ground, readable
from companion.errors import CalibrationRefusedError
from companion.estimation.alignment.align import Alignment, in_words
from companion.estimation.alignment.align_model import Stand
from companion.estimation.alignment.spot import Mounting, mounting, turned
from companion.estimation.machine import Event
from companion.estimation.means.windows import Window
from companion.estimation.records.align_record import BoardRecord, TurnRecord, stand_record, turn_imu_record
from companion.estimation.records.record import WrittenParameter
from companion.estimation.solution.site import LocalEarth
from companion.physics.frames import Array, vector
from companion.physics.units import DEG, MG
from companion.storage.changes import Origin

LOOSE_M_S2: Final = 0.5 * MG
"""A level known worse than marks allow: on a slope of which it is not known how far it was turned."""


class TurnAsked(NamedTuple):
    """What was asked for."""

    headings: int
    """2 or 4."""
    write: bool = False
    """The level bias, as offsets."""
    level: bool = False
    """How the board sits, as trim: of accelerometers that are known from all sides."""


class Turning:
    """Measures so; who may start it is the manager's."""

    def __init__(
        self,
        core: Core,
        imus: Mapping[str, AutopilotImu],
        stands: Stands,
        writes: AccelWrites,
        levels: LevelWrites,
        known: FacesInForce,
    ) -> None:
        self._core, self._machine, self._imus = core, core.machine, imus
        self._stands, self._writes, self._levels, self._known = stands, writes, levels, known

    def why_not(self, asked: TurnAsked) -> str | None:
        """Why there is nothing to measure, or nothing could be written; None where all is well."""
        if asked.level and asked.write:
            return "either --write (offsets) or --level (the board's tilt): what is in one is not in the other"
        if asked.level and self._known.record is None:
            return "the board's tilt needs accelerometers known from all sides: companion align faces --write first"
        return self._writes.why_not(write=asked.write or asked.level)

    async def run(self, job: Job, asked: TurnAsked) -> str:
        """Measure all headings, work out, write; returns the result in one line.

        Raises:
            CompanionError: it failed, and why; what was written is back, or it is said what is not.
            JobCancelledError: cancelled; likewise.
        """
        plan = Plan("zero", asked.headings, back=True)
        taken: list[Taken] = []

        def see(window: Window) -> Taken:
            up = np.array(window.imus[0].accel_m_s2)
            return self._stands.turned(plan, taken, window, up / np.linalg.norm(up), 0.01)

        self._stands.begin(job, imus_alone=True)
        while len(taken) < plan.on_spot:
            taken.append(await self._stands.take(job, plan, taken, see, if_armed=None))
        await self._stands.check_offsets()
        local = await self._core.local_earth()
        names = readable(taken, self._imus)
        stands = [one.as_stand(names) for one in taken]
        found: Alignment = await self._core.offload(turned, stands, ground(local, None))
        if found.complaint is not None:
            raise CalibrationRefusedError(in_words(found.complaint, gradienter=False))
        draft = WriteLog()
        draft.warnings += local.warnings
        if plan.headings == 2 and _sigma_m_s2(found) > LOOSE_M_S2:
            draft.warnings.append(
                f"the spot slopes by {found.slope_deg:.1f} deg: turn it the same way both times, or --headings 4"
            )
        board = self._board(found, local, taken[-1].window)
        if board is None and asked.level:
            raise CalibrationRefusedError("nothing is known from all sides of these accelerometers: align faces again")
        sits: dict[str, WrittenParameter] = {}
        whole = self._whole_m_s2(found, taken[-1].window)
        try:
            if asked.write:
                changes = {
                    imu.name: changes_for(self._imus[imu.name].in_force, None, vector(imu.level_bias_m_s2))
                    for imu in found.imus
                }
                await self._writes.write(job, taken[-1].window, changes, draft)
            elif asked.level and board is not None:
                sits, warning = await self._levels.write(job, board, taken[-1].window, Origin("level", draft.started))
                draft.warnings += [] if warning is None else [warning]
                if warning is not None:
                    self._core.say(Severity.WARNING, warning)
        finally:
            record = _record(taken, stands, found, draft, whole)
            job.deliver(msgspec.structs.replace(record, board=self._as_record(found, board, sits)))
        if not (asked.write or asked.level):
            self._machine.on(Event.NOTHING_TO_WRITE)
        return _in_words(found, board, asked)

    def _whole_m_s2(self, found: Alignment, last: Window) -> dict[str, Array]:
        """By IMU, what is shown when level without the offsets that are in force before a write."""
        degrees = {one.name: one.temperature_degc for one in last.imus}
        zero = (0.0, 0.0, 0.0)
        return {
            imu.name: np.array(
                whole_bias(self._imus[imu.name].in_force, zero, vector(imu.level_bias_m_s2), degrees.get(imu.name))[1]
            )
            for imu in found.imus
        }

    def _board(self, found: Alignment, local: LocalEarth, last: Window) -> Mounting | None:
        """How the board of the first IMU sits, where its accelerometers are known from all sides."""
        imu = found.imus[0]
        calibration = self._imus[imu.name].in_force
        degrees = {one.name: one.temperature_degc for one in last.imus}
        known = self._known.known(imu.name, calibration, degrees.get(imu.name))
        return None if known is None else mounting(imu, known, local.gravity_m_s2)

    def _as_record(
        self, found: Alignment, board: Mounting | None, written: dict[str, WrittenParameter]
    ) -> BoardRecord | None:
        if board is None or self._known.record is None:
            return None
        roll, pitch = (board.sigma_rad / DEG).tolist()
        return BoardRecord(
            imu=found.imus[0].name,
            faces_measured_at=self._known.record.measured_at,
            roll_deg=round(board.roll_rad / DEG, 4),
            pitch_deg=round(board.pitch_rad / DEG, 4),
            sigma_deg=(round(roll, 4), round(pitch, 4)),
            written=written,
        )


def _in_words(found: Alignment, board: Mounting | None, asked: TurnAsked) -> str:
    words = f"level known to {_sigma_m_s2(found) / MG:.2f} mg, the spot slopes by {found.slope_deg:.2f} deg"
    if board is not None:
        words += f"; the board sits at roll {board.roll_rad / DEG:+.2f}, pitch {board.pitch_rad / DEG:+.2f} deg"
    end = "level written" if asked.level else "written" if asked.write else "not written"
    return f"{words}: {end}"


def _sigma_m_s2(found: Alignment) -> float:
    return max(float(np.sqrt(np.diag(imu.level_covariance_m2_s4))[:2].max()) for imu in found.imus)


def _record(
    taken: list[Taken], stands: list[Stand], found: Alignment, draft: WriteLog, whole_m_s2: Mapping[str, Array]
) -> TurnRecord:
    degrees = {imu.name: imu.temperature_degc for imu in taken[-1].window.imus}
    return TurnRecord(
        measured_at=draft.started,
        slope_deg=round(found.slope_deg, 3),
        checked=found.checked,
        chi_square=round(found.chi_square, 3),
        freedom=found.freedom,
        stands=tuple(stand_record(stand, found, k, taken[k].seconds, (0.0, 0.0)) for k, stand in enumerate(stands)),
        imus=tuple(
            turn_imu_record(imu, degrees.get(imu.name), draft.written.get(imu.name, {}), whole_m_s2[imu.name])
            for imu in found.imus
        ),
        warnings=(*draft.warnings, *(words for each in draft.imu_warnings.values() for words in each)),
    )
