"""May the attitude be pushed? What is wrong with it, in one line, and since when it is right again."""

from __future__ import annotations

import math
from typing import Final

from companion.attitude.heading import REFUSED_S
from companion.autopilot.vehicle.vehicle import Vehicle
from companion.daemon.heading.carrier import Carrier
from companion.daemon.heading.difference import Difference
from companion.physics.units import DEG

SILENT_S: Final = 0.2
HEADING_SIGMA_DEG: Final = 15.0
TILT_SIGMA_DEG: Final = 15.0
DIFFERS_SIGMAS: Final = 3.0
DIFFERS_S: Final = 5.0
THEIR_TILT_DEG: Final = 2.0
"""One sigma of what the autopilot's own tilt is off by; trim (AHRS_TRIM) and mounting errors are in it."""
THEIR_HEADING_DEG: Final = 5.0
"""Likewise of its heading, where a compass or we give it."""
GOOD_S: Final = 3.0
"""After a stop everything has to be well for so long before the push begins again."""
TOLD_TILT_DEG: Final = 4.0
TOLD_HEADING_DEG: Final = 8.0
"""A smoothed difference beyond these is told; it is over at half of them."""


class Health:
    """Judges; `judge` several times a second.

    A heading that differs stops the push only if the two have agreed since the last alignment: before that the
    autopilot has no heading, or one of its own that is to be replaced by ours.
    """

    def __init__(self, carrier: Carrier, difference: Difference, vehicle: Vehicle) -> None:
        self._carrier, self._difference, self._vehicle = carrier, difference, vehicle
        self.pushing = False
        self.why_not = carrier.waiting_for
        """Why nothing is pushed; empty while it is."""
        self.warning: str | None = None
        """That the two attitudes differ, in words."""
        self._stopped = False
        self._good_since_s: float | None = None
        self._differs_since_s: float | None = None
        self._agreed = False
        self._alignments = 0

    def judge(self, now_s: float) -> None:
        """Look at everything; `pushing` and the words follow."""
        if self._alignments != self._carrier.alignments:
            self._alignments = self._carrier.alignments
            self._agreed, self._differs_since_s = False, None
            self._difference.forget()
        wrong = self._wrong(now_s)
        self._compare(now_s)
        if wrong is not None:
            self._stopped |= self.pushing
            self.pushing, self.why_not, self._good_since_s = False, wrong, None
            return
        if self._good_since_s is None:
            self._good_since_s = now_s
        wait_s = GOOD_S if self._stopped else 0.0
        if now_s - self._good_since_s >= wait_s:
            self.pushing, self.why_not, self._stopped = True, "", False
        else:
            self.why_not = f"well again, pushed after {GOOD_S:.0f} s of it"

    def stop(self, why: str) -> None:
        """Stop between two looks."""
        self._stopped |= self.pushing
        self.pushing, self.why_not, self._good_since_s = False, why, None

    def _wrong(self, now_s: float) -> str | None:
        carrier = self._carrier
        if self._vehicle.firmware is None:
            return "waiting for the autopilot"
        if self._vehicle.firmware == "other":
            return "this autopilot is neither ArduPilot nor PX4"
        if self._vehicle.conflict is not None:
            return self._vehicle.conflict
        if carrier.estimator is None:
            return carrier.waiting_for
        silent_s = now_s - carrier.heard_s
        if silent_s > SILENT_S:
            return f"IMU {carrier.imu.name} sends nothing"
        attitude = carrier.now()
        if attitude is None:
            if carrier.alignments and carrier.phase == "flight":
                return "attitude lost in flight: it is aligned again on the ground"
            return carrier.waiting_for
        if not carrier.estimator.heading_known:
            return "heading unknown: no compass reading fits"
        roll, pitch, heading = (sigma / DEG for sigma in attitude.sigma_rad)
        if heading > HEADING_SIGMA_DEG:
            return f"heading sigma {heading:.0f} deg > {HEADING_SIGMA_DEG:.0f}"
        if max(roll, pitch) > TILT_SIGMA_DEG and abs(attitude.pitch_rad) < math.radians(80.0):
            return f"tilt sigma {max(roll, pitch):.0f} deg > {TILT_SIGMA_DEG:.0f}"
        if carrier.compass_refused_s > REFUSED_S:
            return f"compass disagrees for {carrier.compass_refused_s:.0f} s"
        return self._differs(now_s, max(roll, pitch), heading)

    def _differs(self, now_s: float, tilt_sigma_deg: float, heading_sigma_deg: float) -> str | None:
        difference = self._difference
        if not difference.is_known(now_s):
            self._differs_since_s = None
            return None
        tilt, heading = difference.tilt_rad / DEG, abs(difference.heading_rad) / DEG
        heading_limit = DIFFERS_SIGMAS * math.hypot(heading_sigma_deg, THEIR_HEADING_DEG)
        tilt_limit = DIFFERS_SIGMAS * math.hypot(tilt_sigma_deg, THEIR_TILT_DEG)
        self._agreed |= heading < heading_limit / DIFFERS_SIGMAS
        words = None
        if tilt > tilt_limit:
            words = f"tilt differs by {tilt:.0f} deg from the autopilot's"
        elif self._agreed and heading > heading_limit:
            words = f"heading differs by {heading:.0f} deg from the autopilot's"
        if words is None:
            self._differs_since_s = None
            return None
        if self._differs_since_s is None:
            self._differs_since_s = now_s
        # What has stopped the push goes on doing so until it is well again.
        return words if now_s - self._differs_since_s >= DIFFERS_S or not self.pushing else None

    def _compare(self, now_s: float) -> None:
        difference = self._difference
        if not difference.is_known(now_s):
            self.warning = None
            return
        share = 0.5 if self.warning is not None else 1.0
        tilt, heading = difference.tilt_rad / DEG, abs(difference.heading_rad) / DEG
        parts = []
        if tilt > share * TOLD_TILT_DEG:
            parts.append(f"{tilt:.0f} deg in tilt")
        if heading > share * TOLD_HEADING_DEG:
            parts.append(f"{heading:.0f} deg in heading")
        self.warning = f"attitude is {', '.join(parts)} off the autopilot's" if parts else None
