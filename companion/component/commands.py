"""The command server of component 191: parses and checks requests, and sends one final COMMAND_ACK for each.

The sender's system id, the sender's component id and the command identify a request: a COMMAND_ACK carries nothing
else. The server handles three kinds of repeated requests:

- The network delivers a packet twice (two routes, a duplicated datagram). A packet is ignored if all its bytes,
  including the sequence number, equal those of a packet received within the last half second.
- The sender repeats its request while the job runs. The server answers IN_PROGRESS and starts no second job: ground
  stations treat any other result as the end.
- The sender retransmits a request (confirmation > 0) after its final ACK was sent. The server repeats that ACK until no
  retransmission has come for 3 s: otherwise one press of a button would calibrate twice.

A request with confirmation 0 is a new press of the button and starts a new job. The setting `mavlink.allow` lists the
senders that may request jobs; everybody may read. Only signatures protect against forged ids of senders.
"""

from __future__ import annotations

import logging
import math
import re
from collections import Counter, OrderedDict, deque
from typing import Final, Literal, NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion import __version__
from companion.commands import Calibrate, Cancel, Undo
from companion.component.service import AcceptedJob, CalibrationService, Refusal
from companion.component.statustext import Severity, StatusText, Weight
from companion.config.sections import Senders
from companion.estimation.machine import What
from companion.links.mavlink.link import MavlinkLink

logger = logging.getLogger(__name__)

MAV_RESULT_CANCELLED = 6
"""Result code for a cancelled command, from MAVLink's common messages; pymavlink's ArduPilot dialect lacks its name."""
ACK_PERIOD_S = 0.4
"""Interval between IN_PROGRESS ACKs. QGroundControl gives up after 1.2 s without an ACK: two in a row can get lost."""
NOTHING_RAN: Final = 1  # `result_param2` of a cancel's ACK when there was nothing to cancel
REMEMBER_FINAL_S = 3.0
SAME_PACKET_S = 0.5
MAX_REMEMBERED: Final = 32
_RETRY_S = 0.1

_REFUSALS: Final = {
    "busy": mavlink.MAV_RESULT_TEMPORARILY_REJECTED,
    "unsupported": mavlink.MAV_RESULT_UNSUPPORTED,
}
"""MAV_RESULT of the ACK for each kind of refused request; kinds not in this table are DENIED."""
_RESULTS = {
    "done": mavlink.MAV_RESULT_ACCEPTED,
    "failed": mavlink.MAV_RESULT_FAILED,
    "cancelled": MAV_RESULT_CANCELLED,
}
_WORDS = {
    What.BOTH: "gyros and accelerometers",
    What.GYROS: "gyros",
    What.ACCELEROMETERS: "accelerometers",
}
_NAMES: dict[type, str] = {Calibrate: "Calibration", Undo: "Undo", Cancel: "Cancel"}  # Requests that need permission

CommandMessage = mavlink.MAVLink_command_long_message | mavlink.MAVLink_command_int_message


class Key(NamedTuple):
    """Identity of a request: the sender's ids and the command, which are all that a COMMAND_ACK names."""

    system_id: int
    component_id: int
    command: int


Request = Calibrate | Undo | Cancel | Literal["version"]  # A checked request; "version": send AUTOPILOT_VERSION


class Permission:
    """Checks senders against the setting `mavlink.allow`; counts refusals, and logs each sender's first refusal."""

    def __init__(self, senders: Senders) -> None:
        self.senders = senders
        self.refused: Counter[tuple[int, int]] = Counter()  # Refusals of the first 32 senders

    def refuses(self, sender: tuple[int, int], what: str) -> str:
        """Return the reason to refuse a sender (system id, component id), or an empty text if the sender is allowed."""
        if sender in self.senders:
            return ""
        system, component = sender
        if sender not in self.refused and len(self.refused) < MAX_REMEMBERED:
            logger.warning("mavlink: %s by %d/%d is refused: mavlink.allow does not name it", what, system, component)
        if sender in self.refused or len(self.refused) < MAX_REMEMBERED:
            self.refused[sender] += 1
        return f"{system}/{component} not in mavlink.allow"


class _Running(NamedTuple):
    key: Key
    request: Calibrate | Undo
    job: AcceptedJob


