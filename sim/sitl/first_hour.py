"""The tape of a first hour: a bare board, a real firmware, the companion's own commands, and somebody who obeys them.

Everything is printed as it comes, with minutes and seconds: commands, what they print, what ground stations are told
(STATUSTEXT), what the daemon logs. In between the truth judges the firmware's telemetry.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import sys
from collections.abc import AsyncIterator
from pathlib import Path

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.hands import AHEAD_S, PLACEMENT_DEG, PROPPED_DEG, Hands
from sim.sitl.by_hand import SETTLE_S, attitude_error_deg, judged, level_error_deg, own_six_positions
from sim.sitl.ground import GroundStation
from sim.sitl.residuals import LEVEL, ground_station, own_calibration
from sim.sitl.vehicle import SitlVehicle

_SEVERITIES = ("EMERGENCY", "ALERT", "CRITICAL", "ERROR", "WARNING", "NOTICE", "INFO", "DEBUG")
_MOVES_ON = "waiting for it to move"
_STARTED = 0.5


class Tape:
    """One firmware, one companion, and what they say.

    Args:
        vehicle: running, with a board of which nothing is known.
        ground: on its ground link.
        folder: for the companion's files; exists.
        seed: of the hands.
    """

    def __init__(self, vehicle: SitlVehicle, ground: GroundStation, folder: Path, *, seed: int = 0) -> None:
        self.vehicle, self.ground, self.folder = vehicle, ground, folder
        self.hands = Hands(vehicle.aircraft, placement_deg=PLACEMENT_DEG, propped_deg=PROPPED_DEG, seed=seed)
        self._begun_s = asyncio.get_running_loop().time()
        self._obeyed = ""

    def say(self, who: str, words: str) -> None:
        """One line of the tape."""
        minutes, seconds = divmod(asyncio.get_running_loop().time() - self._begun_s, 60.0)
        print(f"{minutes:02.0f}:{seconds:04.1f} {who:5} {words}", flush=True)

    async def type(self, *words: str) -> int:
        """A command of the companion, to its end; returns the exit code. What it asks for is done."""
        self.say("$", f"companion {' '.join(words)}")
        process = await self._start(*words)
        assert process.stdout is not None
        assert process.stderr is not None
        await asyncio.gather(self._print(process.stdout, ""), self._print(process.stderr, ""))
        code = await process.wait()
        if code:
            self.say("", f"(exit code {code})")
        return code

    async def setup(self) -> int:
        """`companion setup` by itself; returns the exit code."""
        return await self.type("setup", "--yes", "--udp", self.vehicle.url.rsplit(":", 1)[1])

    @contextlib.asynccontextmanager
    async def daemon(self) -> AsyncIterator[None]:
        """`companion run`, from when it has heard the autopilot to the end of the block."""
        self.say("$", "companion run &")
        process = await self._start("run")
        assert process.stdout is not None
        assert process.stderr is not None
        printing = [asyncio.create_task(self._print(stream, "log")) for stream in (process.stdout, process.stderr)]
        try:
            while process.returncode is None and not await self._hears():
                await asyncio.sleep(_STARTED)
            await self.type("status")
            yield
        finally:
            if process.returncode is None:
                process.terminate()
            await process.wait()
            await asyncio.gather(*printing)

    async def ground_says(self) -> None:
        """Print what ground stations are told until cancelled."""
        at = len(self.ground.heard)
        while True:
            new, at = self.ground.heard[at:], len(self.ground.heard)
            for _, message in new:
                if isinstance(message, mavlink.MAVLink_statustext_message):
                    self.say("GCS", f"{_SEVERITIES[message.severity]} ({message.get_srcComponent()}): {message.text}")
            await asyncio.sleep(0.1)

    async def judge(self, what: str) -> None:
        """What the telemetry has wrong now, on six sides."""
        self.say("TRUTH", f"{what}: {await judged(self.vehicle, self.ground, self.hands)}")

    async def judge_attitude(self, what: str) -> None:
        """What ATTITUDE has wrong after a restart, and what of that is not its estimator's."""
        roll, pitch = await attitude_error_deg(self.vehicle, self.ground)
        x, y = await level_error_deg(self.vehicle, self.ground)
        words = f"{what}, restarted, on the slope: roll {roll:+.3f}, pitch {pitch:+.3f} deg off"
        self.say("TRUTH", f"{words}; by accelerometers and level alone {x:+.3f} {y:+.3f}")

    async def _hears(self) -> bool:
        """Whether the daemon has heard the autopilot."""
        process = await self._start("status", "--json")
        output, _ = await process.communicate()
        return process.returncode == 0 and json.loads(output)["vehicle"]["armed"] == "disarmed"

    async def _start(self, *words: str) -> asyncio.subprocess.Process:
        file = str(self.folder / "companion.toml")
        return await asyncio.create_subprocess_exec(
            sys.executable, "-m", "companion", "-c", file, *words, stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE,
            env=os.environ | {"PYTHONUNBUFFERED": "1"},
        )  # fmt: skip

    async def _print(self, stream: asyncio.StreamReader, who: str) -> None:
        while line := await stream.readline():
            words = line.decode(errors="replace").rstrip()
            self.say(who, words)
            if who == "" and _MOVES_ON in words and words != self._obeyed:
                self._obeyed = words
                self.hands.follow(words, self.vehicle.now_s + AHEAD_S)


async def first_hour(vehicle: SitlVehicle, folder: Path, *, own: bool = False, seed: int = 0) -> int:
    """Start the firmware, play the hour; the exit code (1: a command failed).

    Args:
        vehicle: not running yet.
        folder: for the companion's files; exists.
        own: play the firmware's own six positions and level instead.
        seed: of the hands.
    """
    async with vehicle, ground_station(vehicle) as ground:
        tape = Tape(vehicle, ground, folder, seed=seed)
        listening = asyncio.create_task(tape.ground_says())
        try:
            await vehicle.sleep(SETTLE_S)
            return await (_own(tape) if own else _companion(tape))
        finally:
            listening.cancel()
            await asyncio.gather(listening, return_exceptions=True)


async def _companion(tape: Tape) -> int:
    codes = [await tape.setup(), await tape.type("check")]
    async with tape.daemon():
        for words in (("calibrate", "--wait"), ("align", "turn", "--write")):
            codes.append(await tape.type(*words))
        for words in (("align", "faces", "--write"), ("align", "faces")):
            if (code := await tape.type(*words)) == 0:
                break
        codes.append(code)
        await tape.type("status")
        await tape.judge("after faces")
        codes.append(await tape.type("align", "turn", "--level"))
    await tape.judge_attitude("after the level")
    async with tape.daemon():
        codes.append(await tape.type("undo"))
        await tape.type("history")
    return int(any(codes))


async def _own(tape: Tape) -> int:
    await tape.judge("as it came")
    await own_six_positions(tape.vehicle, tape.ground, tape.hands)
    await tape.judge("after its own six positions")
    await tape.judge_attitude("after its own six positions")
    await tape.judge("after its own six positions, restarted")
    tape.say("", await own_calibration(tape.vehicle, tape.ground, *LEVEL))
    await tape.judge_attitude("after its own level calibration on the slope")
    return 0
