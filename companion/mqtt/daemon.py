"""The daemon as the MQTT process sees it: a stream of its status and attitude, and answers to requests.

Each request over MQTT is answered, none is obeyed twice, and a flood stays bounded. An answer repeats the request's
transaction. A calibration is answered twice: "accepted" at once, and how it ended; everything else once. Requests go to
the control socket, as the command line's do, so refusals are the same too. Three kinds of messages are no new request:
- a retained one comes back at every connection, for ever: it is never obeyed, and the log says so once;
- the empty payload that deletes a retained one looks like a request (on MQTT 3.1.1): it is ignored;
- a repeat of a transaction (QoS 1 delivers at least once) gets the same answer again.
"""

from __future__ import annotations

import asyncio
import contextlib
import difflib
import logging
import re
import time
from collections import OrderedDict
from collections.abc import AsyncGenerator, Callable
from typing import Final

import msgspec

from companion.commands import MAX_SHOWN, Interface, asked_by, shown
from companion.errors import CalibrationRefusedError, CompanionError, DaemonUnreachableError
from companion.formats import Object

logger = logging.getLogger(__name__)

SILENT_S: Final = 5.0
"""The stream has five replies a second; a daemon without any for this long stands still."""
AGAIN_S: Final = 1.0
ANSWER_WITHIN_S: Final = 10.0
CLOCKS_AGREE_S: Final = 2.0

MONITOR: Final[Object] = {"command": "monitor", "pose": True}
"""Request for the stream, whose first reply holds the status and the last record."""
Ask = Callable[[Object], AsyncGenerator[Object, None]]
"""Sends a request to the control socket and yields the replies."""
Respond = Callable[[str, Object], None]
Transaction = str | int | None

MAX_PAYLOAD_BYTES: Final = 4096
MAX_TRANSACTION: Final = 128
MAX_NUMBER: Final = 2**53
"""The largest integer that every reader of JSON keeps exactly."""
MAX_PENDING: Final = 8
"""The most requests that wait for their end, such as cancels in the middle of a write."""
REMEMBERED: Final = 32
REMEMBER_S: Final = 600.0
KNOWN: Final = asked_by(Interface.MQTT)
_COMMAND = re.compile(r"[A-Za-z0-9_-]{1,32}")


class Daemon:
    """Follows the daemon; `follow` runs until cancelled."""

    def __init__(self, ask: Ask) -> None:
        self.ask = ask
        self.status: Object | None = None
        self.pose: Object | None = None
        self.record: Object | None = None
        """The last calibration's record."""
        self.alive = False
        self.news = asyncio.Event()
        """Set at every reply, and when the stream ends."""
        self.clock_agrees = False
        """True if the autopilot's GNSS time confirms the clock of this computer."""

    @property
    def vehicle(self) -> Object:
        """The vehicle's part of the status; empty before the first."""
        return {} if self.status is None else dict(self.status["vehicle"])

    async def follow(self) -> None:
        """Read the stream of states, again after every loss."""
        while True:
            try:
                await self._read()
            except (CompanionError, TimeoutError) as error:
                if self.alive:
                    logger.warning("mqtt: the daemon gives no state: %s", str(error) or "it is silent")
            self.alive, self.pose = False, None
            self.news.set()
            await asyncio.sleep(AGAIN_S)

    async def _read(self) -> None:
        async with contextlib.aclosing(self.ask(MONITOR)) as replies:
            while True:
                async with asyncio.timeout(SILENT_S):
                    reply = await anext(replies, None)
                self._accept(reply)

    async def refresh(self) -> None:
        """Read the status and the last record now; keep the old ones where no answer comes."""
        # Not asyncio.timeout, which cannot expire in a cancelled task before Python 3.11.4: the end reads here.
        reading = asyncio.ensure_future(self._read_once())
        try:
            await asyncio.wait([reading], timeout=SILENT_S)
        finally:
            reading.cancel()

    async def _read_once(self) -> None:
        with contextlib.suppress(CompanionError):
            async with contextlib.aclosing(self.ask(MONITOR)) as replies:
                self._accept(await anext(replies, None))

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
        """Return the final reply to a short request.

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
        raise DaemonUnreachableError("the daemon gives no answer")


class Request(msgspec.Struct):
    """A request, and how it was answered last."""

    command: str
    transaction: Transaction = None
    content: Object = {}
    problem: str = ""
    """Why it cannot be asked of the daemon, in one line; empty: it can."""
    at_s: float = 0.0
    response: Object | None = None


def parse(command: str, payload: bytes) -> Request:
    """Judge a request's payload: a JSON object with known keys, or nothing. Never raises."""

    def unfit(reason: str, transaction: Transaction = None) -> Request:
        return Request(command, transaction, problem=reason)

    if command not in KNOWN:
        return unfit(f"unknown request {command!r}; known: {', '.join(KNOWN)}")
    if len(payload) > MAX_PAYLOAD_BYTES:
        return unfit(f"a payload of {len(payload)} bytes; allowed: at most {MAX_PAYLOAD_BYTES}")
    try:
        content = msgspec.json.decode(payload) if payload.strip() else {}
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        why = "nested too deeply" if isinstance(error, RecursionError) else str(error)
        return unfit(f"the payload is not JSON: {why}; allowed: a JSON object, or nothing")
    if not isinstance(content, dict):
        return unfit(f"the payload is {shown(content)}; allowed: a JSON object, or nothing")
    transaction = content.pop("transaction", None)
    if not _is_transaction(transaction):
        return unfit(
            f"'transaction': found {shown(transaction)}; allowed: a text of at most {MAX_TRANSACTION} characters, or a"
            " whole number"
        )
    kind = KNOWN[command]
    known = kind.fields(Interface.MQTT)
    for key, value in content.items():
        if key not in known:
            near = difflib.get_close_matches(key[:MAX_SHOWN], known, n=1)
            hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(('transaction', *known))}"
            return unfit(f"unknown key {shown(key)}; {hint}", transaction)
        if value is None:
            return unfit(f"{key!r}: found null; allowed: {known[key].allowed}", transaction)
    try:
        kind.read(content)
    except CalibrationRefusedError as error:
        return unfit(str(error), transaction)
    return Request(command, transaction, content)


