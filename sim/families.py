"""Every family of serial devices that can be simulated, under the protocol names of the configuration."""

from __future__ import annotations

from collections.abc import Callable

from sim.aircraft import VirtualAircraft
from sim.devices import HMR3300, Gradienter, ImuLine, SerialDevice, VectorNavBinary
from sim.imu_model import ImuModel
from sim.pni import PniCompass
from sim.rion import RionCompass, RionInclinometer
from sim.witmotion import WitMotionImu, WitMotionInclinometer

IMUS: dict[str, Callable[[ImuModel], SerialDevice]] = {
    "vectornav": VectorNavBinary,
    "imu_line": ImuLine,
    "witmotion": WitMotionImu,
}
"""Made from the model whose readings they send."""

GRADIENTERS: dict[str, Callable[[VirtualAircraft, int], SerialDevice]] = {
    "inclinometer_xy": lambda aircraft, seed: Gradienter(aircraft, seed=seed),
    "rion": lambda aircraft, seed: RionInclinometer(aircraft, seed=seed),
    "pni": lambda aircraft, seed: PniCompass(aircraft, seed=seed),
    "witmotion": lambda aircraft, seed: WitMotionInclinometer(aircraft, seed=seed),
}
"""Made from the aircraft on which they sit and a seed; upright, without errors but noise and lag."""

COMPASSES: dict[str, Callable[[VirtualAircraft, int], SerialDevice]] = {
    "hmr3300": lambda aircraft, seed: HMR3300(aircraft, seed=seed),
    "pni": lambda aircraft, seed: PniCompass(aircraft, seed=seed),
    "rion": lambda aircraft, seed: RionCompass(aircraft, seed=seed),
}
"""The same."""
