"""A thousand interleavings of arming, reboots, lost heartbeats, lost packets and impatient people.

`make test` plays the first 12. The witness sees only the wire and the log of the autopilot: nothing is written while
armed or unknown, no vector stays half written unreported, every request gets exactly one final answer.
"""

from __future__ import annotations

import asyncio
import dataclasses
import os
import random
from collections.abc import Callable
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.estimation.records.record import Record
from tests.e2e.test_calibration import FC_PARAMETERS
from tests.support.component import CALIBRATE, CANCEL, IN_PROGRESS, UNDO
from tests.support.extent import extent
from tests.support.rig import Rig
from tests.support.virtual_time import run_virtual

CASES = extent(whole=1000, a_slice=12)
CASES_A_TEST = extent(whole=25, a_slice=12)
ACTS_S = 10.0
COMMANDS = (CALIBRATE, CANCEL, UNDO)


@dataclasses.dataclass
class InterleavingWitness:
    """Listens at the companion's end of the wire and knows only MAVLink."""

    rig: Rig
    heartbeat_s: float = -1e9
    armed: bool = True
    open_requests: set[int] = dataclasses.field(default_factory=set)
    last_final_s: dict[int, float] = dataclasses.field(default_factory=dict)
    last_repeat_s: dict[int, float] = dataclasses.field(default_factory=dict)
    seen: dict[tuple[int, int], float] = dataclasses.field(default_factory=dict)
    faults: list[str] = dataclasses.field(default_factory=list)
    writes: int = 0
    answered: int = 0

    def __post_init__(self) -> None:
        link = self.rig.link
        link.subscribe(mavlink.MAVLink_heartbeat_message, self._on_heartbeat)
        link.subscribe(mavlink.MAVLink_command_long_message, self._on_command)
        real_send = link.send

        def send(message: mavlink.MAVLink_message, *allowed: Callable[[], bool]) -> bool:
            self._on_sent(message)
            return real_send(message, *allowed)

        link.send = send  # type: ignore[method-assign]

    def _on_heartbeat(self, message: mavlink.MAVLink_heartbeat_message, t_s: float) -> None:
        if (message.get_srcSystem(), message.get_srcComponent()) == (1, 1):
            self.heartbeat_s, self.armed = t_s, bool(message.base_mode & 128)

    def _on_command(self, message: mavlink.MAVLink_command_long_message, t_s: float) -> None:
        if (message.target_component, message.get_srcSystem()) != (191, 255) or message.command not in COMMANDS:
            return
        key = (message.get_seq(), message.command)
        if t_s - self.seen.get(key, -1e9) < 1.0:
            return  # the wire's own copy of a packet
        self.seen[key] = t_s
        if message.confirmation > 0 or message.command in self.open_requests:
            self.last_repeat_s[message.command] = t_s
        recently = t_s - self.last_final_s.get(message.command, -1e9) < 3.0
        if not (message.confirmation > 0 and recently):
            self.open_requests.add(message.command)

    def _on_sent(self, message: mavlink.MAVLink_message) -> None:
        now_s = self.rig.now_s
        if isinstance(message, mavlink.MAVLink_param_set_message):
            self.writes += 1
            if self.armed or now_s - self.heartbeat_s >= 2.0:
                self.faults.append(f"PARAM_SET at {now_s:.3f}: armed {self.armed}, heartbeat at {self.heartbeat_s:.3f}")
        elif isinstance(message, mavlink.MAVLink_command_ack_message) and message.command in COMMANDS:
            if message.result == IN_PROGRESS:
                return
            if message.command in self.open_requests:
                self.open_requests.remove(message.command)
                self.answered += 1
            elif now_s - self.last_repeat_s.get(message.command, -1e9) > 0.5:
                self.faults.append(f"a second final ACK for {message.command} at {now_s:.3f}")
            self.last_final_s[message.command] = now_s


async def people(rig: Rig, chance: random.Random) -> None:
    """A ground station whose operator is in a hurry: requests, repeats, cancels and undoes."""
    for _ in range(chance.randint(2, 5)):
        await asyncio.sleep(chance.uniform(0.2, ACTS_S / 3))
        command = chance.choices(COMMANDS, weights=(6, 1, 2))[0]
        which = float(chance.choice((0, 0, 0, 1, 2)))
        for confirmation in range(chance.choice((1, 1, 2, 3))):
            rig.ground.command(command, which, confirmation=confirmation)
            await asyncio.sleep(chance.choice((0.001, 0.3, 1.2)))


