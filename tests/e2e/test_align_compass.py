"""`companion align compass` on the whole daemon: the iron that it finds, writes, and puts back."""

from __future__ import annotations

import asyncio
import re
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from companion import summary
from companion.commands import Align
from companion.component.service import JobResult, Refusal
from companion.estimation.records.align_record import CompassRecord
from sim.aircraft import Pose
from sim.ardupilot.double import ArduPilotDouble
from sim.devices import HMR3300
from sim.earth import Array, mounting_matrix
from sim.firmware.compass import SimCompass
from sim.hands import Hands
from sim.scenario import site_at
from sim.sitl.compasses import HARD_MGAUSS, NAMES, SOFT, heading_errors_deg
from tests.e2e.test_align import follow
from tests.e2e.test_calibration import started
from tests.support.by_hand import alone
from tests.support.by_hand import follow as follow_sides
from tests.support.rig import Rig

SITE = site_at(40.0, 116.0, 50.0)


def rig(
    folder: Path, firmware: str = "ardupilot", slope: tuple[float, float] = (2.0, -1.0), **more: Any
) -> tuple[Rig, Hands]:
    pose = Pose(pitch_deg=slope[0], roll_deg=slope[1], heading_deg=40.0)
    more = {"compasses": [SimCompass(HARD_MGAUSS, SOFT, noise_mgauss=1.0)], **more}
    made = Rig(folder, pose=pose, seed=1, firmware=firmware, imu_rate_hz=10.0, **more)  # type: ignore[arg-type]
    return made, Hands(made.aircraft, placement_deg=0.1, seed=1)


def values(made: Rig, firmware: str) -> list[list[float]]:
    return [[made.autopilot.parameter(name) for name in names] for names in NAMES[firmware]]


def errors_deg(found: list[list[float]], firmware: str) -> Array:
    return heading_errors_deg(np.array(found), firmware, 1e3 * SITE.field_ned_gauss, (0.0, 0.0))


async def aligned(made: Rig, hands: Hands, **asked: Any) -> tuple[JobResult, CompassRecord | None]:
    job = started(made.service.calibrating.start_alignment(Align(action="compass", **asked), "test"))
    result = await follow(made, hands, job)
    return result, job.product if isinstance(job.product, CompassRecord) else None


@pytest.mark.parametrize("firmware", ["ardupilot", "px4"])
async def test_iron_is_found_at_four_headings_written_seen_and_undone_to_the_bit(tmp_path: Path, firmware: str) -> None:
    second = {"CAL_MAG1_ID": 197644.0} if firmware == "px4" else {}  # as in PX4's simulation: a slot without a field
    made, hands = rig(tmp_path, firmware, parameters=second)
    async with made.running():
        await made.ready()
        old = values(made, firmware)
        before_deg = errors_deg(old, firmware)
        assert np.abs(before_deg).max() > 20.0
        result, record = await aligned(made, hands, write=True)
        assert result.outcome == "done", result
        assert record is not None
        left_deg = errors_deg(values(made, firmware), firmware)
        (found,) = record.compasses
        assert ("compass 2 left out: no field of it arrives" in record.warnings) == bool(second)
        assert np.sqrt(np.mean(np.square(left_deg))) < min(1.0, 2.0 * found.heading_sigma_deg)
        assert found.heading_before_deg == pytest.approx(np.abs(before_deg).max(), abs=1.0)
        assert record.heading_deg == pytest.approx(40.0, abs=1.0)
        assert {one.outcome for one in found.written.values()} == {"verified"}
        assert [one.before for one in found.written.values()] == [value for each in old for value in each]
        undone = made.service.calibrating.manager.start_undo("test")
        assert not isinstance(undone, Refusal)
        assert (await undone.finished).outcome == "done"
        assert values(made, firmware) == old


async def test_iron_under_the_spot_is_named_and_not_written(tmp_path: Path) -> None:
    made, hands = rig(tmp_path)
    bent = np.diag([60.0, -60.0, 0.0])  # milligauss at 0.3 m, so 200 mG/m
    made.autopilot.compasses[0].spot = lambda body_from_ned: bent @ body_from_ned.T @ (1.0, 0.0, 0.0)
    async with made.running():
        await made.ready()
        old = values(made, "ardupilot")
        result, record = await aligned(made, hands, write=True)
        assert result.outcome == "failed"
        assert "nothing was written: compass 1: heading only good to" in result.reason
        assert "mG from pose to pose" in result.reason
        assert record is not None
        assert any("iron near the spot" in words for words in record.warnings)
        assert values(made, "ardupilot") == old


