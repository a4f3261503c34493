"""Reader of recordings, and playback of their bytes through the daemon's decoders.

A power cut or a broken copy may end a file anywhere. The `mcap` library does the parsing. It trusts all lengths in a
file, so they are checked before it unpacks anything.
"""

from __future__ import annotations

import contextlib
import itertools
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any, Final

import msgspec

from companion.autopilot.firmware.firmwares import FIRMWARES, firmware_named
from companion.autopilot.firmware.imu_messages import EkfBiasReading, ImuSamples, all_zero
from companion.config.sections import Config
from companion.configured.models import Role, parts_of, serial_devices
from companion.errors import StorageError
from companion.lab.still_log import unreadable
from companion.links.mavlink.link import MavlinkLink, Message
from companion.recording import messages
from companion.recording.messages import EKF_BIAS, IMU, MAVLINK, SERIAL, ImuState, decode
from companion.samples import ImuSample, Sample

MAGIC: Final = b"\x89MCAP0\r\n"
MOST_BYTES: Final = 4 * 1024 * 1024
"""Largest record and unpacked chunk, bytes; ours have less than 1 MiB, or up to 2.3 MiB in a flood of bytes."""
_NEEDS_MORE: Final = (
    "a recording needs more than is installed: pip install '.[recording]' in the folder of the companion's sources"
)
_UNUSABLE: Final = (
    msgspec.MsgspecError, ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError,
)  # fmt: skip
Part = tuple[Role, Sample]
_KINDS: Final = {
    each.message for firmware in FIRMWARES for sources in firmware.imu_messages.values() for each in sources
}


class Recording:
    """MCAP file of the companion; opening reads up to the first message. `offset_ns`: UTC minus the daemon's clock."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.cut_short: str | None = None  # After reading: reason of an early end; None: complete
        self.companion = ""
        self.offset_ns = 0
        self._config: bytes | None = None
        try:
            with path.open("rb") as file:
                head = file.read(len(MAGIC))
        except OSError as error:
            raise unreadable(path, error) from None
        if not head:
            raise StorageError(f"{path}: the file is empty")
        if not MAGIC.startswith(head):
            raise StorageError(f"{path}: not a recording (MCAP), nor any log that is known")
        self._rest = self._messages()
        self._first = [*itertools.islice(self._rest, 1)]

    def config(self) -> Config:
        try:
            return msgspec.json.decode(self._config or b"", type=Config)
        except ValueError as error:
            raise StorageError(f"{self.path}: its configuration is of another version: {error}") from None

    def read(self) -> Iterator[messages.Message]:
        """Yield the messages in the order of writing, until the end or a cut; call it only once."""
        return itertools.chain(self._first, self._rest)

    def is_same_run(self, later: Recording) -> bool:
        return (self.offset_ns, self._config) == (later.offset_ns, later._config)

    def _checked(self, versions: dict[str, str]) -> dict[str, str]:
        self.companion = versions.get("companion", "")
        if (found := versions.get("format")) != messages.FORMAT_VERSION:
            raise StorageError(
                f"{self.path}: found recording format {found}; allowed: {messages.FORMAT_VERSION};"
                f" companion {self.companion}, which wrote it, replays it"
            )
        return versions

    def _messages(self) -> Iterator[messages.Message]:
        try:
            import zstandard
            from mcap import exceptions, records, stream_reader
        except ImportError:
            raise StorageError(_NEEDS_MORE) from None
        versions: dict[str, str] = {}
        topics: dict[int, str] = {}
        try:
            with self.path.open("rb") as file:
                for record in _records(file):
                    if isinstance(record, records.Metadata) and record.name == messages.METADATA:
                        versions = self._checked(record.metadata)
                    elif isinstance(record, records.Attachment) and record.name == messages.CONFIG and versions:
                        if self._config is None:
                            self.offset_ns, self._config = int(versions["offset_ns"]), record.data
                    elif isinstance(record, records.Channel):
                        topics[record.id] = record.topic
                    elif isinstance(record, records.Message) and self._config and record.channel_id in topics:
                        t_s = (record.log_time - self.offset_ns) / 1e9
                        yield topics[record.channel_id], t_s, record.data
        except OSError as error:
            raise unreadable(self.path, error) from None
        except (exceptions.EndOfFile, exceptions.InvalidMagic, struct.error):
            self.cut_short = "cut, or damaged near its end"
        except (
            exceptions.McapError, stream_reader.CRCValidationError, zstandard.ZstdError,
            KeyError, OverflowError, ValueError,
        ) as error:  # fmt: skip
            self.cut_short = f"damaged: {' '.join(str(error).split())[:200]}"
        if self._config is None:
            cut = self.cut_short
            whose = f"{cut}, before anything was recorded" if cut else "an MCAP file, but not a recording of companion"
            raise StorageError(f"{self.path}: {whose}")


class _Bounded:
    """File that limits each read to the largest record, because the mcap library trusts the lengths of texts."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file

    def read(self, length: int) -> bytes:
        if length > MOST_BYTES:
            raise ValueError(f"found {length} bytes in one piece; allowed: {MOST_BYTES}")
        return self._file.read(length)


