"""Sections of the configuration file, their keys and allowed values."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Final, Literal

import msgspec
from msgspec import Meta

from companion.samples import Triad

EVERYBODY: Final = ("*",)
ALLOWED: Final = '"SYSTEM" or "SYSTEM:COMPONENT", each a number from 0 to 255, a range such as 250-255, or *'
_IDS: Final = re.compile(r"(?:\*|([0-9]{1,3})(?:-([0-9]{1,3}))?)")


class Senders:
    """Set of MAVLink senders such as "255", "255:190" (system:component), "250-255"; ValueError for other forms."""

    def __init__(self, entries: Iterable[str]) -> None:
        self._pairs = [_pair(entry) for entry in entries]

    def __contains__(self, sender: tuple[int, int]) -> bool:
        system, component = sender
        return any(system in systems and component in components for systems, components in self._pairs)


def _pair(entry: str) -> tuple[range, range]:
    system, colon, component = entry.partition(":")
    return _range(system, entry), _range(component, entry) if colon else range(256)


def _range(words: str, entry: str) -> range:
    match = _IDS.fullmatch(words)
    if match is None:
        raise ValueError(entry)
    if match[1] is None:
        return range(256)
    first, last = int(match[1]), int(match[2] or match[1])
    if not first <= last <= 255:
        raise ValueError(entry)
    return range(first, last + 1)


ImuProtocol = Literal["vectornav", "imu_line", "witmotion", "mip", "xsens", "stim300"]
Profile = Literal["icm42688p", "bmi088", "adis16470", "adis16405", "unknown"]
"""Names of the built-in noise profiles of IMUs; `companion log profile --save` estimates and saves further ones."""
UNKNOWN: Final[Profile] = "unknown"
"""Noise profile for an IMU of unknown type: as noisy as the worst of the common types."""
GradienterProtocol = Literal[
    "inclinometer_xy", "jewell", "hmr3300", "nmea", "os5000", "rion", "pni", "witmotion", "stim300"
]
CompassProtocol = Literal["hmr3300", "nmea", "os5000", "pni", "rion"]
Law = Literal["axis", "slope", "euler"]
Parity = Literal["none", "even", "odd"]
Platform = Literal["ground", "deck"]
AtArm = Literal["gate", "warn", "off"]
LogLevel = Literal["debug", "info", "warning", "error"]
Signing = Literal["off", "sign", "require"]
Location = Literal["off", "1km", "full"]

LATITUDE_DEG: Final = (-90.0, 90.0)
LONGITUDE_DEG: Final = (-180.0, 180.0)
HEIGHT_M: Final = (-500.0, 9000.0)
Latitude = Annotated[float, Meta(ge=LATITUDE_DEG[0], le=LATITUDE_DEG[1])]
Longitude = Annotated[float, Meta(ge=LONGITUDE_DEG[0], le=LONGITUDE_DEG[1])]
Height = Annotated[float, Meta(ge=HEIGHT_M[0], le=HEIGHT_M[1])]
Baud = Annotated[int, Meta(ge=300, le=4_000_000)]
PositiveFloat = Annotated[float, Meta(gt=0)]
NonEmpty = Annotated[str, Meta(min_length=1)]
# Plain str on purpose: with a length limit in a union with a tuple, msgspec (0.19 to 0.22) corrupts memory.
Mounting = str | tuple[float, float, float]
"""Rotation from sensor axes to vehicle axes (FRD): a MAVLink rotation name, or [roll, pitch, yaw] in degrees."""


def secret_path(name: str) -> Path:
    """Return the path of a file with a secret; a bare file name is looked up among systemd's credentials."""
    return Path(os.environ.get("CREDENTIALS_DIRECTORY", "/")) / name


class Section(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True): ...


class VehicleSection(Section, frozen=True):
    """Section [vehicle]: platform under the parked vehicle; place and system id that replace the autopilot's values."""

    latitude_deg: Latitude | None = None
    longitude_deg: Longitude | None = None
    height_m: Height | None = None
    system_id: Annotated[int, Meta(ge=1, le=255)] | None = None
    platform: Platform = "ground"
    """Platform: "ground" is fixed to the Earth; "deck" can turn and sway (a boat, a car with its engine running)."""