async def test_a_car_that_drives_by_and_a_plug_that_comes_off_are_named_and_nothing_is_lost(tmp_path: Path) -> None:
    made, hands = rig(tmp_path)
    async with made.running():
        await made.ready()
        job = started(made.service.calibrating.start_alignment(Align(action="compass"), "test"))
        following = asyncio.create_task(follow(made, hands, job))
        (compass,) = made.autopilot.compasses
        for trouble, words in (("car", "the field of compass 1 changes by"), ("plug", "no field of compass 1 arrives")):
            while "measuring, 6 of" not in job.words:
                await asyncio.sleep(0.5)
            compass.spot = (lambda _: np.array([40.0, 0.0, 0.0])) if trouble == "car" else None
            compass.unplugged = trouble == "plug"
            while words not in (stands := made.service.calibrating.stands.state).objection:  # type: ignore[union-attr]
                await asyncio.sleep(0.5)
            compass.spot, compass.unplugged = None, False
            assert stands is not None
            while stands.objection:
                await asyncio.sleep(0.5)
        assert (await following).outcome == "done"
        assert isinstance(job.product, CompassRecord)
        assert job.product.heading_deg == pytest.approx(40.0, abs=1.5)


@pytest.mark.parametrize("until", ["6 s", "the last pose"])
async def test_the_autopilots_own_calibration_of_a_compass_is_named_and_nothing_is_written(
    tmp_path: Path, until: str
) -> None:
    made, hands = rig(tmp_path)
    assert isinstance(made.autopilot, ArduPilotDouble)
    async with made.running():
        await made.ready()
        old = values(made, "ardupilot")
        job = started(made.service.calibrating.start_alignment(Align(action="compass", write=True), "test"))
        following = asyncio.create_task(follow(made, hands, job))
        while f"{1 if until == '6 s' else 4} of 4: measuring, 6 of" not in job.words:
            await asyncio.sleep(0.5)
        made.autopilot.calibrates_compass = True
        while "is calibrating its own sensors" not in made.service.calibrating.stands.state.objection:  # type: ignore[union-attr]
            await asyncio.sleep(0.5)
        assert values(made, "ardupilot") == old
        made.autopilot.calibrates_compass = False
        assert (await following).outcome == "done"


async def test_armed_in_the_middle_nothing_is_written(tmp_path: Path) -> None:
    made, hands = rig(tmp_path)
    async with made.running():
        await made.ready()
        old = values(made, "ardupilot")
        job = started(made.service.calibrating.start_alignment(Align(action="compass", write=True), "test"))
        following = asyncio.create_task(follow(made, hands, job))
        while not job.words.startswith("3 of"):
            await asyncio.sleep(0.5)
        made.autopilot.arm()
        assert "armed during the alignment" in (await following).reason
        assert values(made, "ardupilot") == old


@pytest.mark.parametrize(("own", "asked"), [(True, {}), (False, {"heading": 41.0}), (False, {})])
async def test_one_heading_suffices_where_it_is_known(tmp_path: Path, own: bool, asked: dict[str, float]) -> None:
    made, hands = rig(tmp_path)
    made.devices["compass"] = HMR3300(made.aircraft, seed=1)
    if not own:
        made.config = msgspec.structs.replace(made.config, compass=None)
        del made.devices["compass"]
    async with made.running():
        await made.ready()
        if not (own or asked):
            refused = made.service.calibrating.start_alignment(Align(action="compass", headings=1), "test")
            assert isinstance(refused, Refusal)
            assert "without --heading or a compass" in refused.reason
            return
        result, record = await aligned(made, hands, headings=1, **asked)
        assert record is not None, result
        (found,) = record.compasses
        heading_sigma_deg = record.heading_sigma_deg
        assert abs(record.heading_deg - 40.0) < 2.0 * heading_sigma_deg
        assert found.heading_sigma_deg > heading_sigma_deg > 1.0
        assert np.abs(np.subtract(found.offset_mgauss, HARD_MGAUSS) / found.offset_sigma_mgauss).max() < 3.0


