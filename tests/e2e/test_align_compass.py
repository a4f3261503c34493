"""`companion align compass` on the whole daemon: the iron that it finds, writes, and puts back."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion.commands import Align
from companion.component.service import JobResult, Refusal
from companion.estimation.records.align_record import CompassRecord
from sim.aircraft import Pose
from sim.earth import Array, body_from_ned
from sim.firmware.compass import SimCompass, corrected
from sim.hands import Hands
from tests.e2e.test_align import follow
from tests.e2e.test_calibration import started
from tests.support.rig import Rig

FIELD_NED_MGAUSS = (275.6, -33.9, 471.4)
"""WMM2025 at the rig's place, from NOAA's calculator."""
SOFT = np.array([[1.04, 0.02, -0.03], [0.02, 0.97, 0.015], [-0.03, 0.015, 1.02]])
HARD_MGAUSS = (110.0, -80.0, 60.0)
NAMES = {
    "ardupilot": [[f"COMPASS_{what}_{axis}" for axis in "XYZ"] for what in ("OFS", "DIA", "ODI")],
    "px4": [[f"CAL_MAG0_{axis}{what}" for axis in "XYZ"] for what in ("OFF", "SCALE", "ODIAG")],
}
MILLIGAUSS = {"ardupilot": 1.0, "px4": -1e3}


def rig(
    folder: Path, firmware: str = "ardupilot", slope: tuple[float, float] = (2.0, -1.0), **more: Any
) -> tuple[Rig, Hands]:
    pose = Pose(pitch_deg=slope[0], roll_deg=slope[1], heading_deg=40.0)
    made = Rig(folder, pose=pose, seed=1, firmware=firmware, imu_rate_hz=10.0, **more)  # type: ignore[arg-type]
    made.autopilot.field_ned = np.array(FIELD_NED_MGAUSS)
    made.autopilot.compasses = [SimCompass(HARD_MGAUSS, SOFT, noise_mgauss=1.0)]
    return made, Hands(made.aircraft, placement_deg=0.1, seed=1)


def values(made: Rig, firmware: str) -> list[list[float]]:
    return [[made.autopilot.parameter(name) for name in names] for names in NAMES[firmware]]


def heading_errors_deg(found: list[list[float]], unit_mgauss: float) -> Array:
    """Error of the heading that these parameters give, every 10 degrees on the level."""
    offset, diagonal, beside = found
    errors = []
    for heading in np.radians(np.arange(0.0, 360.0, 10.0)):
        raw = np.linalg.solve(SOFT, body_from_ned(0.0, 0.0, heading) @ FIELD_NED_MGAUSS) - HARD_MGAUSS
        field = corrected(raw, [unit_mgauss * one for one in offset], diagonal, beside)
        declination = math.atan2(FIELD_NED_MGAUSS[1], FIELD_NED_MGAUSS[0])
        off = math.atan2(-field[1], field[0]) + declination - heading
        errors.append(math.degrees(math.remainder(off, 2.0 * math.pi)))
    return np.array(errors)


async def aligned(made: Rig, hands: Hands, **asked: Any) -> tuple[JobResult, CompassRecord | None]:
    job = started(made.service.calibrating.start_alignment(Align(action="compass", **asked), "test"))
    result = await follow(made, hands, job)
    return result, job.product if isinstance(job.product, CompassRecord) else None


@pytest.mark.parametrize("firmware", ["ardupilot", "px4"])
async def test_iron_is_found_at_four_headings_written_seen_and_undone_to_the_bit(tmp_path: Path, firmware: str) -> None:
    made, hands = rig(tmp_path, firmware)
    async with made.running():
        await made.ready()
        old = values(made, firmware)
        before_deg = heading_errors_deg(old, MILLIGAUSS[firmware])
        assert np.abs(before_deg).max() > 20.0
        result, record = await aligned(made, hands, write=True)
        assert result.outcome == "done", result
        assert record is not None
        left_deg = heading_errors_deg(values(made, firmware), MILLIGAUSS[firmware])
        (found,) = record.compasses
        assert np.sqrt(np.mean(np.square(left_deg))) < min(1.0, 2.0 * found.heading_sigma_deg)
        assert found.heading_before_deg == pytest.approx(np.abs(before_deg).max(), abs=1.0)
        assert record.heading_deg == pytest.approx(40.0, abs=1.0)
        assert {one.outcome for one in found.written.values()} == {"verified"}
        assert [one.before for one in found.written.values()] == [value for each in old for value in each]
        undone = made.service.calibrating.manager.start_undo("test")
        assert not isinstance(undone, Refusal)
        assert (await undone.finished).outcome == "done"
        assert values(made, firmware) == old
