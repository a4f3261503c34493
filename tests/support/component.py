"""Component 191 on a wire with a scripted calibration service at one end and a ground station at the other."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager, suppress
from typing import Literal, NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.vehicle.vehicle import Vehicle
from companion.component.component import MavlinkComponent
from companion.component.own_parameters import Parameter
from companion.component.service import AcceptedJob, ArmAnswer, JobResult, Refusal
from companion.component.statustext import StatusText, Tunes
from companion.config.sections import EVERYBODY, Senders
from companion.estimation.machine import What
from companion.links.mavlink.link import MavlinkLink
from tests.support.wire import Wire

CALIBRATE, CANCEL, UNDO, PREFLIGHT = 31010, 31011, 31012, 241
ACCEPTED, TEMPORARILY_REJECTED, DENIED, UNSUPPORTED, FAILED, IN_PROGRESS, CANCELLED = range(7)


class Ground:
    """A ground station: pymavlink's own parser and packer, and a list of all that came."""

    def __init__(self, system_id: int = 255, component_id: int = 190) -> None:
        self.system_id, self.component_id = system_id, component_id
        self.received: list[tuple[float, mavlink.MAVLink_message]] = []
        self.raw: list[bytes] = []
        self._codec = mavlink.MAVLink(None, srcSystem=system_id, srcComponent=component_id)
        self._transmit: Callable[[bytes], None] | None = None

    def attach(self, transmit: Callable[[bytes], None] | None) -> None:
        self._transmit = transmit

    def sign(self, key: bytes, ticks: int, link_id: int = 7) -> None:
        """Sign what is sent, by pymavlink's own signing, beginning at a time; whatever comes is listened to."""
        signing = self._codec.signing
        signing.secret_key, signing.timestamp, signing.link_id, signing.sign_outgoing = key, ticks, link_id, True
        signing.allow_unsigned_callback = lambda _codec, _id: True

    def receive(self, data: bytes, t_s: float) -> None:
        self.raw.append(data)
        for message in self._codec.parse_buffer(data) or ():
            self.received.append((t_s, message))

    def pack(self, message: mavlink.MAVLink_message) -> bytes:
        data: bytes = message.pack(self._codec)
        self._codec.seq = (self._codec.seq + 1) % 256
        return data

    def send(self, message: mavlink.MAVLink_message) -> None:
        self.send_raw(self.pack(message))

    def send_raw(self, data: bytes) -> None:
        assert self._transmit is not None
        self._transmit(data)

    def command(
        self,
        command: int,
        *params: float,
        target: tuple[int, int] = (1, 191),
        confirmation: int = 0,
        int_: bool = False,
    ) -> None:
        self.send(command_message(command, *params, target=target, confirmation=confirmation, int_=int_))

    def acks(self, command: int | None = None) -> list[int]:
        return [ack.result for ack in self.ack_messages() if command in (None, ack.command)]

    def ack_messages(self) -> list[mavlink.MAVLink_command_ack_message]:
        return [
            message
            for _, message in self.received
            if isinstance(message, mavlink.MAVLink_command_ack_message)
            and (message.target_system, message.target_component) == (self.system_id, self.component_id)
        ]

    def finals(self, command: int | None = None) -> list[int]:
        return [result for result in self.acks(command) if result != IN_PROGRESS]

    def texts(self) -> list[str]:
        found: list[str] = []
        for _, message in self.received:
            if isinstance(message, mavlink.MAVLink_statustext_message):
                is_rest = message.text.startswith("... ") and bool(found)
                whole = f"{found.pop()}{message.text[3:]}" if is_rest else message.text
                found.append(whole)
        return found

    def times(self, name: str) -> list[float]:
        return [t_s for t_s, message in self.received if message.get_type() == name]


def command_message(
    command: int, *params: float, target: tuple[int, int] = (1, 191), confirmation: int = 0, int_: bool = False
) -> mavlink.MAVLink_message:
    p = [*params, *[0.0] * (7 - len(params))]
    if int_:
        x, y = int(p[4]), int(p[5])
        return mavlink.MAVLink_command_int_message(*target, 0, command, 0, 0, p[0], p[1], p[2], p[3], x, y, p[6])
    return command_long(command, *p, target=target, confirmation=confirmation)


