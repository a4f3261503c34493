"""Every family of serial devices that can be simulated, under the protocol names of the configuration."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from sim.binary_imus import MipImu, Stim300, WitMotionImu, XsensImu
from sim.compasses import NmeaCompass, Os5000, PniCompass, RionCompass
from sim.devices import HMR3300, Gradienter, ImuLine, Law, SerialDevice, VectorNavBinary
from sim.gradienters import Jewell, RionInclinometer, WitMotionInclinometer
from sim.imu_model import ImuModel

IMUS: dict[str, Callable[[ImuModel], SerialDevice]] = {
    "vectornav": VectorNavBinary,
    "imu_line": ImuLine,
    "witmotion": WitMotionImu,
    "mip": MipImu,
    "xsens": XsensImu,
    "stim300": Stim300,
}
"""Made from the model whose readings they send."""

COMPASSES: dict[str, Callable[..., SerialDevice]] = {
    "hmr3300": HMR3300,
    "pni": PniCompass,
    "rion": RionCompass,
    "nmea": NmeaCompass,
    "os5000": Os5000,
}
"""Made from the aircraft on which they sit and `seed`; upright, without errors but noise and lag."""

GRADIENTERS: dict[str, Callable[..., SerialDevice]] = {
    "inclinometer_xy": Gradienter,
    **COMPASSES,
    "rion": RionInclinometer,
    "witmotion": WitMotionInclinometer,
    "stim300": lambda aircraft, seed: Stim300(ImuModel(aircraft, "adis16470", seed=seed), seed=seed),
    "jewell": Jewell,
}
"""Made in the same way; every compass but RION's also serves as a gradienter."""


class Fit(NamedTuple):
    """What a configuration has to say of a device of one of the tables, in one of its roles."""

    mounting_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Roll, pitch, yaw of the axes in which it speaks, as it lies on the aircraft."""
    law: Law | None = None
    """Of a gradienter; None: its own, or roll and pitch themselves."""
    sigma_deg: float | None = None
    """None: what the companion takes by itself is right."""
    model_mounting_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Of the model of an IMU that sends its model's readings as they are; one that turns them needs none."""


Z_UP = (180.0, 0.0, 0.0)
"""Flat on the aircraft: X forward, Y left, Z up."""

FITS: dict[tuple[str, str], Fit] = {
    ("imu", "xsens"): Fit(mounting_deg=Z_UP),
    ("imu", "stim300"): Fit(mounting_deg=Z_UP),
    ("gradienter", "stim300"): Fit(law="axis"),
    ("gradienter", "inclinometer_xy"): Fit(sigma_deg=0.005),
    ("compass", "hmr3300"): Fit(sigma_deg=1.0),
    ("imu", "witmotion"): Fit(mounting_deg=Z_UP, model_mounting_deg=Z_UP),
}
"""By role ("imu", "gradienter", "compass") and protocol name; who is not here needs nothing said."""


def fit(role: str, name: str) -> Fit:
    """What fits a device in a role."""
    return FITS.get((role, name), Fit())


def law_of(device: SerialDevice) -> Law:
    """What a device's two readings are."""
    own: Law = getattr(device, "law", "euler")
    return fit("gradienter", device.protocol).law or own


class Devices(NamedTuple):
    """One device for each role; one that serves two of them is there twice."""

    imu: SerialDevice
    gradienter: SerialDevice
    compass: SerialDevice


def make(model: ImuModel, imu: str, gradienter: str, compass: str, seed: int) -> Devices:
    """The devices of an aircraft, by their protocols; two roles of one name are one device.

    Args:
        model: what the IMU measures; mounted as `Fit.model_mounting_deg` says.
        imu: a name of `IMUS`.
        gradienter: a name of `GRADIENTERS`.
        compass: a name of `COMPASSES`.
        seed: of the noise.
    """
    inertial, magnetic = IMUS[imu](model), COMPASSES[compass](model.aircraft, seed=seed)
    shared = {imu: inertial, compass: magnetic}
    return Devices(inertial, shared.get(gradienter) or GRADIENTERS[gradienter](model.aircraft, seed=seed), magnetic)
