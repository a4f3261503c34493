"""One alignment from its first pose to its record: guide an operator, measure, estimate, write, save.

`PoseSession.run` executes all steps in order. A `PoseTask` defines the parts that differ between alignments: the
requested poses, the acceptance test, the fit and the record. No button is pressed between poses: the next pose begins
when a detected movement has ended. Thus one person alone can follow the ground station's voice or the web page.
"""

from __future__ import annotations

import abc
import asyncio
import dataclasses
import math
from collections.abc import Mapping
from typing import ClassVar, Final

import numpy as np

from companion.autopilot.firmware.imu_calibration import ImuCalibration
from companion.autopilot.parameters.change import Change
from companion.component.service import JobResult
from companion.component.statustext import LINE_BYTES, Severity, Tune
from companion.daemon.core import Core
from companion.daemon.devices.autopilot_imu import AutopilotImu
from companion.daemon.job import Act, Job
from companion.daemon.offsets.plan import WriteLog
from companion.daemon.poses.measuring import POLL_S, Measuring
from companion.daemon.poses.writes import AlignmentWrites
from companion.errors import CalibrationRefusedError
from companion.estimation.alignment.faces import Mounting
from companion.estimation.alignment.poses import AlignmentRequest, HeldPose, PoseRequest, leaned_deg
from companion.estimation.machine import Event
from companion.estimation.means.windows import Window
from companion.estimation.records.align_record import HandRecord, completed
from companion.estimation.records.record import WrittenParameter
from companion.estimation.solution.site import LocalEarth
from companion.formats import Object
from companion.physics.frames import vector
from companion.physics.units import DEG
from companion.samples import Vector

STAND_S: Final = 12.0
"""Time without motion in each pose: averaging beyond 10 s improves no accelerometer (method.md section 2.3)."""
SETTLE_S: Final = 1.0
STOP_WITHIN_DEG: Final = 5.0  # Angle before the target at which the operator is asked to stop
TURNS_DEG: Final = 2.0  # Minimum turn within a second that counts as turning
EARLY_S: Final = 3.0  # Time at rest after which a movement counts as too early: before, the aircraft is set down
STILL_MOVING_S: Final = 15.0  # Duration of movement after which the operator gets a message: a hand, or the wind
STILL_MOVES: Final = "it still moves: set it down, hands off"
LEANED_DEG: Final = 0.03  # Largest change of tilt within a pose: half of it enters the mean
ARMED: Final = "armed during the alignment; the earlier one stays active"


@dataclasses.dataclass(slots=True, eq=False)
class SessionState:
    """State of one alignment; available after its end too, for web pages that are opened later."""

    job: Job
    asked: AlignmentRequest
    windows: list[Window] = dataclasses.field(default_factory=list)
    poses: list[HeldPose] = dataclasses.field(default_factory=list)
    ups: list[Vector] = dataclasses.field(default_factory=list)
    """Unit vector pointing up in each pose, in vehicle axes (FRD), from the accelerometers."""
    first_calibrations: dict[str, ImuCalibration] = dataclasses.field(default_factory=dict)
    outcome: str | None = None  # None while it runs

    # State of the present pose
    number: int = 1
    total: int = 1
    wish: PoseRequest = dataclasses.field(default_factory=lambda: PoseRequest(""))
    words: str = ""
    objection: str = ""  # Fault of the latest pose, if it was not the requested one
    share: float = 0.0
    since_s: float = 0.0
    """Event-loop time since which the aircraft has not moved."""
    moved: bool = False
    """True once the aircraft has moved after the previous pose, or after the latest objection to a pose."""
    still_s: float = 0.0
    moving_since_s: float = math.inf
    hold_still_said: bool = False
    act: Act = "PUT IT DOWN"
    turn_read_s: float = -math.inf
    turned_deg: float = math.nan
    stop_said: bool = False

    def begin_pose(self, wish: PoseRequest, total: int, now_s: float) -> None:
        self.number, self.wish = len(self.poses) + 1, wish
        self.total = max(total, self.number)
        self.since_s, self.moved = (self.windows[-1].end_s, False) if self.windows else (now_s, True)
        self.still_s, self.moving_since_s, self.objection, self.hold_still_said = 0.0, math.inf, "", False
        self.turn_read_s, self.turned_deg, self.stop_said = -math.inf, math.nan, False
        self.act = "TURN IT" if self.windows else "PUT IT DOWN"

    @property
    def request(self) -> str:
        return f"{self.number} of {self.total}: {self.wish.words}"

    def shown(self) -> Object:
        return {
            "kind": self.job.kind,
            "what": "level" if self.asked.level else self.asked.action,
            "write": self.asked.write or self.asked.level,
            "number": self.number,
            "total": self.total,
            "wish": self.wish.words,
            "hold": {"up": list(self.wish.up), "turn_deg": self.wish.turn_deg},
            "words": self.words,
            "objection": self.objection or None,
            "share": round(self.share, 3),
            "done": [list(up) for up in self.ups],
            "outcome": self.outcome,
        }


