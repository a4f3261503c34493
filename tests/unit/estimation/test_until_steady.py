"""Time until a warm-up no longer matters, against the simulator's temperature."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.estimation.means.until_steady import UntilSteady, lasting_k, until_steady
from sim.thermal import warming

LIMIT_K = 3.0
TIMES_S = np.arange(5.0, 605.0, 10.0)
NOISE_K = 0.016
"""Of a mean of ten seconds."""


def predicted(
    start_degc: float, end_degc: float, tau_s: float, until_s: float, target: float | None = None
) -> UntilSteady | None:
    curve = warming(start_degc, end_degc, tau_s)
    times_s = TIMES_S[until_s >= TIMES_S]
    degc = np.array([curve(t_s) for t_s in times_s]) + np.random.default_rng(1).normal(0.0, NOISE_K, len(times_s))
    return until_steady(times_s, degc, lambda _end: LIMIT_K, target=target)


@pytest.mark.parametrize(
    ("start_degc", "end_degc", "tau_s"), [(10.0, 32.0, 200.0), (35.0, 48.0, 350.0), (40.0, 15.0, 300.0)]
)
def test_the_interval_holds_the_truth_and_narrows(start_degc: float, end_degc: float, tau_s: float) -> None:
    ready_s = tau_s * math.log(abs(end_degc - start_degc) / LIMIT_K)
    widths = []
    for age_s in (60.0, 120.0, 240.0, 360.0):
        found = predicted(start_degc, end_degc, tau_s, age_s)
        assert found is not None
        assert found.low_s - 5.0 <= ready_s - age_s + 5.0 <= found.high_s + 5.0
        widths.append(found.high_s - found.low_s)
    assert widths[1] > widths[2] > 2.0 * widths[3]
    assert found is not None
    true_k_s = (end_degc - start_degc) / tau_s * math.exp(-355.0 / tau_s)
    assert found.k_s == pytest.approx(true_k_s, rel=0.1)
    assert found.figure_s is not None


def test_a_heater_ends_the_warm_up_at_its_target() -> None:
    """At full power this board would reach 80 degC; its heater holds it at 45 degC."""
    found = predicted(5.0, 80.0, 600.0, 120.0, target=45.0)
    ready_s = 600.0 * math.log(75.0 / (80.0 - (45.0 - LIMIT_K)))
    assert found is not None
    assert found.low_s <= ready_s - 115.0 <= found.high_s
    assert found.high_s < 600.0 * math.log(75.0 / LIMIT_K) - 115.0


@pytest.mark.parametrize(("end_degc", "until_s"), [(25.0, 600.0), (45.0, 40.0)], ids=["steady", "too short"])
def test_nothing_is_predicted_without_a_warm_up_or_a_history(end_degc: float, until_s: float) -> None:
    assert predicted(25.0, end_degc, 300.0, until_s) is None


def test_an_interval_that_is_too_wide_has_no_single_figure() -> None:
    assert UntilSteady(190.0, 400.0, 0.01).figure_s is None
    assert UntilSteady(200.0, 400.0, 0.01).figure_s == (300.0, 100.0)
    assert UntilSteady(200.0, 440.0, 0.01).later(250.0) == UntilSteady(0.0, 190.0, 0.01)


def test_a_calibration_lasts_where_the_bias_moves_by_less_than_allowed() -> None:
    """A bias of 10 a kelvin, on one axis, may move by 25: 2.5 K."""

    def drift(then_degc: float, now_degc: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
        return (0.0, 10.0 * (now_degc - then_degc), 0.0), (0.0, 0.0, 0.0)

    assert lasting_k(drift, 40.0, 25.0, 3.0) == pytest.approx(2.5, rel=0.11)  # type: ignore[arg-type]
    assert lasting_k(lambda _then, _now: None, 40.0, 25.0, 3.0) == 3.0
