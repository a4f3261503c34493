"""Tilt compensation and the bound on a real magnetometer with an optical reference (BROAD, Berlin, indoors).

Its reference heading is tied to its magnetometer and a building bends the field, so that WMM2025 is no measure here:
the undisturbed trial is.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from companion.estimation.means.pose import FieldWindow, HeadingWindow
from companion.estimation.solution.magnetic import CompassHeading, assess
from companion.estimation.solution.site import LocalEarth, Whereabouts, local_earth
from companion.physics.earth import MagneticField
from companion.physics.magnetic import heading_rad, inclination_rad
from companion.physics.units import DEG
from tests.support.magnetic import compass
from tests.support.recordings import shared

Floats = NDArray[np.float64]
GAUSS_PER_UT = 0.01
UNDISTURBED = "02_undisturbed_slow_rotation_B"


class Trial(NamedTuple):
    """(n, 3) gauss and m/s^2 in the sensor's axes, (n, 3, 3) sensor to ENU (NaN where unseen), (n,) moving."""

    field: Floats
    accel: Floats
    enu: Floats
    moving: NDArray[np.bool_]

    def rest(self, *, first: bool) -> tuple[Floats, Floats, Floats]:
        """Mean field, its standard error, and up, of the rest before or after the motion."""
        moving = np.flatnonzero(self.moving)
        part = slice(0, moving[0] - 1000) if first else slice(moving[-1] + 1000, None)
        field, accel = self.field[part], self.accel[part].mean(axis=0)
        return field.mean(axis=0), field.std(axis=0) / np.sqrt(len(field)), accel / np.linalg.norm(accel)


def trial(name: str) -> Trial:
    path = shared(f"broad/{name}.hdf5")
    h5py: Any = pytest.importorskip("h5py", reason="h5py is not installed")
    with h5py.File(path) as file:
        field, accel, quaternion = file["imu_mag"][:], file["imu_acc"][:], file["opt_quat"][:]
        moving = file["movement"][:]
    w, x, y, z = quaternion.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return Trial(field * GAUSS_PER_UT, accel, np.moveaxis(np.array(rows), -1, 0), moving)


def test_headings_follow_the_optical_ones_at_every_tilt() -> None:
    seen = trial(UNDISTURBED)
    chosen = [k for k in range(0, len(seen.enu), 20) if np.isfinite(seen.enu[k]).all() and seen.moving[k]]
    errors, tilts = [], []
    for k in chosen:
        forward, up = seen.enu[k][:, 0], seen.enu[k][2]
        if abs(forward[2]) > 0.9:
            continue
        errors.append(heading_rad(seen.field[k], up) - np.arctan2(forward[0], forward[1]))
        tilts.append(np.arccos(up[2]) / DEG)
    off = np.angle(np.exp(1j * np.array(errors))) / DEG
    off = off - np.median(off)
    assert len(off) > 1000
    assert np.max(tilts) > 60.0
    # The magnetometer is as it came: 3.3 degrees rms over all poses; uncompensated headings are off by tens.
    assert np.sqrt(np.mean(off**2)) < 4.0


def undisturbed() -> LocalEarth:
    """Field at the place of the trials, from the first rest of the undisturbed one."""
    field, _, up = trial(UNDISTURBED).rest(first=True)
    found = MagneticField(
        0.0, inclination_rad(field, up) / DEG, float(np.linalg.norm(field)), 0.0, 0.2, 138e-5, compass_use="good"
    )
    known = local_earth(Whereabouts(latitude_deg=52.51, longitude_deg=13.32, height_m=35.0, source="test"))
    return LocalEarth(
        known.site,
        known.gravity_m_s2,
        known.gravity_sigma_m_s2,
        known.rate_ned_rad_s,
        known.rate_ned_covariance,
        0.0,
        0.0,
        (),
        found,
    )


FLIPPED = np.array([1.0, -1.0, -1.0])
"""The trial's axes (z up) to forward, right, down: half a turn about the first."""


def assessed(where: LocalEarth, field: Floats, sigma: Floats, up: Floats) -> CompassHeading:
    (x, y, z), (sx, sy, sz) = (field * FLIPPED).tolist(), sigma.tolist()
    return assess(
        HeadingWindow(heading_deg=0.0, sigma_deg=0.0, from_field=True),
        FieldWindow(field=(x, y, z), sigma=(sx, sy, sz), unit="gauss"),
        compass(),
        where,
        up * FLIPPED,
        np.eye(3) * (0.05 * DEG) ** 2,
    )


def test_the_bound_covers_magnets_beside_the_real_magnetometer() -> None:
    where, random = undisturbed(), np.random.default_rng(1)
    field, sigma, up = trial(UNDISTURBED).rest(first=False)
    clean = heading_rad(field * FLIPPED, up * FLIPPED)
    covered = []
    for _ in range(500):
        magnet = random.standard_normal(3)
        magnet *= random.uniform(0.0, 0.05) * np.linalg.norm(field) / np.linalg.norm(magnet)
        bound = assessed(where, field + magnet, sigma, up).magnetic.heading_bound_deg
        assert bound is not None
        turned = heading_rad((field + magnet) * FLIPPED, up * FLIPPED) - clean
        covered.append(abs(np.angle(np.exp(1j * turned))) / DEG <= bound)
    assert np.mean(covered) >= 0.95


def test_an_undisturbed_field_leaves_a_narrow_bound_and_no_warning() -> None:
    field, sigma, up = trial(UNDISTURBED).rest(first=False)
    found = assessed(undisturbed(), field, sigma, up)
    assert found.magnetic.heading_bound_deg is not None
    assert found.magnetic.heading_bound_deg < 4.0
    assert not any("move away from iron" in words for words in found.warnings)
