"""N, B and K against noise that was made from them, deviations against allantools, their scatter against algebra."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from companion.estimation.noise.allan import AllanCurve, AxisFit, curve, fit_axis
from tests.support.made_noise import FLICKER_OF_FLOOR, slow

Floats = NDArray[np.float64]


def curve_of(*stretches: Floats) -> AllanCurve:
    return curve((np.arange(len(values)), values[:, None]) for values in stretches)


def test_the_deviations_are_those_of_allantools() -> None:
    import allantools  # most of a second, as scipy.stats: not at every collection

    values = slow(np.random.default_rng(1), 3000, 2.0, 0.05, 9.0)
    found = curve_of(values)
    taus, deviations, _, _ = allantools.oadev(values, rate=1.0, data_type="freq", taus=list(found.spans))
    assert list(taus) == list(found.spans)
    assert found.spans[-1] == 256
    np.testing.assert_allclose(np.sqrt(found.variance[:, 0]), deviations, rtol=1e-9)


def fits(seed: int, runs: int, seconds: int, white: float, floor: float, walk: float) -> list[AxisFit]:
    rng = np.random.default_rng(seed)
    made = [slow(rng, seconds, floor * FLICKER_OF_FLOOR, walk, white) for _ in range(runs)]
    return [fit_axis(curve_of(values), 0) for values in made]


@pytest.mark.parametrize(
    ("white", "floor", "walk"),
    [(147.0, 27.0, 1.5), (7.1, 3.0, 0.16), (35.6, 2.0, 0.5), (1.0, 0.0, 0.0)],
    ids=["ADIS16405", "ICM-42688-P", "little flicker", "white only"],
)  # fmt: skip
def test_the_figures_come_back_and_their_errors_are_as_said(white: float, floor: float, walk: float) -> None:
    truth = np.square([white, floor * FLICKER_OF_FLOOR, walk])
    found = fits(3, 40, 4000, white, floor, walk)
    off = np.array([np.square(fit.figures) - truth for fit in found])
    said = np.array([fit.sigmas for fit in found])
    pulls = off / said
    # Those that cannot become negative: on average right, and by so much as is said. Of 40, rms is good to 11 %.
    free = truth > 3.0 * said.mean(axis=0)
    assert free[0]
    assert np.abs(pulls[:, free].mean(axis=0)).max() < 0.55
    assert np.sqrt(np.square(pulls[:, free]).mean(axis=0)) == pytest.approx(1.0, abs=0.35)
    upper = np.array([fit.upper for fit in found])
    # One-sided 95 %: of 40, at least 34 (1 % of the draws have fewer).
    assert ((np.square(upper) >= truth * (1.0 - 1e-9)).sum(axis=0) > 33).all()
    known = np.array([fit.known for fit in found])
    assert known[:, 0].all()
    # What is not there is not told, and what is there by three standard errors is.
    assert (known[:, truth == 0.0].mean(axis=0) < 0.13).all()
    assert (known[:, truth > 5.0 * said.mean(axis=0)].mean(axis=0) > 0.9).all()


def test_more_sessions_tell_more_and_each_has_its_own_level() -> None:
    rng = np.random.default_rng(5)
    parts = [slow(rng, 1800, 3.0 * FLICKER_OF_FLOOR, 0.16, 7.1) + 1000.0 * number for number in range(8)]
    one, all_of_them = fit_axis(curve_of(parts[0]), 0), fit_axis(curve_of(*parts), 0)
    assert all_of_them.sigmas[1] < one.sigmas[1] / 2.0
    assert all_of_them.figures[1] / FLICKER_OF_FLOOR == pytest.approx(3.0, rel=0.15)


def test_what_never_changes_cannot_be_fitted() -> None:
    with pytest.raises(ValueError, match="never change"):
        fit_axis(curve_of(np.ones(100)), 0)
    with pytest.raises(ValueError, match="long enough"):
        curve_of(np.zeros(5))
