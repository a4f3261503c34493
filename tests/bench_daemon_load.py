"""The load of `tests.bench_daemon`: an aircraft that speaks as fast as real ones do, in processes of its own.

A serial IMU at 1 kHz in one process, which does nothing else, so that every frame leaves at its instant; gradienter at
10 Hz, compass at 8 Hz and an ArduPilot double with 200 messages a second on UDP in another. Whoever listens hears the
same: what the daemon asks the autopilot for is sent without being asked, too.
"""

from __future__ import annotations

import asyncio
import functools
import math
import os
import select
import time
import tty
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.devices import ImuLine, SerialDevice, VectorNavBinary
from sim.pty_device import PtyDevice
from sim.scenario import Scenario, demo
from sim.station import open_udp

SECONDS: Final = 180.0
"""Length of the prepared IMU frames."""
SEED: Final = 7

STREAMS_HZ: Final[dict[int, float]] = {
    # What the daemon asks for, at the rates at which it does.
    mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: 100.0,
    mavlink.MAVLINK_MSG_ID_ATTITUDE: 10.0,
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: 5.0,
    mavlink.MAVLINK_MSG_ID_SCALED_IMU: 2.0,
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: 1.0,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 1.0,
    # What a ground station behind the same port has asked for.
    mavlink.MAVLINK_MSG_ID_RAW_IMU: 10.0,
    mavlink.MAVLINK_MSG_ID_SCALED_IMU2: 10.0,
    mavlink.MAVLINK_MSG_ID_VFR_HUD: 10.0,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: 5.0,
    mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT: 5.0,
    mavlink.MAVLINK_MSG_ID_AHRS: 5.0,
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: 2.0,
}
"""Rates of the double's own messages."""

OTHERS_HZ: Final[tuple[tuple[mavlink.MAVLink_message, float], ...]] = (
    (mavlink.MAVLink_servo_output_raw_message(1, 0, *[1500] * 8), 10.0),
    (mavlink.MAVLink_rc_channels_message(1, 16, *([1500] * 18 + [200])), 5.0),
    (mavlink.MAVLink_ahrs2_message(0.05, -0.03, 0.7, 50.0, 400000000, 1160000000), 5.0),
    (mavlink.MAVLink_scaled_pressure_message(1, 1007.3, 0.1, 3200), 5.0),
    (mavlink.MAVLink_nav_controller_output_message(0.1, 0.2, 40, 0, 0, 0.0, 0.0, 0.0), 2.0),
    (mavlink.MAVLink_vibration_message(1, 0.1, 0.1, 0.1, 0, 0, 0), 2.0),
    (mavlink.MAVLink_battery_status_message(0, 0, 1, 2500, [4100] * 10, 120, 50, 10, 98), 2.0),
    (mavlink.MAVLink_power_status_message(5000, 5000, 1), 2.0),
    (mavlink.MAVLink_meminfo_message(0, 60000, 120000), 1.0),
)
"""Messages that the double lacks, with their rates."""

MESSAGES_HZ: Final = sum(STREAMS_HZ.values()) + sum(rate_hz for _, rate_hz in OTHERS_HZ)


def imu_device(scenario: Scenario, protocol: str) -> SerialDevice:
    """VectorNav binary at 1 kHz, or the project's own line at 200 Hz; on a line that can carry it."""
    if protocol == "vectornav":
        device: SerialDevice = VectorNavBinary(scenario.serial_imu, rate_hz=1000.0)
        device.baud = 921600
    else:
        device = ImuLine(scenario.serial_imu)
    return device


def scenario() -> Scenario:
    """The aircraft: the same in every process, down to the noise."""
    return demo(seed=SEED, unix_s=time.time())


def feed_imu(path: Path, protocol: str, pipe: Connection) -> None:
    """Write the IMU's frames, each at its instant, until there is a word on the pipe; then say how many went."""
    device = imu_device(scenario(), protocol)
    device.power_on(0.0)
    frames = [(frame.complete_s, frame.data) for frame in device.frames_until(SECONDS)]
    master, slave = os.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    path.symlink_to(os.ttyname(slave))
    os.close(slave)  # from here on the kernel tells by POLLHUP whether anybody has it open
    poll = select.poll()
    poll.register(master, 0)
    pipe.send(None)
    start_s, sent = time.monotonic(), 0
    for at_s, data in frames:
        wait_s = start_s + at_s - time.monotonic()
        if wait_s > 0.0:
            time.sleep(wait_s)
        if not poll.poll(0):
            try:
                sent += os.write(master, data) == len(data)
            except BlockingIOError:
                pass  # nobody reads: lost, as on a wire
        if pipe.poll():
            break
    pipe.send({"frames": sent})


def feed_rest(folder: Path, target: tuple[str, int], pipe: Connection) -> None:
    """Serve everything but the IMU; answers each word on the pipe with what was sent and received until now."""
    asyncio.run(_feed_rest(folder, target, pipe))


async def _feed_rest(folder: Path, target: tuple[str, int], pipe: Connection) -> None:
    world, loop = scenario(), asyncio.get_running_loop()
    world.aircraft.begin(loop.time())
    channel = world.autopilot.channels[0]
    end = await open_udp(world.autopilot, target=target)
    asked: asyncio.Queue[object] = asyncio.Queue()
    loop.add_reader(pipe.fileno(), lambda: asked.put_nowait(pipe.recv()))
    async with PtyDevice(world.gradienter, folder / "gradienter"), PtyDevice(world.compass, folder / "compass"):
        running = asyncio.create_task(world.autopilot.run())
        await asyncio.sleep(0)
        for number, (message_id, rate_hz) in enumerate(STREAMS_HZ.items()):
            # Apart from each other, as from an autopilot that sends in every turn of its own loop what is due.
            channel.set_stream(message_id, 1.0 / rate_hz, loop.time() + 0.0013 * number)
        world.autopilot.wake()
        others = [
            asyncio.create_task(_repeat(functools.partial(channel.send, message), rate_hz, 0.0017 * number))
            for number, (message, rate_hz) in enumerate(OTHERS_HZ)
        ]
        pipe.send(None)
        while await asked.get() != "end":
            pipe.send({"sent": channel.sent.total(), "received": dict(channel.received)})
        for task in (running, *others):
            task.cancel()
        await asyncio.gather(running, *others, return_exceptions=True)
    end.close()


async def _repeat(send: Callable[[], object], rate_hz: float, late_s: float) -> None:
    loop = asyncio.get_running_loop()
    period_s = 1.0 / rate_hz
    due_s = math.ceil(loop.time() / period_s) * period_s + late_s
    while True:
        await asyncio.sleep(due_s - loop.time())
        send()
        due_s += period_s
