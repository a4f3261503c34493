"""What can be done from the ground: find the companion on the link, ask it for something, say what came of it."""

from __future__ import annotations

import asyncio
import dataclasses
import difflib
import re
from collections.abc import Sequence
from typing import Any, Final, Literal, Protocol

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.calibration.request import What
from companion.component.commands import MAV_RESULT_CANCELLED
from companion.component.service import MEASURED_PERCENT, WRITTEN_PERCENT
from companion.component.statustext import Severity
from companion.errors import ConfigError, NobodyHeardError
from companion.ground import heard
from companion.ground.exchange import Answer, Exchange
from companion.ground.heard import FRESH_S, Heard, Target, Text, Vehicle
from companion.ground.link import GroundLink

CALIBRATE, CANCEL, UNDO = mavlink.MAV_CMD_USER_1, mavlink.MAV_CMD_USER_2, mavlink.MAV_CMD_USER_3
EVERYBODY_WITHIN_S: Final = 1.3
"""Heartbeats come once a second: so long after the first, everybody who can be heard has been."""
WORDS_WITHIN_S: Final = 3.0
"""For how long the words that belong to a result may follow it: two lines a second pass, results first."""
CANCELLED_WITHIN_S: Final = 30.0
"""A cancel waits for a safe point, and old values may have to be put back."""
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
_RESULT_WORDS: Final = re.compile(r"(?:Auto calibration|Calibration|Undo) (?:(?:done|failed|refused|cancelled): )?")


