"""`companion fleet acl` at a real Mosquitto: who may say and hear what in a fleet."""

from __future__ import annotations

import asyncio
import subprocess
from pathlib import Path

import aiomqtt
import pytest

from companion.errors import ConfigError
from companion.fleet.acl import access_list
from tests.support.broker import PASSWORD, Broker
from tests.support.fleet import CRANE, HERON
from tests.support.mqtt_daemon import mosquitto_only

NAMED = [f"heron={HERON}", f"crane={CRANE}"]
USERS = {"heron": ("heron", "crane"), "id": (HERON, CRANE)}
FLEETS = [pytest.param(NAMED, "heron", id="users by name"), pytest.param([], "id", id="users by id")]


def may_say(user: str, which: str) -> set[str]:
    """Topics that an aircraft may publish."""
    face = ("status", "state", "calibration/state", "calibration/progress", "attitude", "response/undo")
    return {f"fleet/{which}/hello", f"fleet/{which}/item"} | {f"companion/{user}/{what}" for what in face}


def may_hear(user: str, which: str) -> set[str]:
    """Topics that an aircraft may receive."""
    of_it = {f"fleet/{which}/confirmed", f"fleet/{which}/wanted"}
    return of_it | {f"companion/{user}/{what}" for what in ("status", "request/calibrate", "request/undo")}


def said_and_heard(users: tuple[str, str]) -> tuple[dict[str, set[str]], dict[str, set[str]]]:
    """Expected topics published and received by each user under the access list."""
    each = list(zip(users, (HERON, CRANE), strict=True))
    says = {user: may_say(user, which) for user, which in each}
    hears = {user: may_hear(user, which) for user, which in each}
    says["collector"] = {f"fleet/{which}/{what}" for _, which in each for what in ("confirmed", "wanted")}
    hears["collector"] = {f"fleet/{which}/{what}" for _, which in each for what in ("hello", "item")}
    return says, hears


def start(folder: Path, aircraft: list[str], users: tuple[str, ...], more: str = "") -> Broker:
    """A Mosquitto with the access list, not started yet; a witness may do everything."""
    acl = folder / "acl"
    acl.write_text("\n".join([*access_list(aircraft), "user witness", "topic readwrite #", ""]))
    one = Broker(folder, users=True, more=f"acl_file {acl}\n{more}")
    names = one.folder / "users"
    for user in users:
        subprocess.run(["mosquitto_passwd", "-b", str(names), user, PASSWORD], check=True, capture_output=True)
    names.chmod(0o644)
    return one


def client(one: Broker, user: str) -> aiomqtt.Client:
    return aiomqtt.Client("127.0.0.1", one.port, username=user, password=PASSWORD, identifier=f"client-{user[:8]}")


async def heard_until(one: aiomqtt.Client, last: str) -> list[tuple[str, str]]:
    found = []
    async with asyncio.timeout(60.0):
        async for message in one.messages:
            if bytes(message.payload).decode() == last:
                break
            found.append((message.topic.value, bytes(message.payload).decode()))
    return found


@pytest.mark.real_clock
@mosquitto_only
@pytest.mark.parametrize(("aircraft", "users"), FLEETS)
async def test_each_says_and_hears_what_is_its_own_and_nothing_else(
    tmp_path: Path, aircraft: list[str], users: str
) -> None:
    says, hears = said_and_heard(USERS[users])
    topics = sorted(set().union(*says.values(), *hears.values()))
    one = start(tmp_path, aircraft, (*says, "witness"), "log_type all")
    await one.start()
    try:
        async with client(one, "witness") as witness:
            await witness.subscribe("#", qos=1)
            for user in says:
                async with client(one, user) as speaker:
                    for topic in topics:
                        await speaker.publish(topic, user, qos=1)
                await witness.publish("over", "over", qos=1)
                heard = await heard_until(witness, "over")
                assert {topic for topic, _ in heard} == says[user], user
            for user in hears:
                async with client(one, user) as listener:
                    # Mosquitto grants every subscription, and delivers what may be read.
                    for topic in ("#", "$share/collectors/fleet/+/item"):
                        await listener.subscribe(topic, qos=1)
                    for topic in topics:
                        await witness.publish(topic, "news", qos=1)
                    await witness.publish(min(hears[user]), "over", qos=1)
                    heard = await heard_until(listener, "over")
                    assert {topic for topic, _ in heard} == hears[user], user
    finally:
        one.kill()
    crane, denied = USERS[users][1], (one.folder / "log").read_text()
    assert f"Denied PUBLISH from client-{crane[:8]} (d0, q1, r0, m" in denied
    assert f"'fleet/{HERON}/item'" in denied


@pytest.mark.parametrize(
    "aircraft",
    [
        ["heron"],
        [f"heron {HERON}"],
        [f"collector={HERON}"],
        [f"={HERON}"],
        [f"he ron={HERON}"],
        [f"+={HERON}"],
        [f'heron"={HERON}'],
        [f"heron\nuser root={HERON}"],
        [f"heron={HERON.upper()}x"],
        ["heron=+"],
        [f"heron={HERON}", f"crane={HERON}"],
    ],
)
def test_what_is_no_user_of_an_aircraft_is_one_line(aircraft: list[str]) -> None:
    with pytest.raises(ConfigError, match=r"found .*allowed: ") as found:
        access_list(aircraft)
    assert "\n" not in str(found.value)


def test_a_companion_that_was_moved_may_still_tell_what_it_has_kept() -> None:
    lines = access_list([f"heron={HERON}", f"heron={CRANE}"])
    assert {f"topic write fleet/{which}/item" for which in (HERON, CRANE)} <= set(lines)
