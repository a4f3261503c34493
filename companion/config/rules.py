"""The rules that span several keys of the configuration file."""

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
"""Of a topic's beginning; MQTT itself allows 65535."""
PORT_WORDS = "a device path (/dev/...) or tcp://HOST:PORT"


def check_together(config: Config, name: str) -> None:
    """Check what no single key can tell.

    Raises:
        ConfigError: one line that names the file, the key, what was found and what is allowed.
    """
    seen: dict[str, int] = {}
    autopilot_instances: dict[int, str] = {}
    for index, imu in enumerate(config.imu):
        here = f"imu[{index}]"
        if imu.name in seen:
            raise ConfigError(
                f"{name}: '{here}.name': found {imu.name!r}, which imu[{seen[imu.name]}] has already;"
                " allowed: a name of its own for each IMU"
            )
        seen[imu.name] = index
        _check_imu(imu, here, name)
        _check_mounting(imu.mounting, f"{here}.mounting", name)
        target = (imu.instance or 1) if imu.source == "autopilot" else imu.autopilot_instance
        if target is not None and target in autopilot_instances:
            raise ConfigError(
                f"{name}: '{here}': found autopilot IMU {target} a second time (imu"
                f" {autopilot_instances[target]!r} has it); allowed: one source for each autopilot IMU"
            )
        if target is not None:
            autopilot_instances[target] = imu.name
    for section in ("gradienter", "compass"):
        device = getattr(config, section)
        if device is not None:
            _check_mounting(device.mounting, f"{section}.mounting", name)
            _check_upright(device.mounting, f"{section}.mounting", name)
            _check_port(device.port, f"{section}.port", name)
    _check_field_heading(config, name)
    _check_ports_differ(config, name)
    _check_mavlink_url(config.mavlink.url, name)
    _check_access(config.mavlink, name)
    if config.web is not None:
        _check_bind(config.web.bind, name)
    if config.mqtt is not None:
        _check_mqtt(config.mqtt, name)
    if (config.vehicle.latitude_deg is None) != (config.vehicle.longitude_deg is None):
        raise ConfigError(
            f"{name}: 'vehicle': found only one of latitude_deg and longitude_deg; allowed: both or neither"
        )
    room_mb = config.storage.recordings_mb
    if room_mb is not None and 0 < room_mb < LEAST_RECORDINGS_MB:
        raise ConfigError(
            f"{name}: 'storage.recordings_mb': found {room_mb}; allowed: 0 (none) or at least {LEAST_RECORDINGS_MB}"
        )
    if config.calibration.max_s < config.calibration.min_still_s:
        raise ConfigError(
            f"{name}: 'calibration.max_s': found {config.calibration.max_s:g}; allowed: at least"
            f" min_still_s ({config.calibration.min_still_s:g})"
        )


def _check_field_heading(config: Config, name: str) -> None:
    if config.compass is None or config.compass.heading != "field":
        return
    if config.gradienter is None:
        raise ConfigError(
            f"{name}: 'compass.heading': found 'field'; allowed: only with a [gradienter], whose tilt it needs"
        )
    if config.compass.reference != "magnetic":
        raise ConfigError(
            f"{name}: 'compass.heading': found 'field'; allowed: only with reference = \"magnetic\", the north that"
            " a field shows"
        )


def _check_imu(imu: Imu, here: str, name: str) -> None:
    if imu.source == "serial":
        for key in ("port", "protocol"):
            if getattr(imu, key) is None:
                what = PORT_WORDS if key == "port" else allowed(f"imu.{key}")
                raise ConfigError(f"{name}: '{here}.{key}' is missing; allowed: {what} (needed by source = \"serial\")")
        _check_port(imu.port or "", f"{here}.port", name)
        if imu.instance is not None:
            raise ConfigError(
                f"{name}: '{here}.instance': found {imu.instance}; allowed: only with source = \"autopilot\""
                " (autopilot_instance names the autopilot's IMU that this one is)"
            )
        return
    if imu.mounting != "ROTATION_NONE":
        raise ConfigError(
            f"{name}: '{here}.mounting': found {imu.mounting!r}; allowed: only with source = \"serial\" (the"
            " autopilot's telemetry is in the vehicle's axes already)"
        )
    for key in ("port", "baud", "protocol", "autopilot_instance"):
        if getattr(imu, key) is not None:
            raise ConfigError(
                f"{name}: '{here}.{key}': found {getattr(imu, key)!r}; allowed: only with"
                ' source = "serial" (this IMU is read over MAVLink)'
            )
    if imu.read_only:
        raise ConfigError(
            f"{name}: '{here}.read_only': found true; allowed: only with source = \"serial\" (nothing is said to an"
            " autopilot's IMU)"
        )


