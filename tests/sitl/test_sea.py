"""A real firmware on a boat: on the ground's terms nothing is written, on the deck's the biases are found."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sim.imu_model import DEG_H, MG
from sim.motions import motions_of
from sim.sitl.daemon import companion_daemon
from sim.sitl.residuals import DECK, Row, ground_station, residual
from tests.sitl.craft import BINARIES, binary_vehicle, missing

pytestmark = pytest.mark.real_clock

WAITS_S = 75.0
"""Ten seconds until the readings come; a wave is a wave after forty of them."""
CALIBRATED_WITHIN_S = 300.0
OBSERVE_S = 20.0
LEFT_DEG_H, LEFT_MG = 120.0, 1.0
"""After a minute, three sigma; the Earth's rate is 15 deg/h, the deck's own 1080."""


@pytest.mark.sitl
@pytest.mark.parametrize("kind", BINARIES)
async def test_a_boat_is_calibrated_as_a_deck_and_refused_as_ground(kind: str, tmp_path: Path) -> None:
    reason = missing(kind)
    if reason is not None:
        pytest.skip(reason)
    for name in ("ground", "deck"):
        (tmp_path / name).mkdir()
    vehicle = binary_vehicle(kind, tmp_path / "firmware", motions=motions_of("sea", seed=3))
    async with vehicle, ground_station(vehicle) as ground:
        async with companion_daemon(vehicle, tmp_path / "ground") as daemon:
            record = await daemon.calibrate(WAITS_S)
        assert record["state"] == "failed"
        assert 'vehicle.platform = "deck"' in record["reason"]
        assert not any(imu["written"] for imu in record["imus"])
        async with companion_daemon(vehicle, tmp_path / "deck", more=DECK) as daemon:
            record = await daemon.calibrate(CALIBRATED_WITHIN_S)
        assert record["state"] == "done", record["reason"]
        for instance in vehicle.instances:
            left = await residual(vehicle, ground, instance, OBSERVE_S)
            print(Row("companion, after a minute of waves", instance, left))
            assert np.abs(left[:3]).max() < LEFT_DEG_H * DEG_H, left
            assert np.abs(left[3:]).max() < LEFT_MG * MG, left
