"""Free (unaided) inertial navigation over a flight, and the biases that the flight shows.

The readings, as corrected by the firmware, are integrated once, from the log's beginning. Navigation from a later start
is this result, rotated and shifted: many starts cost no more than one (method.md section 3.7). No other sensor is used.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np

from companion.estimation.records.flight_record import AXES, Drift, Split, Term
from companion.physics.frames import Floats, rotations, running_products
from companion.physics.statistics import student_quantile
from companion.physics.units import DEG, MG

STEP_S: Final = 0.02
"""Length of one integration step, s; coning and sculling within it are integrated."""
GAP_S: Final = 0.25
"""Longest gap in the readings, s, over which free navigation goes on."""
_LARGEST: Final = 1e6
_LAST_S: Final = 1e11  # In microseconds still exact; a simulated PX4 counts from 1970
_LAG_SPAN_S: Final = 0.3
_MOST_LAG_S: Final = 0.1
_OUTLIER: Final = 50.0


class Navigation(NamedTuple):
    """Trajectory from the autopilot's estimator, or the true one of a simulator; the Earth's rate and gravity at it.

    Quaternions (n, 4) rotate body FRD to NED; velocity (n, 3) and position (n, 3) are NED in m/s and m. The Earth's
    rate is zero for an unknown place, and for a simulator whose Earth does not turn.
    """

    t_s: Floats
    attitude: Floats  # (n, 4) quaternions, body FRD to NED
    velocity: Floats
    position: Floats
    gravity_m_s2: float = 9.80665
    earth_rate_ned_rad_s: Floats = np.zeros(3)  # (3,)

    def at(self, t_s: Floats) -> tuple[Floats, Floats, Floats]:
        """Interpolate rotation matrices (m, 3, 3) from body to NED axes, velocities (m, 3) and positions (m, 3)."""
        q = _between(t_s, self.t_s, _one_sign(self.attitude))
        return matrices(q), _between(t_s, self.t_s, self.velocity), _between(t_s, self.t_s, self.position)


def whole(rows: Floats) -> Floats:
    """Select the rows with numbers of a believable size; the first column is a time in s, which may count from 1970."""
    sizes = np.abs(rows)
    return np.asarray(rows[(sizes[:, 0] < _LAST_S) & (sizes[:, 1:] < _LARGEST).all(axis=1)])


def joined(attitude: Floats, moving: Floats) -> Navigation | None:
    """Join rows of time and quaternion (n, 5) with rows of time, velocity and position (m, 7); None: too few rows."""
    attitude, moving = whole(attitude), whole(moving)
    if len(attitude) < 2 or len(moving) < 2:
        return None
    q = attitude[(attitude[:, 0] >= moving[0, 0]) & (attitude[:, 0] <= moving[-1, 0])]
    q = q[np.linalg.norm(q[:, 1:5], axis=1) > 0.5]
    states = _between(q[:, 0], moving[:, 0], moving[:, 1:7])
    return Navigation(q[:, 0], q[:, 1:5], states[:, :3], states[:, 3:]) if len(q) > 1 else None


# --- free inertial navigation


class Increments(NamedTuple):
    """Readings integrated over short steps: angles (n, 3) in rad and velocities (n, 3) in m/s.

    Axes are the body's at the beginning of each step; times are the ends of the steps.
    """

    t_s: Floats  # (n,) the ends
    dt_s: Floats
    angle: Floats  # (n, 3) rad, body axes at the beginning of each
    velocity: Floats  # (n, 3) m/s, body axes at the beginning of each

    def shifted(self, rate_rad_s: Floats, force_m_s2: Floats) -> Increments:
        """Add a rotation rate and a specific force, (3,) or (n, 3) each, to the readings."""
        dt = self.dt_s[:, None]
        turned = rate_rad_s * dt
        # The added rotation changes the axes in which the force was summed up.
        velocity = self.velocity + force_m_s2 * dt + 0.5 * np.cross(turned, self.velocity)
        return self._replace(angle=self.angle + turned, velocity=velocity)

    def nodes(self) -> Floats:
        """Return the start times of the increments, and the end of the last one, (n + 1,)."""
        return np.concatenate([self.t_s - self.dt_s, self.t_s[-1:]])

    def holes_before(self) -> Floats:
        return _cumulative(np.where(self.dt_s > GAP_S, 1.0, 0.0))


def increments(t_s: Floats, readings: Floats, *, means: bool) -> Increments:
    """Integrate readings (n, 6), rad/s and m/s^2; `means`: each is a mean since the one before, not momentary."""
    dt = np.diff(t_s)
    rates = readings[1:] if means else 0.5 * (readings[1:] + readings[:-1])
    grown = rates * dt[:, None]
    bins = np.floor((t_s[1:] - t_s[0]) / STEP_S)
    starts = np.flatnonzero(np.diff(bins, prepend=-1.0))
    counts = np.diff(np.append(starts, len(bins)))

    def before(values: Floats) -> Floats:
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
    rate = solution.earth_rate_ned_rad_s
    if not rate.any():
        return found
    turn, velocity, _ = solution.at(found.t_s - 0.5 * found.dt_s)
    coriolis = np.cross(2.0 * rate, velocity)
    return found.shifted(-np.einsum("nji,j->ni", turn, rate), -np.einsum("nji,nj->ni", turn, coriolis))


def lag_s(found: Increments, solution: Navigation) -> float:
    """Estimate the delay, s, that filters cause in the readings, from the navigation solution's attitude.

    Over a short time, the rotation from delayed readings is wrong by the change of the rate times the delay.
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
        # Ignore resets of the solution's heading: filters do not explain them.
        size = np.linalg.norm(off + found_s * change, axis=1)
        usual = size <= _OUTLIER * max(float(np.median(size)), 1e-9)
    return found_s if abs(found_s) < _MOST_LAG_S else 0.0


