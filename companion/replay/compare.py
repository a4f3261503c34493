"""Two records field by field, to the last bit."""

from __future__ import annotations

from typing import Any

import msgspec

from companion.calibration.solution.record import Record

_SIGMAS = {
    "gyro_bias_rad_s": "gyro_sigma_use_rad_s",
    "residual_gyro_rad_s": "gyro_sigma_use_rad_s",
    "accel_bias_m_s2": "accel_sigma_use_m_s2",
    "residual_accel_m_s2": "accel_sigma_use_m_s2",
}


class Difference(msgspec.Struct, frozen=True):
    """One field that is not the same."""

    field: str
    """Such as imus[fc].gyro_bias_rad_s[0]."""
    recorded: Any
    replayed: Any
    sigmas: float | None
    """By how many sigma_use a bias differs; None for anything else."""

    def __str__(self) -> str:
        size = "" if self.sigmas is None else f" ({self.sigmas:.2g} sigma)"
        return f"{self.field}: recorded {self.recorded!r}, replayed {self.replayed!r}{size}"


def differences(recorded: Record, replayed: Record) -> list[Difference]:
    """Every field in which they differ, even by the last bit."""
    found: list[Difference] = []
    _compare("", msgspec.to_builtins(recorded), msgspec.to_builtins(replayed), None, found)
    return found


def _compare(path: str, recorded: Any, replayed: Any, sigma: Any, found: list[Difference]) -> None:
    if isinstance(recorded, dict) and isinstance(replayed, dict):
        for key in {**recorded, **replayed}:
            inner = recorded.get(_SIGMAS.get(key, ""))
            _compare(f"{path}.{key}" if path else key, recorded.get(key), replayed.get(key), inner, found)
    elif isinstance(recorded, list | tuple) and isinstance(replayed, list | tuple) and len(recorded) == len(replayed):
        for index, (one, other) in enumerate(zip(recorded, replayed, strict=True)):
            name = one.get("name", index) if isinstance(one, dict) else index
            inner = sigma[index] if isinstance(sigma, list | tuple) and index < len(sigma) else None
            _compare(f"{path}[{name}]", one, other, inner, found)
    elif recorded != replayed:
        sigmas = None
        if isinstance(sigma, float) and sigma > 0.0 and isinstance(recorded, float) and isinstance(replayed, float):
            sigmas = abs(replayed - recorded) / sigma
        found.append(Difference(path, recorded, replayed, sigmas))
