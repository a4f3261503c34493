"""External attitude in the double: VisOdom accepts the attitude, EKF3 uses its yaw if a source set selects that.

Facts: ArduPilot `GCS_Common.cpp`, `AP_VisualOdom_MAV.cpp`, `AP_NavEKF3_Measurements.cpp` (writeExtNavData),
`AP_NavEKF3_MagFusion.cpp` (2026-03). VISO_TYPE and EK3_SRCn_YAW count as they were at the boot. Not modelled: position
and velocity, which nobody here selects; lanes.
"""

from __future__ import annotations

import math
from collections import Counter

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.ardupilot.board import ArduPilotBoard

COMPASS = 1
EXTNAV = 6
LEAST_SPACING_MS = 20
HEALTHY_S = 0.3
YAW_NOISE_RAD = 0.2
"""Smallest sigma accepted for the yaw (default of VISO_YAW_M_NSE); a sigma above 1.5 rad is limited to that."""
GATE_SIGMAS = 3.0
"""Gate of the yaw innovation in sigmas (EK3_YAW_I_GATE)."""
FUSED_S = 2.0
"""Time constant with which the heading follows the external yaw; about as in EKF3 at 30 Hz and this noise."""


class ExternalNav:
    """Processes external attitude, from the message to the heading; call `restart` at each boot."""

    def __init__(self, double: ArduPilotBoard) -> None:
        self._double = double
        self.rejected: Counter[str] = Counter()
        """Number of rejected messages by reason."""
        self.consumed = 0
        """Number of messages that reached the EKF."""
        self.sigma_rad = math.nan
        """Sigma of the last yaw that the EKF has used."""
        self.restart()

    def restart(self) -> None:
        values = self._double.parameters.values
        self.enabled = values["VISO_TYPE"] == 1
        self._sources = {number: values.get(f"EK3_SRC{number}_YAW", 0.0) for number in (1, 2, 3)}
        self.source_set = 1
        self.selected = self._sources[1] == EXTNAV
        self.aligned = self._resets = False
        self._stamp_ms = -math.inf
        self._heard_s = self._fused_s = -math.inf

    def choose(self, source_set: int) -> None:
        """Select a set of sources; the heading is reset to the next value of the new source."""
        double = self._double
        self.source_set = source_set
        self.selected = self._sources[source_set] == EXTNAV
        self._resets = self.selected
        double.estimator.compass = self._sources[source_set] == COMPASS
        if double.estimator.compass:
            double.estimator.yaw_error_rad = 0.0
            self.aligned = True

    def healthy(self, loop_s: float) -> bool:
        """Return True if the check before arming accepts the external attitude."""
        return loop_s - self._heard_s < HEALTHY_S

    def take(self, message: mavlink.MAVLink_vision_position_estimate_message, loop_s: float) -> None:
        covariance = message.covariance
        if not self.enabled:
            self.rejected["off"] += 1
            return
        self._heard_s = loop_s
        sigma = 0.0
        if not math.isnan(covariance[0]):
            total = covariance[15] + covariance[18] + covariance[20]
            sigma = math.sqrt(total) if total >= 0.0 else math.nan
        if any(map(math.isnan, (message.x, message.y, message.z))):
            self.rejected["position"] += 1
            return
        stamp_ms = message.usec // 1000
        if stamp_ms - self._stamp_ms < LEAST_SPACING_MS:
            self.rejected["too soon"] += 1
            return
        self._stamp_ms = stamp_ms
        if any(map(math.isnan, (message.roll, message.pitch, message.yaw, sigma))):
            self.rejected["angle"] += 1
            return
        self.consumed += 1
        self.sigma_rad = max(min(max(sigma, YAW_NOISE_RAD), 1.5), math.radians(5.0))
        if self.selected:
            self._fuse(message.yaw, loop_s)

    def _fuse(self, yaw_rad: float, loop_s: float) -> None:
        double = self._double
        double.update_estimator(loop_s)
        _, _, truth = double.aircraft.angles_rad(double.aircraft.time_at(loop_s))
        wrong = math.remainder(yaw_rad - truth, 2.0 * math.pi)
        estimator = double.estimator
        if self._resets:
            self._resets = False
            estimator.yaw_error_rad = wrong
        elif not self.aligned:
            self.aligned = True
            estimator.yaw_error_rad = wrong
            double.say(mavlink.MAV_SEVERITY_INFO, "EKF3 IMU0 yaw aligned")
        else:
            innovation = math.remainder(wrong - estimator.yaw_error_rad, 2.0 * math.pi)
            if abs(innovation) < GATE_SIGMAS * self.sigma_rad:
                span_s = min(loop_s - self._fused_s, 1.0)
                estimator.yaw_error_rad += (1.0 - math.exp(-span_s / FUSED_S)) * innovation
        self._fused_s = loop_s