def _carry(found: Increments) -> tuple[Floats, Floats, Floats]:
    """Integrate rotation, velocity and position, (n + 1, ...) each, in the body's axes at the log's beginning."""
    turn = np.concatenate([np.eye(3)[None], running_products(rotations(found.angle))])
    added = np.einsum("nij,nj->ni", turn[:-1], found.velocity)
    velocity = _cumulative(added)
    return turn, velocity, _cumulative((velocity[:-1] + 0.5 * added) * found.dt_s[:, None])


def drift(
    found: Increments,
    solution: Navigation,
    within_s: tuple[float, float],
    spans_s: Sequence[float],
    offsets: Mapping[str, tuple[Floats, Floats]],
) -> dict[str, list[Drift]]:
    """Navigate freely from each second of an interval with each set of offsets; compare the ends with the solution.

    Args:
        found: integrated readings, corrected by the firmware, on the solution's clock.
        solution: attitude, velocity and position at each start and end.
        within_s: first start and last end.
        spans_s: lengths of free navigation.
        offsets: change of the output (rad/s, m/s^2) by each set of offsets.

    Returns:
        The drift by set of offsets, over each span without a gap in the readings.
    """
    clean = without_earth(found, solution)
    nodes = found.nodes()
    turn, velocity, position = solution.at(nodes)
    holes = found.holes_before()
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
            off = np.linalg.norm(there - position[j], axis=1)
            rows.append(Drift(span_s, len(off), *np.quantile(off, (0.5, 0.95)).tolist()))
        results[name] = rows
    return results


NO_WINDOWS: Final = np.zeros((0, 7))


