"""Rules that compare keys of the configuration file with each other; each rule yields its complaints as text."""

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
MAX_TOPIC_BYTES = 200  # Limit of `base_topic`; MQTT itself allows 65535
PORT_WORDS = "a device path (/dev/...) or tcp://HOST:PORT"
_SERIAL = 'only with source = "serial"'


def check_together(config: Config, name: str) -> None:
    """Check the rules that compare keys with each other; raise ConfigError with the first complaint."""
    for complaint in _complaints(config):
        raise ConfigError(f"{name}: {complaint}")


def _wrong(key: str, found: object, allowed: str) -> str:
    return f"{key!r}: found {found}; allowed: {allowed}"


def _missing(key: str, allowed: str, needed_by: str) -> str:
    return f"{key!r} is missing; allowed: {allowed} (needed by {needed_by})"


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
        yield _missing("mqtt", "a table with the broker's host", "[fleet]")
    if (config.vehicle.latitude_deg is None) != (config.vehicle.longitude_deg is None):
        yield _wrong("vehicle", "only one of latitude_deg and longitude_deg", "both or neither")
    room_mb = config.storage.recordings_mb
    if room_mb is not None and 0 < room_mb < LEAST_RECORDINGS_MB:
        yield _wrong("storage.recordings_mb", room_mb, f"0 (none) or at least {LEAST_RECORDINGS_MB}")
    limits = config.calibration
    if limits.max_s < limits.min_still_s:
        yield _wrong("calibration.max_s", f"{limits.max_s:g}", f"at least min_still_s ({limits.min_still_s:g})")


def _imus(config: Config) -> Iterator[str]:
    seen: dict[str, int] = {}
    autopilot_instances: dict[int, str] = {}
    for index, imu in enumerate(config.imu):
        here = f"imu[{index}]"
        if imu.name in seen:
            found = f"{imu.name!r}, which imu[{seen[imu.name]}] has already"
            yield _wrong(f"{here}.name", found, "a name of its own for each IMU")
        seen[imu.name] = index
        yield from _imu(imu, here)
        yield from _mounting(imu.mounting, f"{here}.mounting")
        target = (imu.instance or 1) if imu.source == "autopilot" else imu.autopilot_instance
        if target is not None and target in autopilot_instances:
            found = f"autopilot IMU {target} a second time (imu {autopilot_instances[target]!r} has it)"
            yield _wrong(here, found, "one source for each autopilot IMU")
        if target is not None:
            autopilot_instances[target] = imu.name


def _imu(imu: Imu, here: str) -> Iterator[str]:
    if imu.source == "serial":
        for key, what in (("port", PORT_WORDS), ("protocol", allowed("imu.protocol"))):
            if getattr(imu, key) is None:
                yield _missing(f"{here}.{key}", what, 'source = "serial"')
        yield from _port(imu.port or "", f"{here}.port")
        if imu.instance is not None:
            why = "autopilot_instance names the autopilot's IMU that this one is"
            yield _wrong(f"{here}.instance", imu.instance, f'only with source = "autopilot" ({why})')
        return
    if imu.mounting != "ROTATION_NONE":
        why = "the autopilot's telemetry is in the vehicle's axes already"
        yield _wrong(f"{here}.mounting", repr(imu.mounting), f"{_SERIAL} ({why})")
    for key in ("port", "baud", "protocol", "autopilot_instance"):
        if (found := getattr(imu, key)) is not None:
            yield _wrong(f"{here}.{key}", repr(found), f"{_SERIAL} (this IMU is read over MAVLink)")
    if imu.read_only:
        yield _wrong(f"{here}.read_only", "true", f"{_SERIAL} (nothing is said to an autopilot's IMU)")


def _field_heading(config: Config) -> Iterator[str]:
    if config.compass is None or config.compass.heading != "field":
        return
    if config.gradienter is None:
        yield _wrong("compass.heading", "'field'", "only with a [gradienter], whose tilt it needs")
    if config.compass.reference != "magnetic":
        yield _wrong("compass.heading", "'field'", 'only with reference = "magnetic", the north of a field')


def _port(port: str, here: str) -> Iterator[str]:
    address = re.fullmatch(r"tcp://\S+:(\d{1,5})", port)
    if not port.startswith("/") and not (address and 1 <= int(address[1]) <= LAST_PORT):
        yield _wrong(here, repr(port), PORT_WORDS)


