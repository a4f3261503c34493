"""The alignments that can be requested: what each needs, and its start."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from companion.autopilot.vehicle.ekf import OwnAttitude
from companion.daemon.core import Core
from companion.daemon.devices.autopilot_imu import AutopilotImu
from companion.daemon.job import ALIGNMENT, FACES, TURN, Job
from companion.daemon.offsets.subsystem import Offsets
from companion.daemon.stands.alignment import AlignmentInForce, FacesInForce
from companion.daemon.stands.all_sides import SidesTask
from companion.daemon.stands.measuring import Measuring
from companion.daemon.stands.on_spot import TurnTask, ZeroTask
from companion.daemon.stands.session import PoseSession, PoseTask, StandsShown
from companion.daemon.stands.writes import AccelWrites, LevelWrites
from companion.estimation.alignment.poses import HEADINGS, AlignmentRequest
from companion.estimation.request import What
from companion.formats import Object

KINDS: Final = {
    "zero": (ALIGNMENT, What.BOTH),
    "tilts": (ALIGNMENT, What.BOTH),
    "turn": (TURN, What.ACCELEROMETERS),
    "faces": (FACES, What.ACCELEROMETERS),
}
"""Kind of job, and which biases it is about, by action."""


class Alignments:
    """Starts one alignment at a time."""

    def __init__(
        self,
        core: Core,
        imus: Mapping[str, AutopilotImu],
        measuring: Measuring,
        offsets: Offsets,
        own: OwnAttitude,
        alignment: AlignmentInForce,
        faces: FacesInForce,
    ) -> None:
        self._core, self._imus, self._alignment, self._faces = core, imus, alignment, faces
        self._writes = AccelWrites(core, imus, offsets)
        self._session = PoseSession(core, imus, measuring, self._writes, LevelWrites(core, imus, offsets, own))

    @property
    def shown(self) -> StandsShown | None:
        """Progress of the latest alignment; None before the first."""
        return self._session.shown

    @staticmethod
    def parse(request: Object) -> AlignmentRequest | None:
        """Return what was asked for; None where it is not understood."""
        action, headings = request.get("action"), request.get("headings")
        if action not in KINDS or headings not in (None, 2, HEADINGS):
            return None
        if headings is None:
            headings = HEADINGS if action == "turn" else 2
        writes = action in ("turn", "faces")
        return AlignmentRequest(
            action,
            headings,
            write=writes and request.get("write") is True,
            level=action == "turn" and request.get("level") is True,
        )

    def blocking_reason(self, request: AlignmentRequest) -> str | None:
        """Say why there is nothing to measure, or nothing could be written; None when there is."""
        if request.action in ("zero", "tilts"):
            has_one = self._core.config.gradienter is not None
            return None if has_one else "there is no gradienter to align: none is configured"
        if request.level and request.write:
            return "either --write (offsets) or --level (the board's tilt): what is in one is not in the other"
        if request.level and self._faces.record is None:
            return "the board's tilt needs accelerometers known from all sides: companion align faces --write first"
        return self._writes.why_not(write=request.write or request.level)

    async def run(self, job: Job, request: AlignmentRequest) -> str:
        """Measure, estimate, write; as `PoseSession.run`."""
        task: PoseTask
        if request.action == "faces":
            task = SidesTask(request, self._imus, self._faces)
        elif request.action == "turn":
            task = TurnTask(self._core, request, self._imus, self._faces)
        else:
            task = ZeroTask(self._core, request, self._alignment)
        return await self._session.run(job, request, task)
