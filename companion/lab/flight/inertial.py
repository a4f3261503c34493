"""The parts of a log that a flight is judged by, whichever firmware wrote it; and free inertial navigation.

Navigation goes by the firmware's corrected readings alone, over pieces of a flight.

Between any two times the readings are integrated once, from the log's beginning; a start somewhere in the flight is
then one turn and one shift of that, so that many starts cost no more than one (method 3.7).
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.autopilot.parameters.change import FirmwareName
from companion.estimation.records.flight_record import Drift
from companion.physics.frames import Floats, rotations, running_products

STEP_S: Final = 0.02
"""Increments are put together to this; coning and sculling within are kept."""
GAP_S: Final = 0.25
"""A longer hole in the readings is flown over by no start."""
_LARGEST: Final = 1e6
_LAG_SPAN_S: Final = 0.3
_MOST_LAG_S: Final = 0.1
_OUTLIER: Final = 50.0


class Navigation(NamedTuple):
    """An estimator's solution, or the truth of a simulator, and the Earth that it is on."""

    t_s: Floats
    attitude: Floats
    """(n, 4) quaternions, body FRD to NED."""
    velocity: Floats
    """(n, 3) m/s, NED."""
    position: Floats
    """(n, 3) m, NED."""
    gravity_m_s2: float = 9.80665
    earth_rate_ned_rad_s: Floats = np.zeros(3)
    """(3,); zero: a simulator without, or a place that is not known."""

    def at(self, t_s: Floats) -> tuple[Floats, Floats, Floats]:
        """Interpolate rotation matrices (m, 3, 3) body to NED, velocities and positions (m, 3)."""
        q = _between(t_s, self.t_s, _one_sign(self.attitude))
        return matrices(q), _between(t_s, self.t_s, self.velocity), _between(t_s, self.t_s, self.position)


def whole(rows: Floats) -> Floats:
    """Leave out rows with values beyond any aircraft."""
    return np.asarray(rows[(np.abs(rows) < _LARGEST).all(axis=1)])


def joined(attitude: Floats, moving: Floats) -> Navigation | None:
    """Join quaternions (n, 1 + 4) with velocities and positions (m, 1 + 6) by time; None: too few."""
    attitude, moving = whole(attitude), whole(moving)
    if len(attitude) < 2 or len(moving) < 2:
        return None
    q = attitude[(attitude[:, 0] >= moving[0, 0]) & (attitude[:, 0] <= moving[-1, 0])]
    q = q[np.linalg.norm(q[:, 1:5], axis=1) > 0.5]
    states = _between(q[:, 0], moving[:, 0], moving[:, 1:7])
    return Navigation(q[:, 0], q[:, 1:5], states[:, :3], states[:, 3:]) if len(q) > 1 else None


class FlownImu(msgspec.Struct, frozen=True, kw_only=True):
    """One IMU in one log."""

    number: int
    """Number from 1, as in the configuration."""
    t_s: Floats
    readings: Floats
    """(n, 6) rad/s and m/s^2, corrected by the firmware, vehicle FRD."""
    means: bool
    """Each is the mean since the one before, not an instant."""
    gyro_id: int | None = None
    accel_id: int | None = None
    degc: Floats = np.zeros((0, 2))
    """Time and temperature."""
    vibration: Floats = np.zeros((0, 2))
    """Time and level, m/s^2."""
    estimated: Floats | None = None
    """Biases of an EKF, (n, 9): time in s, of the gyro's axes (rad/s) and the accelerometer's z (m/s^2), sigma of each.

    NaN where it says nothing.
    """
    failed_s: Floats = np.zeros(0)
    """Times at which the autopilot took it for failed; its readings then are left out."""

    @property
    def rate_hz(self) -> float:
        """Mean rate of the readings."""
        return (len(self.t_s) - 1) / float(self.t_s[-1] - self.t_s[0]) if len(self.t_s) > 1 else 0.0


