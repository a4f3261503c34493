"""Every family of serial devices that can be simulated, under the protocol names of the configuration."""

from __future__ import annotations

from collections.abc import Callable

from sim.aircraft import VirtualAircraft
from sim.compasses import NmeaCompass, Os5000
from sim.devices import HMR3300, Gradienter, ImuLine, SerialDevice, VectorNavBinary
from sim.gradienters import Jewell
from sim.imu_model import ImuModel

IMUS: dict[str, Callable[[ImuModel], SerialDevice]] = {
    "vectornav": VectorNavBinary,
    "imu_line": ImuLine,
}
"""Made from the model whose readings they send."""

GRADIENTERS: dict[str, Callable[[VirtualAircraft, int], SerialDevice]] = {
    "inclinometer_xy": lambda aircraft, seed: Gradienter(aircraft, seed=seed),
    "jewell": lambda aircraft, seed: Jewell(aircraft, seed=seed),
    "nmea": lambda aircraft, seed: NmeaCompass(aircraft, seed=seed),
    "os5000": lambda aircraft, seed: Os5000(aircraft, seed=seed),
}
"""Made from the aircraft on which they sit and a seed; upright, without errors but noise and lag."""

COMPASSES: dict[str, Callable[[VirtualAircraft, int], SerialDevice]] = {
    "hmr3300": lambda aircraft, seed: HMR3300(aircraft, seed=seed),
    "nmea": lambda aircraft, seed: NmeaCompass(aircraft, seed=seed),
    "os5000": lambda aircraft, seed: Os5000(aircraft, seed=seed),
}
"""The same."""