def _ports_differ(config: Config) -> Iterator[str]:
    """Check that no two devices share a port; sections of one device must agree on protocol, baud and parity."""
    used: dict[str, list[tuple[str, Imu | Gradienter | Compass]]] = {}
    for here, device in _serial_devices(config):
        for before, other in (sharing := used.setdefault(device.port or "", [])):
            yield from _shared(here, device, before, other)
        sharing.append((here, device))
    if config.mavlink.url.startswith("serial:"):
        port = config.mavlink.url.removeprefix("serial:").rpartition(":")[0]
        if port in used:
            yield _wrong("mavlink.url", f"{port!r}, which {used[port][0][0]}.port has already", "a port of its own")


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
        yield _wrong(f"{here}.port", f"{device.port!r}, which {before}.port has already", "a port of its own")
    for key in ("protocol", "baud", "parity"):
        ours, theirs = getattr(device, key, None), getattr(other, key, None)
        # One section of a device may omit a setting that another section of the same device has.
        if ours is not None and theirs is not None and ours != theirs:
            found = f"{ours!r} on {device.port}, where {before}.{key} is {theirs!r}"
            yield _wrong(f"{here}.{key}", found, f"{theirs!r} (one device serves both), or a port of its own")


_MAVLINK_URL = re.compile(r"(udpin|udpout|tcp):[^:\s]+:(?P<port>\d{1,5})|serial:/\S+:\d{3,7}")


def _mavlink_url(url: str) -> Iterator[str]:
    match = _MAVLINK_URL.fullmatch(url)
    if match is None or (match["port"] and not 1 <= int(match["port"]) <= LAST_PORT):
        shapes = "udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or serial:PATH:BAUD"
        yield _wrong("mavlink.url", repr(url), f"{shapes}, with ports from 1 to 65535")


_BIND = re.compile(r"(?:\[(?P<six>[0-9a-fA-F:.]+)\]|(?P<host>[^:\[\]]+)):(?P<port>\d{1,5})")


def bind_problem(bind: str, name: str) -> str | None:
    """Return the reason why a web page cannot be bound to an address, or None if it can.

    Host names are refused: on another network, a name can mean an address that other people can reach.
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
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


def _mounting(mounting: Mounting, here: str) -> Iterator[str]:
    if not isinstance(mounting, str):
        if max(map(abs, mounting)) > 360.0:
            yield _wrong(here, list(mounting), "angles within 360 degrees")
    elif mounting not in ROTATIONS_DEG:
        near = difflib.get_close_matches(mounting, ROTATIONS_DEG, n=1)
        hint = f" (did you mean {near[0]}?)" if near else ""
        shapes = 'a MAVLink rotation name such as "ROTATION_YAW_90", or [roll, pitch, yaw] in degrees'
        yield _wrong(here, f"{mounting!r}{hint}", shapes)


def _upright(mounting: Mounting, here: str) -> Iterator[str]:
    """Refuse a gradienter or compass mounted on its side or upside down: it would measure wrongly without a warning."""
    roll_deg, pitch_deg, _ = ROTATIONS_DEG[mounting] if isinstance(mounting, str) else mounting
    if math.cos(math.radians(roll_deg)) * math.cos(math.radians(pitch_deg)) < UPRIGHT_COSINE:
        yield _wrong(here, f"{mounting!r}, on its side or upside down", "within 60 degrees of upright")


def _access(mavlink: Mavlink) -> Iterator[str]:
    for entry in mavlink.allow:
        try:
            Senders([entry])
        except ValueError:
            yield _wrong("mavlink.allow", repr(entry), ALLOWED)
    if mavlink.signing in ("sign", "require") and mavlink.signing_key_file is None:
        yield _missing("mavlink.signing_key_file", "a text, not empty", f'signing = "{mavlink.signing}"')
    yield from _secret(mavlink.signing_key_file, "mavlink.signing_key_file")


def _secret(path: str | None, here: str) -> Iterator[str]:
    if path is not None and "/" in path and not path.startswith("/"):
        yield _wrong(here, repr(path), "a path that begins with /, or the bare name of a systemd credential")


def broker_complaints(mqtt: Mqtt) -> Iterator[str]:
    if mqtt.base_topic is not None:
        yield from _topic(mqtt.base_topic)
    if mqtt.password_file is not None and mqtt.username is None:
        yield _missing("mqtt.username", "a text, not empty", "password_file")
    yield from _secret(mqtt.password_file, "mqtt.password_file")
    for key in ("ca_file", "cert_file", "key_file"):
        path = getattr(mqtt, key)
        if path is not None and not mqtt.tls:
            yield _wrong(f"mqtt.{key}", repr(path), "only with tls = true")
        if path is not None and not path.startswith("/"):
            yield _wrong(f"mqtt.{key}", repr(path), "a path that begins with /")
    for key, other in (("cert_file", "key_file"), ("key_file", "cert_file")):
        if getattr(mqtt, key) is not None and getattr(mqtt, other) is None:
            yield _missing(f"mqtt.{other}", "a path", key)


_TOPIC = re.compile(r"(?!\$)[^+# /]+(/[^+# /]+)*")


def _topic(topic: str) -> Iterator[str]:
    if len(topic.encode()) > MAX_TOPIC_BYTES or not _TOPIC.fullmatch(topic):
        shape = (
            f'words with / between them, such as "field/heron", without + # or blanks, at most {MAX_TOPIC_BYTES} bytes'
        )
        yield _wrong("mqtt.base_topic", repr(topic), shape)
