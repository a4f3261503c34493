"""Ground station of `companion ground`: finds the companion on the link, sends a request, describes the outcome."""

from __future__ import annotations

import asyncio
import dataclasses
import sys
from collections.abc import Sequence
from typing import Any, Final, Literal

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.component.commands import MAV_RESULT_CANCELLED, NOTHING_RAN
from companion.component.own_parameters import AT_ARM, RESULTS
from companion.component.service import MEASURED_PERCENT, WRITTEN_PERCENT
from companion.component.statustext import Severity
from companion.errors import ConfigError, NobodyHeardError
from companion.estimation.machine import What
from companion.formats import printable
from companion.ground import heard
from companion.ground.heard import FRESH_S, Address, AutopilotSeen, GroundListener, Text
from companion.ground.link import Exchange, GroundLink

CALIBRATE, CANCEL, UNDO = mavlink.MAV_CMD_USER_1, mavlink.MAV_CMD_USER_2, mavlink.MAV_CMD_USER_3
EVERYBODY_WITHIN_S: Final = 1.3  # time after the first heartbeat in which every sender (1 Hz) is received
WORDS_WITHIN_S: Final = 3.0  # longest wait for the companion's texts after the end of a job
QUIET_S: Final = 1.0  # time without a text after which the texts are complete: the companion sends two lines a second
CANCELLED_WITHIN_S: Final = 30.0  # timeout of a cancel, which may first have to restore old values
SILENCE_WORTH_A_WORD_S: Final = 3.0
_POLL_S: Final = 0.05

State = Literal["done", "failed", "cancelled", "refused", "lost", "idle", "busy", "fault", "unknown"]
_STATES: Final[dict[int, State]] = {
    mavlink.MAV_RESULT_ACCEPTED: "done",
    mavlink.MAV_RESULT_FAILED: "failed",
    MAV_RESULT_CANCELLED: "cancelled",
    mavlink.MAV_RESULT_DENIED: "refused",
    mavlink.MAV_RESULT_TEMPORARILY_REJECTED: "refused",
    mavlink.MAV_RESULT_UNSUPPORTED: "refused",
}
_DOING: Final[dict[int, tuple[State, str]]] = {
    mavlink.MAV_STATE_CALIBRATING: ("busy", "calibrating or writing"),
    mavlink.MAV_STATE_STANDBY: ("idle", "nothing is running"),
    mavlink.MAV_STATE_ACTIVE: ("idle", "nothing is running"),
    mavlink.MAV_STATE_CRITICAL: ("fault", "something needs attention: `companion status` on the aircraft says what"),
}
_SAID_AS: Final = {"failed": Severity.ERROR, "refused": Severity.WARNING}  # severity of the text with the reason