async def test_all_sides_give_hard_and_soft_iron_at_headings_that_nobody_knows(tmp_path: Path) -> None:
    compass = SimCompass(HARD_MGAUSS, SOFT, noise_mgauss=1.0)
    made, hands = alone(tmp_path, propped_deg=4.0, imu_rate_hz=10.0, compasses=[compass])
    async with made.running():
        await made.ready()
        asked = {"action": "compass", "sides": True, "write": True, "timeout_s": 2000.0}
        start = made.service.calibrating.start_alignment
        result = await follow_sides(made, hands, started(start(Align.read(asked), "test")))
        assert "align faces first" in result.reason
        faces = {"action": "faces", "write": True, "timeout_s": 2000.0}
        assert (await follow_sides(made, hands, started(start(Align.read(faces), "test")))).outcome == "done"
        job = started(start(Align.read(asked), "test"))
        result = await follow_sides(made, hands, job)
        assert result.outcome == "done", result
        record = job.product
        assert isinstance(record, CompassRecord)
        (found,) = record.compasses
        left_deg = errors_deg(values(made, "ardupilot"), "ardupilot")
        assert np.sqrt(np.mean(np.square(left_deg))) < min(1.0, 2.0 * found.heading_sigma_deg)
        assert np.abs(np.subtract(found.offset_mgauss, HARD_MGAUSS) / found.offset_sigma_mgauss).max() < 3.0
        assert {one.outcome for one in found.written.values()} == {"verified"}


async def test_our_own_compass_that_contradicts_is_named(tmp_path: Path) -> None:
    made, hands = rig(tmp_path)
    made.devices["compass"] = HMR3300(made.aircraft, seed=1, heading_error_deg=25.0)
    async with made.running():
        await made.ready()
        _, record = await aligned(made, hands, headings=2)
        assert record is not None
        assert any(re.search(r"own compass reads 6\d deg, this alignment 4\d", words) for words in record.warnings)


@pytest.mark.parametrize("firmware", ["ardupilot", "px4"])
async def test_the_status_says_how_good_a_heading_is_while_the_autopilot_has_the_values(
    tmp_path: Path, firmware: str
) -> None:
    made, hands = rig(tmp_path, firmware)
    made.devices["compass"] = HMR3300(made.aircraft, seed=1)
    async with made.running():
        await made.ready()
        await asyncio.sleep(40.0)
        status = made.service.status()
        assert status["compasses"] == []
        doubts = [words for words in status["warnings"] if "compass off by" in words]
        about_deg, apart_deg = (float(word) for word in re.findall(r"([-+]?\d+) deg", "".join(doubts)))
        all_round_deg = errors_deg(values(made, firmware), firmware)
        assert about_deg == pytest.approx(np.sqrt(np.mean(np.square(all_round_deg))), rel=0.7)
        assert apart_deg == pytest.approx(all_round_deg[4], abs=6.0)  # at 40 deg, where it stands
        _, record = await aligned(made, hands, write=True)
        assert record is not None
        await asyncio.sleep(40.0)
        sigma_deg = record.compasses[0].heading_sigma_deg
        rows = {name: words for _, name, words, _ in summary.rows(made.service.status())}
        assert rows["compass 1"] == f"heading good to {sigma_deg:.1f} deg, aligned {record.measured_at[:10]}"
        assert not [words for words in made.service.status()["warnings"] if "compass" in words]
        made.autopilot.write_as_another_station(NAMES[firmware][0][0], 0.0)
        await asyncio.sleep(5.0)
        assert made.service.status()["compasses"] == []


@pytest.mark.parametrize(
    ("firmware", "parameters"),
    [
        ("ardupilot", {"COMPASS_SCALE": 0.7}),
        ("px4", {"CAL_MAG0_ROT": 100.0, "CAL_MAG0_ROLL": 10.0, "CAL_MAG0_PITCH": -20.0, "CAL_MAG0_YAW": 35.0}),
    ],
)
async def test_a_scale_and_a_turn_of_its_own_are_those_of_the_firmware(
    tmp_path: Path, firmware: str, parameters: dict[str, float]
) -> None:
    scale = parameters.get("COMPASS_SCALE", 1.0)
    turned = mounting_matrix(10.0, -20.0, 35.0) if firmware == "px4" else np.eye(3)
    compass = SimCompass(HARD_MGAUSS, scale * SOFT, mounting=turned, external=firmware == "px4")
    made, hands = rig(tmp_path, firmware, parameters=parameters, compasses=[compass])
    async with made.running():
        await made.ready()
        result, record = await aligned(made, hands, write=True)
        assert result.outcome == "done", result
        assert record is not None
        assert record.heading_deg == pytest.approx(40.0, abs=1.0)
        (found,) = record.compasses
        assert {one.outcome for one in found.written.values()} == {"verified"}


async def test_without_a_known_tilt_the_first_pose_says_so(tmp_path: Path) -> None:
    made, hands = rig(tmp_path)
    made.config = msgspec.structs.replace(made.config, gradienter=None)
    del made.devices["gradienter"]
    async with made.running():
        await made.ready()
        result, _ = await aligned(made, hands)
        assert result.outcome == "failed"
        assert "the tilt is known to 3 deg only: align faces first" in result.reason
