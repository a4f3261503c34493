"""A signed link end to end: companion, autopilot and ground station with one key; and everybody without it.

The autopilot and the ground station sign and judge by pymavlink's own code, the companion by its own.
"""

from __future__ import annotations

import asyncio
import json
import logging
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.links.mavlink.signing import SigningClock, ticks_of
from tests.support.component import ACCEPTED, CALIBRATE, CANCEL, Ground, command_message
from tests.support.rig import Rig
from tests.support.virtual_time import run_virtual

KEY, OTHER = bytes(range(100, 132)), bytes(range(32))
START_S = 1.8e9


def signed_rig(folder: Path, *, mode: str = "require", key: bytes = KEY, **more: Any) -> Rig:
    """A companion that has a key and wants signatures; autopilot and ground station as they are."""
    path = folder / "signing.key"
    path.write_text(key.hex() + "\n")
    path.chmod(0o600)
    return Rig(folder, mavlink=f'signing = "{mode}"\nsigning_key_file = "{path}"', **more)


def now() -> int:
    return ticks_of(time.time())


def virtual_clock() -> SigningClock:
    """The daemon's clock for signatures, going with the loop's."""

    def seconds() -> float:
        return asyncio.get_running_loop().time()

    return SigningClock(wall_s=lambda: START_S + seconds(), uptime=seconds)


def words_of(rig: Rig) -> str:
    return str(rig.service.status()["vehicle"]["summary"])


def test_with_one_key_all_works_and_the_key_stays_where_it_is(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)

    async def main() -> None:
        rig = signed_rig(tmp_path, firmware="px4", max_s=12.0, recordings_mb=16)
        # An autopilot without GNSS whose clock stopped with the battery last week.
        rig.autopilot.require_signatures(KEY, now() - 7 * 86400 * 100_000)
        rig.ground.sign(KEY, now())
        async with rig.running():
            await rig.ready()
            before = rig.autopilot.parameter("CAL_GYRO0_XOFF")
            # Somebody gives a key to everybody: ArduPilot forwards what is for all components.
            rig.wire.carry_from_other(rig.ground.pack(mavlink.MAVLink_setup_signing_message(1, 0, list(KEY), now())))
            rig.ground.command(CALIBRATE, 1)
            await rig.until(lambda: bool(rig.ground.finals(CALIBRATE)), 120.0)
            assert rig.ground.finals(CALIBRATE) == [ACCEPTED]
            assert rig.autopilot.parameter("CAL_GYRO0_XOFF") != before
            signing = rig.service.status()["vehicle"]["signing"]
            assert signing["good"]
            assert signing["verified"] > 1000
            assert "unsigned" not in signing["doubted"]
            assert rig.autopilot.channels[0].received["bad"] == 0
            said = json.dumps(rig.service.status())
        texts.extend([said, *rig.ground.texts()])

    texts = list[str]()
    run_virtual(main())
    files = [path for path in tmp_path.rglob("*") if path.is_file() and path.suffix != ".key"]
    kept = b"".join(path.read_bytes() for path in files)
    assert any(path.suffix == ".mcap" for path in files)
    assert KEY not in kept
    for form in (KEY.hex(), repr(KEY), str(list(KEY))):
        assert form not in " ".join([*texts, caplog.text])
        assert form.encode() not in kept


Attack = Callable[[Ground, mavlink.MAVLink_message], bytes]


def unsigned(ground: Ground, message: mavlink.MAVLink_message) -> bytes:
    return Ground().pack(message)


def with_another_key(ground: Ground, message: mavlink.MAVLink_message) -> bytes:
    stranger = Ground()
    stranger.sign(OTHER, now())
    return stranger.pack(message)


def replayed(ground: Ground, message: mavlink.MAVLink_message) -> bytes:
    """Recorded long ago, when the true station sent it."""
    true = Ground()
    true.sign(KEY, now() - 3600 * 100_000)
    return true.pack(message)


def replayed_at_once(ground: Ground, message: mavlink.MAVLink_message) -> bytes:
    """The true station's own packet once more; it has been heard since."""
    data = ground.pack(message)
    ground.send(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
    return data


@pytest.mark.parametrize("attack", [unsigned, with_another_key, replayed, replayed_at_once])
async def test_who_has_no_key_starts_nothing_and_changes_nothing(tmp_path: Path, attack: Attack) -> None:
    """On the companion's own wire, behind the autopilot's back."""

    rig = signed_rig(tmp_path)
    rig.autopilot.require_signatures(KEY, now())
    rig.ground.sign(KEY, now())
    async with rig.running():
        await rig.ready()
        await asyncio.sleep(2.0)
        parameters = rig.service.faces.component.parameters
        push = parameters.get("CMP_PUSH")
        for message in (
            command_message(CALIBRATE, 0, target=(1, 191)),
            command_message(CANCEL, target=(1, 191)),
            mavlink.MAVLink_param_set_message(1, 191, b"CMP_PUSH", 1.0 - push, 9),
        ):
            data = attack(rig.ground, message)
            await asyncio.sleep(0.1)
            rig.wire.carry_from_other(data)
            await asyncio.sleep(1.5)
        assert rig.service.calibrating.manager.job is None
        assert parameters.get("CMP_PUSH") == push
        assert rig.ground.acks() == []
        assert sum(rig.service.status()["vehicle"]["signing"]["doubted"].values()) == 3


@pytest.mark.parametrize(
    ("theirs", "words"),
    [
        (None, "messages dropped: the autopilot does not sign on this link"),
        (OTHER, "messages dropped: the autopilot signs with another key"),
    ],
)
async def test_an_autopilot_that_is_not_believed_is_said_and_why(
    tmp_path: Path, theirs: bytes | None, words: str
) -> None:
    rig = signed_rig(tmp_path)
    if theirs is not None:
        rig.autopilot.require_signatures(theirs, now())
    async with rig.running():
        await asyncio.sleep(5.0)
        assert rig.service.core.vehicle.system_id is None
        assert words in words_of(rig)
        assert words in rig.service.status()["headline"]["reason"]
        assert not rig.service.status()["vehicle"]["signing"]["good"]
        assert rig.service.core.collector.status(rig.now_s).still_s == 0.0


async def test_sign_alone_is_for_the_way_there(tmp_path: Path) -> None:
    """With "sign" the autopilot that wants signatures hears us, and a station that has no key yet is still answered."""

    rig = signed_rig(tmp_path, mode="sign")
    async with rig.running():
        await rig.ready()
        rig.ground.command(CANCEL)
        await asyncio.sleep(1.0)
        assert rig.ground.finals(CANCEL) == [ACCEPTED]
        signing = rig.service.status()["vehicle"]["signing"]
        assert signing["good"]
        assert "not signed with our key" in signing["summary"]
        rig.autopilot.require_signatures(KEY, now())
        verified = signing["verified"]
        await asyncio.sleep(3.0)
        assert rig.service.status()["vehicle"]["signing"]["verified"] > verified
        assert rig.service.core.vehicle.alive
