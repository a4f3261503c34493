"""The gate and the estimator on real recordings, with the one set of constants that everyone gets."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from companion.errors import CalibrationRefusedError
from companion.estimation.alignment.faces import Face, faces
from companion.estimation.collector.measurement import GroundWindows
from companion.estimation.collector.rolling import RollingCollector
from companion.physics.units import MG
from tests.support.recordings import Recording, px4, xio, xsens_counts
from tests.support.still_aircraft import imu, settings

Floats = NDArray[np.float64]
G_IMU_TK = 9.81744


class Played:
    """A recording after the collector: one entry a second, and the still stretches."""

    def __init__(self, recording: Recording, **asked: float) -> None:
        from companion.estimation.noise.allan import noise_profile

        self.collector = RollingCollector(settings(**asked), [imu("fc", noise_profile(None))])
        self.still_s: dict[int, float] = {}
        self.words: dict[int, str] = {}
        stretches: dict[int, int] = {}
        second = -1
        for sample in recording.samples():
            self.collector.add_imu("fc", sample)
            if math.floor(sample.t_s) == second:
                continue
            # The sample has closed the second before its own.
            second = math.floor(sample.t_s)
            status = self.collector.status(sample.t_s)
            self.still_s[second - 1] = status.still_s
            self.words[second - 1] = status.waiting_for or ""
            windows = self.collector._windows
            assert isinstance(windows, GroundWindows)
            start = windows._stretch.start
            if start is not None:
                stretches[start] = windows.good_slots(None)[-1]
        self.end_s = float(recording.t_s[-1])
        self.stretches = [(start, float(last + 1)) for start, last in stretches.items()]


# ------------------------------------------------------------------------------------------------- imu_tk (Xsens)


def off_gravity(means: Floats, parameters: Floats) -> Floats:
    """|f| - g of raw counts under three offsets, three scales and, where given, three misalignments."""
    force = (means - parameters[:3]) * parameters[3:6]
    if len(parameters) == 9:
        xy, xz, yz = parameters[6:]
        force = force + np.stack([xy * force[:, 1] + xz * force[:, 2], yz * force[:, 2], 0.0 * force[:, 2]], axis=1)
    return np.asarray(np.linalg.norm(force, axis=1) - G_IMU_TK)


def fit(means: Floats, count: int) -> Floats:
    """Gauss-Newton on |f| = g (Tedaldi et al., ICRA 2014), numerical derivatives."""
    middle = (means.max(axis=0) + means.min(axis=0)) / 2.0
    scale = G_IMU_TK / np.linalg.norm(means - middle, axis=1).mean()
    found = np.concatenate([middle, np.full(3, scale), np.zeros(count - 6)])
    for _ in range(20):
        residual = off_gravity(means, found)
        steps = 1e-6 * np.maximum(np.abs(found), 1e-3)
        slopes = [
            (off_gravity(means, found + step * unit) - residual) / step
            for step, unit in zip(steps, np.eye(count), strict=True)
        ]
        found = found - np.linalg.lstsq(np.stack(slopes, axis=1), residual, rcond=None)[0]
    return np.asarray(found)


@pytest.fixture(scope="module")
def xsens() -> tuple[Recording, Played]:
    counts = xsens_counts()
    # Any user's unit conversion: offset and scale, fitted on seconds that a plain threshold calls quiet.
    second = np.floor(counts.t_s).astype(int)
    quiet = [
        counts.accel[second == k].mean(axis=0)
        for k in range(1, second[-1])
        if counts.accel[second == k].std(axis=0).max() < 15.0
    ]
    parameters = fit(np.array(quiet), 6)
    return counts, Played(counts._replace(accel=(counts.accel - parameters[:3]) * parameters[3:6]))


def test_imu_tk_has_its_still_intervals(xsens: tuple[Recording, Played]) -> None:
    stretches = [stretch for stretch in xsens[1].stretches if stretch[1] - stretch[0] >= 2.0]
    assert 38 <= len(stretches) <= 40
    lengths = [end - start for start, end in stretches]
    # An interval of 8 s holds seven whole seconds of the grid, eight with luck.
    assert 7.0 <= float(np.median(lengths)) <= 8.0
    # The documented 50 s of rest come first.
    assert stretches[0][0] <= 1.0
    assert 48.0 <= lengths[0] <= 52.0


def test_imu_tk_intervals_are_really_still(xsens: tuple[Recording, Played]) -> None:
    """A nine-parameter calibration over them leaves |f| at gravity within 0.15 mg rms: no moving second slipped in."""
    counts, played = xsens
    poses = [
        counts.accel[(counts.t_s >= start) & (counts.t_s < end)].mean(axis=0)
        for start, end in played.stretches
        if end - start >= 2.0
    ]
    residual = off_gravity(np.array(poses), fit(np.array(poses), 9))
    assert float(np.sqrt(np.mean(np.square(residual)))) < 0.15 * MG


def stood(xsens: tuple[Recording, Played]) -> list[Face]:
    """The still intervals; a mean is good for its scatter from second to second."""
    counts, played = xsens
    found = []
    for start, end in played.stretches:
        if end - start < 4.0:
            continue
        inside = [
            counts.accel[(counts.t_s >= at) & (counts.t_s < at + 1.0)].mean(axis=0) for at in np.arange(start, end)
        ]
        means = (np.array(inside) - COUNTS[0]) * COUNTS[1]
        found.append((means.mean(axis=0), means.std(axis=0, ddof=1) / math.sqrt(len(means)) + 0.02 * MG))
    return found


COUNTS = (32768.0, 0.0024)
"""The middle of the range and about m/s^2 a count, as the recording's origin says."""


