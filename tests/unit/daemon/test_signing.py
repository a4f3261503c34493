"""The time of our signatures over restarts, power cuts and full disks, and words about who is not believed."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import AsyncIterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.vehicle.vehicle import Vehicle
from companion.config import parse
from companion.daemon.devices import signing as daemon_signing
from companion.daemon.devices.signing import AHEAD_S, LinkSigning
from companion.errors import StorageError
from companion.links.mavlink import signing as link_signing
from companion.links.mavlink.link import MavlinkLink
from companion.links.mavlink.signing import EPOCH_S, TICKS_PER_S, SigningClock
from companion.storage.records import SIGNING_FILE, SigningTime, signing_time_in, this_boot
from companion.storage.state import StateFile
from tests.support.rig import inline
from tests.support.virtual_time import run_virtual
from tests.unit.config.test_config import GOOD
from tests.unit.links.test_mavlink_signing import KEY, NOW, NOW_S, YEAR_S, peer

MARGIN = 2 * TICKS_PER_S
"""The steps of a test last no longer than this."""


HEARTBEAT = mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3)


class SigningBoard:
    """A companion computer: its clocks, its disk, and how often it was started."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch, *, wall_s: float) -> None:
        self.folder, self.wall_at_boot_s = folder, wall_s
        self.boots = 1
        self._booted_s = 0.0
        monkeypatch.setattr(daemon_signing, "uptime_s", self.uptime_s)
        monkeypatch.setattr(daemon_signing, "this_boot", lambda: f"boot {self.boots}")
        monkeypatch.setattr(
            link_signing, "SigningClock", lambda: SigningClock(wall_s=self.wall_s, uptime=self.uptime_s)
        )
        (folder / "k").write_text(KEY.hex())
        (folder / "k").chmod(0o600)

    def uptime_s(self) -> float:
        return asyncio.get_running_loop().time() - self._booted_s

    def wall_s(self) -> float:
        return self.wall_at_boot_s + self.uptime_s()

    def power_cut(self) -> None:
        self.boots += 1
        self._booted_s = asyncio.get_running_loop().time()

    @contextlib.asynccontextmanager
    async def daemon(self, *, killed: bool = False) -> AsyncIterator[LinkSigning]:
        """Run its signing; `killed`: without an orderly end."""
        text = GOOD.replace("[[imu]]", f'signing_key_file = "{self.folder}/k"\n[[imu]]', 1)
        config = parse(f'{text}[storage]\ndirectory = "{self.folder}"\n', "x.toml")
        vehicle = cast("Vehicle", SimpleNamespace(alive=False, component_id=1, system_id=None))
        found = LinkSigning(config, MavlinkLink(), vehicle, lambda *_: None, inline)
        found.load()
        task = asyncio.create_task(found.run())
        await asyncio.sleep(0)
        kept: bytes | None = None
        try:
            yield found
            kept = (self.folder / SIGNING_FILE).read_bytes()
        finally:
            task.cancel()
            await asyncio.wait([task])
        if killed and kept is not None:
            (self.folder / SIGNING_FILE).write_bytes(kept)


async def test_in_1970_time_goes_on_behind_what_was_used_whatever_ends_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    board = SigningBoard(tmp_path, monkeypatch, wall_s=0.0)
    async with board.daemon() as first:
        assert first.signing is not None
        first.signing.clock.heard(NOW)
        await asyncio.sleep(3.0)
        used = first.signing.clock.next()
        assert used >= NOW + 3 * TICKS_PER_S
    for killed in (False, True, True):
        # kill -9 and a restart within the same boot: on from where it was, however often.
        async with board.daemon(killed=killed) as again:
            assert again.signing is not None
            now = again.signing.clock.next()
            assert used < now < used + MARGIN
            used = now
    for _ in range(3):
        board.power_cut()
        async with board.daemon(killed=True) as anew:
            assert anew.signing is not None
            now = anew.signing.clock.next()
            assert used < now <= used + int(AHEAD_S * TICKS_PER_S) + MARGIN
            await asyncio.sleep(70.0)
            used = anew.signing.clock.next()


@pytest.mark.parametrize("wall_at_start_s", [NOW_S, 0.0])
async def test_a_clock_once_20_years_ahead_is_not_followed_in_that_boot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, wall_at_start_s: float
) -> None:
    """A board without a battery-backed clock has the time from a signed message instead."""
    board = SigningBoard(tmp_path, monkeypatch, wall_s=wall_at_start_s)
    async with board.daemon() as first:
        assert first.signing is not None
        first.signing.clock.heard(NOW)
        before = first.signing.clock.next()
        board.wall_at_boot_s = NOW_S + 20 * YEAR_S
        await asyncio.sleep(3.0)
        assert first.signing.clock.next() < before + 5 * TICKS_PER_S
        await asyncio.sleep(3.0)
    async with board.daemon() as second:  # started again while the clock is wrong
        assert second.signing is not None
        assert second.signing.clock.next() < before + 10 * TICKS_PER_S
    board.wall_at_boot_s = NOW_S
    board.power_cut()
    async with board.daemon() as third:
        assert third.signing is not None
        assert third.signing.clock.next() < before + int(AHEAD_S * TICKS_PER_S) + 10 * TICKS_PER_S


async def test_a_kept_time_far_ahead_is_named_with_the_way_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    board = SigningBoard(tmp_path, monkeypatch, wall_s=NOW_S + 20 * YEAR_S)
    async with board.daemon():
        await asyncio.sleep(1.0)
    board.wall_at_boot_s = NOW_S
    board.power_cut()

    def autopilot_says(found: LinkSigning) -> bool:
        assert found.signing is not None
        ticks = int((board.wall_s() - EPOCH_S) * TICKS_PER_S)
        return found.signing.admits(HEARTBEAT.pack(peer(KEY, ticks)))

    async with board.daemon() as deaf:
        for _ in range(6):
            assert not autopilot_says(deaf)
            await asyncio.sleep(1.0)
        way_back = "far ahead of this board's clock: stop the companion, delete mavlink-signing-time.json, start it"
        assert way_back in str(deaf.warning)
        assert way_back in str(deaf.rejecting)
    (tmp_path / SIGNING_FILE).unlink()
    async with board.daemon() as hears:
        assert autopilot_says(hears)
        await asyncio.sleep(6.0)
        assert hears.rejecting is None


def test_a_disk_that_cannot_be_written_is_said_once_and_costs_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    async def main() -> None:
        board = SigningBoard(tmp_path, monkeypatch, wall_s=NOW_S)

        def full(*_: Any) -> None:
            raise StorageError("disk full")

        signing_time_in(tmp_path).write(SigningTime(0, 0, 0.0, ""))
        monkeypatch.setattr(StateFile, "write", full)
        async with board.daemon() as one:
            await asyncio.sleep(200.0)
            assert one.signing is not None
            assert one.signing.sign(b"\xfd" + bytes(21), 50)[2] == 1

    with caplog.at_level(logging.WARNING):
        run_virtual(main())
    assert [record.getMessage() for record in caplog.records] == ["MAVLink signing time not saved: disk full"]


def test_the_unit_hands_the_boot_id_over(monkeypatch: pytest.MonkeyPatch) -> None:
    own = this_boot()
    assert len(own) == 32
    monkeypatch.setenv("COMPANION_BOOT_ID", "0" * 32)
    assert this_boot() == "0" * 32
    unit = Path("systemd/companion.service").read_text(encoding="utf-8")
    assert "Environment=COMPANION_BOOT_ID=%b\n" in unit
