"""Service that sends the attitude to the autopilot, selects ArduPilot's fallback, and reports to people."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.attitude.estimator import Attitude
from companion.autopilot.firmware.base import Firmware, HeadingFallback
from companion.autopilot.telemetry.attitude_messages import (
    TimesyncResponder,
    attitude_messages,
    vision_position_estimate,
)
from companion.autopilot.vehicle.ekf import OwnCompass
from companion.autopilot.vehicle.vehicle import ArmState, VehicleEvent
from companion.component.statustext import Severity, Weight
from companion.configured import models
from companion.daemon.arming.in_force import ActiveCalibration
from companion.daemon.calibrating.subsystem import Calibrating
from companion.daemon.core import Core, RepeatedRead
from companion.daemon.devices.subsystem import Devices
from companion.daemon.heading.carrier import SLOWEST_AIRSPEED_M_S, AttitudeCarrier, carrying_imu, without_truncation
from companion.daemon.heading.health import Difference, Health
from companion.daemon.heading.resume import Resume
from companion.formats import Object
from companion.links.mavlink.link import MavlinkLink
from companion.physics.units import DEG
from companion.samples import ImuSample, Sample

logger = logging.getLogger(__name__)

TICK_S: Final = 0.1
LOOK_S: Final = 0.5
VFR_HUD_RATE_HZ: Final = 5.0
AIRSPEED_OLD_S: Final = 1.0
INTERNAL: Final = "internal error; the log has the details"
SAID_AGAIN_S: Final = 30.0
LATE_S: Final = 3.0
SHORTEST_S: Final = 0.02
"""Minimum time between two messages: ArduPilot drops a message that comes sooner (autopilots.md section 6)."""
SHOWN_EVERY_S: Final = 0.2
"""Interval of attitude messages for ground stations: autopilots forward them to slow radios."""
_ROUNDING_S: Final = 1e-6
SCRIPT_STARTS_S: Final = 15.0
"""Wait after the autopilot's first heartbeat before checking if a fallback script runs on the flight controller."""
WELL_S: Final = 10.0  # Time of uninterrupted push before the source set with our heading is requested again
AGAIN_S: Final = 1.0
_OURS, _COMPASS, _GYROS = 1, 2, 3
_WORDS: Final = {
    _OURS: "Heading: companion",
    _COMPASS: "Heading: compass, companion's is not pushed",
    _GYROS: "Heading: gyros, companion's is not pushed",
}


class Fallback:
    """Selects the source set of ArduPilot's EKF when no companion heading is sent: 3 in flight, 2 on the ground.

    Set 3 uses gyros and GNSS (docs/reference/autopilots.md section 10.4). Set 2 uses the compass, which nothing could
    check in flight. A script on the flight controller (companion/lua) selects the set; if there is none, `step` sends
    a command to the autopilot. PX4 falls back without help.
    """

    def __init__(self, core: Core) -> None:
        self._vehicle, self._parameters, self._say = core.vehicle, core.parameters, core.say
        self.net: HeadingFallback | None = None
        self._selected = False
        self.reading = RepeatedRead(core.vehicle, self._read, 0.0)
        self._pushed_since_s = math.inf
        self._asked: int | None = None
        self._tried_s = -math.inf
        core.vehicle.on_event.add(self._on_event)

    @property
    def is_all(self) -> bool:
        return self._selected and self.net == "none"

    async def _read(self) -> None:
        kind = self._vehicle.kind
        await asyncio.sleep(SCRIPT_STARTS_S)
        if kind.heading_settings:
            found = await self._parameters.read_many(kind.heading_names(), optional=True)
            self.net, self._selected = kind.heading_net(found), kind.takes_only_our_heading(found)

    def _on_event(self, event: VehicleEvent) -> None:
        if event in ("found", "rebooted"):
            self.net = self._asked = None

    def step(self, now_s: float, *, pushing: bool) -> None:
        self._pushed_since_s = min(self._pushed_since_s, now_s) if pushing else math.inf
        if self.net != "command" or not self._selected:
            return
        if pushing:
            if now_s - self._pushed_since_s < WELL_S:
                return
            wanted = _OURS
        else:
            wanted = _COMPASS if self._vehicle.arm_state is ArmState.DISARMED else _GYROS
        if wanted == self._asked or now_s - self._tried_s < AGAIN_S:
            return
        self._tried_s = now_s
        answer = self._vehicle.commands.send(mavlink.MAV_CMD_SET_EKF_SOURCE_SET, wanted)
        answer.add_done_callback(lambda done: self._answered(wanted, done.result()))

    def close(self, now_s: float) -> None:
        self._tried_s = -math.inf
        self.step(now_s, pushing=False)

    def _answered(self, wanted: int, result: int | None) -> None:
        if result == mavlink.MAV_RESULT_ACCEPTED and self._asked != wanted:
            self._asked = wanted
            self._say(Severity.NOTICE if wanted == _OURS else Severity.WARNING, _WORDS[wanted], Weight.NEWS)


