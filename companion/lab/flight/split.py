"""Biases in flight, split into turn-on bias, step at the motors' start, vibration and trend.

By least squares over windows side by side. What a window is off by comes from the solution's own errors at its two
ends, which the next window has with the other sign: taken as independent they make sigma rather too large. What the
solution can be wrong in for a whole flight without any window showing it stands below, and is in every sigma.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from companion.estimation.records.flight_record import AXES, Split, Term
from companion.physics.frames import Floats
from companion.physics.statistics import student_quantile
from companion.physics.units import DEG, MG

LENGTH_S: Final = 10.0
SHORT_S: Final = 2.0
"""Before the motors, where there is little time and little noise."""
_LEAST: Final = 3
_ATTITUDE_RAD: Final = (0.3 * DEG, 0.3 * DEG, 2.0 * DEG)
"""Error of tilt and heading at one end of a stretch, for a solution with GNSS and a compass."""
_VELOCITY_M_S: Final = 0.1
_GRAVITY_M_S2: Final = 0.003
"""Gravity where it flies against the normal one, and the accelerometer's scale at one g."""
_AT_REST: Final = 0.02
"""Share of both errors while it stands."""
_LEVEL_M_S2: Final = 5.0 * MG
"""Error of the other two accelerometers, which a tilt turns into the vertical."""
_LEAST_SPREAD: Final = 0.15
"""Share of its mean by which vibration has to vary for a slope."""
_LEAST_TREND_S: Final = 60.0


def split(
    before: Floats,
    flight: Floats,
    levels: Floats | None,
    warmth: Sequence[Term | None],
    ekf: Sequence[Term | None],
) -> list[Split]:
    """Split the gyro's three axes and the accelerometer's vertical one.

    Args:
        before: windows before the motors, as `inertial.windows` gives them.
        flight: windows in the air.
        levels: (n,) vibration in each of those, m/s^2; None: not known.
        warmth: by axis, what temperature explains of the step at the motors' start; None: not known.
        ekf: by axis.
    """
    found = []
    for k, axis in enumerate(AXES):
        ground, air = before[:, 1 + k], flight[:, 1 + k]
        end = _ATTITUDE_RAD[k] if k < 3 else _VELOCITY_M_S
        constant = 0.0 if k < 3 else _GRAVITY_M_S2
        aside = 0.0 if k < 3 else _LEVEL_M_S2
        turn_on = _mean(ground, len(before) * SHORT_S, _AT_REST * end, math.hypot(constant, aside * _tilt(before)))
        in_flight = _mean(air, len(flight) * LENGTH_S, end, math.hypot(constant, aside * _tilt(flight)))
        of_degc = warmth[k]
        motors = None
        if turn_on is not None and in_flight is not None:
            by_degc = of_degc or Term(0.0, 0.0)
            # Gravity and scale are the same before and after.
            sigma = np.sqrt(max(turn_on.sigma**2 + in_flight.sigma**2 - 2.0 * constant**2, 0.0) + by_degc.sigma**2)
            motors = Term(in_flight.value - turn_on.value - by_degc.value, float(sigma))
        slope, trend = _slopes(air, flight, levels, end, aside)
        found.append(
            Split(
                axis=axis, in_flight=in_flight, ekf=ekf[k], turn_on=turn_on, temperature=of_degc if motors else None,
                motors=motors, vibration=slope, trend=trend,
            )
        )  # fmt: skip
    return found


def _tilt(windows: Floats) -> float:
    """Root mean square of how x and y lie along the vertical."""
    return math.sqrt(float(np.square(windows[:, 5:]).sum(axis=1).mean())) if len(windows) else 0.0


def _mean(values: Floats, span_s: float, end: float, constant: float) -> Term | None:
    """Average windows; `end`: error of the solution at either end of them all; `constant`: its constant error."""
    if len(values) < _LEAST:
        return None
    freedom = len(values) - 1
    scatter = float(values.std(ddof=1)) / np.sqrt(len(values)) * student_quantile(2.0, freedom) / 2.0
    sigma = np.sqrt(scatter**2 + 2.0 * (end / span_s) ** 2 + constant**2)
    return Term(float(values.mean()), float(sigma))


def _slopes(
    values: Floats, windows: Floats, levels: Floats | None, end: float, aside: float
) -> tuple[Term | None, Term | None]:
    """Fit slopes against vibration and time; each only where the flight has enough of it."""
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
    # The solution's own wandering over minutes, by the same columns.
    wander = math.hypot(end / LENGTH_S / math.sqrt(len(values)), aside * _tilt(windows))
    sigmas = np.sqrt(np.diag(np.linalg.inv(design.T @ design)) * (variance + wander**2))
    terms = {name: Term(float(fit[1 + k]), float(sigmas[1 + k])) for k, name in enumerate(columns)}
    return terms.get("vibration"), terms.get("trend")
