"""External attitude in the double: external vision as EKF2 uses its yaw.

Facts: PX4 `mavlink_receiver.cpp`, `EKF2.cpp` (UpdateExtVisionSample), `ev_control.cpp`, `ev_yaw_control.cpp`,
`Timesync.cpp` (2026). Not modelled: position, velocity, ODOMETRY, the estimator's yaw covariance.
"""

from __future__ import annotations

import math
from collections import Counter

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.firmware.channel import Message
from sim.px4.board import PX4Board

YAW_BIT = 8
"""Bit of EKF2_EV_CTRL that enables yaw."""
LONGEST_GAP_S = 0.2
STOPS_AFTER_S = 0.4
RESTARTS_AFTER_S = 1.0
"""Time without fusion after which EKF2 starts the fusion again."""
CONVERGED_AFTER = 500
"""Number of accepted TIMESYNC exchanges after which time stamps are used."""
LONGEST_ROUND_TRIP_S = 0.010
GATE_SIGMAS = 2.6
"""Gate of the heading innovation in sigmas (EKF2_HDG_GATE)."""
FAILS_AFTER_S = 1.0
FUSED_S = 2.0
COMPASS_FADES_S = 10.0
"""Time constant with which the magnetometer corrects a wrong heading, without external yaw."""


class ExternalVision:
    """Processes external vision, from the message to the heading; call `restart` at each boot."""

    def __init__(self, double: PX4Board) -> None:
        self._double = double
        self.rejected: Counter[str] = Counter()
        """Number of rejected messages by reason."""
        self.consumed = 0
        """Number of messages whose orientation reached EKF2."""
        self.sigma_rad = math.nan
        """Sigma of the last yaw that EKF2 has used."""
        self.late_s = math.nan
        """Age of the last sample, by its time stamp."""
        self.restart()

    def restart(self) -> None:
        self.active = False
        """Status flag cs_ev_yaw: EKF2 uses the external yaw."""
        self.yaw_error_rad = 0.0
        self.exchanges = 0
        self._offset_s = 0.0
        self._counter = 0
        self._heard_s = self._fused_s = -math.inf
        self._updated_s = math.nan

    @property
    def converged(self) -> bool:
        """True: time stamps are used; before, every sample counts as new."""
        return self.exchanges >= CONVERGED_AFTER

    def timesync(self, their_ns: int, sent_ns: int, loop_s: float) -> None:
        """Handle an answer to one of our TIMESYNC requests."""
        now_s = self._double.boot_us(loop_s) * 1e-6
        if now_s - sent_ns * 1e-9 < LONGEST_ROUND_TRIP_S:
            self.exchanges += 1
            self._offset_s = 0.5 * (sent_ns * 1e-9 + now_s) - their_ns * 1e-9

    def update(self, loop_s: float) -> None:
        """Advance the heading to this time."""
        if self.active and loop_s - self._heard_s > STOPS_AFTER_S:
            self.active = False
            self._say("vision data stopped")
        if not self.active and self._updated_s == self._updated_s:
            span_s = max(loop_s - self._updated_s, 0.0)
            if self._double.parameters["EKF2_MAG_TYPE"] != 5:
                self.yaw_error_rad *= math.exp(-span_s / COMPASS_FADES_S)
        self._updated_s = loop_s

    def take(self, message: Message, loop_s: float) -> None:
        """Handle a message if it contains an attitude."""
        if isinstance(message, mavlink.MAVLink_vision_position_estimate_message):
            angles = (message.roll, message.pitch, message.yaw)
            if not all(map(math.isfinite, angles)):
                self.rejected["angle"] += 1
                return
            self._sample(message.usec, message.yaw, message.covariance[20], message.reset_counter, loop_s)

    def _sample(self, stamp_us: int, yaw_rad: float, variance: float, counter: int, loop_s: float) -> None:
        self.update(loop_s)
        parameters = self._double.parameters
        self.late_s = (
            self._double.boot_us(loop_s) * 1e-6 - (stamp_us * 1e-6 + self._offset_s) if self.converged else 0.0
        )
        gap_s = loop_s - self._heard_s
        reset = counter != self._counter
        self._heard_s, self._counter = loop_s, counter
        self.consumed += 1
        # ev_yaw_control.cpp takes the parameter, a sigma by its name, for the least variance.
        given = parameters["EKF2_EV_NOISE_MD"] == 0 and math.isfinite(variance)
        self.sigma_rad = math.sqrt(max(variance if given else 0.0, parameters["EKF2_EVA_NOISE"], 1e-4))
        if not int(parameters["EKF2_EV_CTRL"]) & YAW_BIT:
            if self.active:
                self.active = False
                self._say("stopping EV yaw fusion, continuing conditions failing")
            return
        wrong = self._wrong(yaw_rad, loop_s)
        innovation = math.remainder(wrong - self.yaw_error_rad, 2.0 * math.pi)
        fits = abs(innovation) < GATE_SIGMAS * self.sigma_rad
        if not self.active:
            if gap_s < LONGEST_GAP_S and loop_s - self._fused_s > RESTARTS_AFTER_S and fits:
                self.active = True
                self._fused_s = loop_s
            return
        if reset:
            self._reset(wrong, loop_s)
        elif fits:
            self.yaw_error_rad += (1.0 - math.exp(-min(gap_s, 1.0) / FUSED_S)) * innovation
            self._fused_s = loop_s
        elif loop_s - self._fused_s > FAILS_AFTER_S:
            self._reset(wrong, loop_s)

    def _reset(self, wrong: float, loop_s: float) -> None:
        self.yaw_error_rad, self._fused_s = wrong, loop_s

    def _wrong(self, yaw_rad: float, loop_s: float) -> float:
        _, _, truth = self._double.aircraft.angles_rad(self._double.aircraft.time_at(loop_s))
        return math.remainder(yaw_rad - truth, 2.0 * math.pi)

    def _say(self, words: str) -> None:
        """Print on the autopilot's console only, as the real firmware does."""
        self.rejected[words] += 1
