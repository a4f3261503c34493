"""Functions that create sensor models and serial devices from the configuration."""

from __future__ import annotations

import dataclasses
import datetime
import functools
import time
from collections.abc import Iterator, Sequence
from typing import Final, Literal

import msgspec

from companion.autopilot.firmware.imu_messages import ImuMessage
from companion.autopilot.vehicle.vehicle import Vehicle
from companion.config.sections import (
    UNKNOWN,
    Compass,
    Config,
    Gradienter,
    GradienterProtocol,
    Imu,
    NoiseProfile,
    Parity,
    Profile,
)
from companion.estimation.collector.intake import Settings
from companion.estimation.collector.rolling import RollingCollector
from companion.estimation.deck.deck import KEPT_S, Deck
from companion.estimation.means.pose import CompassModel, GradienterModel
from companion.estimation.means.windows import ImuInput
from companion.estimation.noise.allan import PROFILES, noise_profile, predicted_sigma
from companion.estimation.records.record import AlignmentUsed
from companion.estimation.solution.site import Whereabouts
from companion.links.serial.bytestream import PortSettings
from companion.physics.frames import rotation_matrix
from companion.physics.units import DEG_H, MG
from companion.protocols.guess import Line
from companion.protocols.registry import PROTOCOLS, Kind, ProtocolInfo, part_for
from companion.samples import CompassSample, ImuSample, MagSample, Sample, TiltSample
from companion.storage.profiles import ProfileStore

IMU_RATE_HZ: Final = 100.0
"""Message rate to request for each autopilot IMU if no serial line limits it. The autopilot's filters pass 20 Hz."""
LEAST_IMU_RATE_HZ: Final = 10.0
LINE_SHARE: Final = 0.5
BITS_PER_BYTE: Final = 10.0  # Bits on the wire for one byte (8N1): a start bit, eight bits of data, a stop bit
# Lengths of MAVLink 2 messages: the payload, and 12 bytes of header and checksum.
HIGHRES_BYTES: Final = 75.0  # Length of HIGHRES_IMU: 63 + 12 bytes
VISION_BYTES: Final = 129.0  # Length of VISION_POSITION_ESTIMATE: 117 + 12 bytes
SCALED_BYTES: Final = 36.0  # Length of SCALED_IMU2 and SCALED_IMU3: 24 + 12 bytes

TILT_SIGMA_DEG: Final = 0.05
"""Default sigma of a gradienter's tilt, due to sensor and mounting; protocols of worse devices set a larger sigma."""
TILT_BY_THE_WAY_SIGMA_DEG: Final = 0.65
"""Default sigma of a tilt that a compass or an IMU reports; taken from the HMR3300 compass."""
HEADING_SIGMA_DEG: Final = 3.0
"""Default sigma of a compass heading, caused by the aircraft's own iron and currents."""


def settings(config: Config) -> Settings:
    wanted = config.calibration
    return Settings(
        min_still_s=wanted.min_still_s,
        max_s=wanted.max_s,
        target_gyro_sigma_rad_s=wanted.target_gyro_sigma_deg_h * DEG_H,
        target_accel_sigma_m_s2=wanted.target_accel_sigma_mg * MG,
    )


def baud_of(url: str) -> int | None:
    return int(url.rpartition(":")[2]) if url.startswith("serial:") else None


def imu_rate_hz(config: Config) -> float:
    """Return the message rate for each autopilot IMU, for example 38 Hz for one IMU on a serial line with 57600 baud.

    All IMUs share half of the line, with at least 10 Hz: on a full line, an autopilot drops messages and answers late.
    """
    baud = baud_of(config.mavlink.url)
    instances = [imu.instance or 1 for imu in config.imu if imu.source == "autopilot"]
    each_time = sum(HIGHRES_BYTES if instance == 1 else SCALED_BYTES for instance in instances)
    if baud is None or not each_time:
        return IMU_RATE_HZ
    return max(LEAST_IMU_RATE_HZ, min(IMU_RATE_HZ, LINE_SHARE * baud / BITS_PER_BYTE / each_time))


