"""The configuration: what may be set, what it means, and one clear line for every mistake.

A TOML file becomes frozen structures with units in their names. Unknown keys are errors (with the nearest known
key), so that a misspelt limit is never silently a default. Where `docs` and this file disagree, this file is right.
"""

from __future__ import annotations

import difflib
import os
import re
import tomllib
import types
import typing
from pathlib import Path
from typing import Annotated, Any, Literal, Union

import msgspec
from msgspec import Meta

from companion.errors import ConfigError
from companion.rotations import ROTATIONS_DEG

DEFAULT_PATH = Path("/etc/companion/companion.toml")

ImuProtocol = Literal["vectornav", "imu_line"]
GradienterProtocol = Literal["inclinometer_xy"]
CompassProtocol = Literal["hmr3300"]
Law = Literal["axis", "slope", "euler"]
Parity = Literal["none", "even", "odd"]
AtArm = Literal["gate", "warn", "off"]

Latitude = Annotated[float, Meta(ge=-90, le=90)]
Longitude = Annotated[float, Meta(ge=-180, le=180)]
Height = Annotated[float, Meta(ge=-500, le=9000)]
Baud = Annotated[int, Meta(ge=300, le=4_000_000)]
PositiveFloat = Annotated[float, Meta(gt=0)]
NonEmpty = Annotated[str, Meta(min_length=1)]
# Plain str on purpose: msgspec (0.19 to 0.22) confuses a length limit inside a union with a tuple and corrupts memory.
Mounting = str | tuple[float, float, float]
"""A MAVLink rotation name, or [roll, pitch, yaw] in degrees, sensor to vehicle FRD."""