class Watcher(Protocol):
    """Who shows people what goes on."""

    def progress(self, percent: int, text: str) -> None:
        """How far it is."""

    def text(self, text: str, *, urgent: bool) -> None:
        """What the companion says."""


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What came of it: for programs (`answer`, with `state` and `reason` first) and for people (`lines`)."""

    state: State
    reason: str
    good: bool
    lines: Sequence[str]
    more: dict[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def answer(self) -> dict[str, Any]:
        """One JSON object."""
        return {"state": self.state, "reason": self.reason, **self.more}


class Station:
    """Speaks to the one companion that `find` found.

    Args:
        link: an open link.
        url: its url, for words.
        watcher: is shown what goes on.
    """

    def __init__(self, link: GroundLink, url: str, watcher: Watcher) -> None:
        self._link, self._url, self._watcher = link, url, watcher
        self._heard: Heard = link.heard
        self._target = Target(0, self._heard.component_id)
        self._waiting_for = ""
        self._interrupted = asyncio.Event()
        self._why_cancelled = ""
        self._heard.on_text = self._on_text

    @property
    def vehicle(self) -> Vehicle:
        """The autopilot beside the companion."""
        return self._heard.vehicle(self._target.system_id, asyncio.get_running_loop().time())

    def interrupt(self) -> None:
        """Ctrl-C: cancel what was asked for; a second time: do not wait for its end."""
        self._why_cancelled = self._why_cancelled or "Ctrl-C"
        self._interrupted.set()

    async def find(self, system_id: int | None, within_s: float) -> None:
        """Wait for the companion's heartbeat, and its autopilot's if there is one.

        Raises:
            NobodyHeardError: none came in time; says what was heard and what to try.
            ConfigError: several vehicles have a companion, and nobody has said which is meant.
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
        self._target = Target(wanted[0], self._heard.component_id)

    async def calibrate(self, what: What, timeout_s: float | None, *, reboot: bool) -> Outcome:
        """Calibrate, and follow it to its end.

        Raises:
            NobodyHeardError: the companion beats, but does not answer.
        """
        loop = asyncio.get_running_loop()
        begun_s = loop.time()
        exchange = self._exchange(CALIBRATE, float(what.value), float(reboot))
        exchange.on_progress = self._show_progress
        answer = await self._cancellable(exchange, timeout_s)
        outcome = await self._judge(answer, begun_s, "Calibration")
        more: dict[str, Any] = {"duration_s": round(loop.time() - begun_s, 1)}
        if outcome.state == "done":
            more["gyro_sigma_deg_h"] = await self._sigma("CMP_GYR_SIG") if what.gyros else None
            more["accel_sigma_mg"] = await self._sigma("CMP_ACC_SIG") if what.accelerometers else None
        lines = [f"{outcome.state.upper()} after {more['duration_s']:.0f} s: {outcome.reason}", *outcome.lines]
        return dataclasses.replace(outcome, lines=lines, more={**outcome.more, **more})

    async def undo(self) -> Outcome:
        """Put the old values back; raises as `calibrate`.

        Raises:
            NobodyHeardError: the companion beats, but does not answer.
        """
        begun_s = asyncio.get_running_loop().time()
        exchange = self._exchange(UNDO)
        answer = await self._cancellable(exchange, None)
        outcome = await self._judge(answer, begun_s, "Undo")
        return dataclasses.replace(outcome, lines=[f"{outcome.state.upper()}: {outcome.reason}", *outcome.lines])

    async def cancel(self) -> Outcome:
        """Cancel what runs, whoever asked for it, and wait until it has ended; raises as `calibrate`.

        Raises:
            NobodyHeardError: the companion beats, but does not answer.
        """
        loop = asyncio.get_running_loop()
        begun_s = loop.time()
        answer = await self._exchange(CANCEL).run()
        if answer.result != mavlink.MAV_RESULT_ACCEPTED:
            outcome = await self._judge(answer, begun_s, "Cancel")
            return dataclasses.replace(outcome, lines=[f"{outcome.state.upper()}: {outcome.reason}", *outcome.lines])
        said = await self._wait_for_text(re.compile(r"Nothing to cancel|(Auto calibration|Calibration|Undo) [a-z]+"),
                                         begun_s, CANCELLED_WITHIN_S, give_up_when_idle=True)  # fmt: skip
        if said is None:
            reason = "cancelled; the companion has not said what became of it"
        elif said.words.startswith("Nothing"):
            reason = "nothing was running"
        else:
            reason = said.words
        state: State = "idle" if said is not None and said.words.startswith("Nothing") else "cancelled"
        if said is not None and re.match(r"\S+(?: calibration)? (done|failed)", said.words):
            # Too late for a cancel: what ran had come to its own end.
            state = "done" if " done" in said.words else "failed"
        return Outcome(state, reason, good=True, lines=[reason], more=self._more(begun_s))

    async def status(self) -> Outcome:
        """What the companion is doing, its settings and its last result."""
        beat = self._heard.heartbeats[self._target]
        state: State = {
            mavlink.MAV_STATE_CALIBRATING: "busy",
            mavlink.MAV_STATE_STANDBY: "idle",
            mavlink.MAV_STATE_ACTIVE: "idle",
            mavlink.MAV_STATE_CRITICAL: "fault",
        }.get(beat.system_status, "unknown")  # type: ignore[assignment] # mypy widens the literals
        found = await self._own_parameters()
        vehicle = self.vehicle
        last = heard.RESULTS.get(found.get("CMP_STATE", -1.0))
        reason = {
            "busy": "calibrating or writing",
            "idle": "ready",
            "fault": "something needs attention: `companion status` on the aircraft says what",
        }.get(state, "it does not say what it is doing")
        sigma = {
            "gyro_sigma_deg_h": found.get("CMP_GYR_SIG") or None,
            "accel_sigma_mg": found.get("CMP_ACC_SIG") or None,
        }
        lines = [
            f"companion: system {self._target.system_id}, component {self._target.component_id}: {state} - {reason}",
            f"autopilot: {vehicle.firmware}, {vehicle.armed}" if vehicle.firmware else "autopilot: not heard",
        ]
        if not found:
            lines.append("settings: no answer to the question for its parameters (a bad link?)")
        else:
            known = heard.figures(sigma["gyro_sigma_deg_h"], sigma["accel_sigma_mg"])
            lines.append(f"last calibration: {last}{', ' + known if known and last == 'done' else ''}"
                         if last else "last calibration: none since the companion started")  # fmt: skip
            at_arm = found.get("CMP_AT_ARM", -1.0)
            lines.append(
                f"at arming: {heard.AT_ARM[int(at_arm)] if at_arm in (0.0, 1.0, 2.0) else 'unknown'};"
                f" results are {'written to the autopilot' if found.get('CMP_PUSH') else 'NOT written (CMP_PUSH = 0)'}"
            )
        more = {**self._more(0.0), "last": last, **sigma, "parameters": found}
        return Outcome(state, reason, good=True, lines=lines, more=more)

    async def parameters(self, wanted: dict[str, float]) -> Outcome:
        """Show the companion's own parameters, after setting some.

        Raises:
            ConfigError: it has no parameter of such a name; nothing was set.
            NobodyHeardError: it does not answer.
        """
        found = await self._own_parameters()
        if not found:
            raise NobodyHeardError(f"{self._name()} beats, but does not answer for its parameters: a bad link?")
        for name in wanted:
            if name not in found:
                near = difflib.get_close_matches(name, found, n=1)
                hint = f"; nearest: {near[0]}" if near else ""
                raise ConfigError(f"{name}: the companion has no such parameter (it has {', '.join(found)}{hint})")
        refusals = [refusal for name, value in wanted.items() if (refusal := await self._set(name, value))]
        if wanted:
            found = await self._own_parameters() or found
        lines = [f"{name:12} {value:12g}  {heard.MEANINGS.get(name, '')}".rstrip() for name, value in found.items()]
        reason = "; ".join(refusals) or ("set; holds until the companion restarts" if wanted else "")
        state: State = "refused" if refusals else "done"
        return Outcome(state, reason, good=not refusals, lines=[*lines, *([reason] if reason else [])],
                       more={**self._vehicle_and_companion(), "parameters": found})  # fmt: skip

    # --- asking

    def _exchange(self, command: int, *parameters: float) -> Exchange:
        return Exchange(
            self._link, self._target, command, *parameters,
            busy=lambda since_s: self._heard.busy(self._target.system_id, since_s),
        )  # fmt: skip

    async def _cancellable(self, exchange: Exchange, timeout_s: float | None) -> Answer:
        """Run it; Ctrl-C or the end of the time given cancel it, and its end is waited for all the same."""
        loop = asyncio.get_running_loop()
        running = loop.create_task(exchange.run())
        interrupted = loop.create_task(self._interrupted.wait())
        try:
            await asyncio.wait({running, interrupted}, timeout=timeout_s, return_when=asyncio.FIRST_COMPLETED)
            if not running.done():
                self._why_cancelled = self._why_cancelled or f"not finished within {timeout_s:g} s"
                self._watcher.text(f"{self._why_cancelled}: cancelling (Ctrl-C: do not wait)", urgent=True)
                interrupted.cancel()
                self._interrupted.clear()
                interrupted = loop.create_task(self._interrupted.wait())
                cancelling = loop.create_task(self._exchange(CANCEL).run())
                try:
                    await asyncio.wait(
                        {running, interrupted}, timeout=CANCELLED_WITHIN_S, return_when=asyncio.FIRST_COMPLETED
                    )
                finally:
                    cancelling.cancel()
                    await asyncio.gather(cancelling, return_exceptions=True)
            return running.result() if running.done() else Answer(None, begun=True)
        finally:
            running.cancel()
            interrupted.cancel()
            await asyncio.gather(running, interrupted, return_exceptions=True)

    async def _judge(self, answer: Answer, begun_s: float, name: str) -> Outcome:
        """What an answer means, with the words that the companion says to it."""
        if not answer.begun:
            raise NobodyHeardError(
                f"{self._name()} beats, but does not answer: nothing that is sent from here arrives"
                " (a one-way link, MAVLink signing, or a port of the autopilot that does not forward)"
            )
        if answer.result is None:
            return await self._judge_unheard_end(begun_s)
        if answer.result == mavlink.MAV_RESULT_UNSUPPORTED:
            reason = f"{self._name()} does not know this command: is it a companion?"
            return Outcome("refused", reason, good=False, lines=[], more=self._more(begun_s))
        state = _STATES.get(answer.result, "failed")
        said = await self._wait_for_text(
            re.compile(rf"(Auto calibration|{name}) {state}|Failed" if state == "failed" else rf"{name} {state}"),
            begun_s, WORDS_WITHIN_S,
        )  # fmt: skip
        if said is not None:
            reason = _RESULT_WORDS.sub("", said.words, count=1)
        else:
            reason = f"{state} (MAV_RESULT {answer.result}); no words came with it"
        if state == "cancelled" and self._why_cancelled:
            reason += f" ({self._why_cancelled})"
        return Outcome(
            state, reason, good=state == "done", lines=self._warnings(begun_s, said), more=self._more(begun_s)
        )

    async def _judge_unheard_end(self, begun_s: float) -> Outcome:
        """The link was gone when it ended, or it was not waited for."""
        busy = self._heard.busy(self._target.system_id, asyncio.get_running_loop().time() - FRESH_S)
        if busy is False:
            last = await self._link.get_parameter(self._target, "CMP_STATE")
            ended = heard.RESULTS.get(-1.0 if last is None else last)
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
                " If it was writing, it puts the old values back when it starts again"
            )
        else:
            reason = "nothing is heard of the vehicle any more; it goes on by itself: `companion ground status` later"
        return Outcome("lost", reason, good=False, lines=self._warnings(begun_s, None), more=self._more(begun_s))

    async def _wait_for_text(
        self, pattern: re.Pattern[str], since_s: float, within_s: float, *, give_up_when_idle: bool = False
    ) -> Text | None:
        loop = asyncio.get_running_loop()
        begun_s = loop.time()
        while True:
            for text in reversed(self._heard.texts_of(self._target.system_id, since_s)):
                if pattern.match(text.words):
                    return text
            waited_s = loop.time() - begun_s
            idle = give_up_when_idle and self._heard.busy(self._target.system_id, begun_s) is False
            if waited_s >= within_s or (idle and waited_s >= WORDS_WITHIN_S):
                return None
            await asyncio.sleep(_POLL_S)

    async def _set(self, name: str, value: float) -> str | None:
        """Set a parameter; returns why it was not, in the companion's words where it said some."""
        begun_s = asyncio.get_running_loop().time()
        problem = await self._link.set_parameter(self._target, name, value)
        if problem is None:
            return None
        said = await self._wait_for_text(re.compile(rf"{name} not set: "), begun_s, WORDS_WITHIN_S)
        return said.words if said is not None else f"{name} not set: {problem}"

    async def _own_parameters(self) -> dict[str, float]:
        # MAVSDK's list waits over 10 s for its first answer, and tells nobody; one parameter is given up after 3 s.
        if await self._link.get_parameter(self._target, "CMP_STATE") is None:
            return {}
        found = await self._link.parameters(self._target)
        return {name: value for name, value in sorted(found.items()) if name.startswith("CMP_")}

    async def _sigma(self, name: str) -> float | None:
        return await self._link.get_parameter(self._target, name) or None

    # --- words

    def _on_text(self, system_id: int, text: Text) -> None:
        if system_id != self._target.system_id:
            return
        self._waiting_for = text.words.removeprefix("Calibration: ") if text.words.startswith("Calibration: ") else ""
        self._watcher.text(text.words, urgent=text.severity <= Severity.WARNING)

    def _show_progress(self, percent: int, silent_s: float) -> None:
        if silent_s >= SILENCE_WORTH_A_WORD_S:
            stage = f"nothing heard for {max(silent_s // 5 * 5, SILENCE_WORTH_A_WORD_S):.0f} s"
        elif percent < MEASURED_PERCENT:
            stage = self._waiting_for or "measuring: keep the aircraft still"
        elif percent < WRITTEN_PERCENT:
            stage = "writing to the autopilot"
        else:
            stage = "checking that the autopilot uses the new values"
        self._watcher.progress(percent, stage)

    def _warnings(self, begun_s: float, result: Text | None) -> list[str]:
        return [
            f"warning: {text.words}"
            for text in self._heard.texts_of(self._target.system_id, begun_s)
            if text.severity <= Severity.WARNING and text is not result
        ]

    def _more(self, begun_s: float) -> dict[str, Any]:
        texts = [text.words for text in self._heard.texts_of(self._target.system_id, begun_s)]
        return {**self._vehicle_and_companion(), "texts": texts}

    def _vehicle_and_companion(self) -> dict[str, Any]:
        return {
            "vehicle": self.vehicle._asdict(),
            "companion": self._target._asdict(),
        }

    def _name(self) -> str:
        return f"component {self._target.component_id} of system {self._target.system_id}"
