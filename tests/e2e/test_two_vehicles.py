"""Two aircraft on one network: the companion hears both, and the other one must not notice that it exists."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.aircraft import Pose, VirtualAircraft
from sim.ardupilot.double import ArduPilotDouble
from sim.firmware.double import AutopilotDouble
from sim.imu_model import DEG_H, MG, ImuModel
from sim.px4.double import PX4Double
from sim.station import End
from tests.support.component import CALIBRATE, UNDO
from tests.support.rig import Rig
from tests.support.wire import Wire

Firmware = Literal["ardupilot", "px4"]
OTHER_BIAS_DEG_H = (-300.0, 250.0, -400.0)
OTHER_ACCEL_MG = (-20.0, 15.0, 30.0)


def values(double: AutopilotDouble) -> dict[str, float]:
    assert isinstance(double, ArduPilotDouble | PX4Double)
    return dict(double.parameters.values)


class Network:
    """Several ends behind one: what is sent to it reaches all, as UDP broadcasts and shared radios do."""

    def __init__(self, *ends: End) -> None:
        self.ends = list(ends)
        self._transmit: Callable[[bytes], None] | None = None

    def attach(self, transmit: Callable[[bytes], None] | None) -> None:
        self._transmit = transmit
        for end in self.ends:
            end.attach(transmit)

    def join(self, end: End) -> None:
        self.ends.append(end)
        end.attach(self._transmit)

    def receive(self, data: bytes, t_s: float) -> None:
        for end in self.ends:
            end.receive(data, t_s)


@dataclasses.dataclass
class TwoVehicleStage:
    """Our aircraft with its rig, and another one that flies with other biases at another attitude."""

    rig: Rig
    other: AutopilotDouble
    network: Network
    to_other: list[mavlink.MAVLink_message] = dataclasses.field(default_factory=list)
    """Messages of the companion to the other's address."""
    before: dict[str, float] = dataclasses.field(default_factory=dict)

    def join(self) -> None:
        self.network.join(self.other)

    def assert_untouched(self) -> None:
        assert self.to_other == []
        assert values(self.other) == self.before


@contextlib.asynccontextmanager
async def stage(
    folder: Path, ours: Firmware, others: Firmware, *, own_id: int, configured: bool, late: bool
) -> AsyncIterator[TwoVehicleStage]:
    more = f"[vehicle]\nsystem_id = {own_id}" if configured else ""
    rig = Rig(folder, firmware=ours, system_id=own_id, max_s=12.0, more=more)
    aircraft = VirtualAircraft(Pose(-20.0, 35.0, 200.0), rig.site)
    model = ImuModel(
        aircraft,
        "icm42688p",
        seed=77,
        gyro_bias_rad_s=[value * DEG_H for value in OTHER_BIAS_DEG_H],
        accel_bias_m_s2=[value * MG for value in OTHER_ACCEL_MG],
    )
    kind = ArduPilotDouble if others == "ardupilot" else PX4Double
    other = kind(aircraft, [model], system_id=3 - own_id, seed=5)
    rig.wire.unplug()
    network = Network(rig.autopilot)
    rig.wire = Wire(rig.link, network)
    it = TwoVehicleStage(rig, other, network)
    real_send = rig.link.send

    def send(message: mavlink.MAVLink_message, *allowed: Callable[[], bool]) -> bool:
        if getattr(message, "target_system", 0) == other.system_id:
            it.to_other.append(message)
        return real_send(message, *allowed)

    rig.link.send = send  # type: ignore[method-assign]
    flying = asyncio.create_task(other.run())
    try:
        await asyncio.sleep(1.0)
        it.before = values(other)
        if not late:
            it.join()
        async with rig.running():
            yield it
    finally:
        flying.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await flying


@pytest.mark.parametrize(
    ("ours", "others", "own_id", "configured", "late"),
    [
        ("ardupilot", "px4", 2, True, False),
        # Without a system id the first autopilot that is heard is ours, whoever comes later.
        ("px4", "ardupilot", 2, False, True),
    ],
)
async def test_a_calibration_and_its_undo_leave_the_other_aircraft_alone(
    tmp_path: Path, ours: Firmware, others: Firmware, own_id: int, *, configured: bool, late: bool
) -> None:
    async with stage(tmp_path, ours, others, own_id=own_id, configured=configured, late=late) as it:
        rig = it.rig
        await rig.ready()
        if late:
            it.join()
        await asyncio.sleep(3.0)
        it.other.arm()  # theirs is in the air, ours is not
        before = values(rig.autopilot)
        rig.ground.command(CALIBRATE, target=(own_id, 191))
        await rig.until(lambda: rig.ground.acks(CALIBRATE)[-1:] == [0], 90.0)
        record = rig.service.calibrating.manager.last
        assert record is not None
        assert record.state == "done"
        residual = rig.autopilot.residual(1, rig.now_s)
        assert float(np.abs(residual.gyro_rad_s).max() / DEG_H) < 30.0
        assert float(np.abs(residual.accel_m_s2).max() / MG) < 0.5
        it.assert_untouched()
        rig.ground.command(UNDO, target=(own_id, 191))
        await rig.until(lambda: rig.ground.acks(UNDO)[-1:] == [0], 60.0)
        imu = ("INS", "CAL")
        now = values(rig.autopilot)
        assert {n: v for n, v in now.items() if n.startswith(imu)} == {
            n: v for n, v in before.items() if n.startswith(imu)
        }
        it.assert_untouched()


async def test_ours_in_the_air_is_not_written_to_because_the_other_one_stands_disarmed(tmp_path: Path) -> None:
    async with stage(tmp_path, "px4", "ardupilot", own_id=1, configured=True, late=False) as it:
        rig = it.rig
        await rig.ready()
        before = values(rig.autopilot)
        rig.autopilot.arm()
        await rig.until(lambda: rig.service.core.vehicle.arm_state.name == "ARMED", 5.0)
        rig.ground.command(CALIBRATE, target=(1, 191))
        await rig.until(lambda: rig.ground.acks(CALIBRATE) != [], 5.0)
        await asyncio.sleep(20.0)
        assert rig.ground.acks(CALIBRATE) == [mavlink.MAV_RESULT_DENIED]
        assert values(rig.autopilot) == before
        it.assert_untouched()