def _records(file: IO[bytes]) -> Iterator[Any]:
    """Yield all MCAP records; a chunk is replaced by the records inside it."""
    from mcap.records import Chunk, DataEnd
    from mcap.stream_reader import StreamReader, breakup_chunk

    source: Any = _Bounded(file)
    for record in StreamReader(source, emit_chunks=True, record_size_limit=MOST_BYTES).records:
        if isinstance(record, Chunk):
            _check_size(record)
            yield from breakup_chunk(record, validate_crc=True)
        elif isinstance(record, DataEnd):
            return
        else:
            yield record


def _check_size(chunk: Any) -> None:
    """Check the unpacked size stated by a chunk and by its zstd frame: unpacking allocates what the frame states."""
    import zstandard

    size: int = chunk.uncompressed_size
    if chunk.compression not in ("zstd", ""):
        raise ValueError(f"compressed by {chunk.compression}, which is not read here")
    inside = zstandard.frame_content_size(chunk.data) if chunk.compression else len(chunk.data)
    if size > MOST_BYTES or inside > size:
        raise ValueError(f"found {max(size, inside)} bytes in one piece; allowed: {MOST_BYTES}")


# --- the daemon's decoders


@contextlib.contextmanager
def reporting_damage(path: Path, topic: str) -> Iterator[None]:
    """Convert errors from a message that no companion can have written to StorageError."""
    try:
        yield
    except _UNUSABLE as error:
        raise StorageError(f"{path}: a message on {topic} cannot be used by this version ({error})") from None


class Playback:
    """Decoders of the devices in a configuration, fed with recorded bytes."""

    def __init__(self, config: Config) -> None:
        self._devices = {device.name: device for device in serial_devices(config)}
        self._autopilots = [imu.name for imu in config.imu if imu.source == "autopilot"]
        self.begin()

    def begin(self) -> None:
        self._decoders = {
            name: device.info.decoder(device.settings.seconds_per_byte) for name, device in self._devices.items()
        }
        self._states: dict[str, ImuState] = {}
        self._samples = {name: ImuSamples() for name in self._autopilots}
        self._bias: EkfBiasReading | None = None
        self._found: list[Part] = []
        self._link = MavlinkLink()
        for kind in _KINDS:
            self._link.subscribe(kind, self._on_message)

    def state(self, name: str) -> ImuState | None:
        """Return the newest state of an IMU of the autopilot; None: another IMU, or no state so far."""
        return self._states.get(name)

    def take(self, topic: str, data: bytes, t_s: float) -> list[Part]:
        """Decode a recorded message; return its samples, each with its role."""
        self._found = []
        if topic.startswith(SERIAL):
            name = topic.removeprefix(SERIAL)
            decoder, roles = self._decoders[name], self._devices[name].roles
            if data:
                return [part for sample in decoder.receive(data, t_s) for part in parts_of(sample, roles)]
            decoder.interrupted()
        elif topic == MAVLINK and self._samples:
            if data:
                self._link.receive(data, t_s)
            else:
                self._link.attach(None)
        elif topic == EKF_BIAS:
            self._bias = decode(topic, data)
        elif topic.startswith(IMU):
            name, state = topic.removeprefix(IMU), decode(topic, data)
            samples = self._samples[name]
            # While its messages were missing, the autopilot may have restarted.
            self._samples[name] = ImuSamples() if state.message is None else samples
            self._states[name] = state
        return self._found

    def _on_message(self, message: Message, t_s: float) -> None:
        for name, state in self._states.items():
            sample = self._sample(message, t_s, state, self._samples[name])
            if sample is not None:
                self._found.append((Role(name, "imu"), sample))

    def _sample(self, message: Any, t_s: float, state: ImuState, samples: ImuSamples) -> ImuSample | None:
        """Return the IMU's sample in a MAVLink message; None: the message has no usable sample."""
        sources = firmware_named(state.firmware).imu_messages.get(state.instance, ())
        source = next((each for each in sources if each.message is type(message)), None)
        header = message.get_header()
        if source is None or (header.srcSystem, header.srcComponent) != (state.sender[0], state.sender[1]):
            return None
        found = source.decode(message, t_s)
        if isinstance(found, str) or all_zero(found) or not samples.accept(source.name, found):
            return None
        bias = self._bias if source.lacks_bias else None
        if source.name != state.message or state.calibration is None or (source.lacks_bias and bias is None):
            return None
        return samples.complete(found, bias)
