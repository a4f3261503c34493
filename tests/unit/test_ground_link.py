"""The companion's parameters asked for from the ground: the real component, and a radio that loses packets."""

from __future__ import annotations

import pytest

from companion.component.own_parameters import Parameter
from companion.ground.heard import Heard
from companion.ground.link import OWN, GroundLink
from companion.links.mavlink.link import MavlinkLink
from tests.support.component import bench
from tests.support.ground_wire import COMPANION
from tests.support.virtual_time import run_virtual
from tests.support.wire import Wire

TEN = [Parameter(f"CMP_{number}", float(number), 0.0, 20.0, lambda _value: None) for number in range(10)]


@pytest.mark.parametrize("seed", range(5))
def test_what_a_radio_loses_is_asked_for_again(seed: int) -> None:
    async def main() -> None:
        link = MavlinkLink(system_id=OWN.system_id, component_id=OWN.component_id)
        ground = GroundLink(link, Heard(COMPANION.component_id))
        async with bench(parameters=TEN) as b:
            Wire(b.link, link, seed=seed, loss=0.15)
            assert await ground.parameters(COMPANION) == {one.name: one.value for one in TEN}
            assert await ground.get_parameter(COMPANION, "CMP_7") == 7.0
            assert await ground.set_parameter(COMPANION, "CMP_3", 12.5) is None
            assert b.component.parameters.get("CMP_3") == 12.5

    run_virtual(main())


def test_what_is_not_allowed_stays_and_silence_is_said() -> None:
    async def main() -> None:
        link = MavlinkLink(system_id=OWN.system_id, component_id=OWN.component_id)
        ground = GroundLink(link, Heard(COMPANION.component_id))
        async with bench(parameters=TEN) as b:
            wire = Wire(b.link, link)
            assert await ground.set_parameter(COMPANION, "CMP_3", 21.0) == "it stays 3"
            assert await ground.get_parameter(COMPANION, "CMP_NONE") is None
            wire.cut = True
            assert await ground.set_parameter(COMPANION, "CMP_3", 4.0) == "no answer"
            assert await ground.get_parameter(COMPANION, "CMP_3") is None
            assert await ground.parameters(COMPANION) == {}
            assert b.component.parameters.get("CMP_3") == 3.0

    run_virtual(main())
