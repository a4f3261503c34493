"""Ready-made worlds: an aircraft, its sensors of any family, and its autopilot, made together from one seed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Literal, NamedTuple

import numpy as np
from pygeomag.geomag import GeoMag

from sim.aircraft import Pose, Site, VirtualAircraft
from sim.ardupilot.double import ArduPilotDouble
from sim.binary_imus import MipImu, Stim300, WitMotionImu, XsensImu
from sim.compasses import NmeaCompass, Os5000, PniCompass, RionCompass
from sim.devices import HMR3300, Gradienter, ImuLine, Law, SerialDevice, VectorNavBinary
from sim.firmware.double import AutopilotDouble
from sim.gradienters import Jewell, RionInclinometer, WitMotionInclinometer
from sim.imu_model import DEG_H, MG, PARTS, ImuModel
from sim.motions import Motion
from sim.px4.double import PX4Double
from sim.thermal import ThermalBoard

IMUS: dict[str, Callable[[ImuModel], SerialDevice]] = {
    "vectornav": VectorNavBinary,
    "imu_line": ImuLine,
    "witmotion": WitMotionImu,
    "mip": MipImu,
    "xsens": XsensImu,
    "stim300": Stim300,
}
"""Constructors of IMUs by protocol name; each gets the model whose readings the device sends."""

COMPASSES: dict[str, Callable[..., SerialDevice]] = {
    "hmr3300": HMR3300,
    "pni": PniCompass,
    "rion": RionCompass,
    "nmea": NmeaCompass,
    "os5000": Os5000,
}
"""Constructors of compasses by protocol name, from the aircraft and `seed`; upright, with noise and lag only."""

GRADIENTERS: dict[str, Callable[..., SerialDevice]] = {
    "inclinometer_xy": Gradienter,
    **COMPASSES,
    "rion": RionInclinometer,
    "witmotion": WitMotionInclinometer,
    "stim300": lambda aircraft, seed: Stim300(ImuModel(aircraft, "adis16470", seed=seed), seed=seed),
    "jewell": Jewell,
}
"""Constructors of gradienters, from the aircraft and `seed`; every compass but RION's also serves as a gradienter."""


class Fit(NamedTuple):
    """Configuration that a device of one of the tables needs in one of its roles."""

    mounting_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Mounting of the device on the aircraft: roll, pitch and yaw of its axes."""
    law: Law | None = None
    """Law of a gradienter; None: the protocol's own law, or roll and pitch."""
    sigma_deg: float | None = None
    """Sigma to configure; None: the companion's default is right."""
    model_mounting_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Mounting of the model of an IMU that sends its model's readings unchanged; an IMU that turns them needs none."""


Z_UP = (180.0, 0.0, 0.0)
"""Mounting of a device that is flat on the aircraft: X forward, Y left, Z up."""

FITS: dict[tuple[str, str], Fit] = {
    ("imu", "xsens"): Fit(mounting_deg=Z_UP),
    ("imu", "stim300"): Fit(mounting_deg=Z_UP),
    ("gradienter", "stim300"): Fit(law="axis"),
    ("gradienter", "inclinometer_xy"): Fit(sigma_deg=0.005),
    ("compass", "hmr3300"): Fit(sigma_deg=1.0),
    ("imu", "witmotion"): Fit(mounting_deg=Z_UP, model_mounting_deg=Z_UP),
}
"""Fit of each device by role ("imu", "gradienter", "compass") and protocol name; a device not listed needs none."""


def fit(role: str, name: str) -> Fit:
    return FITS.get((role, name), Fit())


def law_of(device: SerialDevice) -> Law:
    own: Law = getattr(device, "law", "euler")
    return fit("gradienter", device.protocol).law or own


class Devices(NamedTuple):
    """One device for each role; a device with two roles appears twice."""

    imu: SerialDevice
    gradienter: SerialDevice
    compass: SerialDevice