def windows(found: Increments, solution: Navigation, within_s: tuple[float, float], length_s: float) -> Floats:
    """Compare the readings with the navigation solution in adjacent windows; leave out windows with gaps in either.

    Returns:
        (n, 7): middle of the window in s; excess of the readings over the solution, by gyro (3, rad/s, axes of the
        body) and by accelerometer along the vertical, as if it were all in body z (m/s^2); vertical components of the
        body's x and y axes, relative to that of z.
    """
    clean = without_earth(found, solution)
    nodes = found.nodes()
    turn, velocity, _ = solution.at(nodes)
    carried, _, _ = _carry(clean)
    # Rotate specific force by the solution's attitude, so that gyro errors do not tilt it.
    added = np.einsum("nj,nj->n", (0.5 * (turn[:-1] + turn[1:]))[:, 2], clean.velocity)
    down = _cumulative(added)
    along = _cumulative(carried[:-1] * found.dt_s[:, None, None])
    vertical = _cumulative(turn[:-1, 2] * found.dt_s[:, None])
    holes = found.holes_before()
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


# --- biases of a flight
#
# Least squares over adjacent windows. The error of a window comes from the solution's errors at its two ends, which the
# next window has with the opposite sign: treated as independent they make sigma too large rather than too small. The
# constants below are errors of the solution that last a whole flight, so no window shows them; every sigma has them.

LENGTH_S: Final = 10.0
SHORT_S: Final = 2.0
"""Length of windows before the motors' start, s: shorter than in flight, because time is short and noise is low."""
_LEAST: Final = 3
_ATTITUDE_RAD: Final = (0.3 * DEG, 0.3 * DEG, 2.0 * DEG)
"""Errors of roll, pitch and heading at one end of a window, for a navigation solution with GNSS and a compass."""
_VELOCITY_M_S: Final = 0.1
_GRAVITY_M_S2: Final = 0.003
"""Error of the vertical force: local against normal gravity, and the accelerometer's scale at 1 g."""
_AT_REST: Final = 0.02
"""Share of the navigation solution's attitude and velocity errors that applies at rest."""
_LEVEL_M_S2: Final = 5.0 * MG
"""Assumed error of the two horizontal accelerometers; a tilt rotates a part of it into the vertical."""
_LEAST_SPREAD: Final = 0.15
"""Least scatter of vibration, as a share of its median, for an estimate of the bias's slope over vibration."""
_LEAST_TREND_S: Final = 60.0


def split(
    before: Floats,
    flight: Floats,
    levels: Floats | None,
    warmth: Sequence[Term | None],
    ekf: Sequence[Term | None],
) -> list[Split]:
    """Split the biases of the gyro's three axes and of the accelerometer's vertical axis into their causes.

    `before` are windows before the motors' start, `flight` those in the air, `levels` (n,) the vibration in the air,
    m/s^2. `warmth` is the part of each bias's step at the motors' start that temperature explains.
    """
    found = []
    for k, axis in enumerate(AXES):
        ground, air = before[:, 1 + k], flight[:, 1 + k]
        end = _ATTITUDE_RAD[k] if k < 3 else _VELOCITY_M_S
        constant = 0.0 if k < 3 else _GRAVITY_M_S2
        aside = 0.0 if k < 3 else _LEVEL_M_S2
        turn_on = _mean(ground, len(before) * SHORT_S, _AT_REST * end, math.hypot(constant, aside * _tilt(before)))
        in_flight = _mean(air, len(flight) * LENGTH_S, end, math.hypot(constant, aside * _tilt(flight)))
        motors = None
        if turn_on is not None and in_flight is not None:
            by_degc = warmth[k] or Term(0.0, 0.0)
            # Errors of gravity and scale are equal before and after the motors' start.
            sigma = np.sqrt(max(turn_on.sigma**2 + in_flight.sigma**2 - 2.0 * constant**2, 0.0) + by_degc.sigma**2)
            motors = Term(in_flight.value - turn_on.value - by_degc.value, float(sigma))
        slope, trend = _slopes(air, flight, levels, end, aside)
        found.append(
            Split(
                axis=axis, in_flight=in_flight, ekf=ekf[k], turn_on=turn_on, temperature=warmth[k] if motors else None,
                motors=motors, vibration=slope, trend=trend,
            )
        )  # fmt: skip
    return found


