"""The whole daemon beside the PX4 double: it starts, sees the autopilot, and gets samples."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.rig import Rig
from tests.support.virtual_time import run_virtual


def test_a_rig_with_px4_flies_the_same_aircraft(tmp_path: Path) -> None:
    async def main() -> None:
        rig = Rig(tmp_path, firmware="px4", default_streams=True)
        async with rig.running():
            await rig.until(lambda: rig.service.core.vehicle.firmware == "px4", 10.0)
            assert rig.px4.aircraft is rig.aircraft
            with pytest.raises(AssertionError):
                _ = rig.double
            await rig.until(lambda: rig.px4.ground.sent["HEARTBEAT"] > 3, 10.0)
            await rig.until(lambda: rig.px4.ground.sent["ATTITUDE"] > 10, 10.0)
            # The ground station hears the companion through the autopilot: both ports forward.
            await rig.until(lambda: any(m.get_srcComponent() == 191 for _, m in rig.ground.received), 10.0)

    run_virtual(main())
