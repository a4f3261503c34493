"""Recorded bytes through the daemon's decoders: samples, in the recorded order and at the recorded times."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

import msgspec

from companion.autopilot.firmware.firmwares import FIRMWARES, firmware_named
from companion.autopilot.firmware.imu_messages import PX4_FLOATS, EkfBiasReading, ImuMessage, ImuSamples, Reading
from companion.config.sections import Config
from companion.configured.models import Role, parts_of, serial_devices
from companion.errors import StorageError
from companion.lab.logs import recording
from companion.links.mavlink.link import MavlinkLink, Message
from companion.recording.messages import EKF_BIAS, IMU, MAVLINK, SERIAL, ImuState, decode
from companion.samples import ImuSample, Sample

UNUSABLE: Final = (
    msgspec.MsgspecError, ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError,
)  # fmt: skip
"""Errors that a message raises which nobody could have written."""
Part = tuple[Role, Sample]
_KINDS: Final = {
    each.message for firmware in FIRMWARES for sources in firmware.imu_messages.values() for each in sources
}


def config_of(found: recording.Head, where: object) -> Config:
    """Decode the configuration in force."""
    try:
        return msgspec.json.decode(found.config, type=Config)
    except ValueError as error:
        raise StorageError(f"{where}: its configuration is of another version: {error}") from None


class _AutopilotImu:
    """One IMU of the autopilot: its state, and what makes samples of its messages."""

    def __init__(self, role: Role) -> None:
        self.role = role
        self.state: ImuState | None = None
        self.samples = ImuSamples()

    def set_state(self, state: ImuState) -> None:
        """Take a state; without messages the autopilot may have restarted."""
        self.state = state
        if state.message is None:
            self.samples = ImuSamples()

    def sample(self, message: Any, t_s: float, bias: EkfBiasReading | None) -> ImuSample | None:
        """Return the sample in a message; None: it carries none that counts."""
        state = self.state
        source = None if state is None else _source(state, type(message))
        if state is None or source is None or message.get_header().srcSystem != state.sender[0]:
            return None
        if message.get_header().srcComponent != state.sender[1]:
            return None
        reading = source.decode(message)
        if not isinstance(reading, Reading) or reading.all_zero:
            return None
        name, floats = source.name, source is PX4_FLOATS
        if not self.samples.accept(name, reading, t_s) or name != state.message or state.calibration is None:
            return None
        if floats and bias is None:
            return None
        return self.samples.sample(reading, t_s, bias if floats else None)


def _source(state: ImuState, kind: type[Message]) -> ImuMessage | None:
    sources = firmware_named(state.firmware).imu_messages.get(state.instance, ())
    return next((each for each in sources if each.message is kind), None)


class Playback:
    """The devices of a configuration, fed with what was recorded of them."""

    def __init__(self, config: Config) -> None:
        self._devices = {device.name: device for device in serial_devices(config)}
        self._autopilots = [imu.name for imu in config.imu if imu.source == "autopilot"]
        self.begin()

    def begin(self) -> None:
        """Begin anew: something is missing before what comes next."""
        self._decoders = {
            name: device.info.decoder(device.settings.seconds_per_byte) for name, device in self._devices.items()
        }
        self._imus = {name: _AutopilotImu(Role(name, "imu")) for name in self._autopilots}
        self._bias: EkfBiasReading | None = None
        self._found: list[Part] = []
        self._link = MavlinkLink()
        for kind in _KINDS:
            self._link.subscribe(kind, self._on_message)

    def wants(self, topic: str) -> bool:
        """Return whether messages on a topic bring samples or states."""
        return topic.startswith((SERIAL, IMU)) or topic in (MAVLINK, EKF_BIAS)

    def state(self, name: str) -> ImuState | None:
        """Return the state of an IMU; None: it is none of the autopilot's, or nothing is known yet."""
        return self._imus[name].state if name in self._imus else None

    def take(self, topic: str, data: bytes, t_s: float) -> list[Part]:
        """Take a message; return the samples that came of it, each with its role."""
        if topic.startswith(SERIAL):
            return list(self._serial(topic.removeprefix(SERIAL), data, t_s))
        if topic == MAVLINK:
            return self._mavlink(data, t_s)
        if topic == EKF_BIAS:
            self._bias = decode(topic, data)
        else:
            self._imus[topic.removeprefix(IMU)].set_state(decode(topic, data))
        return []

    def _serial(self, name: str, data: bytes, t_s: float) -> Iterator[Part]:
        decoder = self._decoders[name]
        if not data:
            decoder.interrupted()
            return
        roles = self._devices[name].roles
        for sample in decoder.receive(data, t_s):
            yield from parts_of(sample, roles)

    def _mavlink(self, data: bytes, t_s: float) -> list[Part]:
        if not self._imus:
            return []
        if not data:
            self._link.attach(None)
            return []
        self._found = []
        self._link.receive(data, t_s)
        return self._found

    def _on_message(self, message: Message, t_s: float) -> None:
        for imu in self._imus.values():
            sample = imu.sample(message, t_s, self._bias)
            if sample is not None:
                self._found.append((imu.role, sample))
