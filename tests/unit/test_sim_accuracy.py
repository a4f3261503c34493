"""The accuracy bench in small: what docs/accuracy.md says holds, and its rivals do what real firmware was seen to do.

Allowances are four standard errors of the number of stands; the seeds are fixed, so that a failure is a change.
"""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest

from companion.calibration.means.windows import ImuInput
from companion.calibration.noise.allan import noise_profile
from sim.accuracy import cli, deck_tables, experiments, paper, peers, tables, turning, warmup_table
from sim.accuracy.experiments import FloorRun, IntegerRun, WhiteRun, floors, integers, predicted, white
from sim.accuracy.figures import Claim, Figure, beside, covered, rms
from sim.accuracy.stand import EXACT, POSTURES, Stand, biases, collected, samples, sites, solved, stand
from sim.accuracy.tables import report
from sim.accuracy.warmup import WARMING
from sim.aircraft import Pose, Site, VirtualAircraft
from sim.earth import Array
from sim.imu_model import DEG_H, MG, PARTS, ImuModel
from tests.support.extent import extent

FOUR = 4.0


@pytest.fixture(scope="module")
def whites() -> list[WhiteRun]:
    return [white(5, number) for number in range(32)]


@pytest.fixture(scope="module")
def icms() -> list[FloorRun]:
    return [floors("icm42688p", 5, number) for number in range(20)]


def stacked(runs: list[Any], name: str) -> Array:
    return np.array([getattr(run, name) for run in runs])


@pytest.mark.parametrize("index", range(3), ids=["10 s", "30 s", "60 s"])
def test_white_noise_is_averaged_to_within_five_per_cent_of_the_bound(whites: list[WhiteRun], index: int) -> None:
    error, plain = stacked(whites, "error")[:, index], stacked(whites, "plain")[:, index]
    for axis in range(6):
        found = beside(error[:, axis], plain[:, axis])
        assert found.value < 1.05 + FOUR * found.error
    found = rms(error)
    assert found.value == pytest.approx(beside(error, plain).value, abs=FOUR * found.error)


@pytest.mark.parametrize("index", range(3), ids=["10 s", "30 s", "60 s"])
def test_sigma_stat_covers_as_it_says(whites: list[WhiteRun], index: int) -> None:
    error, sigma = stacked(whites, "error")[:, index], stacked(whites, "sigma")[:, index]
    once, twice = covered(error, sigma, 1.0), covered(error, sigma, 2.0)
    assert 0.66 - FOUR * once.error < once.value < 0.76 + FOUR * once.error
    assert 0.94 - FOUR * twice.error < twice.value < 0.97 + FOUR * twice.error


def test_an_icm42688p_is_calibrated_as_well_as_its_flicker_allows(icms: list[FloorRun]) -> None:
    found = rms(stacked(icms, "ideal")[:, -1, :3])
    possible = predicted(PARTS["icm42688p"].gyro, 60.0, 180.0)
    assert found.value == pytest.approx(possible, abs=FOUR * found.error)
    assert found.value < 5.5 * DEG_H + FOUR * found.error
    error, sigma = stacked(icms, "error"), stacked(icms, "sigma")
    twice = covered(error, sigma, 2.0)
    assert twice.value > 0.93 - FOUR * twice.error
    # The plain mean's own interval promises what it does not keep, and it takes the Earth for a bias.
    naive = covered(stacked(icms, "plain")[:, -1, :3], stacked(icms, "plain_sigma")[:, -1, :3], 2.0)
    assert naive.value < 0.4


def test_horizontal_accelerometers_are_as_good_as_the_tilt_reference(icms: list[FloorRun]) -> None:
    upright = [run for run in icms if run.posture in ("level", "by eye", "5/-3")]
    for index, (_, sigma_deg) in enumerate(experiments.TILTS[1:], start=1):
        own = math.radians(sigma_deg) * 9.80665
        found = rms(stacked(upright, "tilted")[:, index])
        assert found.value / own == pytest.approx(1.05, abs=0.05 + FOUR * found.error / own)


