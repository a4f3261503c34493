"""A gradienter whose fluid still moves after the aircraft has stopped: against the tilt that it really has."""

from __future__ import annotations

import dataclasses
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
from companion.estimation.collector.intake import OFF_DEG, Settling
from companion.estimation.collector.rolling import RollingCollector
from companion.estimation.means.pose import GradienterModel
from companion.estimation.means.windows import ImuInput, Window
from companion.estimation.noise.allan import noise_profile
from companion.physics.frames import wrap_deg
from companion.physics.gradienter import attitude_from_readings
from companion.protocols.registry import PROTOCOLS
from companion.recording.messages import encode
from companion.samples import ImuSample, TiltSample
from sim.aircraft import Pose, VirtualAircraft
from sim.devices import Gradienter, VectorNavBinary
from sim.imu_model import ImuModel
from sim.motions import Motion, Turn
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
    """Reasons for waiting, twenty times a second."""
    pitch_deg: float = 0.0

    def error_deg(self, at: int = 0) -> float:
        """Error of the pitch from a window's tilt."""
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
    bound_s = lag_s * math.log(30.0 * OFF_DEG / sigma_deg) + 10.0
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


def turned(lag_s: float) -> tuple[float, float]:
    """Error of the mean heading after a turn of 20 degrees seen through a filter of 2 s, and when it was there."""
    feed = Feeder(RollingCollector(settings(), [imu()], compass=dataclasses.replace(HEADING, lag_s=lag_s)))
    end_s = 1006.0

    def change(_name: str, times: Floats, rows: Floats) -> Floats:
        rows[:, 2] += np.where(times < end_s, 0.5 * np.sin(40.0 * times), 0.0)
        return rows

    feed.change = change
    feed.heading = lambda t_s: (359.0 + 20.0 * math.exp(-max(t_s - end_s, 0.0) / 2.0)) % 360.0
    while (words := feed.waiting_for()) is not None:
        assert feed.now_s < 1100.0, words
        feed.run(0.5)
    heading = feed.collector.window(feed.now_s).heading
    assert heading is not None
    return abs(wrap_deg(heading.heading_deg - 359.0)), feed.now_s


def test_a_filter_of_the_compass_is_waited_for() -> None:
    (without_deg, at_s), (within_deg, later_s) = turned(0.0), turned(2.0)
    assert without_deg > 0.2
    assert within_deg < 0.1
    assert later_s < at_s + 12.0


@pytest.mark.parametrize("lag_s", [0.2, 0.43, 1.0, 3.0])
@pytest.mark.parametrize("size_deg", [0.05, 1.0, 5.0])
def test_what_is_left_is_below_a_tenth_of_sigma(lag_s: float, size_deg: float) -> None:
    """Against the exponential itself; the step comes at the very end of second 0."""
    settling = Settling(lag_s, 0.02)
    assert not settling.judge(0, moved=True)
    counts = next(slot for slot in range(1, 120) if settling.judge(slot, moved=False))
    assert size_deg * math.exp(-(counts - 1.0) / lag_s) <= 0.1 * 0.02
    assert settling.left_s == 0


def test_what_follows_at_once_always_counts() -> None:
    assert Settling(*AT_ONCE).judge(0, moved=True)


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
