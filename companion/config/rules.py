"""Rules that span several keys of the configuration file; a check yields its complaints in words."""

from __future__ import annotations

import difflib
import ipaddress
import math
import re
from collections.abc import Iterator

from companion.config.sections import ALLOWED, Compass, Config, Gradienter, Imu, Mavlink, Mounting, Mqtt, Senders
from companion.config.words import allowed
from companion.errors import ConfigError
from companion.rotations import ROTATIONS_DEG

UPRIGHT_COSINE = 0.5
LAST_PORT = 65535
LEAST_RECORDINGS_MB = 8
MAX_TOPIC_BYTES = 200
"""Limit of `base_topic`; MQTT itself allows 65535."""
PORT_WORDS = "a device path (/dev/...) or tcp://HOST:PORT"
_SERIAL = 'only with source = "serial"'


def check_together(config: Config, name: str) -> None:
    """Check the rules; raise ConfigError with the first complaint."""
    for complaint in _complaints(config):
        raise ConfigError(f"{name}: {complaint}")


def _complaints(config: Config) -> Iterator[str]:
    yield from _imus(config)
    for section in ("gradienter", "compass"):
        device: Gradienter | Compass | None = getattr(config, section)
        if device is not None:
            yield from _mounting(device.mounting, f"{section}.mounting")
            yield from _upright(device.mounting, f"{section}.mounting")
            yield from _port(device.port, f"{section}.port")
    yield from _field_heading(config)
    yield from _ports_differ(config)
    yield from _mavlink_url(config.mavlink.url)
    yield from _access(config.mavlink)
    if config.web is not None and (wrong := bind_problem(config.web.bind, "'web.bind'")) is not None:
        yield wrong
    if config.mqtt is not None:
        yield from broker_complaints(config.mqtt)
    elif config.fleet is not None:
        yield "'mqtt' is missing; allowed: a table with the broker's host (needed by [fleet])"
    if (config.vehicle.latitude_deg is None) != (config.vehicle.longitude_deg is None):
        yield "'vehicle': found only one of latitude_deg and longitude_deg; allowed: both or neither"
    room_mb = config.storage.recordings_mb
    if room_mb is not None and 0 < room_mb < LEAST_RECORDINGS_MB:
        yield f"'storage.recordings_mb': found {room_mb}; allowed: 0 (none) or at least {LEAST_RECORDINGS_MB}"
    limits = config.calibration
    if limits.max_s < limits.min_still_s:
        yield f"'calibration.max_s': found {limits.max_s:g}; allowed: at least min_still_s ({limits.min_still_s:g})"


def _imus(config: Config) -> Iterator[str]:
    seen: dict[str, int] = {}
    autopilot_instances: dict[int, str] = {}
    for index, imu in enumerate(config.imu):
        here = f"imu[{index}]"
        if imu.name in seen:
            yield (
                f"'{here}.name': found {imu.name!r}, which imu[{seen[imu.name]}] has already;"
                " allowed: a name of its own for each IMU"
            )
        seen[imu.name] = index
        yield from _imu(imu, here)
        yield from _mounting(imu.mounting, f"{here}.mounting")
        target = (imu.instance or 1) if imu.source == "autopilot" else imu.autopilot_instance
        if target is not None and target in autopilot_instances:
            yield (
                f"'{here}': found autopilot IMU {target} a second time (imu {autopilot_instances[target]!r} has it);"
                " allowed: one source for each autopilot IMU"
            )
        if target is not None:
            autopilot_instances[target] = imu.name


