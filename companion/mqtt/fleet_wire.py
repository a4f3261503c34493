"""Payloads between an aircraft and a collector: docs/fleet/asyncapi.yaml."""

from __future__ import annotations

import re
from typing import Annotated, Any, Final

import msgspec

from companion.config.sections import Location
from companion.formats import decode
from companion.storage.fleet_items import Kept, Waiting
from companion.storage.state import UNREADABLE

FORMAT_VERSION: Final = 1
MOST_RANGES: Final = 256
MOST_SEQUENCE: Final = 2**53

_Sequence = Annotated[int, msgspec.Meta(ge=1, le=MOST_SEQUENCE)]

_ROUNDED: Final[dict[str, int]] = {
    "latitude_deg": 2,
    "longitude_deg": 2,
    "height_m": -2,
    "gravity_m_s2": 3,
    "declination_deg": 1,
    "field_gauss": 3,
    "field_expected_gauss": 3,
    "inclination_deg": 1,
    "inclination_expected_deg": 1,
}
"""Figures that give away a place (gravity and the field do, too), and the decimals that leave it a kilometre."""
_WORKED_OUT: Final[dict[str, object]] = {"covariance": None, "effective": None}
"""Figures whose digits give away the gravity and the latitude behind them, and their substitutes."""
_EARTHS: Final = re.compile(r"(the Earth's) [\d.]+")


class Said(msgspec.Struct, frozen=True):
    """Sequences that a collector has, or wants."""

    epoch: str
    sequences: Annotated[list[tuple[_Sequence, _Sequence]], msgspec.Meta(max_length=MOST_RANGES)]

    def names(self, sequence: int) -> bool:
        """Return whether a sequence is among them."""
        return any(first <= sequence <= last for first, last in self.sequences)


def parse(payload: bytes) -> Said | None:
    """Read what a collector says; None: it is something else, or of a newer version. Never raises."""
    try:
        said: Said = decode(payload, Said, FORMAT_VERSION)
    except UNREADABLE:
        return None
    return said if all(first <= last for first, last in said.sequences) else None


def hello(kept: Kept, name: str | None, at: str) -> bytes:
    """Encode the payload of a hello."""
    return msgspec.json.encode(
        {
            "format_version": FORMAT_VERSION,
            "aircraft": kept.aircraft,
            "name": name,
            "epoch": kept.epoch,
            "first": kept.first,
            "last": kept.last,
            "at": at,
        }
    )


def item(waiting: Waiting, location: Location) -> bytes:
    """Encode the payload of an item, with the place as exact as configured."""
    told = waiting.item
    try:
        body = msgspec.json.decode(told.body)
    except UNREADABLE:
        body = {}  # the disk has spoilt it
    return msgspec.json.encode(
        {
            "format_version": FORMAT_VERSION,
            "aircraft": waiting.aircraft,
            "epoch": waiting.epoch,
            "sequence": waiting.sequence,
            "kind": told.kind,
            "at": told.at,
            "clock": told.clock,
            "body": body if location == "full" else _less_place(body, location),
        }
    )


def _less_place(value: Any, location: Location, key: str = "") -> Any:
    if isinstance(value, list):
        return [_less_place(each, location, key) for each in value]
    if isinstance(value, dict):
        return {
            name: _WORKED_OUT[name] if name in _WORKED_OUT else _less_place(each, location, name)
            for name, each in value.items()
        }
    if isinstance(value, str):
        return _EARTHS.sub(r"\1 ?", value)
    if key in _ROUNDED:
        return None if location == "off" or value is None else round(value, _ROUNDED[key])
    # Two digits of a sigma are what it is worth; more would tell the latitude, as above.
    return float(f"{value:.2g}") if "sigma" in key and isinstance(value, float) else value
