"""What all parts of an IMU model show, for aircraft that do not know their own yet."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import msgspec
import numpy as np
import sqlalchemy as sa

from companion.calibration.solution.model_prior import LEAST_PARTS, ModelPrior, TriadPrior, check
from companion.fleet.models import MAD_TO_SIGMA, Scatter, middle_of, scatter_of_model
from companion.fleet.schema import parts
from companion.physics.frames import Floats
from companion.samples import Vector

MOST_PARTS: Final = 300
"""Of a model, that are asked."""
_ALIKE: Final = 0.05
"""The least share by which parts are said to differ."""
_DIGITS: Final = 3
_TRIADS: Final = (slice(0, 3), slice(3, 6))

Part = tuple[str, str]
"""Its aircraft, and what it is called there."""


def models(connection: sa.Connection) -> dict[str, int]:
    """How many parts of each there are."""
    one = sa.and_(parts.c.model.is_not(None), parts.c.triad == "gyro", parts.c.axis == "x")
    query = sa.select(parts.c.model, sa.func.count()).where(one).group_by(parts.c.model).order_by(parts.c.model)
    return {row[0]: row[1] for row in connection.execute(query)}


def parts_of(connection: sa.Connection, model: str, *, but: str = "") -> dict[Part, Scatter]:
    """How each scatters, of those that are in aircraft now; `but` in this one."""
    query = sa.select(parts).where(parts.c.model == model, parts.c.aircraft != but)
    found: dict[Part, Scatter] = {}
    for row in connection.execute(query.order_by(parts.c.aircraft, parts.c.imu).limit(6 * MOST_PARTS)):
        one = found.setdefault((row.aircraft, row.imu), Scatter(row.power_ups, 1, *np.full((3, 6), np.nan)))
        place = "xyz".index(row.axis) + 3 * (row.triad == "accel")
        for name in ("turn_on", "wander", "per_k"):
            getattr(one, name)[place] = np.nan if (value := getattr(row, name)) is None else value
    return found


def payloads(connection: sa.Connection) -> dict[str, bytes]:
    """By topic, what aircraft are told of each model of which enough is known (docs/fleet/asyncapi.yaml)."""
    found = (model_prior(model, list(parts_of(connection, model).values())) for model in models(connection))
    return {f"fleet/priors/{one.model}": msgspec.json.encode(one) for one in found if one is not None}


def model_prior(model: str, of_model: Sequence[Scatter]) -> ModelPrior | None:
    """What new aircraft are told; None: too few parts tell, or they tell what no part can."""
    telling = [part for part in of_model if np.isfinite(part.turn_on).any()]
    usual = scatter_of_model(telling)
    if usual is None or len(telling) < LEAST_PARTS:
        return None
    turn_on, per_k = (np.array([getattr(part, name) for part in telling]) for name in ("turn_on", "per_k"))
    slope = np.array([middle_of(column, LEAST_PARTS) for column in per_k.T])
    differ = np.maximum(_spread(turn_on, usual.turn_on), _ALIKE * usual.turn_on)
    spread = _spread(per_k, slope)
    gyro, accel = (_of_triad(*(each[at] for each in (usual.turn_on, differ, slope, spread))) for at in _TRIADS)
    prior = ModelPrior(model=model, parts=len(telling), turn_ons=usual.power_ups, gyro_rad_s=gyro, accel_m_s2=accel)
    try:
        check(prior)
    except msgspec.ValidationError:
        return None
    return prior


def _spread(values: Floats, about: Floats) -> Floats:
    """By how much parts differ, one sigma by the median, of each column."""
    return MAD_TO_SIGMA * np.array([middle_of(off, LEAST_PARTS) for off in np.abs(values - about).T])


def _of_triad(*figures: Floats) -> TriadPrior | None:
    """In as many digits as are worth telling; None: how it scatters is not known, without a slope where that is not."""
    scatter, sigma, per_k, spread = (_vector(each) if np.isfinite(each).all() else None for each in figures)
    if scatter is None or sigma is None:
        return None
    return TriadPrior(scatter, sigma, *((None, None) if None in (per_k, spread) else (per_k, spread)))


def _vector(values: Floats) -> Vector:
    x, y, z = (float(f"{value:.{_DIGITS}g}") for value in values)
    return x, y, z
