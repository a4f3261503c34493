"""PX4's thermal compensation is read and counted, never written; an undo of a former version's write still works."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from companion.errors import RequestRefusedError
from companion.storage.learned import BiasStore
from sim.imu_model import DEG_H
from sim.px4.defaults import SIMULATED_IDS
from tests.e2e.test_temperature_write import Warm
from tests.support.virtual_time import run_virtual

QUIET = {"IMU_GYRO_CAL_EN": 0, "SENS_IMU_AUTOCAL": 0}
ON = {"TC_G_ENABLE": 1, "TC_G0_ID": SIMULATED_IDS[0], "TC_G0_TREF": 25.0, "TC_G0_TMIN": 0.0, "TC_G0_TMAX": 50.0}
TAKEN_DEG_H = (500.0, -300.0, 200.0)


class WarmPx4(Warm):
    def __init__(self, folder: Path, thermal: str, **parameters: float) -> None:
        super().__init__(folder, firmware="px4", thermal=thermal, parameters={**QUIET, **parameters})

    async def whole_bias(self) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        """The learned whole gyro bias of the first still window, deg/h."""
        await self.ready()
        await self.rest()
        point = BiasStore(self.config.storage.path).read()["fc"].points[-1]
        assert point.gyro is not None
        return np.array(point.gyro.bias) / DEG_H


def test_what_it_takes_off_is_counted_in_the_whole_bias(tmp_path: Path) -> None:
    async def main() -> None:
        found = []
        for name, values in (("off", {}), ("on", ON | {f"TC_G0_X0_{k}": v * DEG_H for k, v in enumerate(TAKEN_DEG_H)})):
            rig = WarmPx4(tmp_path / name, "started", **values)
            async with rig.running():
                found.append(await rig.whole_bias())
        np.testing.assert_allclose(found[1], found[0], atol=15.0)

    run_virtual(main())


@pytest.mark.parametrize("thermal", ["absent", "started"])
def test_a_write_is_refused_in_one_line_and_writes_nothing(tmp_path: Path, thermal: str) -> None:
    async def main() -> None:
        rig = WarmPx4(tmp_path, thermal)
        async with rig.running():
            await rig.learn()
            before = dict(rig.px4.parameters.values)
            with pytest.raises(RequestRefusedError) as refused:
                await rig.ask(action="write")
            why = "PX4's thermal compensation (TC_*) is not written: the firmware of common boards is built without it"
            assert str(refused.value) == why
            assert rig.px4.parameters.values == before

    run_virtual(main())
