"""What all parts of one IMU model in a fleet show from power-up to power-up: read with suspicion, judged before use.

A new aircraft's own power-ups are too few to tell how much its biases scatter; its model's fleet knows. But whoever
says so may be wrong, or lie: so figures that no part has are refused, what is said counts for a few power-ups at most,
and only while those of the aircraft itself do not contradict it (`prior.expect`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Final

import msgspec
import numpy as np

from companion.calibration.temperature.curve import Usual
from companion.formats import decode
from companion.physics.frames import Array
from companion.physics.units import DEG_H, MG
from companion.samples import Triad, Vector

FORMAT_VERSION: Final = 1
MOST_BYTES: Final = 4096
LEAST_PARTS: Final = 5
_MOST_WORTH: Final = 5.0
"""Power-ups: from about so many of its own on, an aircraft needs nobody else (`prior.WEIGHS_FROM`)."""
_LEAST_WORTH: Final = 0.1
_CATALOGUE_SHARE: Final = 1.0 / 3.0
"""Of what the catalogue's parts move by a kelvin: the slopes of one model's parts are not believed to differ less."""
_RANGES: Final[Mapping[Triad, tuple[float, float, float, str]]] = {
    "gyro": (0.1 * DEG_H, 3600.0 * DEG_H, 150.0 * DEG_H, "rad/s"),
    "accel": (0.001 * MG, 50.0 * MG, 5.0 * MG, "m/s^2"),
}
"""Least and most scatter, and the most that a kelvin moves."""


class TriadPrior(msgspec.Struct, frozen=True):
    """Of one triad; vehicle FRD, rad/s or m/s^2."""

    scatter: Vector
    scatter_sigma: Vector
    """How different that of one part is, one sigma."""
    per_k: Vector | None = None
    """Mean slope over temperature; None: not known."""
    per_k_spread: Vector | None = None
    """How different that of one part is."""

    @property
    def usual(self) -> Usual:
        """As a fit takes it."""
        scatter = np.array(self.scatter)
        worth = float(np.min(np.square(scatter / np.array(self.scatter_sigma)))) / 2.0
        return Usual(np.square(scatter), min(max(worth, _LEAST_WORTH), _MOST_WORTH))

    def line(self, catalogue_per_k: float, *, tested: bool) -> tuple[Array, float]:
        """Mean slope, (3,), and one sigma of it for one part.

        `tested`: the aircraft has seen temperatures that would have contradicted it.
        """
        if self.per_k is None or self.per_k_spread is None:
            return np.zeros(3), catalogue_per_k
        per_k, spread = np.array(self.per_k), max(*self.per_k_spread, _CATALOGUE_SHARE * catalogue_per_k)
        # Until then the part may as well have none.
        return per_k, spread if tested else math.hypot(spread, float(np.abs(per_k).max()))


class ModelPrior(msgspec.Struct, frozen=True, kw_only=True):
    """`fleet/priors/<model>`: docs/fleet/asyncapi.yaml."""

    model: Annotated[str, msgspec.Meta(pattern=r"^[0-9a-z-]{1,40}$")]
    parts: Annotated[int, msgspec.Meta(ge=LEAST_PARTS, le=10**9)]
    turn_ons: Annotated[int, msgspec.Meta(ge=1, le=10**9)]
    gyro_rad_s: TriadPrior | None = None
    accel_m_s2: TriadPrior | None = None
    format_version: int = FORMAT_VERSION

    def of(self, triad: Triad) -> TriadPrior | None:
        """None: nothing is known of this one."""
        return self.gyro_rad_s if triad == "gyro" else self.accel_m_s2


def read(payload: bytes, model: str) -> ModelPrior:
    """What was published for a model.

    Raises:
        ValueError: it is nothing that can be believed, and why, in one line.
    """
    if len(payload) > MOST_BYTES:
        raise ValueError(f"found {len(payload)} bytes; allowed: up to {MOST_BYTES}")
    try:
        found: ModelPrior = decode(payload, ModelPrior, FORMAT_VERSION)
        check(found)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(str(error)) from None
    if found.model != model:
        raise ValueError(f"found model {found.model!r}; allowed: {model!r}, as its topic says")
    return found


def check(found: ModelPrior) -> None:
    """Whether there could be such parts.

    Raises:
        msgspec.ValidationError: not; where, and what is allowed.
    """
    for triad, (least, most, most_per_k, unit) in _RANGES.items():
        if (known := found.of(triad)) is None:
            continue
        limits = ((least, most), (least / 100.0, most), (-most_per_k, most_per_k), (0.0, most_per_k))
        for (what, values), (low, high) in zip(msgspec.structs.asdict(known).items(), limits, strict=True):
            if values is not None and not all(low <= value <= high for value in values):
                shown = ", ".join(f"{value:.3g}" for value in values)
                raise msgspec.ValidationError(f"{triad} {what}: found {shown}; allowed: {low:.2g} to {high:.2g} {unit}")