class Boot(msgspec.Struct, frozen=True, kw_only=True):
    """Log of one start of the autopilot, whichever firmware wrote it; times in s on its clock."""

    firmware: FirmwareName
    imus: tuple[FlownImu, ...]
    solution: Navigation | None
    truth: Navigation | None = None
    """Truth of a simulator."""
    armed: tuple[tuple[float, bool], ...] = ()
    motors: tuple[tuple[float, bool], ...] = ()
    airborne: tuple[tuple[float, bool], ...] = ()
    parameters: tuple[tuple[float, str, float], ...] = ()
    unix_offset_s: float | None = None
    """UTC less its clock."""
    place: tuple[float, float] | None = None
    """Latitude in degrees, and height in m."""
    earth_turns: bool = True
    standard_gravity: bool = False
    notes: tuple[str, ...] = ()

    def parameters_at(self, t_s: float) -> dict[str, float]:
        """Return the parameters at a time; one that was logged only later has its first value."""
        found: dict[str, float] = {}
        for told_s, name, value in self.parameters:
            if told_s <= t_s or name not in found:
                found[name] = value
        return found


def changes(t_s: Sequence[float] | Floats, states: Sequence[bool] | NDArray[Any]) -> tuple[tuple[float, bool], ...]:
    """List the first state and each change after it."""
    found: list[tuple[float, bool]] = []
    for at_s, state in zip(t_s, states, strict=True):
        if not found or found[-1][1] != bool(state):
            found.append((float(at_s), bool(state)))
    return tuple(found)


# --- free inertial navigation


class Increments(NamedTuple):
    """Angles and velocities that the sensors have integrated, sample by sample."""

    t_s: Floats
    """(n,) the ends."""
    dt_s: Floats
    angle: Floats
    """(n, 3) rad, body axes at the beginning of each."""
    velocity: Floats
    """(n, 3) m/s, likewise."""

    def shifted(self, rate_rad_s: Floats, force_m_s2: Floats) -> Increments:
        """With so much more in the output, (3,) or (n, 3)."""
        dt = self.dt_s[:, None]
        turned = rate_rad_s * dt
        # What turns more has its force summed up in other axes.
        velocity = self.velocity + force_m_s2 * dt + 0.5 * np.cross(turned, self.velocity)
        return self._replace(angle=self.angle + turned, velocity=velocity)


def increments(t_s: Floats, readings: Floats, *, means: bool) -> Increments:
    """Integrate readings (n, 6), rad/s and m/s^2: means since the one before, or instants joined by lines."""
    dt = np.diff(t_s)
    rates = readings[1:] if means else 0.5 * (readings[1:] + readings[:-1])
    grown = rates * dt[:, None]
    bins = np.floor((t_s[1:] - t_s[0]) / STEP_S)
    starts = np.flatnonzero(np.diff(bins, prepend=-1.0))
    counts = np.diff(np.append(starts, len(bins)))

    def before(values: Floats) -> Floats:
        """Sum what a bin has before each of its samples."""
        sums = np.cumsum(values, axis=0) - values
        return np.asarray(sums - np.repeat(sums[starts], counts, axis=0))

    alpha, nu = grown[:, :3], grown[:, 3:]
    turned = before(alpha)
    coned = alpha + 0.5 * np.cross(turned, alpha)
    sculled = nu + np.cross(turned + 0.5 * alpha, nu)
    ends = starts + counts - 1
    return Increments(
        t_s[1:][ends],
        np.add.reduceat(dt, starts),
        np.add.reduceat(coned, starts, axis=0),
        np.add.reduceat(sculled, starts, axis=0),
    )


def without_earth(found: Increments, solution: Navigation) -> Increments:
    """Without what the Earth's turning adds: seen from the ground."""
    rate = solution.earth_rate_ned_rad_s
    if not rate.any():
        return found
    turn, velocity, _ = solution.at(found.t_s - 0.5 * found.dt_s)
    coriolis = np.cross(2.0 * rate, velocity)
    return found.shifted(-np.einsum("nji,j->ni", turn, rate), -np.einsum("nji,nj->ni", turn, coriolis))