class _Final(NamedTuple):
    result: int
    detail: int
    at_s: float
    sent: bool


class CommandServer:
    """Handles commands addressed to this component. `step` returns the time at which it must be called again.

    Commands to other components and to component 0 (everyone) are ignored: our ACK would look like the autopilot's.
    """

    def __init__(
        self, link: MavlinkLink, service: CalibrationService, texts: StatusText, permission: Permission
    ) -> None:
        self._link, self._service, self._permission = link, service, permission
        self._say, self._woken = texts.say, texts.woken
        self._running: _Running | None = None
        self._next_ack_s = 0.0
        self._finals: OrderedDict[Key, _Final] = OrderedDict()
        self._packets: deque[tuple[float, bytes]] = deque(maxlen=MAX_REMEMBERED)
        self._subscriptions = (
            link.subscribe(mavlink.MAVLink_command_long_message, self._on_message),
            link.subscribe(mavlink.MAVLink_command_int_message, self._on_message),
        )

    def step(self, now_s: float) -> float:
        """Send the ACKs that are due; return the time of the next call, or infinity if there is nothing to send."""
        retry_s = self._send_unsent(now_s)
        running = self._running
        if running is None:
            return retry_s
        if running.job.finished.done():
            self._finish(running, now_s)
            return min(retry_s, now_s + _RETRY_S)
        if now_s >= self._next_ack_s:
            self._acknowledge_progress(running)
            self._next_ack_s = now_s + ACK_PERIOD_S
        return min(retry_s, self._next_ack_s)

    def close(self, now_s: float) -> None:
        """Stop handling commands, and send a running job's final ACK: its requester must not wait for ever."""
        for unsubscribe in self._subscriptions:
            unsubscribe()
        if self._running is None:
            return
        if self._running.job.finished.done():
            self._finish(self._running, now_s)
        else:
            self._say(Severity.ERROR, "Failed: the companion stops", Weight.RESULT)
            self._finally(self._running.key, mavlink.MAV_RESULT_FAILED, now_s)
            self._running = None

    def _on_message(self, message: CommandMessage, now_s: float) -> None:
        if (message.target_system, message.target_component) != (self._link.system_id, self._link.component_id):
            return
        if (message.get_srcSystem(), message.get_srcComponent()) == (self._link.system_id, self._link.component_id):
            return
        if message.command == mavlink.MAV_CMD_ARM_AUTHORIZATION_REQUEST:
            return  # `ArmAuthoriser` answers arming requests: they start no job, and need no ACK
        key = Key(message.get_srcSystem(), message.get_srcComponent(), message.command)
        request = self._permit(key, judge(message))
        copy = self._is_copy(bytes(message.get_msgbuf()), now_s)
        running = self._running
        if running is not None and running.key == key and not isinstance(request, Refusal):
            if request != running.request:
                # Report as a text: ground stations would treat an ACK as the end of the running job.
                before = running.request
                doing = "undoing" if isinstance(before, Undo) else f"calibrating {_WORDS[before.biases]}"
                self._say(Severity.WARNING, f"Still {doing}", Weight.REFUSAL)
            self._acknowledge_progress(running)
            return
        if copy:
            return
        final = self._finals.get(key)
        # COMMAND_INT has no confirmation field: each COMMAND_INT is a new request.
        confirmation = 0 if isinstance(message, mavlink.MAVLink_command_int_message) else message.confirmation
        if confirmation > 0 and final is not None and now_s - final.at_s <= REMEMBER_FINAL_S:
            # Start the 3 s again: this copy of the ACK may be lost as well.
            self._finally(key, final.result, now_s, final.detail)
            return
        self._obey(key, request, now_s)

    def _permit(self, key: Key, request: Request | Refusal) -> Request | Refusal:
        name = _NAMES.get(type(request))
        if name is None:
            return request
        reason = self._permission.refuses((key.system_id, key.component_id), name.lower())
        return _denied(f"{name} refused: {reason}") if reason else request

    def _is_copy(self, packet: bytes, now_s: float) -> bool:
        while self._packets and now_s - self._packets[0][0] > SAME_PACKET_S:
            self._packets.popleft()
        if any(before == packet for _, before in self._packets):
            return True
        self._packets.append((now_s, packet))
        return False

    def _obey(self, key: Key, request: Request | Refusal, now_s: float) -> None:
        try:
            match request:
                case Calibrate() | Undo():
                    self._start(key, request, now_s)
                case Cancel():
                    self._cancel(key, now_s)
                case "version":
                    self._acknowledge(key, mavlink.MAV_RESULT_ACCEPTED)
                    self._link.send(autopilot_version())
                case Refusal():
                    # Do not warn: ground stations probe by themselves which commands a component supports.
                    severity = Severity.INFO if request.kind == "unsupported" else Severity.WARNING
                    self._refuse(key, request, now_s, severity)
        except Exception:
            name = _NAMES.get(type(request), "Request")
            logger.exception("%s failed", name)
            self._say(Severity.WARNING, f"{name} failed: internal error, see the log", Weight.REFUSAL)
            self._finally(key, mavlink.MAV_RESULT_FAILED, now_s)

    def _start(self, key: Key, request: Calibrate | Undo, now_s: float) -> None:
        name = _NAMES[type(request)]
        if self._running is not None and self._running.job.finished.done():
            self.step(now_s)
        if self._running is not None:
            other = "an undo" if isinstance(self._running.request, Undo) else "a calibration"
            self._refuse(key, Refusal("busy", f"{name} refused: {other} is running"), now_s)
            return
        requester = f"mavlink {key.system_id}/{key.component_id}"
        if isinstance(request, Undo):
            job = self._service.start_undo(requester)
        else:
            job = self._service.start_calibration(request.biases, requester, reboot=request.reboot)
        if isinstance(job, Refusal):
            self._refuse(key, Refusal(job.kind, f"{name} refused: {job.reason}"), now_s)
            return
        self._finals.pop(key, None)
        self._running = _Running(key, request, job)
        self._acknowledge_progress(self._running)
        self._next_ack_s = now_s + ACK_PERIOD_S
        job.finished.add_done_callback(lambda _: self._woken.set())
        self._woken.set()

    def _cancel(self, key: Key, now_s: float) -> None:
        was_running = self._service.cancel(f"mavlink {key.system_id}/{key.component_id}")
        if not was_running:
            self._say(Severity.INFO, "Nothing to cancel", Weight.NEWS)
        self._finally(key, mavlink.MAV_RESULT_ACCEPTED, now_s, 0 if was_running else NOTHING_RAN)

    def _finish(self, running: _Running, now_s: float) -> None:
        self._running = None
        self._finally(running.key, _RESULTS[running.job.finished.result().outcome], now_s)

    def _refuse(self, key: Key, refusal: Refusal, now_s: float, severity: Severity = Severity.WARNING) -> None:
        self._say(severity, refusal.reason, Weight.REFUSAL)
        self._finally(key, _REFUSALS.get(refusal.kind, mavlink.MAV_RESULT_DENIED), now_s)

    def _finally(self, key: Key, result: int, now_s: float, detail: int = 0) -> None:
        sent = self._acknowledge(key, result, detail=detail)
        self._finals[key] = _Final(result, detail, now_s, sent)
        self._finals.move_to_end(key)
        if len(self._finals) > MAX_REMEMBERED:
            self._finals.popitem(last=False)
        if not sent:
            self._woken.set()

    def _send_unsent(self, now_s: float) -> float:
        """Resend final ACKs that the transport did not accept, for the 3 s in which a requester waits for them."""
        retry_s = math.inf
        for key, final in self._finals.items():
            if not final.sent and now_s - final.at_s <= REMEMBER_FINAL_S:
                sent = self._link.connected and self._acknowledge(key, final.result, detail=final.detail)
                self._finals[key] = final._replace(sent=sent)
                retry_s = retry_s if sent else now_s + _RETRY_S
        return retry_s

    def _acknowledge_progress(self, running: _Running) -> None:
        progress = min(max(int(running.job.progress_percent), 0), 100)
        self._acknowledge(running.key, mavlink.MAV_RESULT_IN_PROGRESS, progress)

    def _acknowledge(self, key: Key, result: int, progress: int = 0, detail: int = 0) -> bool:
        return self._link.send(
            mavlink.MAVLink_command_ack_message(key.command, result, progress, detail, key.system_id, key.component_id)
        )


