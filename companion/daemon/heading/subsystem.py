"""The heading: how the aircraft stands and turns, and what of it the autopilot is told."""

from __future__ import annotations

from collections.abc import AsyncIterator, Mapping, Sequence
from typing import TYPE_CHECKING, Final

from companion.autopilot.firmware.heading_parameters import RISKS, changes_for, wanted_for
from companion.daemon.arming.subsystem import Arming
from companion.daemon.calibrating.subsystem import Calibrating
from companion.daemon.core import Core, Handler, Subsystem, Task
from companion.daemon.devices.subsystem import Devices
from companion.daemon.heading.pose_now import PoseNow
from companion.links.system.request import Object

if TYPE_CHECKING:
    from companion.daemon.heading.attitude_service import AttitudeService


REBOOT: Final = "restart the autopilot then: until that it goes on as before"


class Heading(Subsystem):
    """The pose that people see, and the attitude that is pushed."""

    def __init__(self, core: Core, devices: Devices, calibrating: Calibrating, arming: Arming) -> None:
        self._core = core
        self.attitude = _attitude(core, devices, calibrating, arming)
        """None unless a heading is pushed."""
        self.pose = PoseNow(core, calibrating.alignment, None if self.attitude is None else self.attitude.pose)
        devices.watch_pose(self.pose.take)

    def commands(self) -> Mapping[str, Handler]:  # noqa: D102 - as in the base class
        return {"autopilot-setup": self._answer_setup}

    async def _answer_setup(self, _request: Object, _face: str) -> AsyncIterator[Object]:
        yield await autopilot_setup(self._core)

    def status(self) -> Object:  # noqa: D102
        attitude = self.attitude
        return {
            "pose": self.pose.now(),
            "readings": self.pose.readings(),
            "warnings": [] if attitude is None else attitude.warnings,
            "attitude": None if attitude is None else attitude.view(),
            "devices": [] if attitude is None else [attitude.status()],
        }

    def tasks(self) -> Sequence[Task]:  # noqa: D102
        return [] if self.attitude is None else [("attitude", self.attitude.run)]


def _attitude(core: Core, devices: Devices, calibrating: Calibrating, arming: Arming) -> AttitudeService | None:
    if core.config.push.attitude == "off":
        return None
    # What nobody asked for costs the start nothing.
    from companion.daemon.heading.attitude_service import AttitudeService

    return AttitudeService(core, devices, arming.in_force, calibrating.alignment)


async def autopilot_setup(core: Core) -> Object:
    """What is set, what should be, and what to do.

    Raises:
        AutopilotError: it does not answer, or cannot take in a heading.
    """
    firmware = core.vehicle.firmware
    wanted = wanted_for(firmware)
    found = await core.parameters.read_many([one.parameter for one in wanted], optional=True)
    changes = changes_for(firmware, found)
    if changes:
        todo = ", ".join(f"{change.parameter} {change.after:g}" for change in changes)
        reason = f"set {todo}; {REBOOT}"
    elif core.config.push.attitude == "off":
        reason = 'the autopilot is set up, but push.attitude is "off": the heading never comes'
    else:
        reason = "the autopilot is set up"
    return {
        "kind": "result",
        "state": "not applied" if changes else "applied",
        "reason": reason,
        "firmware": firmware,
        "parameters": [
            {
                "parameter": one.parameter,
                "now": now,
                "wanted": None if now is None else one.after(now),
                "why": one.why,
            }
            for one in wanted
            for now in (found.get(one.parameter),)
        ],
        "risks": list(RISKS.get(firmware or "other", ())),
    }
