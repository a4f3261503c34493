"""Client of the daemon in the MQTT process: receives its status and attitude, and forwards MQTT requests to it.

Requests go to the daemon's control socket, like those of the command line, and get the same refusals.
"""

from __future__ import annotations

import asyncio
import contextlib
import difflib
import logging
import re
import time
from collections.abc import AsyncGenerator, Callable
from typing import Final

import msgspec

from companion.commands import MAX_SHOWN, Interface, commands_for, shown
from companion.errors import CalibrationRefusedError, CompanionError, DaemonUnreachableError
from companion.formats import Object
from companion.messages import message

logger = logging.getLogger(__name__)

SILENT_S: Final = 5.0
"""Time without a reply after which the daemon counts as hung; its status stream has five replies a second."""
AGAIN_S: Final = 1.0
ANSWER_WITHIN_S: Final = 10.0
CLOCKS_AGREE_S: Final = 2.0

Ask = Callable[[Object], AsyncGenerator[Object, None]]  # Sends a request to the control socket and yields the replies
Transaction = str | int | None

MAX_PAYLOAD_BYTES: Final = 4096
MAX_TRANSACTION: Final = 128
MAX_NUMBER: Final = 2**53
"""Largest integer that every JSON parser can represent exactly."""
MAX_PENDING: Final = 8  # Most requests executed at the same time, such as cancels during a write
REMEMBERED: Final = 32
REMEMBER_S: Final = 600.0
KNOWN: Final = commands_for(Interface.MQTT)
_COMMAND = re.compile(r"[A-Za-z0-9_-]{1,32}")


class Daemon:
    """Latest status and attitude from the daemon; the event `news` is set at each message and when the stream is lost.

    `clock_agrees` is True if the autopilot's GNSS time confirms the clock of this computer.
    """

    def __init__(self, ask: Ask) -> None:
        self.ask = ask
        self.status: Object | None = None
        self.pose: Object | None = None
        self.record: Object | None = None  # Record of the last calibration
        self.alive = False
        self.news = asyncio.Event()
        self.clock_agrees = False

    @property
    def vehicle(self) -> Object:
        return {} if self.status is None else dict(self.status["vehicle"])

    async def follow(self) -> None:
        while True:
            try:
                async with contextlib.aclosing(self.ask({"command": "monitor", "pose": True})) as replies:
                    while True:
                        async with asyncio.timeout(SILENT_S):
                            self._accept(await anext(replies, None))
            except (CompanionError, TimeoutError) as error:
                if self.alive:
                    reason = str(error) or f"silent for {SILENT_S:g} s"
                    logger.warning("mqtt: %s", message("daemon_gives_no_answer", reason=reason))
            self.alive, self.pose = False, None
            self.news.set()
            await asyncio.sleep(AGAIN_S)

    def _accept(self, reply: Object | None) -> None:
        if reply is None or reply["kind"] == "error":
            raise DaemonUnreachableError("the stream has ended" if reply is None else str(reply["reason"]))
        self.alive, self.pose = True, reply["pose"]
        self.record = reply.get("record", self.record)
        if "status" in reply:
            self.status = reply["status"]
            unix_s = self.vehicle["unix_time_s"]
            self.clock_agrees = unix_s is not None and abs(unix_s - time.time()) < CLOCKS_AGREE_S
        self.news.set()

    async def result(self, request: Object) -> Object:
        """Send a short request to the daemon and return its final reply.

        Raises:
            CompanionError: the daemon refuses, is gone, or gives no answer within 10 s.
        """
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(ANSWER_WITHIN_S), contextlib.aclosing(self.ask(request)) as replies:
                async for reply in replies:
                    if reply["kind"] == "error":
                        raise CompanionError(str(reply["reason"]))
                    if reply["kind"] == "result":
                        return reply
        raise DaemonUnreachableError(message("daemon_gives_no_answer", reason=f"silent for {ANSWER_WITHIN_S:g} s"))


class Request(msgspec.Struct):
    """MQTT request with its last response. `problem`: why the request is invalid; empty if it may go to the daemon."""

    command: str
    transaction: Transaction = None
    content: Object = {}
    problem: str = ""
    at_s: float = 0.0
    response: Object | None = None


def parse(command: str, payload: bytes) -> Request:
    """Parse the payload of an MQTT request: nothing, or a JSON object with known keys; errors go into its `problem`."""
    request = Request(command)
    try:
        _read(request, payload)
    except CalibrationRefusedError as error:
        request.problem = str(error)
    return request


def _read(request: Request, payload: bytes) -> None:
    if request.command not in KNOWN:
        raise CalibrationRefusedError(f"unknown request {request.command!r}; allowed: {', '.join(KNOWN)}")
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise CalibrationRefusedError(f"a payload of {len(payload)} bytes; allowed: at most {MAX_PAYLOAD_BYTES}")
    try:
        content = msgspec.json.decode(payload) if payload.strip() else {}
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        why = "nested too deeply" if isinstance(error, RecursionError) else str(error)
        raise CalibrationRefusedError(f"the payload is not JSON: {why}; allowed: a JSON object, or nothing") from None
    if not isinstance(content, dict):
        raise CalibrationRefusedError(f"the payload is {shown(content)}; allowed: a JSON object, or nothing")
    transaction = content.pop("transaction", None)
    if not _is_transaction(transaction):
        raise CalibrationRefusedError(
            f"'transaction': found {shown(transaction)}; allowed: a text of at most {MAX_TRANSACTION} characters, or a"
            " whole number"
        )
    request.transaction = transaction
    kind = KNOWN[request.command]
    known = kind.fields(Interface.MQTT)
    for key, value in content.items():
        if key not in known:
            near = difflib.get_close_matches(key[:MAX_SHOWN], known, n=1)
            hint = f" (did you mean {near[0]!r}?)" if near else ""
            allowed = ", ".join(("transaction", *known))
            raise CalibrationRefusedError(f"unknown key {shown(key)}; allowed: {allowed}{hint}")
        if value is None:
            raise CalibrationRefusedError(f"{key!r}: found null; allowed: {known[key].allowed}")
    kind.read(content)
    request.content = content