CAPABILITIES = (
    mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    | mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    # All our parameters are REAL32, which both parameter encodings send as the number itself. Clients check either of
    # two flags: Mission Planner checks PARAM_FLOAT; the present protocol requires ENCODE_C_CAST.
    | mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT
    | mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST
)


def autopilot_version() -> mavlink.MAVLink_autopilot_version_message:
    nothing = (0,) * 8
    return mavlink.MAVLink_autopilot_version_message(
        CAPABILITIES, encode_version(__version__), 0, 0, 0, nothing, nothing, nothing, 0, 0, 0
    )


def encode_version(version: str) -> int:
    """Encode "major.minor.patch" as MAVLink's `flight_sw_version`: four bytes, the last one is the release type."""
    match = re.match(r"(\d+)\.(\d+)\.(\d+)", version)
    major, minor, patch = (min(int(part), 255) for part in match.groups()) if match else (0, 0, 0)
    official = match is not None and match.end() == len(version)
    release_type = mavlink.FIRMWARE_VERSION_TYPE_OFFICIAL if official else mavlink.FIRMWARE_VERSION_TYPE_DEV
    return major << 24 | minor << 16 | patch << 8 | release_type


def judge(message: CommandMessage) -> Request | Refusal:
    """Parse and check a command. Values are not rounded: if 0, 1 and 2 are allowed, then 0.5 is refused."""
    if isinstance(message, mavlink.MAVLink_command_int_message):
        last = float(message.x), float(message.y), message.z
    else:
        last = message.param5, message.param6, message.param7
    first, parameters = message.param1, (message.param1, message.param2, message.param3, message.param4, *last)
    match message.command:
        case mavlink.MAV_CMD_USER_1:
            return _calibrate(first, message.param2)
        case mavlink.MAV_CMD_USER_2:
            return Cancel()
        case mavlink.MAV_CMD_USER_3:
            return Undo()
        case mavlink.MAV_CMD_PREFLIGHT_CALIBRATION:
            return _preflight_calibration(parameters)
        case mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES if first == 1:
            return "version"
        case mavlink.MAV_CMD_REQUEST_MESSAGE if first == mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION:
            return "version"
        case mavlink.MAV_CMD_REQUEST_MESSAGE if 0 <= first < 1 << 24 and first.is_integer():
            return Refusal("unsupported", f"Message {first:.0f} cannot be requested here")
        case mavlink.MAV_CMD_REQUEST_MESSAGE:
            return _denied(f"Message request refused: param1 {first:g}")
        case other:
            return Refusal("unsupported", f"Command {other} is not supported by the companion")


