"""PX4's thermal compensation is never written."""

from __future__ import annotations

from pathlib import Path

import pytest

from companion.errors import RequestRefusedError
from tests.e2e.test_temperature_write import Warm


async def test_a_write_is_refused_in_one_line_and_writes_nothing(tmp_path: Path) -> None:
    rig = Warm(tmp_path, firmware="px4", parameters={"IMU_GYRO_CAL_EN": 0, "SENS_IMU_AUTOCAL": 0})
    async with rig.running():
        await rig.learn()
        before = dict(rig.px4.parameters.values)
        with pytest.raises(RequestRefusedError) as refused:
            await rig.ask(action="write")
        why = "temperature curves are not written: PX4 for common boards is built without TC_*"
        assert str(refused.value) == why
        assert rig.px4.parameters.values == before