def test_imu_tk_stands_give_what_imu_tks_own_method_gives(xsens: tuple[Recording, Played]) -> None:
    """The triangular matrix of Tedaldi et al. and the symmetric one differ by a rotation, which no length tells."""
    stands = stood(xsens)
    found = faces(stands, G_IMU_TK, 0.0)
    kept = [k for k in range(len(stands)) if k not in found.left_out]
    assert len(kept) >= 34
    theirs = fit(np.array([stands[k][0] for k in kept]), 9)
    xy, xz, yz = theirs[6:]
    triangular = np.array([[1.0, xy, xz], [0.0, 1.0, yz], [0.0, 0.0, 1.0]]) * theirs[3:6]
    sx, sy, sz, shear_xy, shear_xz, shear_yz = found.figures[3:]
    response = np.array([[1 + sx, shear_xy, shear_xz], [shear_xy, 1 + sy, shear_yz], [shear_xz, shear_yz, 1 + sz]])
    np.testing.assert_allclose(np.linalg.inv(response @ response), triangular.T @ triangular, atol=4e-4)
    np.testing.assert_allclose(found.figures[:3] / MG, theirs[:3] / MG, atol=0.5)
    assert found.sigma[:3].max() < 0.3 * MG
    assert float(np.sqrt(np.mean(np.square(found.off_m_s2[kept])))) < 0.15 * MG


# --------------------------------------------------------------------------------------------------- PX4 hardware


@pytest.fixture(scope="module")
def flight_controller() -> tuple[Recording, Played]:
    recording = px4()
    return recording, Played(recording)


def test_px4_handling_is_rejected_and_the_rest_is_not(flight_controller: tuple[Recording, Played]) -> None:
    _, played = flight_controller
    for second in range(2, 7):
        assert played.still_s[second] == 0.0
        assert played.words[second].startswith("hold still: gyro fc ")
    assert played.still_s[67] >= 59.0
    assert [start for start, end in played.stretches if end - start >= 10.0] in ([7], [8])


def test_px4_warm_up_is_flagged_and_the_end_value_is_better_than_the_mean(
    flight_controller: tuple[Recording, Played],
) -> None:
    recording, played = flight_controller
    window = played.collector.window(played.end_s).imus[0]
    drift = next(line for line in window.drifting if line.startswith("warm-up: gyro fc drifts "))
    assert 0.8 <= float(drift.split()[4]) <= 2.4
    rest = recording.t_s >= window_start(played)
    mean = recording.gyro[rest].mean(axis=0)
    last = recording.gyro[recording.t_s > played.end_s - 5.0].mean(axis=0)
    # Over the three axes: one of them has nearly levelled off by the end, where a line does it no good.
    assert np.linalg.norm(np.array(window.gyro_rad_s) - last) < 0.5 * np.linalg.norm(mean - last)


def window_start(played: Played) -> float:
    return played.collector.window(played.end_s).start_s


@pytest.mark.parametrize("until_s", [30.0, 40.0, 50.0])
def test_px4_predicts_the_next_seconds_within_its_sigma(until_s: float) -> None:
    """The estimate at `until_s` predicts the mean of the next 15 s."""
    recording = px4()
    past = recording.t_s < until_s
    played = Played(Recording(recording.t_s[past], recording.gyro[past], recording.accel[past]), horizon_s=15.0)
    window = played.collector.window(until_s).imus[0]
    coming = recording.gyro[(recording.t_s >= until_s) & (recording.t_s < until_s + 15.0)].mean(axis=0)
    miss = np.abs(np.array(window.gyro_rad_s) - coming)
    assert window.warming is not None
    # With the allowance for a warm-up that the window is too short to show, as in every sigma of a record.
    sigma = np.hypot(window.gyro_sigma_use_rad_s, np.sqrt(window.warming.unseen(until_s)[:3]))
    assert (miss < 2.0 * sigma).all()
    # Never worse than the plain mean of the same seconds; better once the window shows the warm-up.
    plain = recording.gyro[(recording.t_s >= 9.0) & past].mean(axis=0)
    assert np.linalg.norm(miss) < (1.02 if until_s == 30.0 else 0.8) * np.linalg.norm(plain - coming)


# ------------------------------------------------------------------------------------------------------------ x-io


def test_xio_rests_are_found_and_handling_is_not() -> None:
    played = Played(xio("fusion_sensor_data.csv.gz"))
    still = {second for start, end in played.stretches for second in range(start, int(end))}
    # The long rests at the end, and nothing of the 12 s to 58 s in which the board is turned by hand.
    assert still >= set(range(106, 113)) | set(range(121, 133))
    assert not still & set(range(12, 58))
    window = played.collector.window(played.end_s).imus[0]
    # A calibrated board: what is left of its bias is small.
    assert max(abs(rate) for rate in window.gyro_rad_s) < 0.05 * math.radians(1.0)


def test_xio_walking_is_never_a_calibration() -> None:
    played = Played(xio("gait_short_walk.csv.gz"))
    # Stance phases last a few tenths of a second: none makes a whole second while walking (15 s to 34 s).
    assert not [start for start, end in played.stretches if end > 15.0 and start < 34.0]
    assert max(played.still_s.values()) < 10.0
    with pytest.raises(CalibrationRefusedError, match="hold still: gyro fc"):
        played.collector.window(played.end_s)
