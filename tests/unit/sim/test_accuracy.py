"""The accuracy bench in small: what docs/accuracy.md says holds, and its rivals do what real firmware was seen to do.

Allowances are four standard errors of the number of stands; the seeds are fixed, so that a failure is a change.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.estimation.means.windows import ImuInput
from companion.estimation.noise.allan import noise_profile
from sim.accuracy import by_hand, cli, deck, tables, temperature, turning, warmup
from sim.accuracy.experiments import predicted
from sim.accuracy.figures import Claim, Figure, beside, covered, rms
from sim.accuracy.stand import EXACT, POSTURES, biases, collected, samples, sites, solved, stand
from sim.accuracy.tables import report
from sim.aircraft import VirtualAircraft
from sim.imu_model import DEG_H, MG, PARTS, ImuModel
from tests.support.extent import extent
from tests.support.namespaces import has_shared_memory, run_again_with_mounts


@pytest.mark.parametrize(
    ("runs", "sections"),
    [(32, ("white",)), (60, ("floors", "tilt")), (160, ("integers",)), (150, ("until-ready",))],
    ids=["white noise", "flicker and tilt", "integers", "until ready"],
)
def test_the_claims_hold_in_small(monkeypatch: pytest.MonkeyPatch, runs: int, sections: tuple[str, ...]) -> None:
    monkeypatch.setattr(tables, "FLOORED", ("icm42688p",))
    monkeypatch.setattr(tables, "NOISE_LSB", (0.1, 0.3, 1.0))
    claims = [claim for section in report(runs, 5, sections, 1, lambda _: None).values() for claim in section.claims]
    assert len(claims) >= 5
    assert not [str(claim) for claim in claims if not claim.holds]


@pytest.mark.parametrize(
    ("part", "triad", "published"),
    [
        ("icm42688p", "gyro", (5.8, 5.0, 4.7)),
        ("bmi088", "gyro", (11.8, 7.3, 5.6)),
        ("adis16470", "gyro", (15.6, 13.5, 12.7)),
        ("adis16405", "gyro", (58.5, 46.0, 42.0)),
        ("icm42688p", "accel", (23.7, 18.6, 16.8)),
        ("bmi088", "accel", (53.0, 40.0, 35.0)),
    ],
)
def test_what_is_predicted_is_the_published_table(part: str, triad: str, published: tuple[float, ...]) -> None:
    noise = getattr(PARTS[part], triad)
    unit = DEG_H if triad == "gyro" else MG * 1e-3
    found = [predicted(noise, span, 180.0) / unit for span in (10.0, 30.0, 60.0)]
    assert found == pytest.approx(published, rel=0.015)


def test_the_simulated_noise_is_what_it_is_called_by_an_independent_package() -> None:
    try:
        import allantools
    except ImportError:  # pragma: no cover
        pytest.skip("allantools is not installed")
    part, interval_s = PARTS["bmi088"], 0.5
    times = np.arange(0.0, 2000.0, interval_s)
    squares: dict[float, list[float]] = {1.0: [], 20.0: [], 200.0: []}
    for seed in range(3):
        # As a truth that is asked for its bias, without rounding.
        imu = ImuModel(VirtualAircraft(), part, seed=100 + seed)
        white_noise = np.random.default_rng(seed).standard_normal((len(times), 3)) * part.gyro.white
        values = imu.expected_block(times)[:, :3] + white_noise / math.sqrt(interval_s)
        for axis in range(3):
            taus, deviations, _, _ = allantools.oadev(
                values[:, axis], rate=1.0 / interval_s, data_type="freq", taus=list(squares)
            )
            for tau_s, deviation in zip(taus, deviations, strict=True):
                squares[round(float(tau_s))].append(float(deviation) ** 2)
    for tau_s, found in squares.items():
        floor = (
            2.0 * DEG_H
        )  # as catalogued: white noise over sqrt(tau), the floor, and the walk that meets it at 1000 s
        expected = math.sqrt((35.6 * DEG_H) ** 2 / tau_s + floor**2 + floor**2 * tau_s / 1000.0)
        assert math.sqrt(np.mean(found)) == pytest.approx(expected, rel={1: 0.02, 20: 0.06, 200: 0.18}[int(tau_s)])


# ----------------------------------------------------------------------------------------------------- the bench


def test_a_stand_hides_nothing_from_the_estimator() -> None:
    """A sensor without noise on its back, upside down, anywhere: the solution is the bias to rounding."""
    for number, posture in enumerate(POSTURES):
        standing = stand("white_only", posture, sites()[number % 4], (6, number))
        taken = ImuInput(name="imu", rotation=standing.imu.mounting, profile=noise_profile("icm42688p"))
        times, rows = samples(standing, 10.0)
        quiet = rows + (standing.imu.expected(2.0) - rows) * (1.0 - 1e-6)
        window = collected(standing, taken, times, quiet, (10,))[0]
        assert (window.start_s, window.end_s) == (1.0, 11.0)
        error = biases(solved(standing, window, EXACT).imus[0]) - standing.bias(1.0, 11.0)
        assert np.abs(error[:3]).max() < 0.01 * DEG_H
        assert np.abs(error[3:]).max() < 3e-3 * MG


def test_figures_and_their_standard_errors_are_those_of_known_numbers() -> None:
    rng = np.random.default_rng(1)
    many = rng.normal(0.0, 2.0, (400, 50, 3))
    values = np.array([rms(one) for one in many])
    assert values[:, 0].mean() == pytest.approx(2.0, rel=0.01)
    assert values[:, 0].std() == pytest.approx(values[:, 1].mean(), rel=0.15)
    shares = np.array([covered(one, np.full_like(one, 2.0), 1.0) for one in many])
    assert shares[:, 0].mean() == pytest.approx(0.6827, abs=0.01)
    assert shares[:, 0].std() == pytest.approx(shares[:, 1].mean(), rel=0.15)
    efficient = rng.normal(size=(4000, 3))
    worse = efficient + 0.3 * rng.normal(size=(4000, 3))
    assert beside(worse, efficient).value == pytest.approx(math.sqrt(1.09), abs=0.005)
    assert beside(worse, efficient).value == pytest.approx(rms(worse).value, abs=0.03)
    holes = np.array([[1.0, math.nan], [1.0, 1.0]])
    assert rms(holes).value == 1.0
    assert covered(holes, np.ones((2, 2)), 0.5).value == 0.0
    assert covered(holes, np.ones((2, 2)), 0.5).error > 0.0


def test_a_claim_is_missed_by_more_than_chance_only() -> None:
    assert Claim("", "", Figure(1.06, 0.01), 1.05).holds
    assert not Claim("", "", Figure(1.09, 0.01), 1.05).holds
    assert not Claim("", "", Figure(90.0, 0.5), 97.0, 94.0).holds
    assert str(Claim("a", "", Figure(1.09, 0.01), 1.05)).startswith("NO")


def test_the_command_prints_tables_and_claims(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--runs", "2", "--jobs", "1", "--only", "white"]) in (0, 1)
    printed = capsys.readouterr().out
    assert "## White noise only" in printed
    assert "## What must hold" in printed
    with pytest.raises(SystemExit) as refused:
        cli.main(["--only", "white,wings"])
    assert refused.value.code == 2
    assert "wings" in capsys.readouterr().err


def test_all_sections_are_made_of_the_same_stands(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tables, "FLOORED", ("icm42688p",))
    monkeypatch.setattr(tables, "NOISE_LSB", (0.5,))
    monkeypatch.setattr(deck, "SPANS_S", (120,))
    monkeypatch.setattr(deck, "STILL_S", (60,))
    monkeypatch.setattr(turning, "RATES_DEG_S", extent(whole=turning.RATES_DEG_S, a_slice=(0.0, 0.4)))
    for module, names in (
        (warmup, ("WARMING", "RAMPS", "CURVES_S")),
        (by_hand, ("BY_HAND",)),
        (temperature, ("TRIED", "RATES_K_MIN")),
    ):
        for name in names:
            whole = getattr(module, name)
            monkeypatch.setattr(module, name, extent(whole=whole, a_slice=whole[:1]))
    said: list[str] = []
    found = report(2, 7, cli.SECTIONS, 1, said.append)
    assert tuple(found) == cli.SECTIONS
    assert len(said) == 11
    assert all(len(line) <= 100 for section in found.values() for line in section.lines)


@pytest.mark.real_clock
def test_however_many_processes_share_the_work_the_tables_are_the_same(request: pytest.FixtureRequest) -> None:
    if not has_shared_memory():
        run_again_with_mounts(request.node)
        return
    one, two = (report(4, 7, ("white",), processes, lambda _: None) for processes in (1, 2))
    assert one["white"].lines == two["white"].lines