def command_long(
    command: int, *params: float, target: tuple[int, int] = (1, 191), confirmation: int = 0
) -> mavlink.MAVLink_command_long_message:
    p1, p2, p3, p4, p5, p6, p7 = params
    return mavlink.MAVLink_command_long_message(*target, command, confirmation, p1, p2, p3, p4, p5, p6, p7)


class ScriptedJob:
    def __init__(self) -> None:
        self.progress_percent = 0
        self.finished: asyncio.Future[JobResult] = asyncio.get_running_loop().create_future()

    def finish(self, outcome: Literal["done", "failed", "cancelled"], reason: str = "") -> None:
        if not self.finished.done():
            self.finished.set_result(JobResult(outcome, reason))


class Started(NamedTuple):
    what: What | Literal["undo"]
    requester: str
    job: ScriptedJob


class ScriptedService:
    """Does what the test tells it; `takes_s` None: until the test finishes the job."""

    def __init__(self) -> None:
        self.mav_state = int(mavlink.MAV_STATE_ACTIVE)
        self.progress_percent = 100
        self.started: list[Started] = []
        self.reboots: list[bool] = []
        """For each requested calibration: with a restart of the autopilot."""
        self.refusal: Refusal | None = None
        self.error: Exception | None = None
        self.takes_s: float | None = None

    def start_calibration(self, what: What, requester: str, *, reboot: bool = False) -> AcceptedJob | Refusal:
        self.reboots.append(reboot)
        return self._start(what, requester)

    def start_undo(self, requester: str) -> AcceptedJob | Refusal:
        return self._start("undo", requester)

    def cancel(self, requester: str) -> bool:
        if self.error is not None:
            raise self.error
        running = [started.job for started in self.started if not started.job.finished.done()]
        for job in running:
            job.finish("cancelled", f"Calibration cancelled by {requester}")
        return bool(running)

    @property
    def jobs(self) -> list[ScriptedJob]:
        return [started.job for started in self.started]

    def _start(self, what: What | Literal["undo"], requester: str) -> AcceptedJob | Refusal:
        if self.error is not None:
            raise self.error
        if self.refusal is not None:
            return self.refusal
        job = ScriptedJob()
        self.started.append(Started(what, requester, job))
        if self.takes_s == 0:
            job.finish("done")
        elif self.takes_s is not None:
            asyncio.get_running_loop().call_later(self.takes_s, job.finish, "done")
        return job


class ScriptedGate:
    """Says what the test tells it."""

    def __init__(self) -> None:
        self.at_arm: Literal["gate", "warn", "off"] = "gate"
        self.asks_script = False
        self.says = ArmAnswer("accept", "calibrated 3 min ago, 2.1 deg/h")

    def answer(self) -> ArmAnswer:
        return self.says


class ComponentBench(NamedTuple):
    link: MavlinkLink
    component: MavlinkComponent
    service: ScriptedService
    ground: Ground
    wire: Wire
    task: asyncio.Task[None]
    gate: ScriptedGate
    texts: StatusText


@asynccontextmanager
async def bench(
    *,
    seed: int = 0,
    loss: float = 0.0,
    duplicate: float = 0.0,
    system_id: int | None = None,
    ground: Ground | None = None,
    parameters: Sequence[Parameter] = (),
    allow: Sequence[str] = EVERYBODY,
) -> AsyncIterator[ComponentBench]:
    """The component running at one end of a wire."""
    link, ground = MavlinkLink(), ground or Ground()
    service, gate = ScriptedService(), ScriptedGate()
    if system_id is not None:
        link.join((system_id, 1))
    texts = StatusText(link)
    tunes = Tunes(link, Vehicle(MavlinkLink()), lambda: False, texts.woken)
    component = MavlinkComponent(link, service, gate, texts, tunes, parameters, Senders(tuple(allow)))
    wire = Wire(link, ground, seed=seed, loss=loss, duplicate=duplicate)
    task = asyncio.create_task(component.run())
    try:
        yield ComponentBench(link, component, service, ground, wire, task, gate, texts)
    finally:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task
        await asyncio.sleep(0.1)
    assert link.received["handler error"] == 0
