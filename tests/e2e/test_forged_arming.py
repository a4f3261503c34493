"""A stranger sends "disarmed" under the autopilot's ids: nothing is written while the true autopilot is armed.

Forged heartbeats of every rate on an unsigned link; on a signed one, where nothing can be forged, true ones that were
held back and come late. Judged by what the simulated autopilot is, not by what anybody says of it.
"""

from __future__ import annotations

import asyncio
import os
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.links.mavlink import signing as link_signing
from companion.links.mavlink.signing import ticks_of
from sim.px4.double import PX4Double
from tests.e2e.test_interleavings import people
from tests.e2e.test_signing import KEY, START_S, signed_rig, virtual_clock
from tests.support.extent import extent
from tests.support.rig import Rig
from tests.support.virtual_time import run_virtual

CASES = extent(whole=1000, a_slice=6)
CASES_A_TEST = extent(whole=25, a_slice=6)
ACTS_S = 10.0
WIRE_S = 0.05
"""There and back, and what the autopilot takes to answer: so old may be what is known of it."""
FORGED = 4000
QUICK: dict[str, Any] = {
    "vehicle": "copter",
    "imus": 1,
    "min_still_s": 2.0,
    "max_s": 3.0,
    "imu_rate_hz": 10.0,
    "device_rate_hz": 5.0,
    "feed_s": 0.4,
}


class Judge:
    """Looks at what the companion sends, and knows what the autopilot is."""

    def __init__(self, rig: Rig) -> None:
        self.writes = 0
        self.faults: list[str] = []
        self._rig = rig
        self._send, self._arm = rig.link.send, rig.autopilot.arm
        self._armed_s = 0.0
        rig.link.send = self._sent  # type: ignore[method-assign]
        rig.autopilot.arm = self._arming  # type: ignore[method-assign]

    def _sent(self, message: mavlink.MAVLink_message, *allowed: Callable[[], bool]) -> bool:
        if isinstance(message, mavlink.MAVLink_param_set_message):
            self.writes += 1
            since_s = self._rig.now_s - self._armed_s
            if self._rig.autopilot.armed and since_s > WIRE_S:
                self.faults.append(f"{message.param_id} was written {since_s:.3f} s after arming")
        return self._send(message, *allowed)

    def _arming(self) -> None:
        if not self._rig.autopilot.armed:
            self._armed_s = self._rig.now_s
        self._arm()


def made_up(rig: Rig, number: int) -> bytes:
    """A disarmed heartbeat as of the autopilot, from anybody."""
    codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    codec.seq = number % 256
    firmware = (
        mavlink.MAV_AUTOPILOT_PX4 if isinstance(rig.autopilot, PX4Double) else mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
    )
    message = mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_QUADROTOR, firmware, 0, 0, mavlink.MAV_STATE_STANDBY, 3
    )
    data: bytes = message.pack(codec)
    return data


class Tape:
    """The autopilot's disarmed heartbeats as they were on the companion's wire and on the radio's."""

    def __init__(self, rig: Rig) -> None:
        self.own: list[bytes] = []
        self.radio: list[bytes] = []
        for end, kept in ((rig.link, self.own), (rig.ground, self.radio)):
            self._listen(end, kept)

    @staticmethod
    def _listen(end: Any, kept: list[bytes]) -> None:
        receive = end.receive

        def heard(data: bytes, t_s: float) -> None:
            if data[5:10] == bytes((1, 1, 0, 0, 0)) and not data[16] & mavlink.MAV_MODE_FLAG_SAFETY_ARMED:
                kept.append(data)
            receive(data, t_s)

        end.receive = heard


async def _forge(rig: Rig, tape: Tape, chance: random.Random, *, signed: bool) -> None:
    """Disarmed heartbeats at some rate: made up, or as they were, late."""
    rate_hz = 10.0 ** chance.uniform(0.0, 3.7)
    await asyncio.sleep(chance.uniform(0.0, ACTS_S / 2))
    if made := not signed and chance.random() < 0.7:
        taped: list[bytes] = []
    else:
        # On its other link the autopilot signs with another link id.
        taped = list(chance.choice((tape.own, tape.radio, tape.radio)))
        await asyncio.sleep(chance.uniform(0.0, 80.0 if signed else ACTS_S / 2))
    for number in range(FORGED):
        if made:
            rig.wire.carry_from_other(made_up(rig, number))
        elif taped:
            rig.wire.carry_from_other(taped[number % len(taped)])
        await asyncio.sleep(1.0 / rate_hz)
        if number % 500 == 499:
            await asyncio.sleep(chance.uniform(0.0, 3.0))


async def _fly(rig: Rig, chance: random.Random) -> None:
    """A pilot who arms in the middle of all that, often between two writes."""
    autopilot = rig.autopilot
    for _ in range(chance.randint(2, 4)):
        await asyncio.sleep(chance.uniform(0.1, ACTS_S / 2))
        if chance.random() < 0.3:
            autopilot.arm()
        else:
            autopilot.faults.arm_after_writes = chance.randint(1, 8)
        await asyncio.sleep(chance.uniform(0.3, 12.0))
        autopilot.faults.arm_after_writes = None
        autopilot.disarm()


async def _one(folder: Path, seed: int) -> tuple[int, int]:
    chance = random.Random(seed)
    signed = chance.random() < 0.4
    make = signed_rig if signed else Rig
    rig = make(folder, seed=seed, firmware=chance.choice(("ardupilot", "px4")), **QUICK)
    if signed:
        rig.autopilot.require_signatures(KEY, ticks_of(START_S))
        rig.ground.sign(KEY, ticks_of(START_S))
    judge, tape = Judge(rig), Tape(rig)
    async with rig.running():
        await rig.ready()
        forger = asyncio.create_task(_forge(rig, tape, chance, signed=signed))
        await asyncio.gather(people(rig, chance), _fly(rig, chance), people(rig, chance))
        conflicts = int(rig.service.core.vehicle.conflict is not None)
        forger.cancel()
        rig.autopilot.faults.arm_after_writes = None
        rig.autopilot.disarm()
        await asyncio.sleep(15.0)
        job = rig.service.calibrating.manager.job
        await rig.until(lambda: (job is None or job.finished.done()) and not rig.service.offsets.journal.pending, 240.0)
    assert judge.faults == [], f"seed {seed}"
    return judge.writes, conflicts


@pytest.mark.parametrize("first", range(0, CASES, CASES_A_TEST))
def test_nothing_is_written_to_an_armed_aircraft_whoever_says_disarmed(
    tmp_path: Path, first: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)
    monkeypatch.setattr(link_signing, "SigningClock", virtual_clock)
    writes = conflicts = 0
    for seed in range(first, first + CASES_A_TEST):
        folder = tmp_path / str(seed)
        folder.mkdir()
        w, c = run_virtual(_one(folder, seed))
        writes, conflicts = writes + w, conflicts + c
    # The dice must really have been thrown.
    assert writes > CASES_A_TEST
    assert conflicts
