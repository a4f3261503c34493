"""A gradienter whose fluid still moves after the aircraft has stopped: against the tilt that it really has."""

from __future__ import annotations

import dataclasses
import itertools
import math
import re
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import pytest

from companion.config.sections import Compass, Config, Imu, Mavlink
from companion.config.sections import Gradienter as Section
from companion.configured.models import compass_model, gradienter_model
from companion.errors import CalibrationRefusedError
from companion.estimation.collector.rolling import RollingCollector
from companion.estimation.means.pose import GradienterModel
from companion.estimation.means.windows import ImuInput, Window
from companion.estimation.noise.allan import noise_profile
from companion.estimation.seconds.batch import Batch
from companion.estimation.stillness.stretch import UNKNOWN_DEG, Settling
from companion.physics.gradienter import attitude_from_readings
from companion.protocols.registry import PROTOCOLS
from companion.recording.messages import encode
from companion.samples import ImuSample, TiltSample
from sim.aircraft import Pose, VirtualAircraft
from sim.devices import Gradienter, VectorNavBinary
from sim.imu_model import ImuModel
from sim.motions import Knock, Motion, Turn
from sim.scenario import site_at
from tests.support.decoders import make_decoder
from tests.support.still_aircraft import HEADING, Feeder, Floats, imu, settings

SET_DOWN_S = 12.0
STEP_S = 0.05
SIGMA_DEG = 0.005

Lag = tuple[float, float]
"""Time constant and sigma, s and deg."""
AT_ONCE: Lag = (0.0, 1.0)


def gradienter(lag_s: float, sigma_deg: float) -> GradienterModel:
    return GradienterModel("axis", np.eye(3), (0.0, 0.0), sigma_deg, lag_s)


@dataclass
class Seen:
    """One aircraft from power-on until `until_s`."""

    windows: list[tuple[float, Window]] = field(default_factory=list)
    """Whenever there was one, and when."""
    words: list[str | None] = field(default_factory=list)
    """What it waited for, twenty times a second."""
    pitch_deg: float = 0.0

    def error_deg(self, at: int = 0) -> float:
        """Of the pitch from a window's tilt."""
        tilt = self.windows[at][1].tilt
        assert tilt is not None
        return abs(math.degrees(attitude_from_readings("slope", tilt.x_deg, tilt.y_deg)[0]) - self.pitch_deg)

    def first_after_s(self, since_s: float) -> float:
        return next(t_s for t_s, _ in self.windows if t_s > since_s) - since_s


def fly(motions: list[Motion], *, device_lag_s: float, known: Lag, until_s: float = 60.0, since_s: float = 0.0) -> Seen:
    """Feed a collector from power-on; windows that began after `since_s` are kept."""
    aircraft = VirtualAircraft(Pose(1.0, -0.5, 40.0), site_at(40.0, 116.0, 50.0), motions=motions)
    model = ImuModel(aircraft, "icm42688p", seed=1)
    devices = {
        "imu": (VectorNavBinary(model, rate_hz=50.0), make_decoder("imu", "vectornav")),
        "gradienter": (
            Gradienter(aircraft, seed=1, law="slope", lag_s=device_lag_s),
            make_decoder("gradienter", "inclinometer_xy"),
        ),
    }
    asked = settings(min_still_s=10.0, max_s=10.0)
    own = ImuInput(name="own", rotation=np.eye(3), profile=noise_profile("icm42688p"))
    collector = RollingCollector(asked, [own], gradienter(*known))
    seen = Seen()
    for device, _ in devices.values():
        device.power_on(0.0)
    for k in range(1, int(until_s / STEP_S)):
        t_s = k * STEP_S
        for device, decoder in devices.values():
            for frame in device.frames_until(t_s):
                for sample in decoder.receive(frame.data, frame.complete_s):
                    if isinstance(sample, ImuSample):
                        collector.add_imu("own", sample)
                    elif isinstance(sample, TiltSample):
                        collector.add_tilt(sample)
        collector.tick(t_s)
        seen.words.append(collector.status(t_s).waiting_for)
        try:
            window = collector.window(t_s)
        except CalibrationRefusedError:
            continue
        if window.start_s >= since_s and (not seen.windows or seen.windows[-1][1].end_s != window.end_s):
            seen.windows.append((t_s, window))
    seen.pitch_deg = aircraft.pose_at(until_s).pitch_deg
    return seen


