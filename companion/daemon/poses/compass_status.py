"""Expected heading error of the autopilot's compasses, for the status, the page and `companion check`.

It is the sigma of the last alignment while the autopilot has the values that this wrote. At rest, the corrected
field of the compass in use is also compared with WMM2025 and with the companion's own compass.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from typing import Final

import numpy as np

from companion.autopilot.parameters.change import same_float32
from companion.autopilot.telemetry.compass_fields import SELECTED, CompassFields
from companion.configured import models
from companion.daemon.core import Core, RepeatedRead
from companion.daemon.poses.alignment import ByHand
from companion.errors import CompanionError
from companion.estimation.means.pose import vehicle_heading_rad
from companion.estimation.means.windows import Window
from companion.estimation.solution.site import LocalEarth
from companion.formats import Object
from companion.messages import message
from companion.physics.earth import MagneticField
from companion.physics.frames import Array, body_from_ned, roll_pitch_from_up, wrap_deg
from companion.physics.units import DEG

JUDGED_EVERY_S: Final = 30.0
LISTEN_S: Final = 2.0
RETRY_S: Final = 30.0
DOUBT_DEG: Final = 5.0
"""Heading error from which a compass is doubted; ordinary ground and a small remainder of iron are below."""
_TILT: Final = 2.0 * DEG
"""Tilt error of an accelerometer that was never calibrated: 20 mg, twice."""
_OWN_SIGMAS: Final = 3.0


class CompassStatus:
    """Rows and warnings on the autopilot's compasses; `run` compares the field while the aircraft stands still."""

    def __init__(self, core: Core, by_hand: ByHand) -> None:
        self._core, self._by_hand = core, by_hand
        self._fields = CompassFields(core.link, core.vehicle)
        self._values: dict[str, float] = {}
        self.warnings: list[str] = []
        self.reading = RepeatedRead(core.vehicle, self._read, RETRY_S)
        core.parameters.on_value.add(self._on_value)

    @property
    def rows(self) -> list[Object]:
        """Return the heading error of each compass from the last alignment; none if its values are not in force."""
        done = self._by_hand.last_compass
        now = {name: self._values.get(name, math.nan) for name in (done.written if done else ())}
        if done is None or not all(same_float32(now[name], value) for name, value in done.written.items()):
            return []
        return [
            {"name": name, "summary": f"heading good to {sigma:.1f} deg, aligned {done.measured_at[:10]}"}
            for name, sigma in done.heading_sigma_deg.items()
        ]

    async def _read(self) -> None:
        done = self._by_hand.last_compass
        self._values = {} if done is None else await self._core.parameters.read_many(done.written, optional=True)

    def _on_value(self, name: str, value: float) -> None:
        if name in self._values:
            self._values[name] = value

    async def run(self) -> None:
        while True:
            await asyncio.sleep(JUDGED_EVERY_S)
            if not self._core.machine.state.busy:
                with contextlib.suppress(CompanionError):
                    self.warnings = await self._doubts()

    async def _doubts(self) -> list[str]:
        since_s = asyncio.get_running_loop().time()
        with self._fields.heard():
            await asyncio.sleep(LISTEN_S)
        field = self._fields.mean(SELECTED, since_s)
        window, local = await self._core.window(), await self._core.local_earth()
        if field is None or local.field is None or not window.imus or window.start_s > since_s:
            return []
        up = np.array(window.imus[0].accel_m_s2)
        up /= np.linalg.norm(up)
        return _doubts(field.mean_gauss, up, local, self._own_heading(window, up, local))

    def _own_heading(self, window: Window, up: Array, local: LocalEarth) -> tuple[float, float] | None:
        """Return the true heading of the companion's own compass and its sigma, deg; None: it has none."""
        own = models.compass_model(self._core.config.compass)
        if own is None or window.heading is None:
            return None
        north_deg = local.declination_deg if own.magnetic else 0.0
        heading_deg = vehicle_heading_rad(own, window.heading.heading_deg, up) / DEG + north_deg
        return heading_deg, math.hypot(own.sigma_at(up), window.heading.sigma_deg)


def _doubts(field_gauss: Array, up: Array, local: LocalEarth, own: tuple[float, float] | None) -> list[str]:
    """Compare a corrected field (3,) at rest with the Earth's, and its heading with another compass' heading."""
    assert local.field is not None
    ahead, right, down = body_from_ned(*roll_pitch_from_up(up), 0.0).T @ field_gauss
    off_deg, doubts = _off_deg(local.field, math.hypot(ahead, right), down), []
    if off_deg > DOUBT_DEG:
        doubts.append(message("compass_doubted", degrees=f"{off_deg:.0f}", by="field"))
    if own is not None:
        apart_deg = wrap_deg(math.atan2(-right, ahead) / DEG + local.declination_deg - own[0])
        if abs(apart_deg) > max(DOUBT_DEG, _OWN_SIGMAS * own[1]):
            doubts.append(message("compass_doubted", degrees=f"{apart_deg:+.0f}", by="companion's own compass"))
    return doubts


def _off_deg(earth: MagneticField, horizontal_gauss: float, down_gauss: float) -> float:
    """Return the heading error, rms all round, that iron causes which shifts the field this much in any direction."""
    off = math.hypot(horizontal_gauss - earth.horizontal_gauss, down_gauss - earth.down_gauss) / math.sqrt(2.0)
    return math.atan2(max(0.0, off - abs(earth.down_gauss) * _TILT), earth.horizontal_gauss) / DEG