def _imu(imu: Imu, here: str) -> Iterator[str]:
    if imu.source == "serial":
        for key, what in (("port", PORT_WORDS), ("protocol", allowed("imu.protocol"))):
            if getattr(imu, key) is None:
                yield f"'{here}.{key}' is missing; allowed: {what} (needed by source = \"serial\")"
        yield from _port(imu.port or "", f"{here}.port")
        if imu.instance is not None:
            yield (
                f"'{here}.instance': found {imu.instance}; allowed: only with source = \"autopilot\""
                " (autopilot_instance names the autopilot's IMU that this one is)"
            )
        return
    if imu.mounting != "ROTATION_NONE":
        yield (
            f"'{here}.mounting': found {imu.mounting!r}; allowed: {_SERIAL} (the autopilot's telemetry is in the"
            " vehicle's axes already)"
        )
    for key in ("port", "baud", "protocol", "autopilot_instance"):
        if (found := getattr(imu, key)) is not None:
            yield f"'{here}.{key}': found {found!r}; allowed: {_SERIAL} (this IMU is read over MAVLink)"
    if imu.read_only:
        yield f"'{here}.read_only': found true; allowed: {_SERIAL} (nothing is said to an autopilot's IMU)"


def _field_heading(config: Config) -> Iterator[str]:
    if config.compass is None or config.compass.heading != "field":
        return
    if config.gradienter is None:
        yield "'compass.heading': found 'field'; allowed: only with a [gradienter], whose tilt it needs"
    if config.compass.reference != "magnetic":
        yield "'compass.heading': found 'field'; allowed: only with reference = \"magnetic\", the north of a field"


def _port(port: str, here: str) -> Iterator[str]:
    address = re.fullmatch(r"tcp://\S+:(\d{1,5})", port)
    if not port.startswith("/") and not (address and 1 <= int(address[1]) <= LAST_PORT):
        yield f"{here!r}: found {port!r}; allowed: {PORT_WORDS}"


def _ports_differ(config: Config) -> Iterator[str]:
    """Check that each port has one user; the roles of one device share theirs, and agree on the line."""
    used: dict[str, list[tuple[str, Imu | Gradienter | Compass]]] = {}
    for here, device in _serial_devices(config):
        for before, other in (sharing := used.setdefault(device.port or "", [])):
            yield from _shared(here, device, before, other)
        sharing.append((here, device))
    if config.mavlink.url.startswith("serial:"):
        port = config.mavlink.url.removeprefix("serial:").rpartition(":")[0]
        if port in used:
            yield (
                f"'mavlink.url': found {port!r}, which {used[port][0][0]}.port has already; allowed: a port of its own"
            )


def _serial_devices(config: Config) -> Iterator[tuple[str, Imu | Gradienter | Compass]]:
    yield from ((f"imu[{index}]", imu) for index, imu in enumerate(config.imu) if imu.port is not None)
    if config.gradienter is not None:
        yield "gradienter", config.gradienter
    if config.compass is not None:
        yield "compass", config.compass


def _shared(
    here: str, device: Imu | Gradienter | Compass, before: str, other: Imu | Gradienter | Compass
) -> Iterator[str]:
    if isinstance(device, Imu) and isinstance(other, Imu):
        yield f"'{here}.port': found {device.port!r}, which {before}.port has already; allowed: a port of its own"
    for key in ("protocol", "baud", "parity"):
        ours, theirs = getattr(device, key, None), getattr(other, key, None)
        # What one section leaves open, another may say: there is one device and one line.
        if ours is not None and theirs is not None and ours != theirs:
            yield (
                f"'{here}.{key}': found {ours!r} on {device.port}, where {before}.{key} is {theirs!r}; allowed:"
                f" {theirs!r} (one device serves both), or a port of its own"
            )


_MAVLINK_URL = re.compile(r"(udpin|udpout|tcp):[^:\s]+:(?P<port>\d{1,5})|serial:/\S+:\d{3,7}")


def _mavlink_url(url: str) -> Iterator[str]:
    match = _MAVLINK_URL.fullmatch(url)
    if match is None or (match["port"] and not 1 <= int(match["port"]) <= LAST_PORT):
        yield (
            f"'mavlink.url': found {url!r}; allowed: udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT"
            " or serial:PATH:BAUD, with ports from 1 to 65535"
        )


_BIND = re.compile(r"(?:\[(?P<six>[0-9a-fA-F:.]+)\]|(?P<host>[^:\[\]]+)):(?P<port>\d{1,5})")


