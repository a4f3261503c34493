"""Protocols by their names in the configuration, and default line settings of their devices.

A decoder returns a frame's tilt only once, as a `TiltSample` or within a `CompassSample`; `part_for` extracts it.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Literal

from companion.config.sections import Law, Parity
from companion.errors import ConfigError
from companion.protocols.compasses.hmr3300 import Hmr3300Decoder, Hmr3300Dialogue
from companion.protocols.compasses.nmea import Hmr3000Dialogue, NmeaDecoder
from companion.protocols.compasses.os5000 import Os5000Decoder
from companion.protocols.compasses.pni import PniDecoder, PniDialogue
from companion.protocols.decoding.base import Decoder
from companion.protocols.decoding.dialogue import Dialogue
from companion.protocols.imus.imu_line import ImuLineDecoder
from companion.protocols.imus.mip import MipDecoder, MipDialogue
from companion.protocols.imus.stim300 import Stim300Decoder
from companion.protocols.imus.vectornav import VectorNavDecoder, VectorNavDialogue
from companion.protocols.imus.witmotion import WitMotionDecoder
from companion.protocols.imus.xsens import XsensDecoder, XsensDialogue
from companion.protocols.inclinometers.inclinometer_xy import InclinometerXyDecoder, InclinometerXyDialogue
from companion.protocols.inclinometers.jewell import JewellDecoder, JewellDialogue
from companion.protocols.inclinometers.rion import RionDecoder, RionDialogue
from companion.samples import CompassSample, ImuSample, MagSample, Sample, TiltSample

Kind = Literal["imu", "gradienter", "compass"]


@dataclass(frozen=True, slots=True)
class ProtocolInfo:
    """Protocol as used by one kind of device: its decoder, and the factory setting of the serial line.

    `sigma_deg` is for tilt or a level compass, `tilted_sigma_deg` for a tilted compass; the configuration may set both.
    """

    name: str
    baud: int
    decoder: type[Decoder]
    dialogue: Callable[[], Dialogue] | None = None
    lag_s: float = 0.0  # time constant of the device's response: fluid, pendulum, filters
    sigma_deg: float | None = None
    tilted_sigma_deg: float | None = None
    law: Law | None = None  # meaning of a gradienter's two readings by its documents; None: must be configured
    parity: Parity = "none"


DEVICES: Final[dict[ProtocolInfo, dict[Kind, dict[str, Any]]]] = {
    ProtocolInfo("vectornav", 115200, VectorNavDecoder, VectorNavDialogue): {"imu": {}},
    ProtocolInfo("imu_line", 500000, ImuLineDecoder): {"imu": {}},
    # 9600 baud carries 21 of its usual epochs a second; a faster line is set with the vendor's program.
    # WitMotion prints 0.2 deg for the WT9011; the SINxT are sold as better.
    ProtocolInfo("witmotion", 9600, WitMotionDecoder): {"imu": {}, "gradienter": {"sigma_deg": 0.2, "law": "euler"}},
    # The 3DM-GX5's and CV5's rate, from memory and not from a document.
    ProtocolInfo("mip", 115200, MipDecoder, MipDialogue): {"imu": {}},
    ProtocolInfo("xsens", 115200, XsensDecoder, XsensDialogue): {"imu": {}},
    # The usual one of the rates that can be ordered (TS1524, table 5-11: 374400 to 1843200), from memory. Lag: that of
    # its slowest filter, 16 Hz at -3 dB: 1 / (2 pi 16 Hz).
    ProtocolInfo("stim300", 921600, Stim300Decoder): {"imu": {}, "gradienter": {"lag_s": 0.01, "law": "axis"}},
    # MEAS DPG2, with the damping of the BEI INC (a decade a second). The P-series sends at 2400 baud, BEI with even
    # parity.
    ProtocolInfo("inclinometer_xy", 9600, InclinometerXyDecoder, InclinometerXyDialogue): {
        "gradienter": {"lag_s": 0.43}
    },
    # MD900-T. The settling time of its fluid is not documented.
    ProtocolInfo("jewell", 9600, JewellDecoder, JewellDialogue): {"gradienter": {}},
    # Honeywell: null 0.4 deg, 0.5 deg up to 30 deg of tilt; thermal hysteresis of up to 1 deg is not included.
    # Heading: 1 deg rms level, 3 deg up to 30 deg of tilt.
    ProtocolInfo("hmr3300", 19200, Hmr3300Decoder, Hmr3300Dialogue): {
        "gradienter": {"sigma_deg": math.hypot(0.4, 0.5), "law": "euler"},
        "compass": {"sigma_deg": 1.0, "tilted_sigma_deg": 3.0},
    },
    # An HMR3000, with its first filter's usual time constant of 4 steps of 72 ms. NMEA 0183 itself has 4800 baud.
    ProtocolInfo("nmea", 19200, NmeaDecoder, Hmr3000Dialogue, lag_s=0.29): {
        "gradienter": {"law": "axis"},
        "compass": {},
    },
    # OceanServer: 0.5 deg rms level, 1 deg up to 30 deg of tilt.
    ProtocolInfo("os5000", 19200, Os5000Decoder): {
        "gradienter": {},
        "compass": {"sigma_deg": 0.5, "tilted_sigma_deg": 1.0},
    },
    # 38400: public drivers of the TRAX open the port at this rate; no PNI document with it was found.
    ProtocolInfo("pni", 38400, PniDecoder, PniDialogue): {"gradienter": {"law": "euler"}, "compass": {}},
    # No default law: the compass' frame would have "euler", the inclinometer's frame probably "axis".
    ProtocolInfo("rion", 9600, RionDecoder, RionDialogue): {"gradienter": {}, "compass": {}},
}
"""Devices, one per protocol, with the kinds as which a device can be used and the settings that differ by kind."""

_KINDS: Final[tuple[Kind, ...]] = ("imu", "gradienter", "compass")
PROTOCOLS: Final[dict[Kind, dict[str, ProtocolInfo]]] = {
    kind: {
        info.name: dataclasses.replace(info, **figures[kind]) for info, figures in DEVICES.items() if kind in figures
    }
    for kind in _KINDS
}


def main_kind(name: str) -> Kind:
    """Return the first of compass, IMU, gradienter that speaks a protocol; raise ConfigError for an unknown one."""
    kinds: tuple[Kind, ...] = ("compass", "imu", "gradienter")
    for kind in kinds:
        if name in PROTOCOLS[kind]:
            return kind
    raise ConfigError(f"found protocol {name!r}; allowed: {', '.join(sorted(info.name for info in DEVICES))}")


def part_for(role: Kind, sample: Sample) -> Sample | None:
    """Return the part of a sample that a device in this role provides; None: no such part."""
    match sample:
        case ImuSample():
            return sample if role == "imu" else None
        case TiltSample():
            return sample if role == "gradienter" else None
        case MagSample():
            return sample if role == "compass" else None
        case CompassSample(pitch_deg=pitch_deg, roll_deg=roll_deg):
            if role == "compass":
                return sample
            if role == "gradienter" and pitch_deg is not None and roll_deg is not None:
                return TiltSample(sample.t_s, roll_deg, pitch_deg)
    return None