class Mavlink(Section, frozen=True):
    url: NonEmpty
    component_id: Annotated[int, Meta(ge=2, le=255)] = 191
    """MAVLink component id of the companion; 0 (broadcast) and 1 (autopilot) are reserved."""
    allow: tuple[str, ...] = EVERYBODY
    """MAVLink senders that may calibrate, cancel, undo and set our parameters, such as "255" or "255:190"."""
    signing: Signing | None = None
    signing_key_file: NonEmpty | None = None

    @property
    def signing_mode(self) -> Signing:
        """Mode of MAVLink signing; if none is configured: "require" with a key file, "off" without."""
        return self.signing or ("off" if self.signing_key_file is None else "require")

    @property
    def signing_key_path(self) -> Path | None:
        return None if self.signing_key_file is None else secret_path(self.signing_key_file)


class AllanModel(msgspec.Struct, frozen=True):
    """Coefficients of the Allan deviation of one gyro axis (unit u = rad/s) or accelerometer axis (u = m/s^2)."""

    white: float  # White noise N, u sqrt(s)
    flicker: float  # Flicker noise B, u; the floor of the Allan deviation is 0.664 B
    walk: float  # Random walk K, u/sqrt(s)

    @property
    def floor(self) -> float:
        return math.sqrt(2.0 * math.log(2.0) / math.pi) * self.flicker


class NoiseProfile(msgspec.Struct, frozen=True):
    """Noise of one type of IMU: a built-in profile, or one estimated by `companion log profile --save`."""

    name: NonEmpty
    gyro: AllanModel
    accel: AllanModel
    origin: str = ""  # Description of the recordings from which a saved profile was estimated
    warm_up: tuple[float, float] | None = None
    """Bias change from cold to warm, as a 2-sigma limit: gyro in rad/s, accelerometer in m/s^2; None: unknown."""

    def of(self, triad: Triad) -> AllanModel:
        return self.gyro if triad == "gyro" else self.accel

    @property
    def is_named(self) -> bool:
        return self.name != UNKNOWN


class Imu(Section, frozen=True):
    """Section [[imu]]: one IMU to calibrate, of the autopilot (read over MAVLink) or of the companion (serial port)."""

    name: NonEmpty
    source: Literal["autopilot", "serial"]
    instance: Annotated[int, Meta(ge=1, le=3)] | None = None  # Number of the autopilot's IMU; None: 1
    port: NonEmpty | None = None
    baud: Baud | None = None
    protocol: ImuProtocol | None = None
    mounting: Mounting = "ROTATION_NONE"
    autopilot_instance: Annotated[int, Meta(ge=1, le=3)] | None = None
    read_only: bool = False  # True: nothing is ever sent to the device on this port
    profile: str | NoiseProfile | None = None  # Noise profile: a built-in one (`Profile`), or a saved one

    @property
    def is_flown(self) -> bool:
        """True if the autopilot flies with this IMU."""
        return self.source == "autopilot" or self.autopilot_instance is not None


class Gradienter(Section, frozen=True):
    port: NonEmpty
    protocol: GradienterProtocol
    law: Law
    baud: Baud | None = None
    parity: Parity | None = None
    mounting: Mounting = "ROTATION_NONE"
    offset_deg: tuple[float, float] = (0.0, 0.0)
    sigma_deg: PositiveFloat | None = None
    """Sigma of the gradienter's tilt; None: the figure of its protocol (protocols/registry.py), or 0.05 without one."""
    read_only: bool = False
    lag_s: Annotated[float, Meta(ge=0, le=60)] | None = None
    """Time constant of the gradienter's fluid and filters; None: the figure of its protocol (protocols/registry.py)."""


class Compass(Section, frozen=True):
    port: NonEmpty
    protocol: CompassProtocol
    baud: Baud | None = None
    parity: Parity | None = None
    reference: Literal["magnetic", "true"] = "magnetic"
    mounting: Mounting = "ROTATION_NONE"
    offset_deg: Annotated[float, Meta(ge=-360, le=360)] = 0.0
    sigma_deg: PositiveFloat | None = None
    """Sigma of the compass heading; None: the figure of its protocol (protocols/registry.py), or 3 without one."""
    read_only: bool = False
    lag_s: Annotated[float, Meta(ge=0, le=60)] | None = None
    heading: Literal["device", "field"] = "device"
    """Source of the heading. "device": the compass itself. "field": its field vector and the gradienter's tilt."""
    counts_per_gauss: PositiveFloat | None = None
    """Scale of a compass that reports the magnetic field in counts; None: the field strength is not checked."""


