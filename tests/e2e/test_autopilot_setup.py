"""`companion autopilot params`: what it says of the doubles' parameters, and what they then make of the stream."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.cli.client import setup_lines
from tests.e2e.test_attitude_push import Flight, flight
from tests.support.rig import Rig

Firmware = Literal["ardupilot", "px4"]
BEFORE: dict[Firmware, dict[str, float]] = {
    "ardupilot": {"VISO_TYPE": 0.0, "EK3_SRC1_YAW": 1.0, "EK3_SRC3_YAW": 1.0},
    "px4": {"EKF2_EV_CTRL": 3.0, "EKF2_EV_NOISE_MD": 1.0, "EKF2_EVA_NOISE": 0.1234, "EKF2_EV_DELAY": 12.5},
}
AFTER: dict[Firmware, dict[str, float]] = {
    "ardupilot": {
        "VISO_TYPE": 1.0,
        "EK3_SRC1_YAW": 6.0,
        "EK3_SRC2_YAW": 1.0,
        "EK3_SRC2_POSXY": 3.0,
        "EK3_SRC2_VELXY": 3.0,
        "EK3_SRC2_POSZ": 1.0,
        "EK3_SRC2_VELZ": 3.0,
        "EK3_SRC3_YAW": 0.0,
        "EK3_SRC3_POSXY": 3.0,
        "EK3_SRC3_VELXY": 3.0,
        "EK3_SRC3_POSZ": 1.0,
        "EK3_SRC3_VELZ": 3.0,
    },
    "px4": {"EKF2_EV_CTRL": 11.0, "EKF2_EV_NOISE_MD": 0.0, "EKF2_EVA_NOISE": 0.05, "EKF2_EV_DELAY": 0.0},
}


GATE: dict[Firmware, str] = {
    "ardupilot": "the arming script does not run on the autopilot (see: companion autopilot script)",
    "px4": "set COM_ARM_AUTH_REQ 1",
}
RIVAL: dict[Firmware, str] = {"ardupilot": "INS_GYR_CAL", "px4": "IMU_GYRO_CAL_EN"}


async def ask(rig: Rig) -> dict[str, Any]:
    (reply,) = [reply async for reply in rig.service.faces.answer({"command": "autopilot-setup"})]
    return reply


async def follow(rig: Rig) -> None:
    """Follow the advice as a person with a ground station does."""
    for row in (await ask(rig))["parameters"]:
        rig.autopilot.write_as_another_station(row["parameter"], row["wanted"])


@pytest.mark.parametrize("firmware", ["ardupilot", "px4"])
async def test_what_is_to_be_set_is_said_and_nothing_is_written(tmp_path: Path, firmware: Firmware) -> None:
    async with flight(
        tmp_path, firmware=firmware, calibrated=False, used=False, parameters={**BEFORE[firmware], RIVAL[firmware]: 1.0}
    ) as flying:
        rig = flying.rig
        shown = await ask(rig)
        assert shown["state"] == "not applied"
        assert {row["parameter"]: row["wanted"] for row in shown["parameters"]} == pytest.approx(AFTER[firmware])
        assert all(f"{name} {value:g}" in shown["reason"] for name, value in AFTER[firmware].items())
        assert shown["risks"]
        lines = setup_lines(shown)
        assert lines[0] == f"heading: not applied: {shown['reason']}"
        assert any(line.startswith(f"gate: not wanted; for at_arm = gate: {GATE[firmware]}") for line in lines)
        assert any(line.startswith(f"rival: {RIVAL[firmware]} = 1: ") for line in lines)
        assert {name: rig.autopilot.parameter(name) for name in BEFORE[firmware]} == pytest.approx(BEFORE[firmware])
        await follow(rig)
        assert (await ask(rig))["state"] == "applied"


@pytest.mark.parametrize(("parameter", "value", "named"), [
    ("EKF2_MAG_TYPE", 5, "EKF2_MAG_TYPE = 5"),
    ("SYS_HAS_MAG", 0, "SYS_HAS_MAG = 0"),
    ("EKF2_SENS_EN", 8191 - 1024, "bit 10 of EKF2_SENS_EN"),
])  # fmt: skip
async def test_without_a_compass_px4_has_nothing_to_go_back_to(
    tmp_path: Path, parameter: str, value: int, named: str
) -> None:
    """The real EKF2 uses no magnetometer in flight with any of these (tests/sitl flies the stream's end)."""

    async with flight(tmp_path, firmware="px4", calibrated=False, used=False) as flying:
        rig = flying.rig
        await follow(rig)
        shown = await ask(rig)
        assert (shown["state"], shown["net"]["kind"]) == ("applied", "autopilot")
        rig.autopilot.write_as_another_station(parameter, value)
        shown = await ask(rig)
        assert (shown["state"], shown["net"]["kind"]) == ("not applied", "none")
        assert shown["reason"].startswith(f"this autopilot has no compass in use ({named}): ")


async def set_up(flying: Flight) -> None:
    """All sets of sources, a restart, a calibration, and our heading in use."""
    rig = flying.rig
    await follow(rig)
    rig.double.reboot()
    await rig.until(lambda: rig.service.core.vehicle.boots == 1, 20.0)
    await flying.sleep(20.0)
    await flying.calibrate()
    await flying.pushing()
    await flying.sleep(12.0)


async def test_where_there_is_no_script_the_companion_asks_for_another_heading_and_for_its_own_again(
    tmp_path: Path,
) -> None:
    """In flight for that of the gyros: its own compass may have come to lie."""

    async with flight(tmp_path, calibrated=False, used=False) as flying:
        rig = flying.rig
        await set_up(flying)
        assert flying.attitude.view()["safety_net"] == "command"
        assert rig.double.external_nav.source_set == 1
        rig.autopilot.arm()
        rig.unplugged.add("own")
        await flying.sleep(0.6)
        assert rig.double.external_nav.source_set == 3
        assert flying.theirs_deg() < 2.0
        rig.unplugged.discard("own")
        await flying.pushing(5.0)
        await flying.sleep(9.0)
        assert rig.double.external_nav.source_set == 3
        await rig.until(lambda: rig.double.external_nav.source_set == 1, 2.0)
        await flying.sleep(0.1)
        texts = [text for text in rig.ground.texts() if text.startswith("Heading: ")]
        assert texts[-2:] == ["Heading: gyros, companion's is not pushed", "Heading: companion"]
        flying.attitude.close()  # as the end of the daemon does, at once
        await flying.sleep(0.1)
        assert rig.double.external_nav.source_set == 3


async def test_where_the_script_runs_the_companion_leaves_it_to_it(tmp_path: Path) -> None:
    async with flight(tmp_path, calibrated=False, used=False) as flying:
        rig = flying.rig
        store = rig.double.parameters  # as the script makes it
        store._types["CMPG_HEADING"], store.values["CMPG_HEADING"] = mavlink.MAV_PARAM_TYPE_REAL32, 1.0
        store.names += ("CMPG_HEADING",)
        await set_up(flying)
        assert flying.attitude.view()["safety_net"] == "script"
        rig.unplugged.add("own")
        await flying.sleep(5.0)
        assert rig.double.external_nav.source_set == 1
