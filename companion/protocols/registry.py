"""Which protocols there are, under the names that the configuration uses, and how their lines are set by default."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from companion.errors import ConfigError
from companion.protocols.base import Decoder
from companion.protocols.dialogue import Dialogue
from companion.protocols.hmr3300 import Hmr3300Decoder
from companion.protocols.imu_dialogues import MipDialogue, VectorNavDialogue, XsensDialogue
from companion.protocols.imu_line import ImuLineDecoder
from companion.protocols.inclinometer_xy import InclinometerXyDecoder
from companion.protocols.mip import MipDecoder
from companion.protocols.stim300 import Stim300Decoder
from companion.protocols.vectornav import VectorNavDecoder
from companion.protocols.xsens import XsensDecoder

Kind = Literal["imu", "gradienter", "compass"]


@dataclass(frozen=True, slots=True)
class ProtocolInfo:
    """One protocol: its decoder, and the line settings of a device as it comes from the factory."""

    name: str
    baud: int
    parity: Literal["none", "even", "odd"]
    decoder: type[Decoder]
    dialogue: type[Dialogue] | None = None
    """What has to be said to it; None for a device that speaks by itself or that we have nothing safe to say to."""
    lag_s: float = 0.0
    """Time constant with which its reading follows the truth: fluid, pendulum, filters."""


PROTOCOLS: dict[Kind, dict[str, ProtocolInfo]] = {
    "imu": {
        "vectornav": ProtocolInfo("vectornav", 115200, "none", VectorNavDecoder, VectorNavDialogue),
        "imu_line": ProtocolInfo("imu_line", 500000, "none", ImuLineDecoder),
        # The 3DM-GX5's and CV5's rate, from memory and not from a document.
        "mip": ProtocolInfo("mip", 115200, "none", MipDecoder, MipDialogue),
        "xsens": ProtocolInfo("xsens", 115200, "none", XsensDecoder, XsensDialogue),
        # Of the rates that can be ordered (TS1524, table 5-11: 374400 to 1843200) the usual one, from memory.
        "stim300": ProtocolInfo("stim300", 921600, "none", Stim300Decoder),
    },
    "gradienter": {
        # MEAS DPG2, with the damping of the BEI INC (a decade a second). The P-series sends at 2400 baud, BEI with even
        # parity.
        "inclinometer_xy": ProtocolInfo("inclinometer_xy", 9600, "none", InclinometerXyDecoder, lag_s=0.43),
        # The slowest of its filters, 16 Hz at -3 dB: 1 / (2 pi 16 Hz).
        "stim300": ProtocolInfo("stim300", 921600, "none", Stim300Decoder, lag_s=0.01),
    },
    "compass": {
        "hmr3300": ProtocolInfo("hmr3300", 19200, "none", Hmr3300Decoder),
    },
}


def make_decoder(kind: Kind, name: str, seconds_per_byte: float = 0.0) -> Decoder:
    """A new decoder for a kind of device and a protocol name.

    Raises:
        ConfigError: there is no such protocol for that kind of device.
    """
    info = PROTOCOLS[kind].get(name)
    if info is None:
        allowed = ", ".join(f'"{known}"' for known in PROTOCOLS[kind])
        raise ConfigError(f"'{kind}.protocol': found {name!r}; allowed: {allowed}")
    return info.decoder(seconds_per_byte)