class Calibration(Section, frozen=True):
    min_still_s: Annotated[float, Meta(ge=2, le=600)] = 10.0
    max_s: Annotated[float, Meta(ge=2, le=3600)] = 60.0
    target_gyro_sigma_deg_h: PositiveFloat = 5.0
    target_accel_sigma_mg: PositiveFloat = 0.2
    at_arm: AtArm = "warn"
    max_age_min: PositiveFloat = 30.0
    """Time from a calibration's last confirmation until it is out of date (docs/reference/method.md section 3.2)."""
    max_temperature_change_degc: PositiveFloat = 3.0
    """Temperature change after which a confirmed calibration is out of date, if no temperature curve is known."""
    prior: bool = True
    """True: check a new calibration against earlier ones, and combine it with them (docs/calibration.md)."""
    any_bias: bool = False
    """True: accept an implausibly large bias, and measured gravity that contradicts the tilt."""


class Push(Section, frozen=True):
    parameters: bool = True
    attitude: Literal["off", "yaw", "full"] = "off"
    attitude_rate_hz: Annotated[float, Meta(gt=0, le=50)] = 30.0
    stop_rivals: bool = False
    """True: switch off the autopilot's functions that overwrite our biases; an undo switches them on again."""


class ComponentSection(Section, frozen=True):
    tunes: bool = True
    """True: play tunes on the autopilot's buzzer while it is disarmed."""


class Mqtt(Section, frozen=True):
    host: NonEmpty
    port: Annotated[int, Meta(ge=1, le=65535)] | None = None
    base_topic: NonEmpty | None = None
    """Beginning of all MQTT topics; None: "companion/" and the vehicle's system id."""
    client_id: NonEmpty | None = None
    """MQTT client id; None: the base topic, with each "/" replaced by "-"."""
    username: NonEmpty | None = None
    password_file: NonEmpty | None = None
    tls: bool = False
    ca_file: NonEmpty | None = None  # Authority that signed the broker's certificate; None: the system's authorities
    cert_file: NonEmpty | None = None
    key_file: NonEmpty | None = None
    keepalive_s: Annotated[int, Meta(ge=5, le=600)] = 15

    @property
    def broker_port(self) -> int:
        return self.port or (8883 if self.tls else 1883)

    @property
    def password_path(self) -> Path | None:
        return None if self.password_file is None else secret_path(self.password_file)


class Fleet(Section, frozen=True):
    """Section [fleet]: reports to the collector of a fleet over MQTT. Without this section, no reports are sent."""

    name: NonEmpty | None = None  # Name of the aircraft
    location: Location = "off"  # Precision of the location in the reports


class Control(Section, frozen=True):
    socket: NonEmpty | None = None
    group: NonEmpty | None = None  # Group whose members may use the socket, besides the daemon's user and root

    @property
    def group_name(self) -> str | None:
        """User group of the control socket: the configured one, else the one that systemd's unit sets, else None."""
        return self.group or os.environ.get("COMPANION_CONTROL_GROUP") or None

    @property
    def path(self) -> Path:
        """Path of the control socket: as configured, else in systemd's runtime directory, else in /run/companion."""
        if self.socket is not None:
            return Path(self.socket)
        return Path(os.environ.get("RUNTIME_DIRECTORY", "/run/companion")) / "control.sock"


class Storage(Section, frozen=True):
    directory: NonEmpty | None = None
    recordings_mb: Annotated[int, Meta(ge=0, le=1_000_000)] | None = None
    """Disk space for recordings; new data overwrite the oldest. 0: no recordings. None: 64, if mcap is installed."""

    @property
    def path(self) -> Path:
        """Storage folder of the daemon: as configured, else systemd's state directory, else /var/lib/companion."""
        if self.directory is not None:
            return Path(self.directory)
        return Path(os.environ.get("STATE_DIRECTORY", "/var/lib/companion"))


class Log(Section, frozen=True):
    level: LogLevel = "info"


class Web(Section, frozen=True):
    bind: NonEmpty


class Config(Section, frozen=True):
    mavlink: Mavlink
    imu: Annotated[list[Imu], Meta(min_length=1)]
    vehicle: VehicleSection = VehicleSection()
    gradienter: Gradienter | None = None
    compass: Compass | None = None
    calibration: Calibration = Calibration()
    push: Push = Push()
    component: ComponentSection = ComponentSection()
    mqtt: Mqtt | None = None
    fleet: Fleet | None = None
    control: Control = Control()
    storage: Storage = Storage()
    log: Log = Log()
    web: Web | None = None