def attitude_rate_hz(config: Config) -> float:
    """Return the rate of attitude messages to the autopilot. At 57600 baud it is at most 22 Hz (half of the line)."""
    wanted, baud = config.push.attitude_rate_hz, baud_of(config.mavlink.url)
    return wanted if baud is None else min(wanted, LINE_SHARE * baud / BITS_PER_BYTE / VISION_BYTES)


def ineffective_settings(config: Config) -> list[str]:
    """List the settings that can have no effect, to report them at start."""
    if config.push.attitude == "off" or config.compass is not None:
        return []
    return [f'push.attitude = "{config.push.attitude}" needs [compass]: without one no heading is known']


def doubtful_settings(config: Config) -> list[str]:
    found, gradienter = [], config.gradienter
    if config.mavlink.signing_mode == "off" and config.mavlink.signing_key_file is not None:
        found.append('mavlink.signing_key_file is named, but signing = "off": nothing is signed or checked')
    law = gradienter and PROTOCOLS["gradienter"][gradienter.protocol].law
    if gradienter is not None and law is not None and law != gradienter.law:
        found.append(
            f'gradienter.law: found "{gradienter.law}"; protocol "{gradienter.protocol}" gives "{law}" angles: say that'
        )
    return found


def imu_input(imu: Imu, kind: ImuMessage | None) -> ImuInput:
    return ImuInput(
        name=imu.name,
        rotation=rotation_matrix(imu.mounting if imu.source == "serial" else "ROTATION_NONE"),
        profile=noise_profile(imu.profile),
        gyro_step_rad_s=kind.gyro_step_rad_s if kind else 0.0,
        accel_step_m_s2=kind.accel_step_m_s2 if kind else 0.0,
        clock_from_start=imu.protocol is None or PROTOCOLS["imu"][imu.protocol].decoder.clock_from_start,
    )


def collector(config: Config) -> RollingCollector:
    wanted, pose = settings(config), (gradienter_model(config.gradienter), compass_model(config.compass))
    windows = Deck(*pose, wanted.horizon_s) if config.vehicle.platform == "deck" else None
    return RollingCollector(wanted, [imu_input(imu, None) for imu in config.imu], *pose, windows)


def gradienter_model(gradienter: Gradienter | None) -> GradienterModel | None:
    if gradienter is None:
        return None
    info = PROTOCOLS["gradienter"][gradienter.protocol]
    return GradienterModel(
        law=gradienter.law,
        vehicle_from_sensor=rotation_matrix(gradienter.mounting),
        offset_deg=gradienter.offset_deg,
        sigma_deg=gradienter.sigma_deg or tilt_sigma_deg(gradienter.protocol),
        lag_s=info.lag_s if gradienter.lag_s is None else gradienter.lag_s,
    )


def tilt_sigma_deg(protocol: GradienterProtocol) -> float:
    known = PROTOCOLS["gradienter"][protocol].sigma_deg
    by_the_way = protocol in PROTOCOLS["compass"] or protocol in PROTOCOLS["imu"]
    return known or (TILT_BY_THE_WAY_SIGMA_DEG if by_the_way else TILT_SIGMA_DEG)


def compass_model(compass: Compass | None) -> CompassModel | None:
    if compass is None:
        return None
    info = PROTOCOLS["compass"][compass.protocol]
    said_deg = compass.sigma_deg
    return CompassModel(
        magnetic=compass.reference == "magnetic",
        vehicle_from_sensor=rotation_matrix(compass.mounting),
        offset_deg=compass.offset_deg,
        sigma_deg=said_deg or info.sigma_deg or HEADING_SIGMA_DEG,
        tilted_sigma_deg=info.tilted_sigma_deg if said_deg is None else None,
        counts_per_gauss=compass.counts_per_gauss,
        prefers_field=compass.heading == "field",
        lag_s=info.lag_s if compass.lag_s is None else compass.lag_s,
    )