def _is_transaction(value: object) -> bool:
    if isinstance(value, str):
        return len(value) <= MAX_TRANSACTION
    return value is None or (isinstance(value, int) and not isinstance(value, bool) and abs(value) <= MAX_NUMBER)


class Requests:
    """Handler of MQTT requests: answers each by `respond`, executes none twice, and refuses too many at once.

    An answer contains the request's transaction id. A calibration gets two answers: "accepted" at once, then its
    result. Any other request gets one. Three kinds of messages are not executed:

    - A retained request is refused, with one line in the log, because it would return at every connection.
    - The empty payload that deletes a retained request is ignored; with MQTT 3.1.1 it looks like a request.
    - A request with a known transaction id gets its latest answer again, because QoS 1 may deliver a message twice.
    """

    def __init__(self, ask: Ask, topic: str, respond: Callable[[str, Object], None]) -> None:
        self._ask, self._topic, self._respond = ask, topic, respond
        self._tasks: set[asyncio.Task[None]] = set()
        self._known: dict[tuple[str, Transaction], Request] = {}
        self._retained: set[str] = set()

    def accept(self, command: str, payload: bytes, *, retained: bool) -> None:
        if _COMMAND.fullmatch(command) is None:
            logger.debug("mqtt: a request %.60r is ignored", command)
            return
        if not payload and (retained or command in self._retained):
            self._retained.discard(command)
            return
        request = parse(command, payload)
        reason = message("retained_request", topic=self._topic + command) if retained else request.problem
        if retained and command not in self._retained:
            self._retained.add(command)
            logger.warning("mqtt: %s", reason)
        if reason:
            self._refuse(request, "request", reason)
        elif not self._is_repeat(request):
            self._start(request)

    async def close(self, within_s: float) -> None:
        if self._tasks:
            await asyncio.wait(self._tasks, timeout=within_s)
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def _is_repeat(self, request: Request) -> bool:
        """Return True if a request with this transaction id is known; if so, send the latest answer to it again."""
        if request.transaction is None:
            return False
        known = self._known.get((request.command, request.transaction))
        if known is None or asyncio.get_running_loop().time() - known.at_s > REMEMBER_S:
            return False
        if known.content != request.content:
            reason = f"transaction {request.transaction!r} was another {request.command}; give each one of its own"
            self._refuse(request, "request", reason)
        elif known.response is not None:
            self._respond(request.command, {**known.response, "repeated": True})
        return True

    def _start(self, request: Request) -> None:
        if len(self._tasks) >= MAX_PENDING:
            self._refuse(request, "busy", message("too_many_at_once", what="MQTT requests"))
            return
        if request.transaction is not None:
            request.at_s = asyncio.get_running_loop().time()
            self._known.pop((request.command, request.transaction), None)
            self._known[request.command, request.transaction] = request
            if len(self._known) > REMEMBERED:
                del self._known[next(iter(self._known))]
        task = asyncio.get_running_loop().create_task(self._run(request), name=f"mqtt {request.command}")
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _run(self, request: Request) -> None:
        question = {"command": request.command, **request.content}
        if "wait" in KNOWN[request.command].fields():
            question["wait"] = True
        accepted = False
        try:
            async with contextlib.aclosing(self._ask(question)) as replies:
                async for reply in replies:
                    if reply["kind"] == "error":
                        self._reject(request, reply.get("refusal", "other"), reply["reason"])
                    elif reply["kind"] == "result":
                        record = reply.get("record")
                        final = {key: value for key, value in reply.items() if key != "kind"}
                        if record is not None:
                            final = {"state": record["state"], "reason": record["reason"], "record": record}
                        self._answer(request, final)
                    elif not accepted:
                        accepted = True
                        self._answer(request, {"state": "accepted", "reason": "calibration started"})
        except CompanionError as error:
            self._reject(request, "other", str(error))
        except Exception:
            logger.exception("mqtt request %s failed", request.command)
            self._answer(request, {"state": "failed", "reason": message("daemon_internal_error")})

    def _answer(self, request: Request, answer: Object) -> None:
        request.response = {"transaction": request.transaction, **answer}
        self._respond(request.command, request.response)

    def _reject(self, request: Request, refusal: str, reason: str) -> None:
        # Do not remember a refused request: the daemon may accept the same request later.
        self._known.pop((request.command, request.transaction), None)
        self._refuse(request, refusal, reason)

    def _refuse(self, request: Request, refusal: str, reason: str) -> None:
        response = {"transaction": request.transaction, "state": "refused", "refusal": refusal, "reason": reason}
        self._respond(request.command, response)