class Sender:
    """Sends the attitude to the autopilot at the rate `rate_hz`; with `full` also to ground stations."""

    def __init__(self, link: MavlinkLink, rate_hz: float, *, full: bool) -> None:
        self.sent = 0
        self._link, self._full = link, full
        self._period_s = max(1.0 / rate_hz, SHORTEST_S)
        self._next_s = self._last_s = self._left_s = self._shown_s = -math.inf

    def is_due(self, t_s: float, now_s: float) -> bool:
        """Return whether the attitude of time `t_s` is due: time stamps and sending times stay `SHORTEST_S` apart."""
        return (
            t_s >= self._next_s - _ROUNDING_S
            and t_s - self._last_s >= SHORTEST_S - _ROUNDING_S
            and now_s - self._left_s >= SHORTEST_S - _ROUNDING_S
        )

    def send(
        self, firmware: Firmware, attitude: Attitude, levelled: Attitude, reset_counter: int, now_s: float
    ) -> None:
        t_s = attitude.t_s
        # Keep the average rate, but do not send the messages missed in a gap.
        self._next_s = self._next_s + self._period_s if self._next_s > t_s - self._period_s else t_s + self._period_s
        self._last_s, self._left_s = t_s, now_s
        if self._link.send(vision_position_estimate(firmware, levelled, reset_counter)):
            self.sent += 1
        if self._full and now_s - self._shown_s >= SHOWN_EVERY_S:
            self._shown_s = now_s
            for message in attitude_messages(attitude):
                self._link.send(message)