def bind_problem(bind: str, name: str) -> str | None:
    """Return why a page cannot be bound there, or None.

    Numbers only: what a name stands for may change with the network, and with it who can reach the page.
    """
    match = _BIND.fullmatch(bind)
    host = (match["six"] or match["host"]) if match else ""
    if match and int(match["port"]) <= LAST_PORT and (host == "localhost" or is_address(host)):
        return None
    return (
        f"{name}: found {bind!r}; allowed: ADDRESS:PORT, such as 127.0.0.1:8191 (this board only),"
        " 192.168.4.1:8191 or [::1]:8191"
    )


def is_address(host: str) -> bool:
    """Return whether it is an IP address, and no name."""
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


def _mounting(mounting: Mounting, here: str) -> Iterator[str]:
    if not isinstance(mounting, str):
        if max(map(abs, mounting)) > 360.0:
            yield f"{here!r}: found {list(mounting)}; allowed: angles within 360 degrees"
    elif mounting not in ROTATIONS_DEG:
        near = difflib.get_close_matches(mounting, ROTATIONS_DEG, n=1)
        hint = f" (did you mean {near[0]}?)" if near else ""
        yield (
            f"{here!r}: found {mounting!r}{hint}; allowed: a MAVLink rotation name such as"
            ' "ROTATION_YAW_90", or [roll, pitch, yaw] in degrees'
        )


def _upright(mounting: Mounting, here: str) -> Iterator[str]:
    """Refuse a gradienter or compass on its side or head: it does not work there, and cannot tell."""
    roll_deg, pitch_deg, _ = ROTATIONS_DEG[mounting] if isinstance(mounting, str) else mounting
    if math.cos(math.radians(roll_deg)) * math.cos(math.radians(pitch_deg)) < UPRIGHT_COSINE:
        yield f"{here!r}: found {mounting!r}, on its side or upside down; allowed: within 60 degrees of upright"


def _access(mavlink: Mavlink) -> Iterator[str]:
    for entry in mavlink.allow:
        try:
            Senders([entry])
        except ValueError:
            yield f"'mavlink.allow': found {entry!r}; allowed: {ALLOWED}"
    if mavlink.signing in ("sign", "require") and mavlink.signing_key_file is None:
        yield (
            "'mavlink.signing_key_file' is missing; allowed: a text, not empty (needed by signing ="
            f' "{mavlink.signing}")'
        )
    yield from _secret(mavlink.signing_key_file, "mavlink.signing_key_file")


def _secret(path: str | None, here: str) -> Iterator[str]:
    if path is not None and "/" in path and not path.startswith("/"):
        yield (
            f"{here!r}: found {path!r}; allowed: a path that begins with /, or the bare name of a systemd credential"
        )


def broker_complaints(mqtt: Mqtt) -> Iterator[str]:
    """Yield the complaints about [mqtt]."""
    if mqtt.base_topic is not None:
        yield from _topic(mqtt.base_topic)
    if mqtt.password_file is not None and mqtt.username is None:
        yield "'mqtt.username' is missing; allowed: a text, not empty (needed by password_file)"
    yield from _secret(mqtt.password_file, "mqtt.password_file")
    for key in ("ca_file", "cert_file", "key_file"):
        path = getattr(mqtt, key)
        if path is not None and not mqtt.tls:
            yield f"'mqtt.{key}': found {path!r}; allowed: only with tls = true"
        if path is not None and not path.startswith("/"):
            yield f"'mqtt.{key}': found {path!r}; allowed: a path that begins with /"
    for key, other in (("cert_file", "key_file"), ("key_file", "cert_file")):
        if getattr(mqtt, key) is not None and getattr(mqtt, other) is None:
            yield f"'mqtt.{other}' is missing; allowed: a path (needed by {key})"


_TOPIC = re.compile(r"(?!\$)[^+# /]+(/[^+# /]+)*")


def _topic(topic: str) -> Iterator[str]:
    if len(topic.encode()) > MAX_TOPIC_BYTES or not _TOPIC.fullmatch(topic):
        yield (
            f"'mqtt.base_topic': found {topic!r}; allowed: words with / between them, such as"
            f' "field/heron", without + # or blanks, at most {MAX_TOPIC_BYTES} bytes'
        )