def make(model: ImuModel, imu: str, gradienter: str, compass: str, seed: int) -> Devices:
    """Make the devices of an aircraft by their protocols; two roles with one protocol name share one device.

    Args:
        model: model of the IMU, mounted as `Fit.model_mounting_deg` says.
        imu: a name of `IMUS`.
        gradienter: a name of `GRADIENTERS`.
        compass: a name of `COMPASSES`.
        seed: seed of the noise.
    """
    inertial, magnetic = IMUS[imu](model), COMPASSES[compass](model.aircraft, seed=seed)
    shared = {imu: inertial, compass: magnetic}
    return Devices(inertial, shared.get(gradienter) or GRADIENTERS[gradienter](model.aircraft, seed=seed), magnetic)


Firmware = Literal["ardupilot", "px4"]

DEMO_POSE = Pose(pitch_deg=5.0, roll_deg=-3.0, heading_deg=40.0)
FIRST_GYRO_DEG_H = (162.234, 169.563, 98.289)
FIRST_ACCEL_MG = (2.4125, 2.1596, 0.89809)
GRADIENTER_OFFSET_DEG = (0.003, -0.002)
DEMO_DEVICES = ("vectornav", "inclinometer_xy", "hmr3300")
"""Protocols of IMU, gradienter and compass in the demonstration."""
DEMO_UNIX_S = 1_795_219_200.0
"""Date of the demonstration: 21 November 2026, 00:00 UTC."""


def site_at(latitude_deg: float, longitude_deg: float, height_m: float, unix_s: float = DEMO_UNIX_S) -> Site:
    """Return a site with the magnetic field of the World Magnetic Model at that date."""
    date = datetime.fromtimestamp(unix_s, UTC)
    year = date.year + (date.timetuple().tm_yday - 1) / 365.25
    model = GeoMag(coefficients_file="wmm/WMM_2025.COF")
    field = model.calculate(glat=latitude_deg, glon=longitude_deg, alt=height_m / 1000.0, time=year)
    return Site(latitude_deg, longitude_deg, height_m, float(field.d), float(field.i), float(field.f) * 1e-5)


@dataclass(frozen=True, slots=True)
class Scenario:
    """An aircraft, its devices and its autopilot, which share one truth."""

    aircraft: VirtualAircraft
    flight_controller_imus: tuple[ImuModel, ...]
    serial_imu: ImuModel
    autopilot: AutopilotDouble
    imu: SerialDevice
    gradienter: SerialDevice
    compass: SerialDevice
    gradienter_law: Law
    without: frozenset[str] = frozenset()  # Roles of devices that are not served

    @property
    def ports(self) -> dict[str, SerialDevice]:
        """Return the devices by the names of their ports; a device with two roles has one port."""
        found: dict[str, SerialDevice] = {}
        for name, device in (("imu", self.imu), ("gradienter", self.gradienter), ("compass", self.compass)):
            if name not in self.without and not any(device is other for other in found.values()):
                found[name] = device
        return found


