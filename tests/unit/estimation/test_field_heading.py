"""Headings out of field vectors, and a compass that turns alone: sample by sample, second by second."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.estimation.collector.rolling import RollingCollector
from companion.estimation.means.pose import CompassModel, FieldHeading, GradienterModel, vehicle_heading_rad
from companion.physics.frames import wrap_deg
from companion.physics.units import DEG
from companion.samples import CompassSample, MagSample, TiltSample
from tests.support.magnetic import compass
from tests.support.still_aircraft import Feeder, Floats, imu, settings
from tests.support.windows import about, ned_from_body, readings

FIELD_NED = np.array([0.28, 0.0, 0.45])
GRADIENTER = GradienterModel("euler", np.eye(3), (0.4, -0.3), 0.05)
PLAIN = GradienterModel("euler", np.eye(3), (0.0, 0.0), 0.05)


def field(
    pose_deg: tuple[float, float, float], model: CompassModel, t_s: float, field_ned: Floats = FIELD_NED
) -> MagSample:
    x, y, z = (model.vehicle_from_sensor.T @ ned_from_body(*pose_deg).T @ field_ned).tolist()
    return MagSample(t_s, (x, y, z))


def tilt(pose_deg: tuple[float, float, float], t_s: float, offset_deg: tuple[float, float] = (0.0, 0.0)) -> TiltSample:
    x, y = readings(ned_from_body(*pose_deg).T @ np.array([0.0, 0.0, -1.0]), "euler")
    return TiltSample(t_s, x + offset_deg[0], y + offset_deg[1])


@pytest.mark.parametrize("mounting", [np.eye(3), about(2, 2.5), about(2, -0.6) @ about(1, 0.5) @ about(0, -0.4)])
def test_the_vehicles_heading_comes_out_whatever_the_mounting_the_tilt_and_the_gradienters_zero(
    mounting: Floats,
) -> None:
    model = compass(mounting=mounting)
    for pose in ((0.0, 0.0, 10.0), (25.0, -20.0, 200.0), (-30.0, 15.0, 359.0)):
        maker = FieldHeading(model, GRADIENTER, 10)
        maker.add(field(pose, model, 0.0))
        maker.take_tilt(tilt(pose, 2.9, GRADIENTER.offset_deg))
        made = maker.add(field(pose, model, 3.0))
        assert made is not None
        up = ned_from_body(*pose).T @ np.array([0.0, 0.0, -1.0])
        assert wrap_deg(vehicle_heading_rad(model, made.heading_deg, up) / DEG - pose[2]) == pytest.approx(0, abs=1e-9)


def test_a_devices_own_heading_counts_while_it_comes() -> None:
    model = compass()
    maker = FieldHeading(model, PLAIN, 10)
    made = []
    for k in range(100):
        t_s = k * 0.1
        maker.take_tilt(tilt((0.0, 0.0, 0.0), t_s))
        if k < 50:
            assert maker.takes_own(CompassSample(t_s, 12.0))
        made.append(maker.add(field((0.0, 0.0, 90.0), model, t_s)))
    assert made[:69] == [None] * 69
    late = [sample for sample in made[70:] if sample is not None]
    assert len(late) == 30
    assert late[0].heading_deg == pytest.approx(90.0)
    assert maker.from_field
    # And again: its own is believed from its first word on.
    assert maker.takes_own(CompassSample(10.0, 12.0))
    assert maker.add(field((0.0, 0.0, 90.0), model, 10.0)) is None
    assert not maker.from_field


@pytest.mark.parametrize(
    ("gradienter", "tilt_s", "magnetic", "part"),
    [
        (None, None, True, "needs a gradienter"),
        (PLAIN, None, True, "no tilt from the gradienter"),
        (PLAIN, 1.9, True, "no tilt from the gradienter"),
        (PLAIN, 3.0, False, "magnetic north"),
    ],
)
def test_why_there_is_no_heading_is_said(
    gradienter: GradienterModel | None, tilt_s: float | None, magnetic: bool, part: str
) -> None:
    model = CompassModel(magnetic, np.eye(3), 0.0, 1.0)
    maker = FieldHeading(model, gradienter, 10)
    if tilt_s is not None:
        maker.take_tilt(tilt((0.0, 0.0, 0.0), tilt_s))
    assert maker.add(field((0.0, 0.0, 90.0), model, 0.0)) is None
    assert maker.add(field((0.0, 0.0, 90.0), model, 3.0)) is None
    assert part in maker.hint


@pytest.mark.parametrize("bad", [(math.nan, 0.0, 0.0), (math.inf, 0.0, 1.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.5)])
def test_what_is_no_field_makes_no_heading_and_raises_nothing(bad: tuple[float, float, float]) -> None:
    maker = FieldHeading(compass(), PLAIN, 10)
    maker.take_tilt(TiltSample(3.0, 0.0, 0.0))
    maker.add(MagSample(0.0, bad))
    assert maker.add(MagSample(3.0, bad)) is None
    assert maker.add(MagSample(3.0)) is None
    maker.take_tilt(TiltSample(3.0, math.nan, math.inf))
    maker.add(MagSample(3.0, (0.2, 0.1, 0.3)))


def test_counts_become_gauss_only_with_a_scale() -> None:
    for scale, unit, expected in ((None, "counts", (1000.0, -200.0, 1600.0)), (4000.0, "gauss", (0.25, -0.05, 0.4))):
        maker = FieldHeading(compass(counts_per_gauss=scale), PLAIN, 10)
        for k in range(40):
            maker.add(MagSample(k * 0.1, counts=(1000, -200, 1600)))
        found = maker.window([1, 2])
        assert found is not None
        assert found.unit == unit
        assert found.field == pytest.approx(expected)


# ------------------------------------------------------------------------------------------------- in the collector


class FieldStand:
    """A still aircraft whose compass gives its field; what disturbs it can be changed."""

    def __init__(self) -> None:
        self.model = compass()
        self.collector = RollingCollector(settings(), [imu()], PLAIN, self.model)
        self.feed = Feeder(self.collector)
        self.iron = np.zeros(3)
        self.noise = np.random.default_rng(5)
        # Its FORCE is tilted, but the gradienter is its own witness.
        self.feed.tilt = lambda t_s: (0.0, 0.0)
        self.feed.heading = self._field

    def _field(self, t_s: float) -> None:
        x, y, z = (FIELD_NED + self.iron + 0.0005 * self.noise.standard_normal(3)).tolist()
        self.collector.add_field(MagSample(t_s, (x, y, z)))


def test_a_field_alone_is_a_compass_to_the_collector() -> None:
    stand = FieldStand()
    stand.feed.run(20.0)
    assert stand.feed.waiting_for() is None
    window = stand.collector.window(stand.feed.now_s)
    assert window.heading is not None
    assert window.field is not None
    assert window.heading.from_field
    assert wrap_deg(window.heading.heading_deg) == pytest.approx(0.0, abs=0.05)
    assert window.field.field == pytest.approx(tuple(FIELD_NED), abs=2e-4)
    assert window.heading.wander_deg is not None
    assert window.heading.wander_deg < 0.2


def test_iron_that_comes_while_nothing_turns_is_seen_across_the_stretch_that_it_breaks() -> None:
    stand = FieldStand()
    stand.feed.run(20.0)
    stand.iron = np.array([0.0, 0.28 * math.tan(6 * DEG), 0.0])
    stand.feed.run(2.0)
    assert "compass moved by" in (stand.feed.waiting_for() or "")
    stand.feed.run(25.0)
    window = stand.collector.window(stand.feed.now_s)
    assert window.heading is not None
    assert window.heading.wander_deg == pytest.approx(6.0, abs=0.3)


def test_a_turn_of_the_aircraft_is_no_wandering() -> None:
    stand = FieldStand()
    stand.feed.run(15.0)
    turning = np.array([0.0, 0.0, 10.0 * DEG, 0.0, 0.0, 0.0])
    stand.feed.change = lambda _name, _times, rows: rows + turning
    stand.iron = np.array([0.0, 0.2, 0.0])
    stand.feed.run(3.0)
    stand.feed.change = lambda _name, _times, rows: rows
    stand.feed.run(20.0)
    window = stand.collector.window(stand.feed.now_s)
    assert window.heading is not None
    assert window.heading.wander_deg is not None
    assert window.heading.wander_deg < 0.3


def test_without_a_gradienter_the_field_alone_says_what_is_missing() -> None:
    collector = RollingCollector(settings(), [imu()], compass=compass())
    feed = Feeder(collector)

    def give(t_s: float) -> None:
        collector.add_field(MagSample(t_s, (0.28, 0.0, 0.45)))

    feed.heading = give
    feed.run(15.0)
    assert feed.waiting_for() == "compass sends its field only: a heading from it needs a gradienter"
