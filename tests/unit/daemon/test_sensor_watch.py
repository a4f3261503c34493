"""A gradienter or compass that is stuck: found out by the IMU, which saw the aircraft move, and by nothing else."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from typing import Literal

import numpy as np
import pytest

from companion.component.statustext import Severity
from companion.daemon.devices.sensor_watch import NO_OFFSETS, SensorWatch
from companion.messages import remedy
from companion.protocols.stream_health import Trouble
from companion.samples import CompassSample, ImuSample, Sample, TiltSample, Vector
from tests.support.chatter import Listening, compass_frame
from tests.support.still_aircraft import imu

START_S = 1000.0


class SensorWatchBench:
    """One pose sensor and an IMU, both fed by hand; the sensor's port counts as open."""

    def __init__(self, kind: Literal["gradienter", "compass"]) -> None:
        protocol = {"gradienter": "inclinometer_xy", "compass": "hmr3300"}[kind]
        self.one = Listening(kind, protocol, "/nowhere")
        self.one.sensor.link._descriptor = -1
        self.random = np.random.default_rng(5)
        self.now_s = START_S
        self.resets: list[str] = []
        self.said: list[tuple[Severity, str]] = []
        self.offset: Vector | None = (0.0, 0.0, 0.0)
        """Offset that the autopilot subtracts from its accelerometer; None: unknown, its samples do not come."""
        self.turned = np.eye(3)
        """Sensor axes to vehicle axes, by the autopilot's configured mounting."""
        collector, sensor = self.one.collector, self.one.sensor
        self.one.watch = SensorWatch(
            [sensor], collector, self.offsets_of, lambda severity, words, _: self.said.append((severity, words))
        )
        reset = collector.reset

        def told(why: str, imu: str | None = None) -> None:
            self.resets.append(why)
            reset(why, imu)

        self.one.collector.reset = told  # type: ignore[method-assign]

    def offsets_of(self, name: str) -> object:
        if name != "fc" or self.offset is None:
            return NO_OFFSETS if name != "fc" else None
        return self.offset

    def run(
        self, seconds: float, sample: Callable[[float], Sample], *, pitch_deg: float = 0.0, turn_deg_s: float = 0.0,
        bias_deg_s: float = 1.0,
    ) -> Trouble | None:  # fmt: skip
        """Feed both for some seconds; what is wrong at their end."""
        found = None
        for tick in range(round(seconds * 50)):
            t_s = self.now_s + tick / 50
            pitch = math.radians(pitch_deg)
            noise = self.random.normal(0.0, 0.02, 3)
            force = (9.8 * math.sin(pitch) + noise[0], noise[1], -9.8 * math.cos(pitch) + noise[2])
            rate = math.radians(turn_deg_s + bias_deg_s)
            gyro = (0.0, 0.0, rate + noise[0] * 1e-3)
            if self.offset is not None:
                x, y, z = (self.turned @ np.subtract(force, self.offset)).tolist()
                p, q, r = (self.turned @ gyro).tolist()
                self.one.collector.add_imu("fc", ImuSample(t_s, (p, q, r), (x, y, z)))
            if tick % 5 == 0:
                self.one.sensor.health.stream.took(b"x", [sample(t_s)], t_s)
            if tick % 25 == 0:
                self.one.watch.update(t_s)
                found = self.one.sensor.health.trouble(t_s)
        self.now_s += seconds
        return found


def tilt(t_s: float) -> TiltSample:
    return TiltSample(t_s, 0.430, -0.084)


def heading(t_s: float) -> CompassSample:
    return CompassSample(t_s, 123.4, 18.6, -0.5)


async def test_a_gradienter_that_repeats_its_digits_while_all_stands_still_is_left_in_peace() -> None:
    bench = SensorWatchBench("gradienter")
    assert bench.run(120.0, tilt) is None
    assert bench.resets == []