@pytest.mark.parametrize("noise", [0.3, 1.0])
def test_cut_integers_are_freed_of_the_cut_where_their_noise_shows_it(noise: float) -> None:
    runs = [integers(noise, 5, number) for number in range(8)]
    error, sigma = stacked(runs, "error"), stacked(runs, "sigma")
    measured = np.isfinite(error) & (sigma < 0.45)
    assert measured.mean() > 0.5
    assert float(np.abs(error[measured]).max()) * 1e-3 / DEG_H < 15.0
    assert float(np.abs(stacked(runs, "plain")).max()) * 1e-3 / DEG_H > 90.0
    assert covered(np.where(measured, error, np.nan), sigma, 2.0).value > 0.95


def test_cut_integers_without_noise_are_refused_or_cost_half_a_step() -> None:
    runs: list[IntegerRun] = [integers(0.1, 5, number) for number in range(8)]
    error, sigma = stacked(runs, "error"), stacked(runs, "sigma")
    refused = np.isnan(error)
    assert refused.any()
    assert not refused.all()
    assert (sigma[~refused] >= 0.45).all()
    assert (np.abs(error[~refused]) <= sigma[~refused] + 0.05).all()


# ------------------------------------------------------------------------------------------- what is compared with


def tilted_stand(part: str, gyro_deg_h: tuple[float, float, float], accel_mg: tuple[float, float, float]) -> Stand:
    """The vehicle of autopilots 9.3: pitch +5, roll -3, heading 40 degrees, 40 N, 50 m."""
    site = Site(40.0, 116.0, 50.0)
    imu = ImuModel(
        VirtualAircraft(Pose(5.0, -3.0, 40.0), site),
        part,
        seed=3,
        gyro_bias_rad_s=[one * DEG_H for one in gyro_deg_h],
        accel_bias_m_s2=[one * MG for one in accel_mg],
    )
    return Stand(POSTURES[2], site, imu, np.random.default_rng(3))


CASE_A = ((100.0, -60.0, 170.0), (1.0, -2.0, 3.0))
CASE_C = ((3600.0, 3600.0, 3600.0), (30.0, -30.0, 30.0))
EARTH_DEG_H = np.array([9.64, -6.93, -9.24])


def test_ardupilots_own_calibrations_leave_what_was_measured_on_its_firmware() -> None:
    standing = tilted_stand("white_only", *CASE_A)
    truth = np.concatenate([np.multiply(CASE_A[0], DEG_H), np.multiply(CASE_A[1], MG)])
    found = np.array([peers.ardupilot(standing, 1.0 + 0.5 * n) for n in range(150)]) - truth
    gyro, accel = found[:, :3] / DEG_H, found[:, 3:] / MG
    # Autopilots 9.3.1: the Earth rate stays in it; 9.9 deg/h of noise beside it; the tilt goes into the accelerometers.
    assert gyro.mean(axis=0) == pytest.approx(EARTH_DEG_H, abs=3.5)
    assert gyro.std(axis=0).mean() == pytest.approx(9.9, rel=0.12)
    assert accel.mean(axis=0) == pytest.approx([87.22, 52.18, 5.69], abs=0.15)
    assert accel.std(axis=0).mean() == pytest.approx(0.075, rel=0.25)


def test_ardupilot_takes_the_nearest_pair_of_a_gyro_that_never_agrees() -> None:
    shaky = tilted_stand("adis16405", *CASE_A)
    found = np.array([peers.ardupilot(shaky, 1.0 + n)[:3] for n in range(25)]) - shaky.bias(1.0, 30.0)[:3]
    # Half a second of 120 deg/h * sqrt(s) is 170 deg/h; pairs that agree by chance are no better.
    assert 120.0 < rms(found).value / DEG_H < 260.0


