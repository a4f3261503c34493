"""A real firmware without any other sensor: held on all sides, turned on a slope, judged by its telemetry."""

from __future__ import annotations

import asyncio
import os
from pathlib import Path

import numpy as np
import pytest

from sim.hands import PLACEMENT_DEG, PROPPED_DEG, Hands
from sim.sitl.by_hand import attitude_error_deg, judged
from sim.sitl.cli import parser, scenario_of, vehicle_of
from sim.sitl.first_hour import Tape
from sim.sitl.residuals import ground_station
from tests.sitl.craft import BINARIES, missing

BIAS_MG, SCALE_PERCENT, LEVEL_DEG = 0.5, 0.03, 0.05
NAMES = {
    "ardupilot-sitl": [f"INS_ACC{what}_{axis}" for what in ("OFFS", "SCAL") for axis in "XYZ"]
    + ["AHRS_TRIM_X", "AHRS_TRIM_Y"]
}


@pytest.mark.sitl
@pytest.mark.parametrize("kind", list(NAMES))
def test_a_bare_board_is_right_after_stands_by_hand_and_as_it_was_after_undo(kind: str, tmp_path: Path) -> None:
    """20 mg, 0.5 %, a board that sits askew, a spot that slopes by 5 deg: as in the tape of a first hour."""
    reason = missing(kind)
    if reason is not None:
        pytest.skip(reason)

    async def main() -> None:
        arguments = parser().parse_args(["first-hour", "--binary", os.environ[BINARIES[kind]]])
        vehicle = vehicle_of(arguments, scenario_of(arguments), tmp_path / "firmware")
        async with vehicle, ground_station(vehicle) as ground:
            tape = Tape(vehicle, ground, tmp_path)
            tape.hands = Hands(
                vehicle.aircraft, placement_deg=PLACEMENT_DEG, propped_deg=PROPPED_DEG, seed=1, takes_s=2.0
            )
            before = {name: await ground.get(name) for name in NAMES[kind]}
            assert await tape.setup() == 0
            async with tape.daemon():
                assert await tape.type("align", "faces", "--write") == 0
                left = await judged(vehicle, ground, tape.hands)
                assert np.abs(left.bias_mg).max() < BIAS_MG, left
                assert np.abs(left.scale_percent).max() < SCALE_PERCENT, left
                assert await tape.type("align", "turn", "--level") == 0
            assert np.abs(await attitude_error_deg(vehicle, ground)).max() < LEVEL_DEG
            async with tape.daemon():
                assert await tape.type("undo") == 0
                assert await tape.type("undo") == 0
            assert {name: await ground.get(name) for name in NAMES[kind]} == before

    asyncio.run(main())
