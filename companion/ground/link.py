"""Telemetry link of the ground commands, on MAVSDK 4.1, and the client of MAVLink's command protocol (`Exchange`).

MAVSDK's MavlinkDirectServer sends and receives any message, even before MAVSDK has found a system; its Param is a
parameter client with retries. Its `send_command` is not used: it reports no progress, repeats requests with
confirmation 0 (as new requests), and does not recover a lost final answer. MAVSDK 4.1 has no signing: with a key, the
companion's own link code verifies and signs, and MAVSDK connects to it over `raw://`. MAVSDK calls back in its own
threads; the code of this module runs in the event loop.

`Exchange` works over a radio that loses packets. It repeats a request with increasing `confirmation` until the first
answer, then receives IN_PROGRESS until the final answer. If the answers stop, it repeats the request: the companion
sends a lost final answer again for 3 s (`component.commands`). A later request would start a new job and is not sent.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any, ClassVar, Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.component.commands import REMEMBER_FINAL_S
from companion.errors import AutopilotError, ConfigError, LinkError
from companion.ground.heard import Address, Fields, GroundListener, whole
from companion.links.mavlink.link import MavlinkLink, Message
from companion.links.mavlink.signing import Signing
from companion.links.mavlink.transport import parse_url, run_transport
from companion.links.system.events import Listeners, comes

logger = logging.getLogger(__name__)


@asynccontextmanager
async def open_signed(sdk: Any, own: tuple[int, int], url: str, key: bytes) -> AsyncIterator[Signing]:
    """Connect MAVSDK to a url through a link that signs and verifies; `own`: our own system and component id."""
    await asyncio.to_thread(sdk.add_any_connection_with_handle, "raw://")
    loop, parser = asyncio.get_running_loop(), mavlink.MAVLink(None)
    parser.robust_parsing = True
    link = MavlinkLink(system_id=own[0], component_id=own[1])
    link.signing = signing = Signing(required=True, key=key)

    def hand_over(message: Message, _t_s: float) -> None:
        sdk.pass_received_raw_bytes(bytes(message.get_msgbuf()))

    def send(data: bytes) -> None:
        for message in parser.parse_buffer(data) or ():
            if message.get_msgId() in mavlink.mavlink_map:
                link.send(message)

    def send_from_thread(data: bytes) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has ended
            loop.call_soon_threadsafe(send, data)

    for kind in mavlink.mavlink_map.values():
        link.subscribe(kind, hand_over)
    sdk.subscribe_raw_bytes_to_be_sent(send_from_thread)
    carrying = asyncio.create_task(run_transport(link, url), name="signed link")
    try:
        yield signing
    finally:
        carrying.cancel()
        await asyncio.wait([carrying])


INSTALL: Final = "install it with: pip install '.[ground]' (in the folder of the companion's sources)"
_SCHEMES: Final = {"udpin": "udpin", "udpout": "udpout", "tcp": "tcpout", "serial": "serial"}
_HEARD: Final = ("HEARTBEAT", "STATUSTEXT", "COMMAND_ACK")


class GroundLink:
    """An open telemetry link: sends commands, reads parameters, and passes received messages on."""

    def __init__(
        self, sdk: Any, direct: Any, own: Address, heard: GroundListener, signing: Signing | None = None
    ) -> None:
        self.own, self.heard = own, heard
        self._sdk, self._direct, self._signing = sdk, direct, signing
        self.on_ack: Listeners[[Address, Fields]] = Listeners()  # callbacks for every COMMAND_ACK to us
        self._loop = asyncio.get_running_loop()
        for name in _HEARD:
            direct.subscribe_message(name, self._in_a_thread)

    def unbelieved(self) -> str:
        """Describe the messages that were dropped for a missing or wrong signature; empty: none."""
        if self._signing is None or not self._signing.doubted:
            return ""
        counts = ", ".join(f"{count} {reason}" for reason, count in self._signing.doubted.most_common())
        return f"messages dropped because of their signature: {counts}"

    def send_command(self, target: Address, command: int, parameters: tuple[float, ...], confirmation: int) -> None:
        """Send a COMMAND_LONG; ignore a failure to send, as packets can be lost anyway."""
        from mavsdk.plugins.mavlink_direct_server import MavlinkDirectServerError, MavlinkMessage

        # Name every field, with a number: for a wrong name or a string MAVSDK sends 0, without an error.
        fields = {
            "target_system": target.system_id,
            "target_component": target.component_id,
            "command": command,
            "confirmation": confirmation,
            **{f"param{number}": float(value) for number, value in enumerate(parameters, 1)},
        }
        message = MavlinkMessage("COMMAND_LONG", *self.own, *target, json.dumps(fields))
        try:
            self._direct.send_message(message)
        except MavlinkDirectServerError as error:
            logger.debug("not sent: %s", error)

    async def parameters(self, target: Address) -> dict[str, float]:
        found = await asyncio.to_thread(self._client(target).get_all_params)
        return {one.name: one.value for one in (*found.float_params, *found.int_params)}

    async def get_parameter(self, target: Address, name: str) -> float | None:
        """Read one parameter of a component; None: the component did not answer or has no such parameter."""
        from mavsdk.plugins.param import ParamError

        try:
            return float(await asyncio.to_thread(self._client(target).get_param_float, name))
        except ParamError as error:
            logger.debug("%s not read: %s", name, error)
            return None

    def _client(self, target: Address) -> Any:
        from mavsdk.plugins.param import Param, ParamError, ParamResult, ProtocolVersion

        for system in self._sdk.get_systems():
            if system.get_system_id() == target.system_id:
                client = Param(system)
                try:
                    client.select_component(target.component_id, ProtocolVersion.V1)
                except ParamError as error:
                    # MAVSDK 4.1.0 selects the component, but reports UNKNOWN.
                    if error.result != ParamResult.UNKNOWN:
                        raise AutopilotError(f"component {target.component_id}: {error.result.name}") from None
                return client
        raise AutopilotError(f"system {target.system_id} is not heard any more")

    def _in_a_thread(self, message: Any, _: object) -> None:
        self._loop.call_soon_threadsafe(
            self._on_message,
            message.message_name,
            Address(message.system_id, message.component_id),
            message.fields_json,
        )

    def _on_message(self, name: str, source: Address, fields_json: str) -> None:
        try:
            fields = json.loads(fields_json)
        except ValueError:
            logger.debug("%s of %s is no JSON: %.80s", name, source, fields_json)
            return
        if name != "COMMAND_ACK":
            self.heard.update(name, source, fields, self._loop.time())
            return
        system, component = whole(fields, "target_system"), whole(fields, "target_component")
        if system in (0, self.own.system_id) and component in (0, self.own.component_id):
            self.on_ack.tell(source, fields)


class _Log:
    """Receives MAVSDK's log, which otherwise goes to the terminal.

    MAVSDK logs every STATUSTEXT. Its Python function `mavsdk.log_subscribe` fails on texts that are not UTF-8, so this
    class subscribes in the C library.
    """

    def __init__(self) -> None:
        from mavsdk.cmavsdk_loader import _cmavsdk_lib
        from mavsdk.logging import LogCallback, LogLevel

        self.last_error = ""
        self._error = LogLevel.ERROR
        # Store a reference for as long as the library is loaded: the library may call back at any time.
        _Log.callback = LogCallback(self._take)
        _cmavsdk_lib.mavsdk_log_subscribe(_Log.callback, None)

    callback: ClassVar[Any] = None

    def _take(self, level: int, message: bytes | None, *_: object) -> bool:
        """Log a message of MAVSDK, in one of its threads; return True, so that MAVSDK does not print it."""
        words = (message or b"").decode(errors="replace")
        logger.debug("MAVSDK: %s", words)
        if level == self._error:
            self.last_error = words.partition(": ")[2] or words
        return True


@asynccontextmanager
async def open_link(url: str, heard: GroundListener, key: bytes | None = None) -> AsyncIterator[GroundLink]:
    """Open a telemetry link as a ground station. `heard` receives all messages, or only messages signed with `key`.

    Raises:
        ConfigError: MAVSDK is not installed, or the url is invalid.
        LinkError: the port cannot be opened.
    """
    try:
        import mavsdk
        from mavsdk.plugins.mavlink_direct_server import MavlinkDirectServer
    except (ImportError, OSError) as error:
        raise ConfigError(f"companion ground needs MAVSDK 4.1: {error}; {INSTALL}") from None
    kind, where, number = parse_url(url)
    log = _Log()
    configuration = mavsdk.Configuration.create_with_component_type(mavsdk.ComponentType.GROUND_STATION)
    own = Address(configuration.system_id, configuration.component_id)
    with mavsdk.Mavsdk(configuration) as sdk:
        direct = MavlinkDirectServer(sdk.server_component_by_id(own.component_id))
        if key is not None:
            async with open_signed(sdk, own, url, key) as signing:
                yield GroundLink(sdk, direct, own, heard, signing)
            return
        try:
            await asyncio.to_thread(sdk.add_any_connection_with_handle, f"{_SCHEMES[kind]}://{where}:{number}")
        except mavsdk.MavsdkError as error:
            hint = "; another ground station has it: docs/ground_stations.md" if "in use" in log.last_error else ""
            raise LinkError(f"{url} cannot be opened: {log.last_error or error}{hint}") from None
        yield GroundLink(sdk, direct, own, heard)


ANSWER_WITHIN_S: Final = (0.6, 0.6, 0.6, 0.6, 1.6)
"""Timeouts in seconds of the attempts to send a request: 0.3 s for the companion, the rest for the radio. The last
attempt must come while the companion remembers its answer to the first: later it would start a second calibration."""
REPEAT_AFTER_S: Final = (1.2, 1.5, 1.8, 2.1, 2.4)
"""Seconds without an answer after which a running request is repeated. The first value allows two lost IN_PROGRESS
ACKs. The last repeat must arrive while the companion remembers its final answer (3 s)."""
assert max(REPEAT_AFTER_S[-1], sum(ANSWER_WITHIN_S[:-1])) < REMEMBER_FINAL_S - 0.5
ENDED_AFTER_S: Final = 5.0  # time without answers, but with idle heartbeats: the final answer counts as lost
LOST_AFTER_S: Final = 20.0
_TICK_S: Final = 0.25


class Exchange:
    """Sends one command by `run`; then `result` is its MAV_RESULT (None: no final answer), `detail` its result_param2.

    `on_progress` is called several times a second with the percentage and the seconds since the last answer.
    """

    def __init__(
        self,
        link: GroundLink,
        target: Address,
        command: int,
        *parameters: float,
        on_progress: Callable[[int, float], None] = lambda percent, silent_s: None,
    ) -> None:
        self._link, self._target, self._command = link, target, command
        self._on_progress = on_progress
        self._parameters = (*parameters, *(0.0,) * (7 - len(parameters)))
        self.result: int | None = None
        self.detail = 0
        self.unanswered = False  # True: no attempt was answered
        self._answered = asyncio.Event()
        self._heard_s = 0.0
        self._confirmation = 0
        self.percent = 0

    async def run(self) -> None:
        """Send the command and wait for its final answer; stop after 20 s without answers or heartbeats."""
        stop_watching = self._link.on_ack.add(self._on_ack)
        try:
            self.unanswered = not await self._begin()
            while not self.unanswered and self.result is None and await self._follow():
                pass
        finally:
            stop_watching()

    async def _begin(self) -> bool:
        for within_s in ANSWER_WITHIN_S:
            self._send()
            if await self._hears(within_s):
                return True
        return False

    async def _follow(self) -> bool:
        """Wait for the next answer, and repeat the request; return False if the job has ended or the link is lost."""
        loop = asyncio.get_running_loop()
        repeats = list(REPEAT_AFTER_S)
        while not await self._hears(_TICK_S):
            silent_s = loop.time() - self._heard_s
            self._on_progress(self.percent, silent_s)
            if repeats and silent_s >= repeats[0]:
                del repeats[0]
                self._send()
            since_s = max(self._heard_s + ENDED_AFTER_S / 2, loop.time() - LOST_AFTER_S)
            busy = self._link.heard.busy(self._target.system_id, since_s)
            if (busy is False and silent_s >= ENDED_AFTER_S) or (busy is None and silent_s >= LOST_AFTER_S):
                return False
        self._on_progress(self.percent, 0.0)
        return True

    def _send(self) -> None:
        self._link.send_command(self._target, self._command, self._parameters, min(self._confirmation, 255))
        self._confirmation += 1

    async def _hears(self, within_s: float) -> bool:
        if not await comes(self._answered, within_s):
            return False
        self._answered.clear()
        return True

    def _on_ack(self, source: Address, ack: Fields) -> None:
        if source != self._target or whole(ack, "command") != self._command or self.result is not None:
            return
        self._heard_s = asyncio.get_running_loop().time()
        result, progress = whole(ack, "result"), whole(ack, "progress")
        if result != mavlink.MAV_RESULT_IN_PROGRESS:
            self.result, self.detail = result, whole(ack, "result_param2")
        elif progress <= 100:
            self.percent = max(self.percent, progress)
        self._answered.set()