def lag_s(found: Increments, solution: Navigation) -> float:
    """Estimate by how much filters delay the readings against the solution's attitude.

    Over a short while readings that are late have turned by less than the solution has, by the rate at its end less
    that at its beginning, times the delay.
    """
    span = max(round(_LAG_SPAN_S / float(np.median(found.dt_s))), 1)
    rate = found.angle / found.dt_s[:, None]
    holes = np.cumsum(found.dt_s > GAP_S)
    k = np.arange(1, len(found.t_s) - span, span)
    k = k[holes[k + span] == holes[k]]
    if len(k) < 2:
        return 0.0
    turn, _, _ = solution.at(found.t_s)
    carried = running_products(rotations(found.angle))
    off = vectors(_transposed(turn[k + span]) @ turn[k] @ _transposed(carried[k]) @ carried[k + span])
    change = 0.5 * (rate[k + span] + rate[k + span - 1] - rate[k] - rate[k - 1])
    found_s, usual = 0.0, np.ones(len(k), dtype=bool)
    for _ in range(2):
        by_off, by_change = off[usual] - off[usual].mean(axis=0), change[usual] - change[usual].mean(axis=0)
        power = float(np.square(by_change).sum())
        found_s = -float((by_off * by_change).sum()) / power if power > 0.0 else 0.0
        # Where the solution found its heading anew, no filter is to blame.
        size = np.linalg.norm(off + found_s * change, axis=1)
        usual = size <= _OUTLIER * max(float(np.median(size)), 1e-9)
    return found_s if abs(found_s) < _MOST_LAG_S else 0.0


def _carry(found: Increments) -> tuple[Floats, Floats, Floats]:
    """Integrate turn, velocity and position in the axes of the body at the log's beginning.

    Each is (n + 1, ...), before the first increment and after each.
    """
    turn = np.concatenate([np.eye(3)[None], running_products(rotations(found.angle))])
    added = np.einsum("nij,nj->ni", turn[:-1], found.velocity)
    velocity = np.concatenate([np.zeros((1, 3)), np.cumsum(added, axis=0)])
    moved = (velocity[:-1] + 0.5 * added) * found.dt_s[:, None]
    return turn, velocity, np.concatenate([np.zeros((1, 3)), np.cumsum(moved, axis=0)])


def drift(
    found: Increments,
    solution: Navigation,
    within_s: tuple[float, float],
    spans_s: Sequence[float],
    offsets: Mapping[str, tuple[Floats, Floats]],
) -> dict[str, list[Drift]]:
    """Navigate freely from a start each second within a time, by each set of offsets.

    Args:
        found: readings, corrected by the firmware, on the solution's clock.
        solution: where each start begins, and what its end is compared with.
        within_s: first start and last end.
        spans_s: how long each is without aid.
        offsets: by name, what the output has more with those offsets, rad/s and m/s^2.

    Returns:
        By name, one of each span that fits in without a gap in the readings.
    """
    clean = without_earth(found, solution)
    # A node is the beginning of an increment; the last one ends the last of them.
    nodes = np.concatenate([found.t_s - found.dt_s, found.t_s[-1:]])
    turn, velocity, position = solution.at(nodes)
    holes = np.concatenate([[0], np.cumsum(found.dt_s > GAP_S)])
    known = np.searchsorted(solution.t_s, nodes)
    stale = np.diff(solution.t_s, prepend=-np.inf, append=np.inf)[known] > 2.0
    first, last = max(within_s[0], float(nodes[0])), min(within_s[1], float(nodes[-1]))
    results: dict[str, list[Drift]] = {}
    for name, (gyro, accel) in offsets.items():
        turned, gained, moved = _carry(clean.shifted(gyro, accel))
        rows = []
        for span_s in spans_s:
            k = np.searchsorted(nodes, np.arange(first, last - span_s + 1e-9))
            j = np.minimum(np.searchsorted(nodes, nodes[k] + span_s), len(nodes) - 1)
            good = (holes[j] == holes[k]) & ~stale[k] & ~stale[j] & (j > k)
            k, j = k[good], j[good]
            if not len(k):
                continue
            t = (nodes[j] - nodes[k])[:, None]
            back = turn[k] @ _transposed(turned[k])
            inertial = moved[j] - moved[k] - gained[k] * t
            there = position[k] + velocity[k] * t + np.einsum("nij,nj->ni", back, inertial)
            there += [0.0, 0.0, 0.5 * solution.gravity_m_s2] * t**2
            off = np.sort(np.linalg.norm(there - position[j], axis=1))
            rows.append(Drift(span_s, len(off), float(_at(off, 0.5)), float(_at(off, 0.95))))
        results[name] = rows
    return results


