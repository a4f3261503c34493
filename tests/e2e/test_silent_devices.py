"""Devices that say nothing by themselves, on a pty, through port, decoder and dialogue as the daemon has them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path

import pytest

from companion.configured.models import Role, SerialDevice
from companion.daemon.devices.sensors import SerialSensor
from companion.protocols.registry import PROTOCOLS, Kind
from companion.samples import CompassSample, Sample, TiltSample
from sim.aircraft import Pose, VirtualAircraft
from sim.compasses import NmeaCompass
from sim.devices import Gradienter
from sim.devices import SerialDevice as SimulatedDevice
from sim.gradienters import BeiInclinometer, Jewell
from sim.pty_device import PtyDevice
from sim.scenario import site_at

POSE = Pose(pitch_deg=5.0, roll_deg=-3.0, heading_deg=40.0)


def stopped(device: SimulatedDevice) -> SimulatedDevice:
    device.streaming = False
    return device


SILENT: list[tuple[Kind, str, Callable[[VirtualAircraft], SimulatedDevice]]] = [
    ("compass", "nmea", lambda aircraft: NmeaCompass(aircraft, sentences=())),
    ("gradienter", "jewell", lambda aircraft: Jewell(aircraft, continuous=False, output="XDR")),
    ("gradienter", "inclinometer_xy", Gradienter),
    ("gradienter", "inclinometer_xy", lambda aircraft: BeiInclinometer(aircraft, polled=True)),
]


@pytest.mark.parametrize(("kind", "protocol", "make"), SILENT, ids=["hmr3000", "jewell", "meas", "bei"])
def test_a_silent_device_is_brought_to_give_readings(
    tmp_path: Path, kind: Kind, protocol: str, make: Callable[[VirtualAircraft], SimulatedDevice]
) -> None:
    async def main() -> None:
        aircraft = VirtualAircraft(POSE, site_at(40.0, 116.0, 50.0))
        aircraft.begin(asyncio.get_running_loop().time())
        device, path, info = make(aircraft), tmp_path / "device", PROTOCOLS[kind][protocol]
        async with PtyDevice(device, path):
            stopped(device)
            taken: list[Sample] = []
            enough = asyncio.Event()

            def take(role: Role, part: Sample) -> None:
                taken.append(part)
                if len(taken) >= 10:
                    enough.set()

            which = SerialDevice(str(path), info, info.baud, info.parity, read_only=False, roles=(Role(kind, kind),))
            sensor = SerialSensor(which, take)
            running = asyncio.create_task(sensor.run())
            try:
                await asyncio.wait_for(enough.wait(), 20.0)
            finally:
                running.cancel()
                await asyncio.gather(running, return_exceptions=True)
        assert sensor.text
        assert getattr(device, "stored", 0) == 0
        for part in taken:
            if isinstance(part, CompassSample):
                assert (part.pitch_deg, part.roll_deg) == pytest.approx((5.0, -3.0), abs=0.2)
            else:
                assert isinstance(part, TiltSample)
                assert (part.x_deg, part.y_deg) == pytest.approx((-2.989, 5.0), abs=0.02)

    asyncio.run(main())