def _check_port(port: str, here: str, name: str) -> None:
    if port.startswith("/"):
        return
    address = re.fullmatch(r"tcp://\S+:(\d{1,5})", port)
    if address and 1 <= int(address[1]) <= LAST_PORT:
        return
    raise ConfigError(f"{name}: {here!r}: found {port!r}; allowed: {PORT_WORDS}")


def _check_ports_differ(config: Config, name: str) -> None:
    """Each port once; only the roles of one device share theirs, and they agree on how it is read."""
    used: dict[str, list[tuple[str, Imu | Gradienter | Compass]]] = {}
    for here, device in _serial_devices(config):
        for before, other in (sharing := used.setdefault(device.port or "", [])):
            _check_shared(here, device, before, other, name)
        sharing.append((here, device))
    if config.mavlink.url.startswith("serial:"):
        port = config.mavlink.url.removeprefix("serial:").rpartition(":")[0]
        if port in used:
            raise ConfigError(
                f"{name}: 'mavlink.url': found {port!r}, which {used[port][0][0]}.port has already; allowed: a port of"
                " its own"
            )


def _serial_devices(config: Config) -> Iterator[tuple[str, Imu | Gradienter | Compass]]:
    yield from ((f"imu[{index}]", imu) for index, imu in enumerate(config.imu) if imu.port is not None)
    if config.gradienter is not None:
        yield "gradienter", config.gradienter
    if config.compass is not None:
        yield "compass", config.compass


def _check_shared(
    here: str, device: Imu | Gradienter | Compass, before: str, other: Imu | Gradienter | Compass, name: str
) -> None:
    if isinstance(device, Imu) and isinstance(other, Imu):
        raise ConfigError(
            f"{name}: '{here}.port': found {device.port!r}, which {before}.port has already; allowed: a port of its own"
        )
    for key in ("protocol", "baud", "parity"):
        ours, theirs = getattr(device, key, None), getattr(other, key, None)
        # What one section leaves open, another may say: there is one device and one line.
        if ours is not None and theirs is not None and ours != theirs:
            raise ConfigError(
                f"{name}: '{here}.{key}': found {ours!r} on {device.port}, where {before}.{key} is {theirs!r}; allowed:"
                f" {theirs!r} (one device serves both), or a port of its own"
            )


_MAVLINK_URL = re.compile(r"(udpin|udpout|tcp):[^:\s]+:(?P<port>\d{1,5})|serial:/\S+:\d{3,7}")


def _check_mavlink_url(url: str, name: str) -> None:
    match = _MAVLINK_URL.fullmatch(url)
    if match is None or (match["port"] and not 1 <= int(match["port"]) <= LAST_PORT):
        raise ConfigError(
            f"{name}: 'mavlink.url': found {url!r}; allowed: udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT"
            " or serial:PATH:BAUD, with ports from 1 to 65535"
        )


_BIND = re.compile(r"(?:\[(?P<six>[0-9a-fA-F:.]+)\]|(?P<host>[^:\[\]]+)):(?P<port>\d{1,5})")


def _check_bind(bind: str, name: str) -> None:
    """Numbers only: what a name stands for may change with the network, and with it who can reach the page."""
    match = _BIND.fullmatch(bind)
    host = (match["six"] or match["host"]) if match else ""
    if match and int(match["port"]) <= LAST_PORT and (host == "localhost" or _is_address(host)):
        return
    raise ConfigError(
        f"{name}: 'web.bind': found {bind!r}; allowed: ADDRESS:PORT, such as 127.0.0.1:8191 (this board only),"
        " 192.168.4.1:8191 or [::1]:8191"
    )