class PoseTask(abc.ABC):
    """Base class of the kinds of alignment: their poses, acceptance test, fit, record and estimate."""

    imus_alone: bool = True
    """True: do not wait for samples of gradienter or compass, as either may stop sending when turned over."""
    if_armed: ClassVar[str | None] = None
    """Text of the error if the aircraft arms; None: the alignment continues once it is disarmed."""
    request: AlignmentRequest
    total: int
    stand_s: float | None = None  # Time without motion in the next pose; None: STAND_S, or min_still_s if longer
    fit_from: int
    """Number of poses before the first fit; the fit is repeated after each further pose."""
    board: Mounting | None = None  # Tilt of the board, if it can be known
    shortfall: str | None = None
    """Text on a bias or scale still unknown after the last pose; then nothing is written or saved."""

    @abc.abstractmethod
    def wish(self, state: SessionState) -> PoseRequest | None:
        """Return the next pose to request; None: there are enough poses."""

    @abc.abstractmethod
    def examine(self, state: SessionState, now: Window) -> tuple[HeldPose, str | None]:
        """Return the pose that a new window shows, and an objection if it is not the requested pose."""

    @abc.abstractmethod
    def fit(self, state: SessionState, local: LocalEarth) -> list[str]:
        """Fit all poses and return messages for the operator; raise CalibrationRefusedError on a bad fit. Blocking."""

    @abc.abstractmethod
    def record(self, state: SessionState, local: LocalEarth, log: WriteLog) -> HandRecord:
        """Build the record of the measurement, before any write; add warnings to `log`."""

    def changes(self) -> dict[str, list[Change]]:
        return {}

    async def write(self, writes: AlignmentWrites, job: Job, last: Window, log: WriteLog) -> None:
        await writes.write_accelerometers(job, last, self.changes(), log)

    def unsteady(self, window: Window) -> str | None:
        """Return why a pose must be measured again where the aircraft stands, or None."""
        del window
        return None

    async def keep(self, record: HandRecord) -> None:
        """Save the result and make it the active one; a StorageError leaves the previous one active."""
        del record

    @abc.abstractmethod
    def summary(self) -> str: ...


