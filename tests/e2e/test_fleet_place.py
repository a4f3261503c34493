"""Place information in all that one aircraft sends to a fleet: none, to a kilometre, or all, as configured."""

from __future__ import annotations

import asyncio
import json
import math
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from companion.config.sections import Location
from sim.earth import normal_gravity_m_s2
from sim.scenario import site_at
from tests.support.fleet import HERON, Aircraft, check
from tests.support.rig import Rig

LOCATIONS: tuple[Location, ...] = ("full", "1km", "off")
PLACE = site_at(47.123456, 11.654321, 623.4)
GRAVITY_M_S2 = normal_gravity_m_s2(47.123456, 623.4)
TELLING = {
    "latitude": PLACE.latitude_deg,
    "longitude": PLACE.longitude_deg,
    "height": PLACE.height_m,
    "declination": PLACE.declination_deg,
    "inclination": PLACE.inclination_deg,
    "field": PLACE.field_gauss,
    "gravity": GRAVITY_M_S2,
    # As it is found in what was worked out with it: sigmas of scale (0.5 %), 1 mg.
    "gravity times 0.005": 0.005 * GRAVITY_M_S2,
    "latitude's cosine": math.cos(math.radians(PLACE.latitude_deg)),
    "latitude's sine": math.sin(math.radians(PLACE.latitude_deg)),
}


async def lived(folder: Path) -> None:
    """A calibration and an arming there, by the whole daemon."""
    rig = Rig(folder, min_still_s=3.0, max_s=4.0, site=PLACE)
    async with rig.running():
        await rig.ready()
        await asyncio.sleep(5.0)
        replies = [reply async for reply in rig.service.faces.answer({"command": "calibrate", "wait": True})]
        assert replies[-1]["record"]["state"] == "done"
        rig.autopilot.armed = True
        await asyncio.sleep(3.0)
        rig.autopilot.armed = False
        await asyncio.sleep(2.0)


async def told(folder: Path, location: Location) -> list[Any]:
    aircraft = Aircraft(folder, location=location)
    async with aircraft.running():
        aircraft.connection.connect()
        async with asyncio.timeout(600.0):
            while aircraft.collector.kinds() != ["calibration", "arming"]:
                await asyncio.sleep(1.0)
    return [check("item", json.dumps(item).encode()) for item in aircraft.collector.of(HERON)]


def figures(value: Any, path: str = "") -> Iterator[tuple[str, float]]:
    """All numbers, also those within texts (of texts that are no times)."""
    if isinstance(value, dict):
        for key, each in value.items():
            yield from figures(each, f"{path}.{key}")
    elif isinstance(value, list):
        for number, each in enumerate(value):
            yield from figures(each, f"{path}[{number}]")
    elif isinstance(value, str) and not re.match(r"\d{4}-\d\d-\d\d", value):
        yield from ((path, float(number)) for number in re.findall(r"(?<![\w.])-?\d+\.?\d*", value))
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield path, float(value)


def telling(items: list[Any], relative: float) -> dict[str, str]:
    """Values that match the place to that relative accuracy, by path; the sign is ignored."""
    return {
        path: name
        for item in items
        for path, figure in figures(item["body"])
        for name, truth in TELLING.items()
        if abs(abs(figure) - abs(truth)) <= relative * abs(truth)
    }


async def test_no_figure_tells_more_of_the_place_than_is_wanted(tmp_path: Path) -> None:
    (tmp_path / "aircraft").mkdir()
    await lived(tmp_path / "aircraft")
    folders = {location: tmp_path / location for location in LOCATIONS}
    for folder in folders.values():
        shutil.copytree(tmp_path / "aircraft", folder)
    full, rounded, none = [await told(folder, location) for location, folder in folders.items()]
    found = telling(full, 1e-5)
    # The search finds them where they are, also the gravity within what was worked out with it.
    assert {"latitude", "height", "declination", "inclination", "gravity"} <= {*found.values()}
    assert "gravity times 0.005" in found.values()
    assert telling(none, 2e-3) == {}
    # A kilometre is 1e-2 deg of latitude, and no gravity or field tells it to that.
    assert telling(rounded, 1e-5) == {}
    assert {".site.latitude_deg", ".site.gravity_m_s2"} <= telling(rounded, 1e-3).keys()
    site = rounded[0]["body"]["site"]
    assert (site["latitude_deg"], site["height_m"]) == (47.12, 600.0)
    # What it is for is there as before.
    for one, other in zip(full, none, strict=True):
        assert other["body"].keys() == one["body"].keys()
    before, now = full[0]["body"]["imus"][0], none[0]["body"]["imus"][0]
    for key in ("gyro_bias_rad_s", "accel_bias_m_s2", "written", "gyro_id"):
        assert now[key] == before[key]
    for key in ("gyro_sigma_use_rad_s", "accel_sigma_use_m_s2", "gyro_sigma_stat_rad_s"):
        for sigma, exact in zip(now[key], before[key], strict=True):
            assert abs(sigma / exact - 1.0) <= 0.05
            # With all its digits the latitude could be worked out from it.
            assert sigma == float(f"{sigma:.1e}")
