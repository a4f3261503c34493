"""The IMU of a PX4 slot, and offsets that may not be in use: found and corrected around a write."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from companion.autopilot.firmware.base import NO_IMU, SlotMemory
from companion.autopilot.firmware.firmwares import read_calibration
from companion.autopilot.firmware.imu_calibration import ImuCalibration, changes_for
from companion.autopilot.parameters.change import WriteFailedError
from companion.autopilot.vehicle.parameter_client import ParameterClient
from companion.autopilot.vehicle.parameter_writer import ParameterWriter
from companion.autopilot.vehicle.vehicle import Vehicle
from companion.daemon.offsets.journal import WriteJournal
from companion.daemon.offsets.plan import ImuPlan
from companion.daemon.offsets.px4_writes import Px4Writes
from companion.links.mavlink.link import MavlinkLink
from companion.storage.changes import ChangeLog
from tests.support.scripted_autopilot import flying_on
from tests.support.scripted_px4 import ICM, ScriptedPx4

BMI = 6684682
BOSCH = 9_109_514


class Px4WriteStage(NamedTuple):
    px4: ScriptedPx4
    client: ParameterClient
    writer: ParameterWriter
    writes: Px4Writes
    memory: SlotMemory

    async def read(self, instance: int) -> ImuCalibration:
        return await read_calibration(self.client, instance, self.memory)

    async def write(self, *instances: int) -> list[ImuCalibration]:
        found = [await self.read(instance) for instance in instances]
        targets = [planned(each) for each in found]
        async with self.writes.observing(targets, {}) as probe:
            await self.writer.apply([change for target in targets for change in target.changes], probe)
        return found


def planned(found: ImuCalibration) -> ImuPlan:
    changes = changes_for(found, (0.0005, -0.0003, 0.0008), (0.003, 0.002, -0.004))
    return ImuPlan(f"fc {found.instance}", found, tuple(changes), (None, None), watched=True)


@contextlib.asynccontextmanager
async def aboard(px4: ScriptedPx4, folder: Path) -> AsyncIterator[Px4WriteStage]:
    link = MavlinkLink()
    vehicle = Vehicle(link)
    client, memory = ParameterClient(link, vehicle), SlotMemory()
    writer = ParameterWriter(client, vehicle)

    async def inline(function: Callable[..., Any], *arguments: Any) -> Any:
        return function(*arguments)

    journal = WriteJournal(ChangeLog(folder), inline)
    journal.load()
    writes = Px4Writes(link, vehicle, writer, journal, memory, lambda *what: None)
    async with flying_on(link, px4):
        await vehicle.found.wait()
        await asyncio.sleep(1.0)
        yield Px4WriteStage(px4, client, writer, writes, memory)
    vehicle.close()


async def test_the_right_slot_is_seen_to_act_and_remembered(tmp_path: Path) -> None:
    async with aboard(ScriptedPx4(devices=(ICM, BMI)), tmp_path) as stage:
        one, two = await stage.write(1, 2)
        assert [stage.memory.known("gyro", device) for device in (ICM, BMI)] == [1, 2]
        assert [stage.memory.known("accel", device) for device in (ICM, BMI)] == [1, 2]
        for found in (one, two):
            far = stage.writes.under_far_offset[found.instance]
            raw_gyro, raw_accel = stage.px4.raw[found.instance - 1]
            np.testing.assert_allclose(far["gyro"][0][0], raw_gyro - [0.0, 0.0, 0.022], atol=3e-3)
            np.testing.assert_allclose(far["accel"][0][0], raw_accel - [0.0, 0.0, 0.09], atol=0.03)
            np.testing.assert_allclose(far["gyro"][1], [-0.0005, 0.0003, 0.022], atol=1e-6)
            np.testing.assert_allclose(far["accel"][1], [-0.003, -0.002, 0.094], atol=1e-6)


async def test_one_far_value_at_a_time_is_in_use_for_less_than_a_second_and_a_half(tmp_path: Path) -> None:
    far: list[tuple[float, frozenset[tuple[str, int]]]] = []

    class Watched(ScriptedPx4):
        """Notes which sensors use offsets of more than 0.01 rad/s or m/s^2, all of them wrong here, and since when."""

        def load(self, *, boot: bool = False) -> None:
            super().load(boot=boot)
            wrong = frozenset(key for key, used in self.used.items() if np.linalg.norm(used) > 0.015)
            if not boot and (not far or far[-1][1] != wrong):
                far.append((asyncio.get_running_loop().time(), wrong))

    async with aboard(Watched(devices=(ICM, BMI)), tmp_path) as stage:
        await stage.write(1, 2)
        await asyncio.sleep(2.0)
    stretches = [(wrong, end_s - start_s) for (start_s, wrong), (end_s, _) in itertools.pairwise(far) if wrong]
    assert {wrong for wrong, _ in stretches} == {
        frozenset({(sensor, device)}) for sensor in ("GYRO", "ACC") for device in (ICM, BMI)
    }
    assert max(seconds for _, seconds in stretches) < 1.5, stretches


async def test_the_wrong_slot_is_put_back_and_named_and_the_next_write_takes_the_right_one(tmp_path: Path) -> None:
    px4 = ScriptedPx4(devices=(BMI, ICM))
    px4.parameters |= {"CAL_GYRO0_ID": ICM, "CAL_GYRO1_ID": BMI, "CAL_ACC0_ID": ICM, "CAL_ACC1_ID": BMI}
    px4.load(boot=True)
    before = dict(px4.parameters)
    async with aboard(px4, tmp_path) as stage:
        with pytest.raises(WriteFailedError) as caught:
            await stage.write(1)
        assert caught.value.kind == "wrong slot, orientation or scale"
        assert "the offsets in CAL_GYRO0 act on the gyro of IMU 2, not of IMU 1" in str(caught.value)
        assert "the offsets in CAL_ACC0 act on the accelerometer of IMU 2, not of IMU 1" in str(caught.value)
        assert px4.parameters == before
        await asyncio.sleep(1.5)
        assert not np.any(list(px4.used.values()))
        (found,) = await stage.write(1)
        assert found.parameters.gyro_offset[0] == "CAL_GYRO1_XOFF"
        assert found.parameters.accel_offset[0] == "CAL_ACC1_XOFF"
        assert {name[:9] for name in px4.parameters if px4.parameters[name] != before[name]} == {
            "CAL_GYRO1",
            "CAL_ACC1_",
        }


async def test_a_slot_of_a_sensor_that_is_not_there_moves_nobody(tmp_path: Path) -> None:
    px4 = ScriptedPx4(devices=(ICM,))
    px4.parameters |= {"CAL_GYRO0_ID": BOSCH, "CAL_ACC0_ID": BOSCH, "CAL_GYRO1_ID": ICM, "CAL_ACC1_ID": ICM}
    px4.load(boot=True)
    async with aboard(px4, tmp_path) as stage:
        with pytest.raises(WriteFailedError, match="CAL_GYRO0 do not act on the gyro of IMU 1"):
            await stage.write(1)
        assert stage.memory.known("gyro", BOSCH) == NO_IMU
        (found,) = await stage.write(1)
        assert found.parameters.gyro_id == "CAL_GYRO1_ID"


class DeafPx4(ScriptedPx4):
    """Stores and answers, and goes on with what it had."""

    def changed(self) -> None:
        pass


async def test_where_every_slot_is_somebodys_a_write_without_effect_is_not_tried_on_another_imu(tmp_path: Path) -> None:
    px4 = DeafPx4(devices=(ICM, BMI))
    before = dict(px4.parameters)
    async with aboard(px4, tmp_path) as stage:
        for _ in range(2):
            with pytest.raises(WriteFailedError, match="CAL_GYRO0 do not act on the gyro of IMU 1: PX4") as caught:
                await stage.write(1)
            assert caught.value.kind == "without effect"
        assert stage.memory.known("gyro", ICM) is None
        written = {m.param_id for m in px4.requests if m.get_type() == "PARAM_SET"}
        assert {name[:9] for name in written} == {"CAL_GYRO0", "CAL_ACC0_"}
        assert px4.parameters == before


async def test_over_a_restart_nothing_is_concluded(tmp_path: Path) -> None:
    """It starts with what it has stored: neither who moved nor who did not says whose slot that is."""
    px4 = DeafPx4(devices=(ICM,))
    px4.parameters |= {"CAL_GYRO1_ID": BMI, "CAL_ACC1_ID": BMI}  # a stranger, so that the first might be one too
    async with aboard(px4, tmp_path) as stage:
        found = await stage.read(1)
        async with stage.writes.observing([planned(found)], {}) as probe:
            assert probe is not None
            verify = probe("CAL_GYRO0_ZOFF")
            stage.client.vehicle.boots += 1
            assert await verify() is None
        assert stage.memory.known("gyro", ICM) is None


async def test_old_values_that_are_back_are_in_use(tmp_path: Path) -> None:
    px4 = ScriptedPx4(devices=(ICM, BMI))
    async with aboard(px4, tmp_path) as stage:
        found = await stage.read(1)
        target = planned(found)
        async with stage.writes.observing([target], {}) as probe:
            await stage.writer.apply(target.changes, probe)
        await asyncio.sleep(2.0)
        await stage.writer.undo(target.changes)
        assert not np.any(list(px4.used.values()))

        async def verify() -> str:
            return "not as believed"

        with pytest.raises(WriteFailedError):
            await stage.writer.apply(target.changes, lambda _parameter: verify)
        assert not np.any(list(px4.used.values()))


async def test_while_the_aircraft_moves_nothing_is_concluded(tmp_path: Path) -> None:
    px4 = ScriptedPx4(devices=(ICM, BMI))
    async with aboard(px4, tmp_path) as stage:
        found = await stage.read(1)
        target = planned(found)

        def turn(name: str, value: float) -> float:
            for k, (gyro, accel) in enumerate(px4.raw):  # by hand, further with every write: all IMUs feel it
                px4.raw[k] = (gyro + np.array([0.3, 0.1, -0.2]), accel + np.array([1.0, 0.0, 0.1]))
            return value

        px4.on_set = turn
        async with stage.writes.observing([target], {}) as probe:
            await stage.writer.apply(target.changes, probe)
        assert stage.memory.known("gyro", ICM) is None
        assert stage.writes.under_far_offset[found.instance] == {}