def whereabouts(config: Config, vehicle: Vehicle) -> Whereabouts:
    """Return the place (the configured one, otherwise the autopilot's) and the date.

    The date comes from the autopilot's GNSS, otherwise from the host; it only selects the year of the magnetic model.
    """
    unix_s = time.time() if vehicle.place.unix_time_s is None else vehicle.place.unix_time_s
    date = datetime.datetime.fromtimestamp(unix_s, tz=datetime.UTC).date()
    place, position = config.vehicle, vehicle.place.position
    if place.latitude_deg is not None:
        height_m, source = place.height_m, "configuration"
        if height_m is None and position is not None:
            height_m, source = position.height_m, f"configuration; height: {position.source}"
        return Whereabouts(place.latitude_deg, place.longitude_deg, height_m, source, date)
    if position is not None:
        height_m = position.height_m if place.height_m is None else place.height_m
        source = position.source if place.height_m is None else f"{position.source}; height: configuration"
        return Whereabouts(position.latitude_deg, position.longitude_deg, height_m, source, date)
    return Whereabouts(height_m=place.height_m, source=None, date=date)


def place_doubt(config: Config, vehicle: Vehicle) -> str | None:
    """Return a doubt about the autopilot's position; None: no doubt, or the configuration has both place and height."""
    place = config.vehicle
    return None if place.latitude_deg is not None and place.height_m is not None else vehicle.place.doubt


def aligned(model: GradienterModel | None, used: AlignmentUsed | None) -> GradienterModel | None:
    """Return the configured gradienter model, corrected by the zero offset and sigma that an alignment has measured."""
    if model is None or used is None:
        return model
    x_deg, y_deg = model.offset_deg
    return dataclasses.replace(
        model, offset_deg=(x_deg + used.offset_deg[0], y_deg + used.offset_deg[1]), sigma_deg=used.sigma_deg
    )


@dataclasses.dataclass(frozen=True, slots=True)
class Role:
    """Role of a serial device: IMU, gradienter or compass. One device can have several roles."""

    name: str
    kind: Kind
    north: Literal["magnetic", "true"] | None = None  # Configured north of a compass' headings

    def refuses(self, sample: Sample) -> bool:
        """Return True for a heading whose north (magnetic or true) is not the configured one."""
        return self.north is not None and isinstance(sample, CompassSample) and sample.north not in (None, self.north)


@dataclasses.dataclass(frozen=True, slots=True)
class SerialDevice:
    """One device on a serial port. Baud rate and parity: as configured, otherwise the factory settings."""

    port: str
    info: ProtocolInfo
    baud: int
    parity: Parity
    read_only: bool
    roles: tuple[Role, ...]

    @property
    def settings(self) -> PortSettings:
        return PortSettings(self.port, self.baud, self.parity)

    @property
    def line(self) -> Line:
        return Line(self.baud, self.parity)

    @property
    def name(self) -> str:
        """Name of the device, equal to the name of its first role. Recordings store its bytes under this name."""
        return self.roles[0].name

    @property
    def kind(self) -> Kind:
        return self.roles[0].kind


def serial_devices(config: Config) -> list[SerialDevice]:
    shared: dict[str, list[tuple[Role, Imu | Gradienter | Compass]]] = {}
    for role, section in _sections(config):
        shared.setdefault(section.port or "", []).append((role, section))
    return [_device(port, used) for port, used in shared.items()]


def _sections(config: Config) -> Iterator[tuple[Role, Imu | Gradienter | Compass]]:
    for imu in config.imu:
        if imu.source == "serial":
            yield Role(imu.name, "imu"), imu
    if config.gradienter is not None:
        yield Role("gradienter", "gradienter"), config.gradienter
    if config.compass is not None:
        yield Role("compass", "compass", config.compass.reference), config.compass