def _is_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


def _check_mounting(mounting: Mounting, here: str, name: str) -> None:
    if not isinstance(mounting, str):
        if max(map(abs, mounting)) > 360.0:
            raise ConfigError(f"{name}: {here!r}: found {list(mounting)}; allowed: angles within 360 degrees")
        return
    if mounting in ROTATIONS_DEG:
        return
    near = difflib.get_close_matches(mounting, ROTATIONS_DEG, n=1)
    hint = f" (did you mean {near[0]}?)" if near else ""
    raise ConfigError(
        f"{name}: {here!r}: found {mounting!r}{hint}; allowed: a MAVLink rotation name such as"
        ' "ROTATION_YAW_90", or [roll, pitch, yaw] in degrees'
    )


def _check_upright(mounting: Mounting, here: str, name: str) -> None:
    """Neither liquid nor pendulum nor tilt-compensated compass works on its side or head, nor can it tell."""
    roll_deg, pitch_deg, _ = ROTATIONS_DEG[mounting] if isinstance(mounting, str) else mounting
    if math.cos(math.radians(roll_deg)) * math.cos(math.radians(pitch_deg)) < UPRIGHT_COSINE:
        raise ConfigError(
            f"{name}: {here!r}: found {mounting!r}, on its side or upside down; allowed: within 60 degrees of upright"
        )


def _check_access(mavlink: Mavlink, name: str) -> None:
    """Who may ask, and signing."""
    for entry in mavlink.allow:
        try:
            Senders([entry])
        except ValueError:
            raise ConfigError(f"{name}: 'mavlink.allow': found {entry!r}; allowed: {ALLOWED}") from None
    path = mavlink.signing_key_file
    if mavlink.signing in ("sign", "require") and path is None:
        raise ConfigError(
            f"{name}: 'mavlink.signing_key_file' is missing; allowed: a text, not empty (needed by signing ="
            f' "{mavlink.signing}")'
        )
    if path is not None and "/" in path and not path.startswith("/"):
        raise ConfigError(
            f"{name}: 'mavlink.signing_key_file': found {path!r}; allowed: a path that begins with /, or the bare name"
            " of a systemd credential"
        )


def _check_mqtt(mqtt: Mqtt, name: str) -> None:
    if mqtt.base_topic is not None:
        _check_topic(mqtt.base_topic, "mqtt.base_topic", name)
    if mqtt.password_file is not None and mqtt.username is None:
        raise ConfigError(f"{name}: 'mqtt.username' is missing; allowed: a text, not empty (needed by password_file)")
    if mqtt.password_file is not None and "/" in mqtt.password_file and not mqtt.password_file.startswith("/"):
        raise ConfigError(
            f"{name}: 'mqtt.password_file': found {mqtt.password_file!r}; allowed: a path that begins with /, or the"
            " bare name of a systemd credential"
        )
    for key in ("ca_file", "cert_file", "key_file"):
        path = getattr(mqtt, key)
        if path is not None and not mqtt.tls:
            raise ConfigError(f"{name}: 'mqtt.{key}': found {path!r}; allowed: only with tls = true")
        if path is not None and not path.startswith("/"):
            raise ConfigError(f"{name}: 'mqtt.{key}': found {path!r}; allowed: a path that begins with /")
    for key, other in (("cert_file", "key_file"), ("key_file", "cert_file")):
        if getattr(mqtt, key) is not None and getattr(mqtt, other) is None:
            raise ConfigError(f"{name}: 'mqtt.{other}' is missing; allowed: a path (needed by {key})")


def _check_topic(topic: str, here: str, name: str) -> None:
    good = (
        len(topic.encode()) <= MAX_TOPIC_BYTES
        and not any(character in topic for character in "+# ")
        and not topic.startswith(("/", "$"))
        and not topic.endswith("/")
        and "//" not in topic
    )
    if not good:
        raise ConfigError(
            f"{name}: {here!r}: found {topic!r}; allowed: words with / between them, such as"
            f' "field/heron", without + # or blanks, at most {MAX_TOPIC_BYTES} bytes'
        )