class PoseSession:
    """Guides one operator through the poses of one alignment at a time."""

    def __init__(
        self, core: Core, imus: Mapping[str, AutopilotImu], measuring: Measuring, writes: AlignmentWrites
    ) -> None:
        self._core, self._machine, self._collector, self._say = core, core.machine, core.collector, core.say
        self._imus, self._measuring, self._writes = imus, measuring, writes
        self.state: SessionState | None = None

    async def run(self, job: Job, task: PoseTask) -> str:
        """Measure all poses, estimate, write and save; return the result in one line.

        After an error or a cancel, old parameter values are restored; the error names any that are not.
        """
        request = task.request
        if request.write and request.action == "faces":
            await self._writes.path.offsets_still_hold()
        state = self._begin(job, task)
        while (wish := task.wish(state)) is not None:
            await self._measure(state, task, wish)
            if len(state.poses) >= task.fit_from:
                local = await self._core.local_earth()
                try:
                    heard = await self._core.offload(task.fit, state, local)
                except CalibrationRefusedError:
                    # If somebody else has changed the offsets meanwhile, report that as the cause.
                    await self._check_offsets(state)
                    raise
                for words in heard:
                    self._say(Severity.NOTICE, words)
        await self._check_offsets(state)
        log = WriteLog()
        log.warnings += local.warnings
        record = task.record(state, local, log)
        last, shortfall = state.windows[-1], task.shortfall
        level: dict[str, WrittenParameter] = {}
        try:
            if request.write and shortfall is None:
                await task.write(self._writes, job, last, log)
            elif request.level and task.board is not None:
                level = await self._writes.write_level(job, task.board, last, log)
        finally:
            job.product = record = completed(record, log.all_warnings, log.written, level)
        if shortfall is None:
            await task.keep(record)
        elif request.write:
            raise CalibrationRefusedError(f"nothing was written: {shortfall}")
        if not (request.write or request.level):
            self._machine.on(Event.NOTHING_TO_WRITE)
        return task.summary()

    def _begin(self, job: Job, task: PoseTask) -> SessionState:
        self._collector.count_turns(wanted=True)
        if task.imus_alone:
            self._collector.expect(gradienter=False, compass=False)
        self.state = state = SessionState(job, task.request)

        def ended(result: asyncio.Future[JobResult]) -> None:
            state.outcome, state.words, state.share = result.result().outcome, result.result().reason, 0.0
            self._collector.count_turns(wanted=False)
            if task.imus_alone:
                config = self._core.config
                self._collector.expect(gradienter=config.gradienter is not None, compass=config.compass is not None)

        job.finished.add_done_callback(ended)
        return state

    # --- one pose

    async def _measure(self, state: SessionState, task: PoseTask, wish: PoseRequest) -> None:
        loop, job = asyncio.get_running_loop(), state.job
        state.begin_pose(wish, task.total, loop.time())
        stand_s = task.stand_s or max(STAND_S, self._core.config.calibration.min_still_s)
        if state.number > 1:
            self._machine.on(Event.MOVED)
            self._core.tunes.play(Tune.NEXT)
        self._say(Severity.NOTICE, state.request)
        while True:
            now_s = loop.time()
            status, waiting_for, hold_still_s = await self._measuring.read_state(job, task.if_armed)
            self._check_known(state)
            moving = self._watch_movement(state, now_s)
            state.still_s = min(status.still_s, now_s - state.since_s - SETTLE_S)
            # If only more still time is needed, show the pose as measuring from its first second on.
            standing = state.moved and (waiting_for is None or hold_still_s is not None)
            state.share = min(max(state.still_s, 0.0) / stand_s, 1.0) if standing else 0.0
            turned = self._turned(state, now_s) if moving or standing else ""
            state.act = "HOLD STILL" if standing else state.act
            job.act = state.act if waiting_for is None or hold_still_s is not None or moving else ""
            if not standing:
                reason = turned or waiting_for if state.moved or not job.act else "waiting for it to move"
                words = f"{state.objection or wish.words}; {reason}"
            else:
                words = f"measuring, {max(state.still_s, 0.0):.0f} of {stand_s:.0f} s, hands off"
                words += f" ({turned})" if turned else ""
                if not state.hold_still_said:
                    state.hold_still_said = True
                    self._core.prompt(Tune.HOLD_STILL, "Hold still")
            self._measuring.show(measuring=state.share > 0.0)
            percent = 100.0 * (state.number - 1 + state.share) / state.total
            job.progress(percent, f"{state.number} of {state.total}: {words}")
            state.words = words
            enough = waiting_for is None if task.stand_s is None else standing
            if enough and state.moved and state.still_s >= stand_s and await self._accept(state, task, now_s):
                return
            await job.pause(POLL_S)

    async def _accept(self, state: SessionState, task: PoseTask, now_s: float) -> bool:
        window = await self._core.window(since_s=state.since_s + SETTLE_S)
        pose, objection = task.examine(state, window)
        forces = self._collector.imus[window.imus[0].name].forces_m_s2(window.start_s, window.end_s)
        # A lean without a detected movement comes from a hand removed slowly, or from soft ground.
        if (leaned := leaned_deg(np.array(forces))) >= LEANED_DEG:
            state.since_s = now_s
            self._object(state, f"it leaned by {leaned:.2g} degrees: hands off, firm ground")
            return False
        if (unsteady := task.unsteady(window)) is not None:
            state.since_s = now_s
            self._object(state, unsteady)
            return False
        if objection is not None:
            state.moved, state.act = False, "TURN IT"
            self._measuring.show(measuring=False)
            self._object(state, objection)
            return False
        state.windows.append(window)
        state.poses.append(pose)
        if not state.first_calibrations:
            state.first_calibrations = {
                name: imu.calibration for name, imu in self._imus.items() if imu.calibration is not None
            }
        read = np.array(window.imus[0].accel_m_s2)
        state.ups.append(vector((read / max(float(np.linalg.norm(read)), 1e-9)).round(3)))
        self._machine.on(Event.ENOUGH)
        state.job.restart_time()
        return True

    def _turned(self, state: SessionState, now_s: float) -> str:
        wanted_deg = state.wish.turn_deg
        if not state.windows or not wanted_deg:
            return ""
        if now_s - state.turn_read_s >= 1.0:
            last, before_deg = state.windows[-1], state.turned_deg
            imu = last.imus[0]
            counted = self._collector.imus[imu.name].counted(last.end_s, now_s, np.array(imu.gyro_rad_s))
            state.turn_read_s, state.turned_deg = now_s, math.nan if counted is None else abs(counted.angle_rad) / DEG
            step_deg = state.turned_deg - before_deg
            is_near = state.turned_deg + step_deg > wanted_deg - STOP_WITHIN_DEG
            if not state.stop_said and step_deg > TURNS_DEG and is_near:
                state.stop_said, state.act = True, "HOLD STILL"
                self._say(Severity.NOTICE, "Stop turning")
        return "" if math.isnan(state.turned_deg) else f"turned {state.turned_deg:.0f} of {wanted_deg:.0f} degrees"

    def _watch_movement(self, state: SessionState, now_s: float) -> bool:
        glance = self._collector.glance(now_s)
        if not glance.moving:
            state.moving_since_s = math.inf
            state.objection = "" if state.objection == STILL_MOVES else state.objection
            return False
        if glance.moves is not None and state.moved:
            state.moving_since_s = min(state.moving_since_s, now_s)
            if state.still_s >= EARLY_S:
                self._object(state, f"it moved after {state.still_s:.0f} seconds: hands off")
            elif now_s - state.moving_since_s >= STILL_MOVING_S:
                state.moving_since_s, state.act, state.objection = now_s, "HOLD STILL", STILL_MOVES
                self._say(Severity.NOTICE, STILL_MOVES.capitalize())
        state.moved, state.since_s, state.still_s = True, now_s, 0.0
        return True

    def _object(self, state: SessionState, objection: str) -> None:
        """Report an objection to the operator; if it is too long for one spoken message, repeat the request."""
        state.objection, state.hold_still_said = objection, False
        self._core.prompt(Tune.WRONG, objection)
        if len(objection) > LINE_BYTES:
            self._say(Severity.NOTICE, state.request)

    # --- the autopilot's side

    async def _check_offsets(self, state: SessionState) -> None:
        for name, imu in self._imus.items():
            holds = await imu.refresh()
            self._check_known(state)
            if not holds:
                raise _changed(name)

    def _check_known(self, state: SessionState) -> None:
        for name, imu in self._imus.items():
            first, now = state.first_calibrations.get(name), imu.calibration
            if first is None or now is None or first.corrects_like(now):
                continue
            for old, new in ((first.accel_id, now.accel_id), (first.gyro_id, now.gyro_id)):
                if old != new:
                    raise CalibrationRefusedError(
                        f"imu {name} was exchanged in between (device id {old}, now {new}): align again"
                    )
            raise _changed(name)


def _changed(name: str) -> CalibrationRefusedError:
    return CalibrationRefusedError(f"the offsets of imu {name} were changed in between: align again")