class _Section(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A table of the file; unknown keys are refused."""


class Vehicle(_Section, frozen=True):
    """Where the aircraft stands, if the autopilot is not to be asked, and its MAVLink system id."""

    latitude_deg: Latitude | None = None
    longitude_deg: Longitude | None = None
    height_m: Height | None = None
    system_id: Annotated[int, Meta(ge=1, le=255)] | None = None


class Mavlink(_Section, frozen=True):
    """How to reach the autopilot, and which component we are."""

    url: NonEmpty
    component_id: Annotated[int, Meta(ge=1, le=255)] = 191


class Imu(_Section, frozen=True):
    """One IMU to be calibrated: the autopilot's, read over MAVLink, or our own on a serial port."""

    name: NonEmpty
    source: Literal["autopilot", "serial"]
    instance: Annotated[int, Meta(ge=1, le=3)] = 1
    port: NonEmpty | None = None
    baud: Baud | None = None
    protocol: ImuProtocol | None = None
    mounting: Mounting = "ROTATION_NONE"
    autopilot_instance: Annotated[int, Meta(ge=1, le=3)] | None = None
    profile: NonEmpty | None = None


class Gradienter(_Section, frozen=True):
    """The two-axis tilt sensor."""

    port: NonEmpty
    protocol: GradienterProtocol
    law: Law
    baud: Baud | None = None
    parity: Parity | None = None
    mounting: Mounting = "ROTATION_NONE"
    offset_deg: tuple[float, float] = (0.0, 0.0)
    sigma_deg: PositiveFloat = 0.05


class Compass(_Section, frozen=True):
    """The magnetic compass."""

    port: NonEmpty
    protocol: CompassProtocol
    baud: Baud | None = None
    parity: Parity | None = None
    reference: Literal["magnetic", "true"] = "magnetic"
    mounting: Mounting = "ROTATION_NONE"
    offset_deg: Annotated[float, Meta(ge=-360, le=360)] = 0.0
    sigma_deg: PositiveFloat = 3.0


class Calibration(_Section, frozen=True):
    """How long, how good, and what happens at arming."""

    min_still_s: Annotated[float, Meta(ge=2, le=600)] = 10.0
    max_s: Annotated[float, Meta(ge=2, le=3600)] = 60.0
    target_gyro_sigma_deg_h: PositiveFloat = 5.0
    target_accel_sigma_mg: PositiveFloat = 0.2
    at_arm: AtArm = "warn"


class Push(_Section, frozen=True):
    """What is sent to the autopilot."""

    parameters: bool = True
    attitude: Literal["off", "yaw", "full"] = "off"
    attitude_rate_hz: Annotated[float, Meta(gt=0, le=50)] = 30.0


class Mqtt(_Section, frozen=True):
    """A broker to speak to; the section absent means no MQTT."""

    host: NonEmpty
    port: Annotated[int, Meta(ge=1, le=65535)] = 1883
    base_topic: NonEmpty = "companion"
    username: NonEmpty | None = None
    password_file: NonEmpty | None = None
    tls: bool = False
    tls_ca_file: NonEmpty | None = None


class Control(_Section, frozen=True):
    """The socket on which `companion status`, `calibrate`, ... find the daemon."""

    socket: NonEmpty | None = None

    @property
    def path(self) -> Path:
        """The socket's path: as configured, else in systemd's runtime directory, else /run/companion."""
        if self.socket is not None:
            return Path(self.socket)
        return Path(os.environ.get("RUNTIME_DIRECTORY", "/run/companion")) / "control.sock"


class Storage(_Section, frozen=True):
    """Where records and the values for undo are kept."""

    directory: NonEmpty | None = None

    @property
    def path(self) -> Path:
        """The folder: as configured, else systemd's state directory, else /var/lib/companion."""
        if self.directory is not None:
            return Path(self.directory)
        return Path(os.environ.get("STATE_DIRECTORY", "/var/lib/companion"))


class Web(_Section, frozen=True):
    """The page; the section absent means no page."""

    bind: NonEmpty


class Config(_Section, frozen=True):
    """The whole file."""

    mavlink: Mavlink
    imu: Annotated[list[Imu], Meta(min_length=1)]
    vehicle: Vehicle = Vehicle()
    gradienter: Gradienter | None = None
    compass: Compass | None = None
    calibration: Calibration = Calibration()
    push: Push = Push()
    mqtt: Mqtt | None = None
    control: Control = Control()
    storage: Storage = Storage()
    web: Web | None = None


def load(path: Path) -> Config:
    """Read and check a configuration file.

    Raises:
        ConfigError: one line that names the file, the key, what was found and what is allowed.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file; give another with -c FILE") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from None
    return parse(text, str(path))


def parse(text: str, name: str) -> Config:
    """Check the text of a configuration file; `name` stands for the file in messages.

    Raises:
        ConfigError: one line that names the file, the key, what was found and what is allowed.
    """
    try:
        raw = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{name}: not valid TOML: {error}") from None
    _refuse_unknown_keys(raw, Config, "", name)
    try:
        config = msgspec.convert(raw, Config, strict=True)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{name}: {_explain(str(error), raw)}") from None
    _check_together(config, name)
    return config


def _refuse_unknown_keys(raw: dict[str, Any], section: type[msgspec.Struct], path: str, name: str) -> None:
    known = typing.get_type_hints(section)
    for key, value in raw.items():
        here = f"{path}.{key}" if path else key
        if key not in known:
            kind = "section" if isinstance(value, dict) else "key"
            near = difflib.get_close_matches(key, known, n=1)
            hint = f"did you mean {near[0]!r}?" if near else f"allowed: {', '.join(sorted(known))}"
            raise ConfigError(f"{name}: unknown {kind} {here!r}; {hint}")
        inner = _section_in(known[key])
        if inner is None:
            continue
        if isinstance(value, dict):
            _refuse_unknown_keys(value, inner, here, name)
        elif isinstance(value, list):
            for index, item in enumerate(value):
                if isinstance(item, dict):
                    _refuse_unknown_keys(item, inner, f"{here}[{index}]", name)


def _section_in(annotation: object) -> type[msgspec.Struct] | None:
    """The section type inside an annotation such as `Section | None` or `list[Section]`."""
    if isinstance(annotation, type) and issubclass(annotation, msgspec.Struct):
        return annotation
    for inner in typing.get_args(annotation):
        found = _section_in(inner)
        if found is not None:
            return found
    return None


_AT_PATH = re.compile(r"^(?P<what>.*?)(?: - at `\$(?P<path>[^`]*)`)?$", re.DOTALL)
_MISSING = re.compile(r"missing required field `(?P<field>\w+)`")


def _explain(message: str, raw: dict[str, Any]) -> str:
    """Turn msgspec's message into `key: found ..., allowed ...` in the file's own words."""
    match = _AT_PATH.match(message)
    what, path = (match["what"], (match["path"] or "").lstrip(".")) if match else (message, "")
    missing = _MISSING.search(what)
    if missing:
        key = f"{path}.{missing['field']}" if path else missing["field"]
        return f"{key!r} is missing; allowed: {_allowed(key)}"
    found = _value_at(raw, path)
    return f"{path!r}: found {found!r}; allowed: {_allowed(path)}"


def _value_at(raw: object, path: str) -> object:
    for key, index in re.findall(r"(\w+)|\[(\d+|\.\.\.)\]", path):
        if key and isinstance(raw, dict) and key in raw:
            raw = raw[key]
        elif index.isdigit() and isinstance(raw, list) and int(index) < len(raw):
            raw = raw[int(index)]
        else:
            break
    return raw


def _allowed(path: str) -> str:
    """What may stand at a path such as `imu[0].source`, in words."""
    annotation: object = Config
    for key in re.findall(r"\w+(?=\[|\.|$)", re.sub(r"\[[^\]]*\]", "", path)):
        section = _section_in(annotation)
        if section is None:
            break
        annotation = typing.get_type_hints(section, include_extras=True).get(key, annotation)
    return _describe(annotation)


_WORDS: dict[object, str] = {
    str: "a text", int: "a whole number", float: "a number", bool: "true or false", types.NoneType: "",
}  # fmt: skip


def _describe(annotation: object) -> str:
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is Annotated:
        return _describe(arguments[0]) + _describe_limits(arguments[1])
    if origin is Literal:
        return ", ".join(f'"{value}"' for value in arguments)
    if origin in (Union, types.UnionType):
        return " or ".join(words for words in map(_describe, arguments) if words)
    if origin is tuple:
        return f"[{', '.join('number' for _ in arguments)}]"
    if origin is list or (isinstance(annotation, type) and issubclass(annotation, msgspec.Struct)):
        section = _section_in(annotation)
        brackets = "[[{}]]" if origin is list else "[{}]"
        return f"a section {brackets.format(section.__name__.lower() if section else '')}"
    return _WORDS.get(annotation, str(annotation))


def _describe_limits(meta: Meta) -> str:
    if meta.ge is not None and meta.le is not None:
        return f" from {meta.ge:g} to {meta.le:g}"
    if meta.gt is not None:
        return f" above {meta.gt:g}" + (f", at most {meta.le:g}" if meta.le is not None else "")
    if meta.min_length is not None:
        return ", not empty"
    return ""


def _check_together(config: Config, name: str) -> None:
    """The rules that span several keys."""
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
        target = imu.instance if imu.source == "autopilot" else imu.autopilot_instance
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
            _check_port(device.port, f"{section}.port", name)
    _check_ports_differ(config, name)
    _check_mavlink_url(config.mavlink.url, name)
    if (config.vehicle.latitude_deg is None) != (config.vehicle.longitude_deg is None):
        raise ConfigError(
            f"{name}: 'vehicle': found only one of latitude_deg and longitude_deg; allowed: both or neither"
        )
    if config.calibration.max_s < config.calibration.min_still_s:
        raise ConfigError(
            f"{name}: 'calibration.max_s': found {config.calibration.max_s:g}; allowed: at least"
            f" min_still_s ({config.calibration.min_still_s:g})"
        )


def _check_imu(imu: Imu, here: str, name: str) -> None:
    if imu.source == "serial":
        for key in ("port", "protocol"):
            if getattr(imu, key) is None:
                raise ConfigError(
                    f"{name}: '{here}.{key}' is missing; allowed: {_allowed(f'imu.{key}')}"
                    f' (needed by source = "serial")'
                )
        _check_port(imu.port or "", f"{here}.port", name)
        return
    for key in ("port", "baud", "protocol", "autopilot_instance"):
        if getattr(imu, key) is not None:
            raise ConfigError(
                f"{name}: '{here}.{key}': found {getattr(imu, key)!r}; allowed: only with"
                ' source = "serial" (this IMU is read over MAVLink)'
            )


def _check_port(port: str, here: str, name: str) -> None:
    if port.startswith("/") or re.fullmatch(r"tcp://\S+:\d{1,5}", port):
        return
    raise ConfigError(f"{name}: {here!r}: found {port!r}; allowed: a device path (/dev/...) or tcp://HOST:PORT")


def _check_ports_differ(config: Config, name: str) -> None:
    used: dict[str, str] = {}
    ports = [(f"imu[{index}].port", imu.port) for index, imu in enumerate(config.imu)]
    ports += [(f"{section}.port", device.port) for section in ("gradienter", "compass")
              if (device := getattr(config, section)) is not None]  # fmt: skip
    if config.mavlink.url.startswith("serial:"):
        ports.append(("mavlink.url", config.mavlink.url.split(":")[1]))
    for here, port in ports:
        if port is not None and port in used:
            raise ConfigError(
                f"{name}: {here!r}: found {port!r}, which {used[port]} has already; allowed: a port of its own"
            )
        if port is not None:
            used[port] = here


_MAVLINK_URL = re.compile(r"(udpin|udpout|tcp):[^:\s]+:\d{1,5}|serial:[^:\s]+:\d{3,7}")


def _check_mavlink_url(url: str, name: str) -> None:
    if not _MAVLINK_URL.fullmatch(url):
        raise ConfigError(
            f"{name}: 'mavlink.url': found {url!r}; allowed: udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT"
            " or serial:PATH:BAUD"
        )


def _check_mounting(mounting: Mounting, here: str, name: str) -> None:
    if not isinstance(mounting, str) or mounting in ROTATIONS_DEG:
        return
    near = difflib.get_close_matches(mounting, ROTATIONS_DEG, n=1)
    hint = f" (did you mean {near[0]}?)" if near else ""
    raise ConfigError(
        f"{name}: {here!r}: found {mounting!r}{hint}; allowed: a MAVLink rotation name such as"
        ' "ROTATION_YAW_90", or [roll, pitch, yaw] in degrees'
    )
