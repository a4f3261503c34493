"""The devices on the companion's own ports as the configuration names them: one port, one device, one role or more.

The daemon and a replay share this, so that both hand the same samples to the same roles in the same order.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Literal

from companion.calibration.collector.rolling import RollingCollector
from companion.config.sections import Compass, Config, Gradienter, Imu
from companion.links.serial.bytestream import PortSettings
from companion.protocols.registry import PROTOCOLS, Kind, ProtocolInfo, part_for
from companion.samples import CompassSample, ImuSample, MagSample, Sample, TiltSample


@dataclasses.dataclass(frozen=True, slots=True)
class Role:
    """What a device is used as: under which name, and as which kind."""

    name: str
    kind: Kind
    north: Literal["magnetic", "true"] | None = None
    """The north that a compass' headings are configured to mean."""

    def refuses(self, sample: Sample) -> bool:
        """Whether this is a heading to another north than the configured one, by the device's own word."""
        return self.north is not None and isinstance(sample, CompassSample) and sample.north not in (None, self.north)


@dataclasses.dataclass(frozen=True, slots=True)
class SerialDevice:
    """One device: its line as configured, else as it comes from the factory."""

    port: str
    info: ProtocolInfo
    baud: int
    parity: Literal["none", "even", "odd"]
    read_only: bool
    roles: tuple[Role, ...]

    @property
    def settings(self) -> PortSettings:
        """Of its port."""
        return PortSettings(self.port, self.baud, self.parity)

    @property
    def name(self) -> str:
        """That of its first role; its bytes have it in a recording."""
        return self.roles[0].name


def serial_devices(config: Config) -> list[SerialDevice]:
    """All devices, in the order of their first roles: IMUs as configured, gradienter, compass."""
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
    # The configuration has been checked: what several sections say of one port agrees.
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
    """What each role takes of a sample."""
    for role in roles:
        if (part := part_for(role.kind, sample)) is not None and not role.refuses(sample):
            yield role, part


def collect(collector: RollingCollector, role: Role, part: Sample) -> TiltSample | CompassSample | None:
    """Give the collector what a role has taken; the reading of the pose that counts, or came of it, if any."""
    match part:
        case ImuSample():
            collector.add_imu(role.name, part)
        case TiltSample():
            collector.add_tilt(part)
            return part
        case CompassSample():
            return part if collector.add_compass(part) else None
        case MagSample():
            return collector.add_field(part)
    return None