def _calibrate(which: float, reboot: float) -> Calibrate | Refusal:
    # Some ground stations send NaN for "not given".
    if reboot not in (0.0, 1.0) and not math.isnan(reboot):
        return _denied(f"Calibration refused: param2 {reboot:g}, allowed 0, 1")
    for what in What:
        if which == what.value:
            return Calibrate.of(what, reboot=reboot == 1.0)
    return _denied(f"Calibration refused: param1 {which:g}, allowed 0, 1, 2")


def _preflight_calibration(parameters: tuple[float, ...]) -> Calibrate | Refusal:
    """Parse MAV_CMD_PREFLIGHT_CALIBRATION: param1 = 1 calibrates the gyros, param5 = 1 the accelerometers.

    Mission Planner's button always sets param3 (ground pressure) too: param3 is ignored, but is not enough alone.
    """
    for number, value in enumerate(parameters, start=1):
        if value != 0 and not (number in (1, 3, 5) and value == 1):
            allowed = "0 or 1" if number in (1, 3, 5) else "0"
            return _denied(f"Calibration refused: param{number} {value:g}, allowed {allowed}")
    chosen = {(1, 1): What.BOTH, (1, 0): What.GYROS, (0, 1): What.ACCELEROMETERS}
    what = chosen.get((int(parameters[0]), int(parameters[4])))
    return _denied("Calibration refused: set param1 or param5 to 1") if what is None else Calibrate.of(what)


def _denied(reason: str) -> Refusal:
    return Refusal("other", reason)