class AttitudeService:
    """Estimates and supervises the attitude, and sends it to the autopilot (the push); `run` is its task."""

    def __init__(self, core: Core, devices: Devices, in_force: ActiveCalibration, calibrating: Calibrating) -> None:
        config, link, vehicle = core.config, core.link, core.vehicle
        self.turns = 0
        self._config, self._vehicle, self._say = config, vehicle, core.say
        self.carrier = AttitudeCarrier(core, carrying_imu(config), in_force, calibrating.alignment)
        self.difference = Difference(vehicle, self.carrier)
        self._autopilot_imu = devices.imus.get(self.carrier.imu.name)
        self.resume = Resume(core, self.carrier, self.difference, calibrating, self._autopilot_imu)
        self.fallback, own = Fallback(core), OwnCompass(vehicle, wanted=True)
        self.health = Health(
            self.carrier, self.difference, vehicle, lambda now_s: own.agrees(now_s) and not self.fallback.is_all
        )
        self.sender = Sender(link, models.attitude_rate_hz(config), full=config.push.attitude == "full")
        self.timesync = TimesyncResponder(link, vehicle)
        vehicle.hear(mavlink.MAVLink_heartbeat_message, self._on_heartbeat)
        self._fixed_wing = False
        self._airspeed_s = -math.inf
        self._looked_s = -math.inf
        self._was_pushing = False
        self._said: tuple[str, float] = ("", -math.inf)
        self._warned: str | None = None
        self._runs = core.only_listening is None
        self._started_s = math.inf
        self._closed = False
        if self._autopilot_imu is not None:
            take = self._guarded(self._on_imu)
            self._autopilot_imu.on_counting.add(lambda sample: take((sample,), sample.t_s))
        for sensor in devices.sensors:
            if any(role.name == self.carrier.imu.name for role in sensor.roles):
                sensor.on_samples.add(self._guarded(self._on_imu))
            elif "compass" in sensor.kinds:
                sensor.on_samples.add(self._guarded(lambda samples, _read_s: self.carrier.take_compass(samples)))

    # --- inputs

    def _guarded(self, take: Callable[[Sequence[Sample], float], None]) -> Callable[[Sequence[Sample], float], None]:
        """Wrap a sample callback: an exception stops sending and drops the attitude estimate; calibration continues."""

        def guarded(samples: Sequence[Sample], read_s: float) -> None:
            try:
                take(samples, read_s)
            except Exception:
                logger.exception("attitude met a fault of the program; it begins anew")
                self.health.stop(INTERNAL)
                self.carrier.forget()

        return guarded

    def _on_imu(self, samples: Sequence[Sample], read_s: float) -> None:
        found, step = [sample for sample in samples if isinstance(sample, ImuSample)], self.carrier.gyro_step_rad_s
        if found:
            self.carrier.add([without_truncation(sample, step) for sample in found] if step else found)
            self._push(read_s)

    def _push(self, read_s: float) -> None:
        """Send the attitude if due. Call this right after reading samples: a timer would skip messages."""
        if not self.health.pushing or not self.sender.is_due(self.carrier.heard_s, read_s):
            return
        attitude = self.carrier.now()
        figures = () if attitude is None else (*attitude.quaternion, *attitude.sigma_rad, *attitude.rate_rad_s)
        if attitude is None or not all(map(math.isfinite, (attitude.t_s, *figures))):
            self.health.stop("attitude lost: samples were missing for too long")
            return
        levelled = self.difference.levelled(attitude, read_s)
        self.sender.send(self._vehicle.kind, attitude, levelled, self.carrier.reset_counter, read_s)

    def _on_heartbeat(self, message: mavlink.MAVLink_heartbeat_message, _t_s: float) -> None:
        if not self._fixed_wing and message.type == mavlink.MAV_TYPE_FIXED_WING:
            self._fixed_wing = True
            self._vehicle.hear(mavlink.MAVLink_vfr_hud_message, self._on_vfr_hud, VFR_HUD_RATE_HZ)

    def _on_vfr_hud(self, message: mavlink.MAVLink_vfr_hud_message, t_s: float) -> None:
        good = (
            self.carrier.phase == "flight"
            and math.isfinite(message.airspeed)
            and message.airspeed > SLOWEST_AIRSPEED_M_S
        )
        self.carrier.airspeed_m_s = message.airspeed if good else None
        self._airspeed_s = t_s

    # --- task

    async def run(self) -> None:
        loop = asyncio.get_running_loop()
        self._started_s = loop.time()
        try:
            while True:
                self.turns += 1
                try:
                    if not self._closed:  # otherwise the push could resume while the daemon waits for a write to end
                        await self._turn(loop.time())
                except Exception:
                    # A doubtful attitude must not be pushed to an EKF in flight.
                    logger.exception("attitude met a fault of the program")
                    self.health.stop(INTERNAL)
                    await asyncio.sleep(1.0)
                await asyncio.sleep(TICK_S)
        finally:
            self.health.stop("the companion ends")

    async def _turn(self, now_s: float) -> None:
        if now_s - self._airspeed_s > AIRSPEED_OLD_S:
            self.carrier.airspeed_m_s = None
        if self._autopilot_imu is not None:
            kind = self._autopilot_imu.stream.kind
            self.carrier.gyro_step_rad_s = kind.gyro_step_rad_s if kind is not None else 0.0
        await self.resume.step(now_s)
        self.health.judge(now_s)
        self.fallback.step(now_s, pushing=self.health.pushing)
        if now_s - self._looked_s >= LOOK_S:
            self._looked_s = now_s
            await self.carrier.update(now_s)
        self._tell(now_s)

    def close(self) -> None:
        self._closed = True
        self.health.stop("the companion ends")
        self.fallback.close(asyncio.get_running_loop().time())

    def _tell(self, now_s: float) -> None:
        if self.health.pushing and not self._was_pushing:
            self._say_once(Severity.NOTICE, "Attitude: heading pushed to the autopilot", now_s)
        elif self._was_pushing and not self.health.pushing:
            self._say_once(Severity.WARNING, f"Attitude push stopped: {self.health.why_not}", now_s)
        elif self._restarted and now_s - self._started_s >= LATE_S:
            self._started_s = math.inf  # reported once
            self._say_once(Severity.WARNING, f"Attitude not pushed: {self.health.why_not}", now_s)
        self._was_pushing = self.health.pushing
        warning = self.health.warning
        if warning is not None and self._warned is None:
            logger.warning("%s", warning)
            self._say(Severity.WARNING, warning, Weight.NEWS)
        self._warned = warning

    def _say_once(self, severity: Severity, words: str, now_s: float) -> None:
        logger.log(logging.WARNING if severity is Severity.WARNING else logging.INFO, "%s", words)
        if self._said[0] != words or now_s - self._said[1] >= SAID_AGAIN_S:
            self._said = (words, now_s)
            self._say(severity, words, Weight.NEWS)

    # --- state

    @property
    def _restarted(self) -> bool:
        return self.resume.pending and self._vehicle.arm_state is ArmState.ARMED

    @property
    def concern(self) -> str | None:
        if self._restarted:
            return f"attitude not pushed: {self.health.why_not}"
        if self.carrier.phase == "flight" and not self.health.pushing and self.carrier.alignments:
            return f"attitude push stopped: {self.health.why_not}"
        return self.health.warning

    def status(self) -> Object:
        # A missing calibration does not count as a fault of a device.
        calibrated = self.carrier.alignments > 0 or self._restarted
        good = not self._runs or self.health.pushing or not calibrated
        summary = self._summary() if self._runs else "starts with companion run"
        return {"name": "attitude", "kind": "attitude", "good": good, "summary": summary}

    def _summary(self) -> str:
        if not self.health.pushing:
            return f"not pushed: {self.health.why_not}"
        seen = self.view()
        difference = seen["difference_deg"]
        differs = f", the autopilot's differs by {difference['heading']:.1f} deg" if difference is not None else ""
        return f"heading {seen['heading_deg']:.1f} +- {seen['sigma_deg']['heading']:.1f} deg pushed{differs}"

    def view(self) -> Object:
        now_s = asyncio.get_running_loop().time()
        attitude, difference = self.carrier.now(), self.difference
        known = attitude is not None and difference.is_known(now_s)
        return {
            "mode": self._config.push.attitude,
            "imu": self.carrier.imu.name,
            "pushing": self.health.pushing,
            "why_not": self.health.why_not or None,
            "sent": self.sender.sent,
            "alignments": self.carrier.alignments,
            "reset_counter": self.carrier.reset_counter % 256,
            "timesync_answers": self.timesync.answered,
            "safety_net": self.fallback.net,
            **_angles(attitude),
            "sigma_deg": attitude and _degrees(zip(("roll", "pitch", "heading"), attitude.sigma_rad, strict=True), 3),
            "difference_deg": _degrees((("tilt", difference.tilt_rad), ("heading", difference.heading_rad)), 2)
            if known
            else None,
        }

    def pose(self) -> Object | None:
        attitude = self.carrier.now() if self.health.pushing else None
        if attitude is None:
            return None
        return {**_angles(attitude), "north": "true", "source": "attitude", "still": self.carrier.still}


def _angles(attitude: Attitude | None) -> Object:
    if attitude is None:
        return {"roll_deg": None, "pitch_deg": None, "heading_deg": None}
    heading_deg = round(attitude.yaw_rad / DEG % 360.0, 2) % 360.0
    tilt = _degrees((("roll_deg", attitude.roll_rad), ("pitch_deg", attitude.pitch_rad)), 3)
    return {**tilt, "heading_deg": heading_deg}


def _degrees(angles_rad: Iterable[tuple[str, float]], digits: int) -> Object:
    return {name: round(angle / DEG, digits) for name, angle in angles_rad}