async def test_a_gradienter_that_repeats_its_digits_while_the_aircraft_tilts_is_stuck(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)
    bench = SensorWatchBench("gradienter")
    bench.run(10.0, tilt)
    assert bench.run(2.0, tilt, pitch_deg=2.0) is None, "one second may be a jolt"
    found = bench.run(8.0, tilt, pitch_deg=8.0)
    ((severity, said),) = bench.said
    assert severity is Severity.WARNING
    assert said.startswith("gradienter: stuck: the same reading for ")
    assert said.endswith("; switch its power off and on")
    assert found is not None
    assert (found.key, found.implausible) == ("stuck", True)
    assert "while the aircraft tilted by 8 deg" in found.words
    assert bench.resets, "nothing may be measured with it"
    assert bench.one.counts == {"stuck": 1}
    assert bench.run(2.0, lambda t_s: TiltSample(t_s, 0.43, 8.0 + 1e-3 * (t_s % 3)), pitch_deg=8.0) is None
    count = len(bench.resets)
    assert bench.run(5.0, lambda t_s: TiltSample(t_s, 0.43, 8.0 + 1e-3 * (t_s % 3)), pitch_deg=8.0) is None
    assert len(bench.resets) == count
    warnings = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert len(warnings) == 1
    assert warnings[0].startswith("gradienter: /nowhere at 9600 baud")
    assert any("gradienter: good again after" in record.getMessage() for record in caplog.records)


async def test_a_compass_is_stuck_when_the_aircraft_turned_and_not_when_a_gyro_is_biased() -> None:
    bench = SensorWatchBench("compass")
    assert bench.run(60.0, heading, bias_deg_s=8.0) is None, "480 deg of bias"
    assert bench.run(10.0, heading, pitch_deg=10.0) is None, "a heading may stay when it tilts"
    found = bench.run(4.0, heading, turn_deg_s=30.0)
    assert found is not None
    assert "turned by" in found.words
    assert bench.run(2.0, lambda t_s: CompassSample(t_s, t_s % 360.0)) is None


async def test_new_offsets_and_another_orientation_are_no_tilt() -> None:
    bench = SensorWatchBench("gradienter")
    bench.run(10.0, tilt)
    bench.offset = None
    bench.run(6.0, tilt)
    bench.offset = (1.0, -0.5, 0.3)
    bench.one.collector.reset("offsets written", "fc")
    assert bench.run(10.0, tilt) is None, "the output has stepped by 6 deg"
    bench.turned, bench.offset = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), (1.0, -0.5, 0.4)
    bench.one.collector.reset("the autopilot's offsets were read anew", "fc")
    assert bench.run(10.0, tilt) is None, "AHRS_ORIENTATION was set right"


async def test_one_imu_that_is_broken_convicts_nobody() -> None:
    bench = SensorWatchBench("gradienter")
    add = bench.one.collector.add_imu
    bench.one.collector.set_imu(imu("second"))

    def both(name: str, sample: ImuSample) -> None:
        add(name, sample)
        add("second", ImuSample(sample.t_s, (0.0, 0.0, sample.gyro_rad_s[2]), (0.0, 0.0, -9.8)))

    bench.one.collector.add_imu = both  # type: ignore[method-assign]
    bench.run(5.0, tilt)
    assert bench.run(10.0, tilt, pitch_deg=20.0) is None


async def test_the_wait_for_a_gradienter_on_the_compass_port_names_the_device_found() -> None:
    bench = SensorWatchBench("gradienter")
    for tick in range(60):
        bench.one.sensor.receive(compass_frame(tick), now_s := START_S + 0.1 * tick)
        bench.one.watch.update(now_s)
    waits = {one.name: one.words for one in bench.one.collector.status(now_s).sources}["gradienter"]
    assert waits == "gradienter: this is hmr3300, a device for compass, not inclinometer_xy"
    assert "swapped" in remedy(f"{bench.one.sensor.link.settings}: {waits}")