def set_down(device_lag_s: float, known: Lag) -> Seen:
    """In somebody's hands, then tilted by 5 degrees in 0.8 s, and left alone."""
    handled = [
        Turn(start_s=k + 0.15, duration_s=0.8, pitch_deg=-5.0 if k % 2 else 5.0) for k in range(1, int(SET_DOWN_S) - 1)
    ]
    last = Turn(start_s=SET_DOWN_S - 0.85, duration_s=0.8, pitch_deg=5.0)
    return fly([*handled, last], device_lag_s=device_lag_s, known=known, since_s=SET_DOWN_S - 1.0)


@pytest.mark.parametrize(
    ("lag_s", "sigma_deg", "without_deg", "longer_s"),
    [(0.43, 0.005, 0.0001, 0.0), (3.0, 0.02, 0.03, 10.0)],
)
def test_what_the_fluid_leaves_in_the_mean(lag_s: float, sigma_deg: float, without_deg: float, longer_s: float) -> None:
    without = set_down(lag_s, AT_ONCE)
    within = set_down(lag_s, (lag_s, sigma_deg))
    assert without.error_deg() > without_deg
    assert within.error_deg() < min(0.1 * sigma_deg, 0.5 * without.error_deg())
    assert within.first_after_s(SET_DOWN_S) <= without.first_after_s(SET_DOWN_S) + longer_s
    # Never more than a tail's time and the five seconds that a mean takes.
    bound_s = lag_s * math.log(30.0 * UNKNOWN_DEG / sigma_deg) + 10.0
    assert within.first_after_s(SET_DOWN_S) < bound_s


def test_the_wait_is_told_in_words_and_counts_down_to_nothing() -> None:
    told = set_down(3.0, (3.0, 0.02)).words
    lines = [after for before, after in pairwise([None, *told]) if before != after]
    waits = [line for line in lines if line is not None and "settles" in line]
    assert re.fullmatch(r"gradienter settles: \d+ s more", waits[0])
    seconds = [int(line.split()[2]) for line in waits]
    assert seconds == sorted(seconds, reverse=True)
    assert 20 < seconds[0] < 30
    assert seconds[-1] == 1
    assert lines[lines.index(waits[-1]) + 1 :] == [None]


def test_an_aircraft_that_stands_still_waits_no_longer() -> None:
    at_once = fly([], device_lag_s=0.43, known=AT_ONCE, until_s=20.0)
    lagging = fly([], device_lag_s=0.43, known=(3.0, SIGMA_DEG), until_s=20.0)
    assert [t_s for t_s, _ in lagging.windows] == [t_s for t_s, _ in at_once.windows]
    assert [encode(window) for _, window in lagging.windows] == [encode(window) for _, window in at_once.windows]
    assert lagging.words == at_once.words


def test_a_knock_in_a_still_stretch_costs_no_more_seconds_than_before() -> None:
    knock = Knock(start_s=20.3)
    at_once = fly([knock], device_lag_s=0.43, known=AT_ONCE, until_s=40.0)
    lagging = fly([knock], device_lag_s=0.43, known=(0.43, SIGMA_DEG), until_s=40.0)
    assert [t_s for t_s, _ in lagging.windows] == [t_s for t_s, _ in at_once.windows]
    for (_, one), (_, other) in zip(lagging.windows, at_once.windows, strict=True):
        assert encode(one.imus) == encode(other.imus)
    errors = [lagging.error_deg(k) for k in range(len(lagging.windows))]
    assert max(errors) < 0.1 * SIGMA_DEG


def turned(known: Lag, tilted: bool) -> tuple[float, float]:
    """Error of the mean heading (or tilt) after a turn of 20 degrees (2 degrees) seen through a filter of 2 s."""
    collector = RollingCollector(
        settings(),
        [imu()],
        gradienter(*known) if tilted else None,
        None if tilted else dataclasses.replace(HEADING, lag_s=known[0], sigma_deg=known[1]),
    )
    feed = Feeder(collector)
    size, end_s = 2.0 if tilted else 20.0, 1006.0

    def off(t_s: float) -> float:
        return size if t_s < end_s else size * math.exp(-(t_s - end_s) / 2.0)

    def change(_name: str, times: Floats, rows: Floats) -> Floats:
        rows[:, 2] += np.where(times < end_s, 0.5 * np.sin(40.0 * times), 0.0)
        return rows

    feed.change = change
    if tilted:
        feed.tilt = lambda t_s: (1.0 + off(t_s), 2.0)
    else:
        feed.heading = lambda t_s: (359.0 + off(t_s)) % 360.0
    while (words := feed.waiting_for()) is not None:
        assert feed.now_s < 1100.0, words
        feed.run(0.5)
    window = collector.window(feed.now_s)
    if window.heading is not None:
        return abs((window.heading.heading_deg - 359.0 + 180.0) % 360.0 - 180.0), feed.now_s
    assert window.tilt is not None
    return abs(window.tilt.x_deg - 1.0), feed.now_s


