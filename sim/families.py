"""Every family of serial devices that can be simulated, under the protocol names of the configuration."""

from __future__ import annotations

from collections.abc import Callable

from sim.aircraft import VirtualAircraft
from sim.binary_imus import MipImu, Stim300, XsensImu
from sim.devices import HMR3300, Gradienter, ImuLine, SerialDevice, VectorNavBinary
from sim.imu_model import ImuModel

IMUS: dict[str, Callable[[ImuModel], SerialDevice]] = {
    "vectornav": VectorNavBinary,
    "imu_line": ImuLine,
    "mip": MipImu,
    "xsens": XsensImu,
    "stim300": Stim300,
}
"""Made from the model whose readings they send."""

GRADIENTERS: dict[str, Callable[[VirtualAircraft, int], SerialDevice]] = {
    "inclinometer_xy": lambda aircraft, seed: Gradienter(aircraft, seed=seed),
    "stim300": lambda aircraft, seed: Stim300(ImuModel(aircraft, "adis16470", seed=seed), seed=seed),
}
"""Made from the aircraft on which they sit and a seed; upright, without errors but noise and lag."""

COMPASSES: dict[str, Callable[[VirtualAircraft, int], SerialDevice]] = {
    "hmr3300": lambda aircraft, seed: HMR3300(aircraft, seed=seed),
}
"""The same."""