async def _fate(rig: Rig, chance: random.Random) -> None:
    """Draw an event of pilots, radios and power supplies."""
    double = rig.double
    for _ in range(chance.randint(1, 5)):
        await asyncio.sleep(chance.uniform(0.1, ACTS_S / 3))
        match chance.randrange(8):
            case 0:
                double.arm()
                await asyncio.sleep(chance.uniform(0.05, 6.0))
                double.disarm()
            case 1:
                double.faults.arm_after_writes = chance.randint(1, 8)
                await asyncio.sleep(chance.uniform(0.5, 8.0))
                double.faults.arm_after_writes = None
                double.disarm()
            case 2:
                double.faults.heartbeat_off = True
                await asyncio.sleep(chance.uniform(0.5, 6.0))
                double.faults.heartbeat_off = False
            case 3:
                double.reboot(down_s=chance.uniform(0.2, 3.0))
            case 4:
                double.faults.reboot_after_writes = chance.randint(1, 8)
                await asyncio.sleep(chance.uniform(0.5, 8.0))
                double.faults.reboot_after_writes = None
            case 5:
                rig.wire.cut = True
                await asyncio.sleep(chance.uniform(0.1, 5.0))
                rig.wire.cut = False
            case 6:
                double.faults.silent = True
                await asyncio.sleep(chance.uniform(0.5, 6.0))
                double.faults.silent = False
            case _:
                rig.wire.loss = chance.choice((0.0, 0.3, 0.6))
                await asyncio.sleep(chance.uniform(0.5, 4.0))
                rig.wire.loss = 0.0


def _half_written(start: dict[str, float], now: dict[str, float], records: list[Record]) -> list[str]:
    """Vectors that are neither as at the start nor as some calibration that says "done" has written them."""
    written = [record.imus[0].written for record in records if record.state == "done" and record.imus]
    faults = []
    for names in (FC_PARAMETERS[:3], FC_PARAMETERS[3:]):
        known = [[start[name] for name in names]]
        known += [[what[name].after for name in names] for what in written if names[0] in what]
        if [now[name] for name in names] not in known:
            faults.append(f"{names[0]}...: {[now[name] for name in names]}")
    return faults


async def _one(folder: Path, seed: int) -> tuple[int, int, int]:
    chance = random.Random(seed)
    rig = Rig(
        folder,
        seed=seed,
        vehicle="plane",
        imus=1,
        min_still_s=2.0,
        max_s=3.0,
        duplicate=chance.choice((0.0, 0.0, 0.1, 0.5)),
        imu_rate_hz=10.0,
        device_rate_hz=5.0,
        feed_s=0.4,
        version=chance.choice(("4.8", "4.8", "4.5")),
    )
    witness = InterleavingWitness(rig)
    start = {name: rig.double.parameter(name) for name in FC_PARAMETERS}
    async with rig.running():
        await rig.ready()
        await asyncio.gather(people(rig, chance), _fate(rig, chance), _fate(rig, chance))
        # Now let everything come to rest.
        double, manager = rig.double, rig.service.calibrating.manager
        faults = double.faults
        faults.silent = faults.heartbeat_off = False
        faults.arm_after_writes = faults.reboot_after_writes = None
        rig.wire.cut, rig.wire.loss = False, 0.0
        double.disarm()
        await asyncio.sleep(2.0)  # what is still on the wire, and the autopilot's reboot, if it is in one
        await rig.until(
            lambda: (manager.job is None or manager.job.finished.done()) and not rig.service.offsets.journal.pending,
            240.0,
        )
        records = rig.service.calibrating.store.history()[::-1]
        now = {name: rig.double.parameter(name) for name in FC_PARAMETERS}
    assert witness.faults == [], f"seed {seed}"
    assert not witness.open_requests, f"seed {seed}: no final ACK for {witness.open_requests}"
    assert _half_written(start, now, records) == [], f"seed {seed}"
    done = sum(record.state == "done" for record in records)
    return witness.writes, witness.answered, done


@pytest.mark.parametrize("first", range(0, CASES, CASES_A_TEST))
def test_interleavings(tmp_path: Path, first: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)  # power cuts are another test's
    writes = answered = done = 0
    for seed in range(first, first + CASES_A_TEST):
        folder = tmp_path / str(seed)
        folder.mkdir()
        w, a, d = run_virtual(_one(folder, seed))
        writes, answered, done = writes + w, answered + a, done + d
    # The dice must really have been thrown: requests answered, parameters written, some calibrations done.
    assert answered > CASES_A_TEST
    assert writes > CASES_A_TEST
    assert done