def _is_transaction(value: object) -> bool:
    if isinstance(value, str):
        return len(value) <= MAX_TRANSACTION
    return value is None or (isinstance(value, int) and not isinstance(value, bool) and abs(value) <= MAX_NUMBER)


class Requests:
    """Accepts requests and answers them.

    `on_retained` is called once for each command with a retained request at the broker.
    """

    def __init__(self, ask: Ask, respond: Respond, on_retained: Callable[[str], None]) -> None:
        self._ask, self._respond, self._on_retained = ask, respond, on_retained
        self._tasks: set[asyncio.Task[None]] = set()
        self._known: OrderedDict[tuple[str, Transaction], Request] = OrderedDict()
        self._retained: set[str] = set()

    def accept(self, command: str, payload: bytes, *, retained: bool) -> None:
        """Accept one request; its answer comes later."""
        if _COMMAND.fullmatch(command) is None:
            logger.debug("mqtt: a request %.60r is ignored", command)
            return
        if self._is_leftover(command, payload, retained=retained):
            return
        request = parse(command, payload)
        reason = "a retained request is never obeyed; send it again without retain" if retained else request.problem
        if reason:
            self._refuse(request, "request", reason)
        elif not self._is_repeat(request):
            self._start(request)

    async def close(self, within_s: float) -> None:
        """Wait so long for answers, then drop the requests."""
        if self._tasks:
            await asyncio.wait(self._tasks, timeout=within_s)
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def _is_leftover(self, command: str, payload: bytes, *, retained: bool) -> bool:
        """Return whether this only deletes a retained request; report a retained one."""
        if retained and payload:
            if command not in self._retained:
                self._retained.add(command)
                self._on_retained(command)
            return False
        if payload or not (retained or command in self._retained):
            return False
        self._retained.discard(command)
        return True

    def _is_repeat(self, request: Request) -> bool:
        """Return whether the transaction is known already; answer it as before."""
        if request.transaction is None:
            return False
        now_s = asyncio.get_running_loop().time()
        while self._known and now_s - next(iter(self._known.values())).at_s > REMEMBER_S:
            self._known.popitem(last=False)
        known = self._known.get((request.command, request.transaction))
        if known is None:
            return False
        if known.content != request.content:
            reason = f"transaction {request.transaction!r} was another {request.command}; give each one of its own"
            self._refuse(request, "request", reason)
        elif known.response is not None:
            self._respond(request.command, {**known.response, "repeated": True})
        return True

    def _start(self, request: Request) -> None:
        if len(self._tasks) >= MAX_PENDING:
            reason = f"{MAX_PENDING} requests are waiting for their end already"
            self._refuse(request, "busy", reason)
            return
        if request.transaction is not None:
            request.at_s = asyncio.get_running_loop().time()
            self._known[request.command, request.transaction] = request
            if len(self._known) > REMEMBERED:
                self._known.popitem(last=False)
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
            self._answer(
                request, {"state": "failed", "reason": "internal error of the daemon; its log has the details"}
            )

    def _answer(self, request: Request, answer: Object) -> None:
        request.response = {"transaction": request.transaction, **answer}
        self._respond(request.command, request.response)

    def _reject(self, request: Request, refusal: str, reason: str) -> None:
        # A refused request is not remembered: the daemon may accept the same one a moment later.
        self._known.pop((request.command, request.transaction), None)
        self._refuse(request, refusal, reason)

    def _refuse(self, request: Request, refusal: str, reason: str) -> None:
        response = {"transaction": request.transaction, "state": "refused", "refusal": refusal, "reason": reason}
        self._respond(request.command, response)
