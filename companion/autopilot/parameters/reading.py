"""Parameters as firmwares ask for them: of an autopilot that answers, or of a log in which they stand."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Final, Literal, Protocol

from companion.errors import AutopilotError
from companion.samples import Vector

FirmwareName = Literal["ardupilot", "px4", "other"]

SCALES: Final = (0.5, 2.0)
"""Accelerometer scales with which a calibration works: it divides by them."""


class Owner(Protocol):
    """An autopilot, or a log of one."""

    @property
    def name(self) -> str:
        """For people."""

    @property
    def firmware(self) -> FirmwareName | None:
        """None: not known yet."""

    @property
    def boots(self) -> int:
        """Starts that have been seen."""

    async def hear_boot_time(self) -> bool:
        """Make sure that `boots` counts every start until now."""


class Parameters(Protocol):
    """Parameters read by name; `ParameterClient` says what they raise."""

    @property
    def vehicle(self) -> Owner:
        """Their owner."""

    async def read(self, name: str) -> float:
        """Read one that must exist."""

    async def read_optional(self, name: str) -> float | None:
        """Read one; None: there is no such parameter."""

    async def read_many(self, names: Iterable[str], *, optional: bool = False) -> dict[str, float]:
        """Read several; where `optional`, what does not exist is left out."""


async def read_vector(
    parameters: Parameters, names: tuple[str, str, str], low: float = -math.inf, high: float = math.inf
) -> Vector:
    """Read three numbers within limits, such as `SCALES`.

    Raises:
        AutopilotError: one is outside; or as `Parameters.read`.
    """
    x, y, z = [await parameters.read(name) for name in names]
    for name, value in zip(names, (x, y, z), strict=True):
        if not math.isfinite(value) or not low <= value <= high:
            raise AutopilotError(f"{name} is {value:.9g}; this cannot be right, calibrate the accelerometers first")
    return x, y, z


async def read_integer(parameters: Parameters, name: str) -> int | None:
    """Read a whole number; None where the firmware has no such parameter.

    Raises:
        AutopilotError: not a number; or as `Parameters.read_optional`.
    """
    value = await parameters.read_optional(name)
    if value is None:
        return None
    if not math.isfinite(value):
        raise AutopilotError(f"{name} is {value}; a whole number was expected")
    return round(value)
