"""A regular wave is named, a hand is not: the simulator's sea and handling, and recordings of people."""

from __future__ import annotations

import numpy as np
import pytest

from companion.estimation.collector.outlook import WATCHED_S, is_wave
from companion.estimation.seconds.batch import summary
from sim.aircraft import Pose, Site, VirtualAircraft
from sim.earth import Array
from sim.motions import Handling, Motion
from sim.sea import SWELL, Sea, Wave
from tests.support.recordings import shared, xsens_counts

RATE_HZ = 20


def hints(times: Array, rates: Array, lost: int | None = None) -> list[bool]:
    """Of every second from `WATCHED_S` on but the lost one, whether it hints."""
    batches, found = {}, []
    slots = np.floor(times).astype(int)
    for slot in range(int(slots[-1])):
        here = slots == slot
        if not here.any() or slot == lost:
            continue
        batches[slot] = summary(slot, times[here], np.hstack([rates[here], np.zeros((here.sum(), 3))]))
        if slot >= WATCHED_S:
            found.append(is_wave(batches))
    return found


def share(motions: list[Motion], seconds: int, lost: int | None = None) -> float:
    aircraft = VirtualAircraft(Pose(2.0, 1.0, 30.0), Site(latitude_deg=45.0), motions=motions)
    times = (np.arange(seconds * RATE_HZ) + 0.5) / RATE_HZ
    return float(np.mean(hints(times, aircraft.truth(times)[0], lost)))


@pytest.mark.parametrize(
    "waves", [SWELL, (Wave(0.3, 2.0),), (Wave(0.15, 2.0),), (Wave(0.07, 2.0),), (Wave(0.25, 0.3),)]
)
def test_waves_are_named(waves: tuple[Wave, ...]) -> None:
    assert np.mean([share([Sea(start_s=-30.0, waves=waves, seed=seed)], 90) for seed in range(4)]) > 0.8


def test_a_wave_stays_one_when_a_second_is_lost() -> None:
    assert np.mean([share([Sea(start_s=-30.0, seed=seed)], 90, lost=60) for seed in range(4)]) > 0.8


def test_hands_are_hardly_ever_taken_for_waves() -> None:
    assert np.mean([share([Handling(start_s=0.0, duration_s=100.0, seed=seed)], 100) for seed in range(12)]) < 0.15


def test_a_person_who_turns_a_sensor_slowly_is_no_wave() -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(shared("broad/02_undisturbed_slow_rotation_B.hdf5")) as file:
        rates = np.asarray(file["imu_gyr"])
    assert not any(hints(np.arange(len(rates)) / (2000.0 / 7.0), rates))


def test_a_person_who_lays_a_sensor_on_all_its_sides_is_no_wave() -> None:
    recording = xsens_counts()
    assert not any(hints(recording.t_s - recording.t_s[0], recording.gyro))
