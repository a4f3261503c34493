"""Seeded chaos on the wire and in the aircraft: what may never happen, and that nothing goes unreported."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.autopilot.parameters.change import Change, WriteFailedError, same_float32
from companion.autopilot.vehicle.parameter_client import ParameterClient
from companion.autopilot.vehicle.parameter_writer import ParameterWriter
from companion.autopilot.vehicle.vehicle import ArmState, Vehicle
from companion.errors import NotDisarmedError
from companion.links.mavlink.link import MavlinkLink, Message
from tests.support.scripted_autopilot import ScriptedAutopilot, f32, flying_on
from tests.support.virtual_time import run_virtual

NAMES = [f"INS_{kind}_{axis}" for kind in ("ACCOFFS", "GYROFFS") for axis in "XYZ"]
BEFORE = {name: f32(0.01 * (i + 1)) for i, name in enumerate(NAMES)}
CHANGES = [Change(name, BEFORE[name], BEFORE[name] + 0.005) for name in NAMES]
AFTER = {change.parameter: change.after for change in CHANGES}


class WatchedLink(MavlinkLink):
    """Notes in which state each PARAM_SET left, as the heartbeats received so far tell it: independently of Vehicle."""

    def __init__(self) -> None:
        super().__init__()
        self.heartbeat: tuple[float, bool] | None = None
        self.forbidden: list[str] = []
        self.sets = 0

    def receive(self, data: bytes, t_s: float) -> None:
        if len(data) > 9 and data[0] == 0xFD and data[7:10] == b"\x00\x00\x00" and data[5] == 1 and data[6] == 1:
            # MAVLink 2 cuts trailing zeros: base_mode is byte 6 of the payload.
            base_mode = data[10 + 6] if data[1] > 6 else 0
            self.heartbeat = (t_s, bool(base_mode & 128))
        super().receive(data, t_s)

    def send(self, message: Message, *allowed: Callable[[], bool]) -> bool:
        if message.get_type() == "PARAM_SET":
            self.sets += 1
            now_s = asyncio.get_running_loop().time()
            if self.heartbeat is None or now_s - self.heartbeat[0] >= 2.0 or self.heartbeat[1]:
                self.forbidden.append(f"at {now_s} with {self.heartbeat}")
        return super().send(message, *allowed)


async def chaos(autopilot: ScriptedAutopilot, rng: random.Random, *, arming: bool, reboots: bool) -> None:
    while True:
        await asyncio.sleep(rng.expovariate(1.0))
        what = rng.random()
        if what < 0.3 and arming:
            autopilot.armed = not autopilot.armed
        elif what < 0.45:
            autopilot.beating = not autopilot.beating
            await asyncio.sleep(rng.uniform(0, 5))
            autopilot.beating = True
        elif what < 0.5 and reboots:
            await autopilot.reboot(rng.uniform(0.5, 6))


@settings(max_examples=40)
@given(
    seed=st.integers(0, 2**32 - 1),
    loss=st.sampled_from([0.0, 0.1, 0.4]),
    duplicate=st.sampled_from([0.0, 0.3]),
    arming=st.booleans(),
    reboots=st.booleans(),
    param_errors=st.booleans(),
)
def test_nothing_leaves_unless_disarmed_and_what_is_reported_is_true(
    *, seed: int, loss: float, duplicate: float, arming: bool, reboots: bool, param_errors: bool
) -> None:
    async def main() -> None:
        rng = random.Random(seed)
        link = WatchedLink()
        vehicle = Vehicle(link)
        client = ParameterClient(link, vehicle)
        writer = ParameterWriter(client, vehicle)
        autopilot = ScriptedAutopilot(parameters=BEFORE, param_errors=param_errors)
        async with flying_on(link, autopilot, seed=seed, loss=loss, duplicate=duplicate) as wire:
            await vehicle.found.wait()
            await asyncio.sleep(rng.uniform(0, 2))
            trouble = asyncio.create_task(chaos(autopilot, rng, arming=arming, reboots=reboots))
            try:
                written = await writer.apply(CHANGES)
            except NotDisarmedError:
                assert client.writes == 0
                assert autopilot.parameters == BEFORE
            except WriteFailedError as error:
                await settle(autopilot, trouble, wire.delay_s[1])
                check_report(autopilot, error)
            else:
                await settle(autopilot, trouble, wire.delay_s[1])
                assert {w.outcome for w in written.values()} == {"stored"}
                assert all(same_float32(autopilot.parameters[name], AFTER[name]) for name in NAMES)
            finally:
                trouble.cancel()
            assert client.writes == link.sets
            assert link.forbidden == []
            vehicle.close()

    run_virtual(main())


async def settle(autopilot: ScriptedAutopilot, trouble: asyncio.Task[None], delay_s: float) -> None:
    trouble.cancel()
    await asyncio.sleep(2 * delay_s)


def check_report(autopilot: ScriptedAutopilot, error: WriteFailedError) -> None:
    assert set(error.written) in (set(NAMES), set())
    for name, written in error.written.items():
        real = autopilot.parameters[name]
        if written.outcome == "rolled_back":
            assert same_float32(real, BEFORE[name])
        else:
            assert written.outcome == "failed"
        if written.read_back is not None:
            assert same_float32(real, written.read_back)
        if not same_float32(real, BEFORE[name]):
            assert name in error.left_changed, f"{name} = {real} goes unreported: {error}"
    assert all(name in str(error) for name in error.left_changed)


@settings(max_examples=30)
@given(seed=st.integers(0, 2**32 - 1), loss=st.sampled_from([0.0, 0.2]), after_s=st.floats(0, 2))
def test_a_cancel_at_any_moment_leaves_the_old_values(seed: int, loss: float, after_s: float) -> None:
    async def main() -> None:
        link = WatchedLink()
        vehicle = Vehicle(link)
        client = ParameterClient(link, vehicle)
        writer = ParameterWriter(client, vehicle)
        autopilot = ScriptedAutopilot(parameters=BEFORE)
        async with flying_on(link, autopilot, seed=seed, loss=loss):
            await vehicle.found.wait()
            await asyncio.sleep(1.0)
            if vehicle.arm_state is not ArmState.DISARMED:
                return
            task = asyncio.create_task(writer.apply(CHANGES))
            await asyncio.sleep(after_s)
            if task.done():
                return
            task.cancel()
            with pytest.raises((asyncio.CancelledError, WriteFailedError)):
                await task
            left = [name for name in NAMES if not same_float32(autopilot.parameters[name], BEFORE[name])]
            assert set(left) <= set(writer.left_changed)
            if loss == 0.0:
                assert left == []
            assert link.forbidden == []
            vehicle.close()

    run_virtual(main())