def _tilt(windows: Floats) -> float:
    return math.sqrt(float(np.square(windows[:, 5:]).sum(axis=1).mean())) if len(windows) else 0.0


def _mean(values: Floats, span_s: float, end: float, constant: float) -> Term | None:
    """Average windows of `span_s` in all; sigma has the solution's errors: `end` at each end, `constant` throughout."""
    if len(values) < _LEAST:
        return None
    freedom = len(values) - 1
    scatter = float(values.std(ddof=1)) / np.sqrt(len(values)) * student_quantile(2.0, freedom) / 2.0
    sigma = np.sqrt(scatter**2 + 2.0 * (end / span_s) ** 2 + constant**2)
    return Term(float(values.mean()), float(sigma))


def _slopes(
    values: Floats, windows: Floats, levels: Floats | None, end: float, aside: float
) -> tuple[Term | None, Term | None]:
    times = windows[:, 0]
    columns = {}
    if len(times) > _LEAST and np.ptp(times) >= _LEAST_TREND_S:
        columns["trend"] = (times - times.mean()) / 60.0
    if levels is not None and len(levels) and levels.std() > _LEAST_SPREAD * abs(np.median(levels)):
        columns["vibration"] = levels - levels.mean()
    freedom = len(values) - 1 - len(columns)
    if not columns or freedom < _LEAST:
        return None, None
    design = np.column_stack([np.ones(len(values)), *columns.values()])
    fit, _, rank, _ = np.linalg.lstsq(design, values, rcond=None)
    if rank < design.shape[1]:
        return None, None
    left = values - design @ fit
    variance = float(left @ left) / freedom * (student_quantile(2.0, freedom) / 2.0) ** 2
    # Wander of the solution itself over minutes, fitted with the same columns.
    wander = math.hypot(end / LENGTH_S / math.sqrt(len(values)), aside * _tilt(windows))
    sigmas = np.sqrt(np.diag(np.linalg.inv(design.T @ design)) * (variance + wander**2))
    terms = {name: Term(float(fit[1 + k]), float(sigmas[1 + k])) for k, name in enumerate(columns)}
    return terms.get("vibration"), terms.get("trend")


# --- rotations and sums


def matrices(q: Floats) -> Floats:
    """Return the rotation matrices (n, 3, 3) of quaternions (n, 4), which may have any length."""
    w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def vectors(turns: Floats) -> Floats:
    """Return the rotation vectors (n, 3), rad, of matrices (n, 3, 3) that rotate by less than 180 degrees."""
    skew = 0.5 * (turns - _transposed(turns))
    sine = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
    size = np.linalg.norm(sine, axis=1)
    angle = np.arctan2(size, 0.5 * (np.trace(turns, axis1=1, axis2=2) - 1.0))
    return np.asarray(sine * np.where(size > 1e-9, angle / np.maximum(size, 1e-12), 1.0)[:, None])


def _transposed(turns: Floats) -> Floats:
    return np.swapaxes(turns, -1, -2)


def _one_sign(q: Floats) -> Floats:
    """Choose the sign of each quaternion (n, 4) that is nearer to the previous row; q and -q are one rotation."""
    if not len(q):
        return q
    flips = np.where(np.einsum("ni,ni->n", q[1:], q[:-1]) < 0.0, -1.0, 1.0)
    return np.asarray(q * np.concatenate([[1.0], np.cumprod(flips)])[:, None])


def _cumulative(values: Floats) -> Floats:
    """Return cumulative sums over rows that begin with zero, one row more than `values`."""
    return np.concatenate([np.zeros_like(values[:1]), np.cumsum(values, axis=0)])


def _between(t_s: Floats, known_s: Floats, values: Floats) -> Floats:
    return np.column_stack([np.interp(t_s, known_s, column) for column in values.T])
