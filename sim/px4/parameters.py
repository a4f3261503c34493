"""PX4's parameter store: two types, a working copy, what has been saved, and what others have not been told yet.

Facts: PX4 `src/lib/parameters/parameters.cpp` and `autosave.cpp` (2026-08), autopilots 4.4 and 7.5.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.firmware.numbers import float32

INT32 = mavlink.MAV_PARAM_TYPE_INT32
REAL32 = mavlink.MAV_PARAM_TYPE_REAL32
SMALLEST_CHANGE = 1.1920929e-07
"""A float that changes by no more than this is stored, but nobody is told and it is not saved for that; one that
differs from its default by no more is not saved at all."""


class ParameterStore:
    """Name to value. A default that is an `int` makes an INT32, one that is a `float` a REAL32."""

    def __init__(self, defaults: Mapping[str, float]) -> None:
        self._defaults = {name: v if isinstance(v, int) else float32(v) for name, v in sorted(defaults.items())}
        self.values: dict[str, float] = dict(self._defaults)
        """What is read back, and what the firmware reads when it looks."""
        self.saved: dict[str, float] = dict(self._defaults)
        """What a boot finds."""
        self.unsaved: set[str] = set()
        """Changed since the last save: what is announced on every port."""
        self.names = tuple(self.values)
        """In the order of their indices: the alphabet's."""
        self.index = {name: number for number, name in enumerate(self.names)}

    def __contains__(self, name: object) -> bool:
        return name in self.values

    def __getitem__(self, name: str) -> float:
        return self.values[name]

    def is_int(self, name: str) -> bool:
        """INT32, else REAL32."""
        return isinstance(self._defaults[name], int)

    def type_of(self, name: str) -> int:
        """MAV_PARAM_TYPE."""
        return INT32 if self.is_int(name) else REAL32

    def set(self, name: str, value: float) -> bool:
        """Store, within no limits; says whether that is a change that counts."""
        new = int(value) if self.is_int(name) else float32(value)
        old = self.values[name]
        changed = new != old if self.is_int(name) else abs(new - old) > SMALLEST_CHANGE
        self.values[name] = new
        # The same value once more takes the mark away: the others are then not told of the first change.
        if changed:
            self.unsaved.add(name)
        else:
            self.unsaved.discard(name)
        return changed

    def save(self) -> None:
        """Write everything to the storage that is not, or almost, its default."""
        self.saved = {name: self._stored(name, value) for name, value in self.values.items()}
        self.unsaved.clear()

    def _stored(self, name: str, value: float) -> float:
        default = self._defaults[name]
        return default if abs(value - default) <= SMALLEST_CHANGE and not self.is_int(name) else value

    def load(self) -> None:
        """What a boot does: work with what has been saved."""
        self.values = dict(self.saved)
        self.unsaved.clear()

    def reset(self, *prefixes: str) -> None:
        """Back to the defaults: all, or names that begin so. Not saved yet."""
        for name, value in self._defaults.items():
            if not prefixes or name.startswith(prefixes):
                self.set(name, value)

    def preset(self, name: str, value: float) -> None:
        """Set and save without a word, as if it had always been so."""
        self.values[name] = self.saved[name] = int(value) if self.is_int(name) else float32(value)

    def on_the_wire(self, name: str) -> float:
        """The value as PARAM_VALUE carries it: the bytes of an int32 in the place of a float."""
        value = self.values[name]
        return bytes_as_float(int(value)) if self.is_int(name) else value

    def vector(self, slot: int, kind: str, suffix: str) -> tuple[float, float, float]:
        """CAL_<kind><slot>_{X,Y,Z}<suffix>."""
        x, y, z = (self.values[f"CAL_{kind}{slot}_{axis}{suffix}"] for axis in "XYZ")
        return x, y, z


def bytes_as_float(value: int) -> float:
    """The float that has the bytes of this int32."""
    return float(struct.unpack("<f", struct.pack("<i", value))[0])


def float_as_int(value: float) -> int:
    """The int32 that has the bytes of this float."""
    return int(struct.unpack("<i", struct.pack("<f", value))[0])
