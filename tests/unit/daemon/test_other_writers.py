"""Several companions on one link: exactly one writes, and nothing else on the link is taken for a companion."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass, field

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.daemon.offsets.other_writers import OtherCompanions
from companion.links.mavlink.link import MavlinkLink

NAME = b"CMP_INST"


@dataclass
class Bus:
    """A network on which everybody hears everybody; with `echo` also himself, some time later."""

    echo: bool = False
    loss: Callable[[], bool] = lambda: False
    links: list[MavlinkLink] = field(default_factory=list)
    packets: int = 0

    def join(self, link: MavlinkLink) -> None:
        self.links.append(link)
        link.attach(lambda data: self._carry(link, data))

    def leave(self, link: MavlinkLink) -> None:
        self.links.remove(link)
        link.attach(None)

    def _carry(self, sender: MavlinkLink, data: bytes) -> None:
        self.packets += 1
        loop = asyncio.get_running_loop()
        for delay_s in (0.01, 0.8):
            for link in self.links:
                if (link is not sender or self.echo) and not self.loss():
                    loop.call_later(delay_s, lambda link=link: link.receive(data, loop.time()))  # type: ignore[misc]


@dataclass
class One:
    link: MavlinkLink
    others: OtherCompanions
    said: list[str]
    writes: bool = True


@contextlib.asynccontextmanager
async def companion(bus: Bus, *, component_id: int = 191, system_id: int = 1) -> AsyncIterator[One]:
    link, said = MavlinkLink(system_id=system_id, component_id=component_id), list[str]()
    one = One(link, OtherCompanions(link, lambda _severity, text, _weight: said.append(text), lambda: one.writes), said)
    bus.join(link)
    running = asyncio.create_task(one.others.run())
    try:
        yield one
    finally:
        running.cancel()
        bus.leave(link)


@pytest.mark.parametrize("component_id", [191, 192])
@pytest.mark.parametrize("apart_s", [0.0, 0.3, 3.0, 5.5, 6.5, 60.0])
async def test_exactly_one_of_two_refuses_to_write_and_each_names_the_other(apart_s: float, component_id: int) -> None:
    bus = Bus()
    async with companion(bus) as first:
        await asyncio.sleep(apart_s)
        async with companion(bus, component_id=component_id) as second:
            await asyncio.sleep(3.0)
            for _ in range(200):
                await asyncio.sleep(0.1)
                assert [one.others.why_not() is None for one in (first, second)].count(True) == 1
            if apart_s > 6.0:
                assert second.others.why_not() is not None, "who was there goes on"
            for one, other in ((first, component_id), (second, 191)):
                (words,) = one.said
                waits = "writes" if one.others.why_not() else "waits"
                assert words == f"Second companion (1/{other}) on this link {waits}: stop one of them"
                assert one.others.warning == words[0].lower() + words[1:]


async def test_a_lossy_link_does_not_let_both_write() -> None:
    lost = iter(range(10**6))
    bus = Bus(loss=lambda: next(lost) % 5 == 0)
    async with companion(bus) as first, companion(bus) as second:
        await asyncio.sleep(6.0)
        for _ in range(600):
            await asyncio.sleep(0.1)
            assert [one.others.why_not() is None for one in (first, second)].count(True) == 1


async def test_nothing_else_is_taken_for_a_companion() -> None:
    """Our own echo, a restart of ourselves, a packet in a loop, an ordinary onboard computer, another aircraft's."""
    bus = Bus(echo=True)
    async with companion(bus) as before:
        await asyncio.sleep(5.0)
        assert before.others.warning is None
    onboard = MavlinkLink(system_id=1, component_id=191)
    bus.join(onboard)
    async with companion(bus) as one, companion(bus, system_id=2) as elsewhere:
        for turn in range(300):
            onboard.send(mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
            onboard.send(mavlink.MAVLink_named_value_int_message(turn, b"CMP_X", 7))
            onboard.send(mavlink.MAVLink_named_value_int_message(1234, NAME, 8))  # as a loop of routers has it
            await asyncio.sleep(0.1)
            assert one.others.warning is None
            assert elsewhere.others.warning is None


async def test_who_writes_nothing_neither_announces_itself_nor_is_kept_from_measuring() -> None:
    bus = Bus()
    async with companion(bus) as one, companion(bus) as silent:
        silent.writes = False
        await asyncio.sleep(30.0)
        assert one.others.warning is None
        assert silent.others.why_not() is None
