"""The physics back ends against peers that play the firmware on real sockets."""

from __future__ import annotations

import asyncio
import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.aircraft import Pose, VirtualAircraft
from sim.imu_model import DEG_H, MG, PARTS, ImuModel
from sim.motions import Turn
from sim.sitl.hil_backend import FRAME_HZ, HilBackend, on_fifo_grid
from sim.sitl.json_backend import JsonBackend, ServoPacket, decode_servos
from sim.sitl.process import FirmwareProcess
from sim.sitl.samples import JUMP_S, SampleBlocks

pytestmark = pytest.mark.real_clock

TILTED = Pose(pitch_deg=5.0, roll_deg=-3.0, heading_deg=40.0)
PEER = ("127.0.0.1", 40000)


def tilted() -> tuple[VirtualAircraft, ImuModel]:
    aircraft = VirtualAircraft(TILTED)
    return aircraft, ImuModel(aircraft, "perfect", gyro_bias_rad_s=[100 * DEG_H, 0, 0], accel_bias_m_s2=[0, -2 * MG, 0])


def packet(count: int, *, rate: int = 1000, channels: int = 16) -> bytes:
    return struct.pack(
        f"<HHI{channels}H", 18458 if channels == 16 else 29569, rate, count, *range(1000, 1000 + channels)
    )


@pytest.mark.parametrize(("channels", "magic", "size"), [(16, 18458, 40), (32, 29569, 72)])
def test_a_servo_packet_has_magic_rate_count_and_channels(channels: int, magic: int, size: int) -> None:
    data = struct.pack(f"<HHI{channels}H", magic, 400, 7, *range(channels))
    assert len(data) == size
    assert decode_servos(data) == ServoPacket(400, 7, tuple(range(channels)))


async def test_a_json_frame_is_the_truth_of_the_tilted_aircraft_between_newlines() -> None:
    aircraft, imu = tilted()
    async with JsonBackend(aircraft, imu) as backend:
        data = backend.answer(packet(0, rate=400), PEER)
    assert data[:1] == data[-1:] == b"\n"
    frame = json.loads(data)
    assert frame["timestamp"] == 1 / 400
    # By hand: Earth rate at 40 N in the body, +9.64, -6.93, -9.24 deg/h (autopilots 9.3), and the bias.
    np.testing.assert_allclose(np.array(frame["imu"]["gyro"]) / DEG_H, [109.64, -6.93, -9.24], atol=0.01)
    g = 9.801543
    sp, cp, sr, cr = (f(np.radians(a)) for a in (5.0, -3.0) for f in (np.sin, np.cos))
    expected = [g * sp, -g * sr * cp - 2 * MG, -g * cr * cp]
    np.testing.assert_allclose(frame["imu"]["accel_body"], expected, atol=1e-5)
    np.testing.assert_allclose(np.degrees(frame["attitude"]), [-3.0, 5.0, 40.0], atol=1e-6)
    assert frame["position"] == frame["velocity"] == [0, 0, 0]


def test_samples_follow_the_wall_clock_within_a_fifth_and_jump_when_far_behind() -> None:
    aircraft = VirtualAircraft(TILTED, motions=[Turn(start_s=1.0, duration_s=1.0, heading_deg=90.0)])
    blocks = SampleBlocks(aircraft, [ImuModel(aircraft, "perfect")])
    slow = [blocks.next(0.001, n * 0.00105) for n in range(4000)]  # the firmware runs 5 % slow
    steps = np.diff([sample.t_s for sample in slow])
    assert steps.min() >= 0.0008 - 1e-9
    assert steps.max() <= 0.00125 + 1e-9
    assert abs(slow[-1].t_s - 4000 * 0.00105) < 0.08
    assert blocks.jumps == 0
    assert np.degrees(slow[-1].angles_rad[2]) == pytest.approx(130.0)
    turned = sum(sample.readings[0][2] * step for sample, step in zip(slow[1:], steps, strict=True))
    assert np.degrees(turned) == pytest.approx(90.0, abs=3.0)
    late = [blocks.next(0.001, 10.0) for _ in range(40)]
    assert blocks.jumps == 1
    assert abs(late[-1].t_s - 10.0) < JUMP_S


class FakePx4:
    """Connects, sets its clock by sensor 0, answers every frame of it."""

    def __init__(self) -> None:
        self.codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        self.messages: list[mavlink.MAVLink_message] = []
        self.silent = False

    async def connect(self, port: int) -> None:
        self.reader, self.writer = await asyncio.open_connection("127.0.0.1", port)

    async def run(self, frames: int) -> None:
        seen = 0
        while seen < frames:
            for message in self.codec.parse_buffer(await asyncio.wait_for(self.reader.read(4096), 30.0)) or ():
                self.messages.append(message)
                if isinstance(message, mavlink.MAVLink_hil_sensor_message) and message.id == 0:
                    seen += 1
                    if not self.silent:
                        self.answer(message.time_usec)

    def answer(self, time_us: int) -> None:
        controls = mavlink.MAVLink_hil_actuator_controls_message(time_us, [0.0] * 16, 129, 1)
        self.writer.write(controls.pack(self.codec))

    def sensors(self, number: int) -> list[mavlink.MAVLink_hil_sensor_message]:
        return [m for m in self.messages if isinstance(m, mavlink.MAVLink_hil_sensor_message) and m.id == number]

    def close(self) -> None:
        self.writer.close()