def demo(
    *,
    pose: Pose = DEMO_POSE,
    seed: int = 0,
    unix_s: float = DEMO_UNIX_S,
    motions: Sequence[Motion] = (),
    gyr_cal_at_boot: bool = False,
    firmware: Firmware = "ardupilot",
    part: str = "icm42688p",
    gyro_deg_h: Sequence[float] = FIRST_GYRO_DEG_H,
    accel_mg: Sequence[float] = FIRST_ACCEL_MG,
    accel_scale: Sequence[float] = (0.0, 0.0, 0.0),
    board_deg: tuple[float, float] = (0.0, 0.0),
    gradienter_offset_deg: tuple[float, float] = GRADIENTER_OFFSET_DEG,
    devices: tuple[str, str, str] = DEMO_DEVICES,
    warms: tuple[float, float, float] | None = None,
    power_up: int = 0,
    aircraft: VirtualAircraft | None = None,
) -> Scenario:
    """A small aircraft on uneven ground near Beijing, 40 N, 116 E, 50 m: pitch 5, roll -3, heading 40 degrees.

    The flight controller's first IMU has biases of the size of the paper's tables (162, 170, 98 deg/h; 2.4, 2.2, 0.9
    mg: its fourth row), its second IMU and the serial IMU have other biases. The compass is 0.8 degrees off; the
    gradienter shows 3 and -2 millidegrees too much.

    Args:
        pose: pose of the aircraft.
        seed: seed of all noise.
        unix_s: date at the beginning.
        motions: motions of the aircraft.
        gyr_cal_at_boot: the autopilot's default INS_GYR_CAL = 1, which has already removed most of the gyro bias (and
            includes the Earth's rotation). The demonstration starts without it, to have a bias to show.
        firmware: firmware of the autopilot.
        part: part of the flight controller's IMUs.
        gyro_deg_h: gyro biases of the flight controller's first IMU.
        accel_mg: accelerometer biases of the flight controller's first IMU.
        accel_scale: relative scale errors of the accelerometers of the flight controller's first two IMUs.
        board_deg: roll and pitch of the flight controller in the aircraft.
        gradienter_offset_deg: offset of the gradienter, x and y.
        devices: families of IMU, gradienter and compass, by their names in `sim.scenario`; only the default
            families have the errors above.
        warms: the air's temperature in degC, the self-heating in K, and its time constant in s; then each IMU has
            a curve of its own over temperature, by the seed.
        power_up: the same aircraft on another day: each power-up has other biases, about the usual ones.
        aircraft: another aircraft for the sensors; pose, motions and temperature are then those of that aircraft.
    """
    air_degc, rise_k, time_constant_s = warms or (25.0, 0.0, 1.0)
    temperature_degc = ThermalBoard(rise_k, time_constant_s).switched_on(air_degc)
    aircraft = aircraft or VirtualAircraft(
        pose, site_at(40.0, 116.0, 50.0, unix_s), motions=motions, temperature_degc=temperature_degc, unix_s=unix_s
    )

    def imu(
        number: int,
        rates_deg_h: Sequence[float],
        forces_mg: Sequence[float],
        name: str,
        mounting_deg: tuple[float, float, float] = (0.0, 0.0, 0.0),
        scale: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> ImuModel:
        usual = np.concatenate([np.multiply(rates_deg_h, DEG_H), np.multiply(forces_mg, MG)])
        piece = PARTS[name].piece(np.random.default_rng([seed, number]), usual)
        if power_up:
            usual = piece.turned_on(np.random.default_rng([seed, number, power_up]))
        return ImuModel(
            aircraft,
            name,
            seed=(seed + 1000 * power_up) * 10 + number,
            gyro_bias_rad_s=usual[:3],
            accel_bias_m_s2=usual[3:],
            accel_scale=scale,
            mounting_deg=mounting_deg,
            curve=piece.curve if warms is not None else None,
        )

    board = (*board_deg, 0.0)
    flight_controller = (
        imu(1, gyro_deg_h, accel_mg, part, board, accel_scale),
        imu(2, (-89.532, -98.564, -72.196), (-0.55739, -1.0068, 0.34809), part, board, accel_scale),
    )
    autopilot: AutopilotDouble
    if firmware == "px4":
        autopilot = PX4Double(aircraft, flight_controller, parameters={"MAV_1_FORWARD": 1}, seed=seed)
    else:
        parameters = {"INS_GYR_CAL": float(gyr_cal_at_boot)}
        autopilot = ArduPilotDouble(aircraft, flight_controller, parameters=parameters, seed=seed)
    inertial, tilt, magnetic = devices
    mounting_deg = fit("imu", inertial).model_mounting_deg
    serial = imu(3, (60.294, 124.657, 108.289), (0.21593, -2.2118, 1.2953), "bmi088", mounting_deg)
    made = make(serial, inertial, tilt, magnetic, seed)
    compass, gradienter = made.compass, made.gradienter
    if isinstance(compass, HMR3300):
        compass.heading_error_deg = 0.8
    if isinstance(gradienter, Gradienter) and tilt == DEMO_DEVICES[1]:
        gradienter = Gradienter(aircraft, seed=seed, offset_deg=gradienter_offset_deg)
    return Scenario(
        aircraft=aircraft,
        flight_controller_imus=flight_controller,
        serial_imu=serial,
        autopilot=autopilot,
        imu=made.imu,
        gradienter=gradienter,
        compass=compass,
        gradienter_law=law_of(gradienter),
    )