@dataclasses.dataclass(frozen=True)
class RequestOutcome:
    """Outcome of a request: `answer` is JSON for programs (`state`, `reason`, more); `lines` are texts for people."""

    state: State
    reason: str
    good: bool
    lines: Sequence[str]
    more: dict[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def answer(self) -> dict[str, Any]:
        return {"state": self.state, "reason": self.reason, **self.more}


class Display:
    """Prints progress and received texts on stderr."""

    def __init__(self) -> None:
        self._shown: tuple[str, int] | None = None

    def progress(self, percent: int, stage: str) -> None:
        if (shown := (stage, percent // 10)) != self._shown:
            self._shown = shown
            self.text(f"[{percent:3d} %] {stage}")

    def text(self, words: str) -> None:
        sys.stderr.write(printable(words) + "\n")
        sys.stderr.flush()


class Station:
    """Client of one vehicle's companion: `find` selects it, the other methods send requests to it."""

    def __init__(self, link: GroundLink, url: str, display: Display) -> None:
        self._link, self._url, self._display = link, url, display
        self._heard: GroundListener = link.heard
        self._target = Address(0, self._heard.component_id)
        self._interrupted = asyncio.Event()
        self._why_cancelled = ""
        self._heard.on_text.add(self._on_text)

    @property
    def vehicle(self) -> AutopilotSeen:
        return self._heard.vehicle(self._target.system_id, asyncio.get_running_loop().time())

    def interrupt(self) -> None:
        """Handle Ctrl-C: the first cancels the running request, the second ends the wait for its end."""
        self._why_cancelled = self._why_cancelled or "Ctrl-C"
        self._interrupted.set()

    async def find(self, system_id: int | None, within_s: float) -> None:
        """Find the companion by its heartbeat. Wait up to 1.3 s for heartbeats of its autopilot and of other vehicles.

        Raises:
            NobodyHeardError: no heartbeat in time; the text names the received senders and the remedy.
            ConfigError: several vehicles have a companion, and none was selected.
        """
        loop = asyncio.get_running_loop()
        begun_s = loop.time()
        while True:
            wanted = [found for found in self._heard.companions() if system_id in (None, found)]
            first_s = self._heard.first_s
            waited_s = 0.0 if first_s is None else loop.time() - first_s
            certain = system_id is not None and self._heard.vehicle(system_id, loop.time()).firmware is not None
            if wanted and (certain or waited_s >= EVERYBODY_WITHIN_S):
                break
            if loop.time() - begun_s >= within_s and not wanted:
                raise NobodyHeardError(heard.nobody_heard(self._heard, self._url, system_id, within_s))
            await asyncio.sleep(_POLL_S)
        if len(wanted) > 1:
            raise ConfigError(
                f"companions of systems {', '.join(map(str, wanted))} are heard: say which with --system N"
            )
        self._target = Address(wanted[0], self._heard.component_id)

    async def calibrate(self, what: What, timeout_s: float | None, *, reboot: bool) -> RequestOutcome:
        """Start a calibration, and show its progress until it ends.

        Raises:
            NobodyHeardError: no answer to the request, although the companion sends heartbeats.
        """
        loop = asyncio.get_running_loop()
        begun_s = loop.time()
        asked = float(what.value), float(reboot)
        exchange = Exchange(self._link, self._target, CALIBRATE, *asked, on_progress=self._show_progress)
        await self._cancellable(exchange, timeout_s)
        outcome = await self._judge(exchange, begun_s)
        more: dict[str, Any] = {"duration_s": round(loop.time() - begun_s, 1)}
        reason = outcome.reason
        if outcome.state == "done":
            wanted = {"CMP_GYR_SIG": what.gyros, "CMP_ACC_SIG": what.accelerometers}
            gyro, accel = [
                (await self._link.get_parameter(self._target, name) or None) if calibrated else None
                for name, calibrated in wanted.items()
            ]
            more |= {"gyro_sigma_deg_h": gyro, "accel_sigma_mg": accel}
            reason = heard.figures(gyro, accel) or reason
        lines = [f"{outcome.state.upper()} after {more['duration_s']:.0f} s: {reason}", *outcome.lines[1:]]
        return dataclasses.replace(outcome, reason=reason, lines=lines, more={**outcome.more, **more})

    async def undo(self) -> RequestOutcome:
        """Undo the last write to the autopilot; raise NobodyHeardError if the companion does not answer."""
        begun_s, exchange = asyncio.get_running_loop().time(), Exchange(self._link, self._target, UNDO)
        await self._cancellable(exchange, None)
        return await self._judge(exchange, begun_s)

    async def cancel(self) -> RequestOutcome:
        """Cancel the running job of any requester, and wait for its end; raise NobodyHeardError without an answer."""
        loop = asyncio.get_running_loop()
        begun_s, exchange = loop.time(), Exchange(self._link, self._target, CANCEL)
        await exchange.run()
        if exchange.result != mavlink.MAV_RESULT_ACCEPTED:
            return await self._judge(exchange, begun_s)
        if exchange.detail == NOTHING_RAN:
            return self._ended("idle", "nothing was running", begun_s, good=True)
        answered_s = loop.time()
        while self._is_busy(answered_s) is not False and loop.time() - begun_s < CANCELLED_WITHIN_S:
            await asyncio.sleep(_POLL_S)
        last = await self._last_result()
        reason = f"the companion's last calibration: {last}" if last else "there was no calibration"
        return self._ended("cancelled", reason, begun_s, good=True)

    async def status(self) -> RequestOutcome:
        doing = self._heard.heartbeats[self._target].system_status
        state, reason = _DOING.get(doing, ("unknown", "it does not say what it is doing"))
        found, vehicle = await self._own_parameters(), self.vehicle
        last = _result(found.get("CMP_STATE"))
        sigma = {
            "gyro_sigma_deg_h": found.get("CMP_GYR_SIG") or None,
            "accel_sigma_mg": found.get("CMP_ACC_SIG") or None,
        }
        lines = [
            f"companion: system {self._target.system_id}, component {self._target.component_id}: {state} - {reason}",
            f"autopilot: {vehicle.firmware}, {vehicle.armed}" if vehicle.firmware else "autopilot: not heard",
        ]
        if found:
            known = heard.figures(*sigma.values()) if last == "done" else ""
            ended = ", ".join(filter(None, (last, known))) or "none since the companion started"
            at_arm, pushes = found.get("CMP_AT_ARM"), found.get("CMP_PUSH")
            at_arming = AT_ARM[int(at_arm)] if at_arm in (0.0, 1.0, 2.0) else "unknown"
            results = "written to the autopilot" if pushes else "NOT written (CMP_PUSH = 0)"
            lines += [f"last calibration: {ended}", f"at arming: {at_arming}; results are {results}"]
        else:
            lines.append("settings: no answer to the question for its parameters (a bad link?)")
        more = {**self._more(0.0), "last": last, **sigma, "parameters": found}
        return RequestOutcome(state, reason, good=True, lines=lines, more=more)

    # --- requests

    async def _cancellable(self, exchange: Exchange, timeout_s: float | None) -> None:
        """Run a request; at Ctrl-C or the timeout, cancel it at the companion and wait for its end."""
        running = asyncio.create_task(exchange.run())
        try:
            if not await self._ends(running, timeout_s):
                self._why_cancelled = self._why_cancelled or f"not finished within {timeout_s:g} s"
                self._display.text(f"{self._why_cancelled}: cancelling (Ctrl-C: do not wait)")
                cancelling = asyncio.create_task(Exchange(self._link, self._target, CANCEL).run())
                try:
                    await self._ends(running, CANCELLED_WITHIN_S)
                finally:
                    cancelling.cancel()
                    await asyncio.gather(cancelling, return_exceptions=True)
            if running.done():
                await running  # raise its error
        finally:
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)

    async def _ends(self, running: asyncio.Task[None], within_s: float | None) -> bool:
        """Wait for the end of a request, the timeout or Ctrl-C; return True if the request has ended."""
        interrupted = asyncio.create_task(self._interrupted.wait())
        try:
            await asyncio.wait({running, interrupted}, timeout=within_s, return_when=asyncio.FIRST_COMPLETED)
        finally:
            interrupted.cancel()
            self._interrupted.clear()
        return running.done()

    async def _judge(self, exchange: Exchange, begun_s: float) -> RequestOutcome:
        if exchange.unanswered:
            raise NobodyHeardError(
                f"{self._name()} beats, but does not answer: nothing that is sent from here arrives"
                " (a one-way link, MAVLink signing, or a port of the autopilot that does not forward)"
            )
        if exchange.result is None:
            return await self._judge_unheard_end(begun_s)
        if exchange.result == mavlink.MAV_RESULT_UNSUPPORTED:
            reason = f"{self._name()} does not know this command: is it a companion?"
            return self._ended("refused", reason, begun_s)
        state = _STATES.get(exchange.result, "failed")
        await self._hear_out(begun_s)
        said = next((text for text in reversed(self._texts(begun_s)) if text.severity == _SAID_AS.get(state)), None)
        reason = said.words if said is not None else f"{state} (MAV_RESULT {exchange.result})"
        if state == "cancelled" and self._why_cancelled:
            reason += f" ({self._why_cancelled})"
        return self._ended(state, reason, begun_s, said, good=state == "done")

    async def _judge_unheard_end(self, begun_s: float) -> RequestOutcome:
        busy = self._is_busy(asyncio.get_running_loop().time() - FRESH_S)
        if busy is False:
            ended = await self._last_result()
            reason = (
                f"the answer to the request got lost; the companion's last calibration: {ended}"
                if ended is not None
                else "the answer to the request got lost, and the companion has no result: has it restarted?"
            )
        elif busy:
            reason = "not waited for; the companion is still at work"
        elif self.vehicle.armed != "unknown":
            reason = (
                "the companion fell silent, its autopilot did not: has it stopped?"
                " If it was writing, it restores the old values when it starts again"
            )
        else:
            reason = "nothing is heard of the vehicle any more; it goes on by itself: `companion ground status` later"
        return self._ended("lost", reason, begun_s)

    async def _hear_out(self, since_s: float) -> None:
        loop = asyncio.get_running_loop()
        ended_s = loop.time()
        while loop.time() - ended_s < WORDS_WITHIN_S:
            said = self._texts(since_s)
            if said and loop.time() - max(said[-1].at_s, ended_s) >= QUIET_S:
                return
            await asyncio.sleep(_POLL_S)

    def _is_busy(self, since_s: float) -> bool | None:
        return self._heard.busy(self._target.system_id, since_s)

    async def _last_result(self) -> str | None:
        return _result(await self._link.get_parameter(self._target, "CMP_STATE"))

    async def _own_parameters(self) -> dict[str, float]:
        # MAVSDK waits over 10 s for the first answer to a list, without an error; a single parameter fails after 3 s.
        if await self._link.get_parameter(self._target, "CMP_STATE") is None:
            return {}
        found = await self._link.parameters(self._target)
        return {name: value for name, value in sorted(found.items()) if name.startswith("CMP_")}

    # --- texts

    def _on_text(self, text: Text) -> None:
        if text.system_id == self._target.system_id:
            self._display.text(text.words)

    def _show_progress(self, percent: int, silent_s: float) -> None:
        if silent_s >= SILENCE_WORTH_A_WORD_S:
            stage = f"nothing heard for {max(silent_s // 5 * 5, SILENCE_WORTH_A_WORD_S):.0f} s"
        elif percent < MEASURED_PERCENT:
            stage = "measuring"
        elif percent < WRITTEN_PERCENT:
            stage = "writing to the autopilot"
        else:
            stage = "checking that the autopilot uses the new values"
        self._display.progress(percent, stage)

    def _texts(self, since_s: float) -> list[Text]:
        return self._heard.texts_of(self._target.system_id, since_s)

    def _ended(
        self, state: State, reason: str, begun_s: float, said: Text | None = None, *, good: bool = False
    ) -> RequestOutcome:
        """Create an outcome that includes the companion's warnings since `begun_s`."""
        warned = [text for text in self._texts(begun_s) if text.severity <= Severity.WARNING and text != said]
        lines = [f"{state.upper()}: {reason}", *(f"warning: {text.words}" for text in warned)]
        return RequestOutcome(state, reason, good=good, lines=lines, more=self._more(begun_s))

    def _more(self, begun_s: float) -> dict[str, Any]:
        texts = [text.words for text in self._texts(begun_s)]
        return {"vehicle": self.vehicle._asdict(), "companion": self._target._asdict(), "texts": texts}

    def _name(self) -> str:
        return f"component {self._target.component_id} of system {self._target.system_id}"


def _result(state: float | None) -> str | None:
    """Return the result of the last calibration from the value of CMP_STATE; None: no calibration, or unknown."""
    return RESULTS[int(state)] if state in (1.0, 2.0, 3.0) else None