def test_px4_leaves_small_biases_where_they_were_and_averages_a_second_of_large_ones() -> None:
    small, large = tilted_stand("white_only", *CASE_A), tilted_stand("white_only", *CASE_C)
    assert peers.px4(small, 20.0)[:3].tolist() == [0.0, 0.0, 0.0]
    found = np.array([peers.px4(large, 20.0 + n) for n in range(60)])
    gyro = found[:, :3] / DEG_H - 3600.0
    assert gyro.mean(axis=0) == pytest.approx(EARTH_DEG_H, abs=FOUR * 7.1 / math.sqrt(60.0))
    assert gyro.std(axis=0).mean() == pytest.approx(7.1, rel=0.2)
    # Autopilots 9.3.2, case B: x and y not corrected at all, z right to a milli-g or two.
    accel = found[:, 3:] / MG
    left = np.array(CASE_C[1]) - accel.mean(axis=0)
    assert np.abs(left[:2]) == pytest.approx([30.0, 30.0], abs=4.5)
    assert abs(left[2]) < 6.0


def test_the_paper_put_right_finds_the_bias_and_as_printed_what_the_method_says() -> None:
    standing = tilted_stand("perfect", *CASE_A)
    still = paper.Still(standing.imu.aircraft.pose, standing.site)
    mean, truth = standing.imu.expected(0.0), standing.bias(0.0, 0.0)
    assert paper.biases(still, mean, paper.NONE) == pytest.approx(truth, abs=1e-12)
    printed = paper.biases(still, mean, paper.ALL)
    # Method 1.3, in FRD: north is forward, up is minus down.
    assert printed[3] == pytest.approx(-truth[3])
    assert printed[5] == pytest.approx(
        truth[5] - 2.0 * standing.site.gravity_m_s2 * math.cos(0.0873) * 0.9986, rel=1e-3
    )
    sign = paper.biases(still, mean, frozenset(("6sign",)))[:3]
    assert sign == pytest.approx(-truth[:3] - 2.0 * EARTH_DEG_H * DEG_H, abs=0.02 * DEG_H)
    rows = {name: paper.biases(still, mean, frozenset((name,))) - truth for name in paper.ERRATA}
    up_to = 2.0 * math.sin(math.radians(3.0)) * math.sin(math.radians(5.0)) * 15.04 * math.cos(math.radians(40.0))
    assert abs(rows["5T11,T12"][1]) / DEG_H == pytest.approx(up_to * math.cos(math.radians(40.0)), rel=0.01)
    assert abs(rows["5row2"][0]) > 1.0 * DEG_H
    assert np.abs(rows["psi"]).max() < 1e-12  # this site has no declination


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
    """Of a sensor without noise on its back, upside down, anywhere, the solution is the bias to rounding."""
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


def test_the_command_prints_tables_claims_and_one_json_object(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert cli.main(["--runs", "2", "--jobs", "1", "--only", "white,paper"]) in (0, 1)
    printed = capsys.readouterr().out
    assert "## White noise only" in printed
    assert "## What must hold" in printed
    assert max(map(len, printed.splitlines())) <= 100
    assert cli.main(["--only", "paper", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["sections"]["paper"]["figures"]["6sign"]["unit"] == "deg/h"
    for wrong in (["--only", "paper,wings"], ["--runs", "0"]):
        with pytest.raises(SystemExit) as refused:
            cli.main(wrong)
        assert refused.value.code == 2
    assert "wings" in capsys.readouterr().err


def test_all_sections_are_made_of_the_same_stands(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tables, "FLOORED", ("icm42688p",))
    monkeypatch.setattr(tables, "NOISE_LSB", (0.5,))
    monkeypatch.setattr(deck_tables, "SPANS_S", (120,))
    monkeypatch.setattr(deck_tables, "STILL_S", (60,))
    monkeypatch.setattr(turning, "RATES_DEG_S", extent(whole=turning.RATES_DEG_S, a_slice=(0.0, 0.4)))
    for module in (tables, warmup_table):
        monkeypatch.setattr(module, "WARMING", extent(whole=WARMING, a_slice=WARMING[:1]))
    said: list[str] = []
    found = report(2, 7, cli.SECTIONS, 1, said.append)
    assert tuple(found) == cli.SECTIONS
    assert len(said) == 9
    assert all(len(line) <= 100 for section in found.values() for line in section.lines)


@pytest.mark.real_clock
def test_however_many_processes_share_the_work_the_tables_are_the_same() -> None:
    one, two = (report(4, 7, ("white",), processes, lambda _: None) for processes in (1, 2))
    assert one["white"].lines == two["white"].lines
