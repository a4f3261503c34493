"""Parameters read as what they are: vectors of offsets, of scales, whole numbers."""

from __future__ import annotations

import math

from companion.autopilot.parameters.client import ParameterClient
from companion.errors import AutopilotError
from companion.samples import Vector


async def read_offsets(parameters: ParameterClient, names: tuple[str, str, str]) -> Vector:
    """Three offsets; any finite ones will do, for they are only added to."""
    return await _read_vector(parameters, names, -math.inf, math.inf)


async def read_scales(parameters: ParameterClient, names: tuple[str, str, str]) -> Vector:
    """Three scales, which will be divided by."""
    return await _read_vector(parameters, names, 0.5, 2.0)


async def read_integer(parameters: ParameterClient, name: str) -> int | None:
    """A whole number, or None where the firmware has no such parameter."""
    value = await parameters.read_optional(name)
    if value is None:
        return None
    if not math.isfinite(value):
        raise AutopilotError(f"{name} is {value}; a whole number was expected")
    return round(value)


async def _read_vector(parameters: ParameterClient, names: tuple[str, str, str], low: float, high: float) -> Vector:
    x, y, z = [await parameters.read(name) for name in names]
    for name, value in zip(names, (x, y, z), strict=True):
        if not math.isfinite(value) or not low <= value <= high:
            raise AutopilotError(f"{name} is {value:.9g}; this cannot be right, calibrate the accelerometers first")
    return x, y, z
