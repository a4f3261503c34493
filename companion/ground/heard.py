"""Store of heartbeats and texts received on the telemetry link, with the armed state of each autopilot."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, Literal, NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.component.statustext import GOES_ON, to_ascii
from companion.links.system.events import Listeners
from companion.protocols.guess import AUTOPILOT_NAMES

_NO_VEHICLES: Final = frozenset({mavlink.MAV_TYPE_GCS, mavlink.MAV_TYPE_ONBOARD_CONTROLLER})
FRESH_S: Final = 3.0  # maximum age of a valid heartbeat; heartbeats come once a second, two in a row may be lost
MAX_PEERS: Final = 64  # maximum number of stored senders; later ones are ignored
MAX_TEXTS: Final = 200

Fields = Mapping[str, object]


class Address(NamedTuple):
    """MAVLink address of a component: system id of its vehicle, and component id."""

    system_id: int
    component_id: int


class PeerState(NamedTuple):
    """Fields of the last heartbeat of a component, and the time of its receipt."""

    kind: int
    autopilot: int
    base_mode: int
    system_status: int
    at_s: float

    @property
    def firmware(self) -> str:
        return AUTOPILOT_NAMES.get(self.autopilot, f"autopilot type {self.autopilot}")


class Text(NamedTuple):
    """A received STATUSTEXT: a text for the pilot."""

    system_id: int
    severity: int
    words: str
    at_s: float


class AutopilotSeen(NamedTuple):
    """Firmware and armed state of an autopilot, from its last heartbeat; after 3 s the armed state is unknown."""

    system_id: int
    firmware: str | None
    armed: Literal["armed", "disarmed", "unknown"]


class GroundListener:
    """Stores heartbeats of all components and texts of the companions. Malformed messages raise no errors."""

    def __init__(self, component_id: int) -> None:
        self.component_id = component_id
        self.first_s: float | None = None  # time of the first heartbeat
        self.heartbeats: dict[Address, PeerState] = {}
        self.texts: list[Text] = []  # texts of all vehicles' companions, oldest first
        self.on_text: Listeners[[Text]] = Listeners()  # callbacks for every received text of a companion

    def update(self, name: str, source: Address, fields: Fields, now_s: float) -> None:
        if name == "HEARTBEAT":
            self._heartbeat(source, fields, now_s)
        elif name == "STATUSTEXT" and source.component_id == self.component_id:
            self._text(source.system_id, fields, now_s)

    def companions(self) -> list[int]:
        return sorted(target.system_id for target in self.heartbeats if target.component_id == self.component_id)

    def vehicle(self, system_id: int, now_s: float) -> AutopilotSeen:
        beat = self.heartbeats.get(Address(system_id, mavlink.MAV_COMP_ID_AUTOPILOT1))
        if beat is None:
            return AutopilotSeen(system_id, None, "unknown")
        armed: Literal["armed", "disarmed", "unknown"] = "unknown"
        if now_s - beat.at_s <= FRESH_S:
            armed = "armed" if beat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED else "disarmed"
        return AutopilotSeen(system_id, beat.firmware, armed)

    def busy(self, system_id: int, since_s: float) -> bool | None:
        """Return True if the companion's last heartbeat reports a job; None: no heartbeat came after `since_s`."""
        beat = self.heartbeats.get(Address(system_id, self.component_id))
        if beat is None or beat.at_s <= since_s:
            return None
        return beat.system_status == mavlink.MAV_STATE_CALIBRATING

    def texts_of(self, system_id: int, since_s: float) -> list[Text]:
        """List the texts of a vehicle's companion since `since_s`; join the lines of a text that was split."""
        found: list[Text] = []
        for text in self.texts:
            if text.system_id != system_id or text.at_s < since_s:
                continue
            if found and text.words.startswith(GOES_ON):
                words = f"{found[-1].words} {text.words.removeprefix(GOES_ON)}"
                found[-1] = found[-1]._replace(words=words, at_s=text.at_s)
            else:
                found.append(text)
        return found

    def summary(self) -> str:
        vehicles, others = [], []
        for (system, component), beat in sorted(self.heartbeats.items()):
            if component == mavlink.MAV_COMP_ID_AUTOPILOT1 and beat.kind not in _NO_VEHICLES:
                vehicles.append(f"system {system} ({beat.firmware})")
            else:
                station = " (a ground station)" if beat.kind == mavlink.MAV_TYPE_GCS else ""
                others.append(f"{system}/{component}{station}")
        return ", ".join([*vehicles, *others])

    def _heartbeat(self, source: Address, fields: Fields, now_s: float) -> None:
        if self.first_s is None:
            self.first_s = now_s
        if source in self.heartbeats or len(self.heartbeats) < MAX_PEERS:
            self.heartbeats[source] = PeerState(
                whole(fields, "type"), whole(fields, "autopilot"), whole(fields, "base_mode"),
                whole(fields, "system_status"), now_s,
            )  # fmt: skip

    def _text(self, system_id: int, fields: Fields, now_s: float) -> None:
        # Remove control characters: the terminal must not execute them.
        words = to_ascii(str(fields.get("text", "")).rstrip("\0"))
        text = Text(system_id, whole(fields, "severity"), words, now_s)
        self.texts.append(text)
        del self.texts[:-MAX_TEXTS]
        self.on_text.tell(text)


def whole(fields: Fields, name: str) -> int:
    """Return an integer field of a message, or 0 if the field is absent or not an integer."""
    value = fields.get(name)
    return value if isinstance(value, int) else 0


def figures(gyro_deg_h: float | None, accel_mg: float | None) -> str:
    gyro = f"sigma {gyro_deg_h:.3g} deg/h" if gyro_deg_h is not None else ""
    accel = f"{'' if gyro else 'sigma '}{accel_mg:.3g} mg" if accel_mg is not None else ""
    return ", ".join(filter(None, (gyro, accel)))


def nobody_heard(heard: GroundListener, url: str, system_id: int | None, within_s: float) -> str:
    """Return one line that no companion was found, with the senders that were received, and the remedy."""
    others, component = heard.summary(), heard.component_id
    if not others:
        return (
            f"nothing heard on {url} within {within_s:g} s:"
            " is the radio connected, and is this the url (--url) that the vehicle sends to?"
        )
    which = f"of system {system_id} " if system_id is not None else ""
    what = f"no companion (component {component}) {which}heard on {url} within {within_s:g} s, only {others}"
    how = "on another port of the autopilot than this link, and forwarded"
    if "PX4" in others:
        how = "and is MAV_1_FORWARD = 1 (then restart the autopilot)"
    return f"{what}: does it run (on its board: companion status), {how}?"
