"""Unseen effect of a warm-up: thermometers, age, the window's own slope; against known ramps."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from companion.config.sections import AllanModel, Imu, NoiseProfile
from companion.configured.models import imu_input
from companion.estimation.collector.rolling import RollingCollector
from companion.estimation.means.warming import Warming
from companion.estimation.noise.allan import WARM_UP
from companion.estimation.seconds.batch import Batch
from companion.physics.units import DEG_H
from companion.protocols.registry import PROTOCOLS
from sim.accuracy.experiments import SPANS_S
from sim.accuracy.figures import covered
from sim.accuracy.warmup import WarmupCase, cases, warm
from tests.support.still_aircraft import imu, imu_sample, noise, settings
from tests.unit.estimation.test_windows import batches_of, window_of


def with_temperatures(batches: list[Batch], degc: list[float]) -> list[Batch]:
    return [msgspec.structs.replace(each, temperature_degc=one) for each, one in zip(batches, degc, strict=True)]


def seconds(degc: list[float]) -> list[Batch]:
    return with_temperatures(batches_of(np.random.default_rng(1).normal(size=(len(degc), 6))), degc)


def rate_of(batches: list[Batch]) -> tuple[float, float] | None:
    found = window_of(imu(), batches).warming
    assert isinstance(found, Warming)
    return found.rate


def test_a_thermometers_rate_is_found_and_holds_what_it_says() -> None:
    rng = np.random.default_rng(3)
    inside = 0
    for _ in range(200):
        degc = 31.0 + 0.02 * np.arange(30.0) + rng.normal(0.0, 0.05, 30)
        found = rate_of(seconds(degc.tolist()))
        assert found is not None
        inside += abs(found[0] - 0.02) < 2.0 * math.sqrt(found[1])
    assert 0.90 < inside / 200 < 0.99
    assert rate_of(batches_of(np.random.default_rng(1).normal(size=(30, 6)))) is None
    assert rate_of(seconds([25.0, 25.0])) is None


@pytest.mark.parametrize("step", [1.0, 0.25, 0.01])
def test_a_coarse_thermometer_that_stands_still_tells_no_more_than_its_step_allows(step: float) -> None:
    """The fastest that a reading can go through T seconds without showing it is a step in T."""
    found = rate_of(seconds([24.0 + step] * 20))
    assert found is not None
    assert found[0] == 0.0
    assert step / 20.0 < 2.0 * math.sqrt(found[1]) < 3.0 * step / 20.0
    rounded = np.rint((24.0 + 0.4 * step * np.arange(20.0) / 20.0) / step) * step
    seen = rate_of(seconds(rounded.tolist()))
    assert seen is not None
    assert abs(seen[0] - 0.4 * step / 20.0) < 2.0 * math.sqrt(seen[1])


def test_a_part_whose_warm_up_was_learned_is_believed() -> None:
    model = AllanModel(150.0 * DEG_H, 1.0 * DEG_H, 0.1 * DEG_H)
    quick = NoiseProfile("quick", model, model)
    calm = NoiseProfile("calm", model, model, warm_up=(WARM_UP[0] / 20.0, WARM_UP[1] / 20.0))
    batches = batches_of(np.random.default_rng(5).normal(0.0, model.white, (10, 6)))
    found = [window_of(imu("fc", profile), batches).warming for profile in (quick, calm)]
    assert found[0] is not None
    assert found[1] is not None
    ratio = found[1].unseen(10.0)[:3] / found[0].unseen(10.0)[:3]
    assert ratio == pytest.approx(1.0 / 400.0, rel=0.25)


@pytest.mark.parametrize(
    ("says", "clock_s", "age_s"),
    [
        (True, 5000.0, 5020.0),
        (True, 2.0, 22.0),
        (True, None, 20.0),
        (False, 5000.0, 20.0),  # the time of week of a GPS, say
        (True, 1.8e9, 20.0),  # UTC
    ],
)
def test_how_long_a_part_has_been_on_says_its_device_else_its_stream(
    says: bool,
    clock_s: float | None,
    age_s: float,
) -> None:
    collector = RollingCollector(settings(), [imu("fc", clock_from_start=says)])
    rows = noise(np.random.default_rng(1), 1000)
    for k, row in enumerate(rows):
        sample = imu_sample(100.0 + k / 50.0, row)
        device_s = None if clock_s is None else clock_s + k / 50.0
        collector.add_imu("fc", msgspec.structs.replace(sample, t_device_s=device_s))
    collector.tick(120.0)
    window = collector.window(120.0)
    assert window.powered_s["fc"] == pytest.approx(age_s, abs=1.5)
    told = says and clock_s is not None and clock_s < 1e9
    assert collector.up_s("fc") == (pytest.approx(age_s, abs=1.5) if told else None)
    # Restarted without a pause in the stream: young again.
    for k, row in enumerate(rows):
        collector.add_imu("fc", msgspec.structs.replace(imu_sample(120.0 + k / 50.0, row), t_device_s=k / 50.0))
    collector.tick(140.0)
    assert not told or collector.window(140.0).powered_s["fc"] == pytest.approx(20.0, abs=1.5)


@pytest.mark.parametrize("protocol", PROTOCOLS["imu"])
def test_only_clocks_that_count_from_the_start_by_their_documents_tell_an_age(protocol: str) -> None:
    imu = Imu(name="own", source="serial", port="/dev/x", protocol=protocol)  # type: ignore[arg-type]
    assert imu_input(imu, None).clock_from_start == (protocol in {"vectornav", "xsens"})
    assert imu_input(Imu(name="fc", source="autopilot"), None).clock_from_start


@pytest.mark.parametrize(
    "case",
    [
        WarmupCase(False, ramp_deg_h_s=3.0),
        WarmupCase(False, curve_s=300.0, late_s=5.0),
        WarmupCase(True, curve_s=1200.0, late_s=120.0),
    ],
)
def test_the_next_minute_of_a_part_that_warms_up_is_covered(case: WarmupCase) -> None:
    assert case in cases()
    runs = [warm("adis16405", case, 5, number) for number in range(8)]
    error, sigma = np.array([run.error for run in runs]), np.array([run.sigma for run in runs])
    for at in range(len(SPANS_S)):
        found = covered(error[:, at, :3], sigma[:, at, :3], 2.0)
        assert found.value > 0.9 - 3.0 * found.error