def _device(port: str, used: Sequence[tuple[Role, Imu | Gradienter | Compass]]) -> SerialDevice:
    # The configuration has been checked: sections that share a port do not contradict each other.
    (first, section), sections = used[0], [section for _, section in used]
    info = PROTOCOLS[first.kind][section.protocol or ""]
    return SerialDevice(
        port=port,
        info=info,
        baud=next((each.baud for each in sections if each.baud is not None), info.baud),
        parity=next((each.parity for each in sections if not isinstance(each, Imu) and each.parity), info.parity),
        read_only=any(each.read_only for each in sections),
        roles=tuple(role for role, _ in used),
    )


def parts_of(sample: Sample, roles: Sequence[Role]) -> Iterator[tuple[Role, Sample]]:
    for role in roles:
        if (part := part_for(role.kind, sample)) is not None and not role.refuses(sample):
            yield role, part


def collect(into: RollingCollector, role: Role, part: Sample) -> TiltSample | CompassSample | None:
    """Pass a sample to the collector; return a tilt sample, or a heading that the collector uses, otherwise None."""
    match part:
        case ImuSample():
            into.add_imu(role.name, part)
        case TiltSample():
            into.add_tilt(part)
            return part
        case CompassSample():
            return part if into.add_compass(part) else None
        case MagSample():
            return into.add_field(part)
    return None


def gyro_sigmas_deg_h(config: Config) -> dict[str, float]:
    """Predict the sigma in deg/h of a gyro bias averaged over the longest window, for each built-in noise profile.

    The sigma covers noise and the drift in the 180 s after the window, but not warm-up or the rounding of telemetry.
    """
    mean_s = config.calibration.max_s if config.vehicle.platform == "ground" else KEPT_S
    horizon_s = settings(config).horizon_s
    known = {name: one.gyro for name, one in PROFILES.items() if one.is_named}
    return {name: predicted_sigma(gyro, mean_s, horizon_s) / DEG_H for name, gyro in known.items()}


class Profiles:
    """Noise profiles of the IMUs: each as configured, otherwise by the type of sensor that the autopilot reports."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._imus = {imu.name: imu for imu in config.imu}
        self._parts: dict[str, Profile | None] = {}

    def found(self, name: str, part: Profile | None) -> bool:
        """Store the type of sensor that the autopilot reports for an IMU; return True if its noise profile changes."""
        before = self.of(name)
        self._parts[name] = part
        return self.of(name) != before

    def of(self, name: str) -> str | NoiseProfile | None:
        """Return the noise profile of an IMU; None: the type of sensor is unknown."""
        return self._imus[name].profile or self._parts.get(name)

    def imu(self, name: str) -> Imu:
        return msgspec.structs.replace(self._imus[name], profile=self.of(name))

    def status(self) -> list[dict[str, object]]:
        found: list[dict[str, object]] = []
        for name, imu in self._imus.items():
            profile, file = self.of(name), None
            by_device_id = imu.profile is None and profile is not None
            if isinstance(profile, NoiseProfile):
                file, summary = ProfileStore(self._config.storage.path).path(profile.name), profile.origin
                profile = profile.name
            elif profile in (None, UNKNOWN):
                summary = self._price_of_unknown
            else:
                summary = f"of the catalogue{', by its device id' if by_device_id else ''}"
            label = "part unknown: " if profile in (None, UNKNOWN) else f"{profile}, "
            found.append(
                {
                    "imu": name,
                    "name": profile,
                    "fitted": file is not None,
                    "by_device_id": by_device_id,
                    "file": None if file is None else str(file),
                    "summary": label + summary,
                }
            )
        return found

    @functools.cached_property
    def _price_of_unknown(self) -> str:
        known = ", ".join(f"{part} {sigma:.0f}" for part, sigma in gyro_sigmas_deg_h(self._config).items())
        return f"its noise is learned at rest; a named part has a surer sigma (gyros, deg/h: {known})"