async def test_px4_gets_both_imus_magnetometer_barometer_and_gnss_at_their_rates() -> None:
    aircraft, imu = tilted()
    other = ImuModel(aircraft, "perfect", gyro_bias_rad_s=[0, 0, -50 * DEG_H])
    px4 = FakePx4()
    async with HilBackend(aircraft, [imu, other]) as backend:
        await px4.connect(backend.port)
        await px4.run(FRAME_HZ)
        assert backend.armed
        assert backend.locked
        px4.close()
    first, second = px4.sensors(0), px4.sensors(1)
    assert [m.time_usec for m in first] == [4000 * n for n in range(1, FRAME_HZ + 1)]
    assert abs(len(second) - len(first)) <= 1
    assert sum(m.fields_updated == 0o77 | 0o700 | 0x1A00 for m in first) == 50
    assert sum(m.fields_updated == 0o77 for m in first) == FRAME_HZ - 50
    assert all(m.fields_updated == 0o77 for m in second)
    np.testing.assert_allclose(np.array([second[9].xgyro, second[9].ygyro, second[9].zgyro]) / DEG_H,
                               [9.64, -6.93, -59.24], atol=0.01)  # fmt: skip
    magnetic = [m for m in first if m.fields_updated & 0o700]
    field = np.mean([[m.xmag, m.ymag, m.zmag] for m in magnetic], axis=0)
    # Declination 0: 0.28 gauss along the heading of 40 deg, 0.45 down, seen from 5/-3 deg of tilt.
    assert np.linalg.norm(field) == pytest.approx(np.hypot(0.28, 0.45), abs=0.001)
    assert field[0] == pytest.approx(0.28 * np.cos(np.radians(40)) * np.cos(np.radians(5))
                                     - 0.45 * np.sin(np.radians(5)), abs=0.001)  # fmt: skip
    assert np.mean([m.abs_pressure for m in magnetic]) == pytest.approx(1007.26, abs=0.2)  # ISA at 50 m
    fixes = [m for m in px4.messages if isinstance(m, mavlink.MAVLink_hil_gps_message)]
    assert len(fixes) == 5
    assert abs(fixes[0].lat - 400_000_000) < 10
    assert (fixes[0].alt, fixes[0].fix_type) == (50_000, 3)
    assert fixes[0].time_usec // 10**12 == 1795


async def test_px4_frames_keep_to_the_wall_clock_and_wait_for_the_answer() -> None:
    aircraft, imu = tilted()
    loop = asyncio.get_running_loop()
    async with HilBackend(aircraft, [imu]) as backend:
        px4 = FakePx4()
        await px4.connect(backend.port)
        begun_s = loop.time()
        await px4.run(100)
        assert loop.time() - begun_s > 0.39
        px4.silent = True
        before = backend.frames
        await asyncio.sleep(0.15)
        assert backend.frames <= before + 1  # it waits...
        await asyncio.sleep(0.3)
        assert backend.unanswered >= 1  # ...but not for ever
        px4.close()


@pytest.mark.parametrize("part", ["white_only", "icm42688p"])
def test_sensor_0_has_the_models_mean_after_the_firmware_has_cut_it_to_16_bits(part: str) -> None:
    aircraft = VirtualAircraft(TILTED)
    gyro, accel = (replace(triad, flicker=0.0) for triad in (PARTS[part].gyro, PARTS[part].accel))
    steady = replace(PARTS[part], gyro=gyro, accel=accel)
    imu = ImuModel(aircraft, steady, seed=2, gyro_bias_rad_s=[100 * DEG_H, -60 * DEG_H, 170 * DEG_H])
    blocks = HilBackend(aircraft, [imu]).blocks
    rows = [on_fifo_grid(blocks.next(0.004, n * 0.004).readings[0]) for n in range(40_000)]
    sent = np.array(rows, dtype=np.float32)
    # The firmware divides in single precision by 2000/32768 deg/s and g/2048 and converts to int16.
    scale = np.array([np.radians(2000 / 32768)] * 3 + [9.80665 / 2048] * 3, dtype=np.float32)
    mean = np.trunc(sent / scale).mean(axis=0) * scale
    expected = imu.expected(0.0)
    np.testing.assert_allclose(mean[:3] / DEG_H, expected[:3] / DEG_H, atol=3.0)
    np.testing.assert_allclose(mean[3:] / MG, expected[3:] / MG, atol=0.02)


def test_stopping_a_binary_ends_its_children_too_even_if_they_ignore_sigterm(tmp_path: Path) -> None:
    script = "trap '' TERM; sh -c 'trap \"\" TERM; echo $$ > child; sleep 60 & wait' & wait"

    async def main() -> None:
        process = FirmwareProcess(["/bin/sh", "-c", script], tmp_path)
        await process.start()
        await process.until(lambda: (tmp_path / "child").exists() and (tmp_path / "child").read_text() != "", 5.0, "it")
        leader = process.pid
        assert leader is not None
        await process.stop()
        assert process.pid is None
        # Killed is not gone yet: the kernel ends it when it would run next.
        async with asyncio.timeout(10.0):
            while alive(int((tmp_path / "child").read_text())):
                await asyncio.sleep(0.01)

    def alive(child: int) -> bool:
        try:
            return Path(f"/proc/{child}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
        except OSError:
            return False

    asyncio.run(main())