NO_WINDOWS: Final = np.zeros((0, 7))


def windows(found: Increments, solution: Navigation, within_s: tuple[float, float], length_s: float) -> Floats:
    """Compare the readings with the solution in windows side by side; leave out those with holes in either.

    Returns:
        (n, 7): middle of the window in s; excess of the readings over the solution, by gyro (3, rad/s, axes of the
        body) and by accelerometer along the vertical, counted along body z (m/s^2); share of x and of y that lies along
        the vertical, for one of z.
    """
    clean = without_earth(found, solution)
    nodes = np.concatenate([found.t_s - found.dt_s, found.t_s[-1:]])
    turn, velocity, _ = solution.at(nodes)
    carried, _, _ = _carry(clean)
    # The solution's attitude turns specific force, so that what the gyros have wrong does not tilt it.
    added = np.einsum("nj,nj->n", (0.5 * (turn[:-1] + turn[1:]))[:, 2], clean.velocity)
    down = np.concatenate([[0.0], np.cumsum(added)])
    along = np.concatenate([np.zeros((1, 3, 3)), np.cumsum(carried[:-1] * found.dt_s[:, None, None], axis=0)])
    vertical = np.concatenate([np.zeros((1, 3)), np.cumsum(turn[:-1, 2] * found.dt_s[:, None], axis=0)])
    holes = np.concatenate([[0], np.cumsum(found.dt_s > GAP_S)])
    edges = np.arange(max(within_s[0], float(nodes[0])), min(within_s[1], float(nodes[-1])) + 1e-9, length_s)
    at = np.searchsorted(nodes, edges)
    at = at[at < len(nodes)]
    rows = []
    for k, j in itertools.pairwise(at):
        inside = np.searchsorted(solution.t_s, nodes[[k, j]])
        t = float(nodes[j] - nodes[k])
        x, y, level = (vertical[j] - vertical[k]) / max(t, 1e-9)
        if holes[j] != holes[k] or inside[1] - inside[0] < length_s or t <= 0.0 or abs(level) < 0.5:
            continue
        turned = carried[k].T @ carried[j]
        off = vectors((turn[j].T @ turn[k] @ turned)[None])[0]
        gyro = np.linalg.solve(carried[j].T @ (along[j] - along[k]), off)
        more = (down[j] - down[k] + solution.gravity_m_s2 * t - (velocity[j] - velocity[k])[2]) / t
        rows.append([0.5 * (nodes[k] + nodes[j]), *gyro, more / level, x / level, y / level])
    return np.array(rows).reshape(-1, 7)


def matrices(q: Floats) -> Floats:
    """(n, 3, 3) of quaternions (n, 4) of any length."""
    w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def vectors(turns: Floats) -> Floats:
    """(n, 3) rotation vectors of matrices (n, 3, 3) that turn by less than half a circle."""
    skew = 0.5 * (turns - _transposed(turns))
    sine = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
    size = np.linalg.norm(sine, axis=1)
    angle = np.arctan2(size, 0.5 * (np.trace(turns, axis1=1, axis2=2) - 1.0))
    return np.asarray(sine * np.where(size > 1e-9, angle / np.maximum(size, 1e-12), 1.0)[:, None])


def _transposed(turns: Floats) -> Floats:
    return np.swapaxes(turns, -1, -2)


def _one_sign(q: Floats) -> Floats:
    """Choose of q and -q, which are the same, the one next to the one before."""
    if not len(q):
        return q
    flips = np.where(np.einsum("ni,ni->n", q[1:], q[:-1]) < 0.0, -1.0, 1.0)
    return np.asarray(q * np.concatenate([[1.0], np.cumprod(flips)])[:, None])


def _between(t_s: Floats, known_s: Floats, values: Floats) -> Floats:
    return np.column_stack([np.interp(t_s, known_s, column) for column in values.T])


def _at(ascending: Floats, share: float) -> float:
    return float(ascending[min(int(share * len(ascending)), len(ascending) - 1)])