@pytest.mark.parametrize("tilted", [False, True])
def test_a_filter_of_either_sensor_is_waited_for(tilted: bool) -> None:
    sigma_deg = 0.05 if tilted else 1.0
    without_deg, at_s = turned(AT_ONCE, tilted)
    within_deg, later_s = turned((2.0, sigma_deg), tilted)
    assert without_deg > 0.2 * sigma_deg
    assert within_deg < 0.1 * sigma_deg
    assert later_s < at_s + 12.0


# --- one sensor


def batch(slot: int, low: float, high: float, mean: float, n: int = 10) -> Batch:
    one = np.ones(1)
    return Batch(
        slot=slot, n=n, mean=mean * one, variance=0 * one, white=1e-12 * one,
        low=low * one, high=high * one, distinct=np.array([5]), clipped=False, largest_gap_s=0.1, missing=None,
        temperature_degc=None,
    )  # fmt: skip


@pytest.mark.parametrize("lag_s", [0.2, 0.43, 1.0, 3.0])
def test_what_is_left_is_below_a_tenth_of_sigma_and_never_long_before(lag_s: float) -> None:
    """Against the exponential itself; the step comes at any time of second 0."""
    sigma_deg = 0.02
    for rate_hz, size_deg, at_s in itertools.product((1, 8, 10), (0.05, 1.0, 5.0, 40.0), (0.0, 0.37, 0.9, 0.999)):
        case = (rate_hz, size_deg, at_s)
        settling = Settling(lag_s, sigma_deg, circle=True)
        counts = None
        for slot in range(120):
            t_s = slot + (np.arange(rate_hz) + 0.5) / rate_hz
            off = np.where(t_s < at_s, size_deg, size_deg * np.exp(-np.maximum(t_s - at_s, 0.0) / lag_s))
            readings = 359.99 + off  # on the circle
            row = batch(slot, readings.min(), readings.max(), float(np.mod(readings.mean(), 360.0)), rate_hz)
            if settling.judge(slot, row, moved=slot == 0):
                counts = slot
                break
        assert counts is not None, case
        left_deg = size_deg * math.exp(-(counts - at_s) / lag_s)
        assert left_deg <= 0.1 * sigma_deg * 1.05, case
        # Not seconds too late either, where the readings come often enough to tell.
        if rate_hz > 1:
            needed_s = at_s + lag_s * math.log(max(size_deg / (0.1 * sigma_deg), 1.0))
            assert counts <= max(needed_s, 1.0) + 2.0, case


def test_after_a_silence_the_most_is_assumed() -> None:
    settling = Settling(0.43, 0.005)
    settling.judge(0, None, moved=True)
    counted = [settling.judge(slot, batch(slot, 1.0, 1.0, 1.0), moved=False) for slot in range(1, 8)]
    n = math.ceil(0.43 * math.log(5.0 / 0.0005))
    assert n == 4
    assert counted == [slot > n for slot in range(1, 8)]


def test_what_follows_at_once_always_counts() -> None:
    settling = Settling(*AT_ONCE)
    assert settling.judge(0, batch(0, 0.0, 9.0, 5.0), moved=True)


def test_the_protocols_lag_is_the_default_and_the_configuration_comes_first() -> None:
    gradienter = gradienter_model(Section(port="/dev/x", protocol="inclinometer_xy", law="slope"))
    assert gradienter is not None
    assert gradienter.lag_s == PROTOCOLS["gradienter"]["inclinometer_xy"].lag_s
    config = Config(
        mavlink=Mavlink(url="udpin:127.0.0.1:0"),
        imu=[Imu(name="fc", source="autopilot")],
        gradienter=Section(port="/dev/x", protocol="inclinometer_xy", law="slope", lag_s=2.5, sigma_deg=0.02),
        compass=Compass(port="/dev/x", protocol="hmr3300", lag_s=0.288, sigma_deg=1.5),
    )
    models = gradienter_model(config.gradienter), compass_model(config.compass)
    assert [(one.lag_s, one.sigma_deg) for one in models if one is not None] == [(2.5, 0.02), (0.288, 1.5)]
