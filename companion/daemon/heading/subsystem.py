"""Roll, pitch and heading shown to people, the attitude sent to the autopilot, and the autopilot settings for it."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Final

from companion.autopilot.firmware.base import HEADING_FALLBACKS
from companion.commands import AutopilotSetup
from companion.configured import models
from companion.daemon.arming.subsystem import Arming
from companion.daemon.calibrating.subsystem import Calibrating
from companion.daemon.core import Core, Handler, Subsystem, Task
from companion.daemon.devices.subsystem import Devices
from companion.daemon.poses.alignment import ActiveAlignment
from companion.estimation.means.pose import up_in_vehicle, vehicle_heading_rad
from companion.estimation.solution.site import Whereabouts, local_earth
from companion.formats import Object
from companion.physics.frames import roll_pitch_from_up
from companion.physics.units import DEG
from companion.samples import CompassSample, Sample, TiltSample

if TYPE_CHECKING:
    from companion.daemon.heading.attitude_service import AttitudeService

REBOOT: Final = "then restart the autopilot: they act from then on"
OLDEST_S: Final = 1.0
DECLINATION_EVERY_S: Final = 60.0


class Heading(Subsystem):
    """Subsystem for roll, pitch and heading shown to people, and for the attitude sent to the autopilot."""

    def __init__(self, core: Core, devices: Devices, calibrating: Calibrating, arming: Arming) -> None:
        self._core = core
        self.attitude: AttitudeService | None = None
        if core.config.push.attitude != "off":
            # Imported here to keep the start short.
            from companion.daemon.heading.attitude_service import AttitudeService

            self.attitude = AttitudeService(core, devices, arming.in_force, calibrating)
        self.pose = PoseNow(core, calibrating.alignment, None if self.attitude is None else self.attitude.pose)
        devices.on_pose.add(self.pose.add)

    @property
    def concern(self) -> str | None:
        return None if self.attitude is None else self.attitude.concern

    def commands(self) -> Mapping[str, Handler]:
        return {"autopilot-setup": self._answer_setup}

    async def _answer_setup(self, _request: AutopilotSetup, _face: str) -> AsyncIterator[Object]:
        firmware = self._core.vehicle.kind
        found = await self._core.parameters.read_many(firmware.heading_names(), optional=True)
        changes = firmware.heading_changes(found)
        gate = await firmware.find_gate_problem(self._core.parameters, self._core.vehicle.system_id, 0.0)
        sends = self._core.config.push.attitude != "off"
        todo = ", ".join(f"{one.parameter} {one.after:g}" for one in changes)
        # If no heading is sent and none is expected, compass and risks do not matter.
        concerned = sends or not changes
        net = firmware.heading_net(found)
        missing = firmware.missing_compass(found) if concerned else None
        if not concerned:
            reason = f"not wanted; for push.attitude: set {todo}; {REBOOT}"
        elif missing is not None:
            reason = f"this autopilot has no compass in use ({missing}): {HEADING_FALLBACKS['none']}"
        elif changes:
            reason = f"set {todo}; {REBOOT}"
        elif not sends:
            reason = 'the autopilot is set up, but push.attitude is "off": no heading is sent'
        else:
            reason = "the autopilot is set up"
        yield {
            "kind": "result",
            "state": "not applied" if changes or missing is not None else "applied",
            "reason": reason,
            "net": {"kind": net, "words": HEADING_FALLBACKS[net]} if concerned else None,
            "firmware": firmware.name,
            "parameters": [
                {
                    "parameter": one.parameter,
                    "now": found.get(one.parameter),
                    "wanted": one.after(found) if one.parameter in found else None,
                    "why": one.why,
                }
                for one in firmware.heading_settings
            ],
            "risks": list(firmware.heading_risks) if concerned else [],
            "gate": {"at_arm": self._core.wanted.at_arm, "problem": gate},
            "rivals": [rival.words for rival in await firmware.read_rivals(self._core.parameters)],
        }

    def status(self) -> Object:
        attitude = self.attitude
        return {
            "pose": self.pose.now(),
            "readings": self.pose.readings(),
            "warnings": [] if attitude is None or attitude.health.warning is None else [attitude.health.warning],
            "attitude": None if attitude is None else attitude.view(),
            "devices": [] if attitude is None else [attitude.status()],
        }

    def close(self) -> None:
        if self.attitude is not None:
            self.attitude.close()

    def tasks(self) -> Sequence[Task]:
        if self.attitude is None:
            return []
        return [("attitude", self.attitude.run), ("fallback", self.attitude.fallback.reading.run)]


class PoseNow:
    """Roll, pitch, heading shown to people: from the attitude estimate (valid in flight too), else from sensors."""

    def __init__(self, core: Core, alignment: ActiveAlignment, carried: Callable[[], Object | None] | None) -> None:
        self._core, self._alignment, self._carried = core, alignment, carried
        self._compass = models.compass_model(core.config.compass)
        self._tilt: TiltSample | None = None
        self._heading: CompassSample | None = None
        self._declination_deg: float | None = None
        self._looked_up_s = -math.inf

    def add(self, sample: Sample) -> None:
        if isinstance(sample, TiltSample):
            self._tilt = sample
        elif isinstance(sample, CompassSample):
            self._heading = sample

    def _fresh(self) -> tuple[TiltSample | None, CompassSample | None]:
        since_s = asyncio.get_running_loop().time() - OLDEST_S
        tilt, heading = self._tilt, self._heading
        return tilt if tilt and tilt.t_s >= since_s else None, heading if heading and heading.t_s >= since_s else None

    async def refresh(self) -> Object | None:
        now_s = asyncio.get_running_loop().time()
        due = now_s - self._looked_up_s >= DECLINATION_EVERY_S or self._declination_deg is None
        if self._compass is not None and self._compass.magnetic and due:
            where: Whereabouts = models.whereabouts(self._core.config, self._core.vehicle)
            if where.latitude_deg is not None:
                self._looked_up_s = now_s
                self._declination_deg = (await self._core.offload(local_earth, where)).site.declination_deg
        return self.now()

    def now(self) -> Object | None:
        """Return roll, pitch and heading (magnetic while the declination is unknown); None without a recent tilt."""
        if self._carried is not None and (carried := self._carried()) is not None:
            return carried
        tilt, heading = self._fresh()
        gradienter = self._alignment.model()
        if gradienter is None or tilt is None:
            return None
        try:
            up = up_in_vehicle(gradienter, tilt.x_deg, tilt.y_deg)
        except ValueError:
            return None
        roll, pitch = roll_pitch_from_up(up)
        still = self._core.collector.glance(asyncio.get_running_loop().time()).obstacle is None
        pose: Object = {
            "roll_deg": round(roll / DEG, 3),
            "pitch_deg": round(pitch / DEG, 3),
            "heading_deg": None,
            "north": None,
            "source": "gradienter",
            "still": still and self._core.config.vehicle.platform == "ground",
        }
        if self._compass is not None and heading is not None:
            heading_deg = vehicle_heading_rad(self._compass, heading.heading_deg, up) / DEG
            declination_deg = self._declination_deg if self._compass.magnetic else 0.0
            pose |= {
                "heading_deg": round((heading_deg + (declination_deg or 0.0)) % 360.0, 2) % 360.0,
                "north": "magnetic" if declination_deg is None else "true",
                "source": "gradienter and compass",
            }
        return pose

    def readings(self) -> dict[str, float | None]:
        tilt, heading = self._fresh()
        return {
            "gradienter_x_deg": None if tilt is None else round(tilt.x_deg, 4),
            "gradienter_y_deg": None if tilt is None else round(tilt.y_deg, 4),
            "compass_deg": None if heading is None else round(heading.heading_deg, 3),
        }
