"""The access list of docs/mqtt.md at a real Mosquitto: who may press buttons, and what the companion needs."""

from __future__ import annotations

import asyncio
import json
import subprocess
from pathlib import Path

import aiomqtt
import pytest

from tests.support.broker import PASSWORD, USER, Broker
from tests.support.documents import ROOT
from tests.support.mqtt_daemon import BASE, alone, mosquitto_only, until_connected

pytestmark = pytest.mark.real_clock


def access_list() -> str:
    """Return the access list in the document."""
    text = (ROOT / "docs/mqtt.md").read_text(encoding="utf-8")
    begin = text.index(f"    user {USER}\n")
    lines = text[begin:].split("\n\n")[0].splitlines()
    return "".join(f"{line.strip()}\n" for line in lines).replace("companion/1/", f"{BASE}/")


@mosquitto_only
def test_only_the_pilot_presses_buttons(tmp_path: Path) -> None:
    path = tmp_path / "acl"
    path.write_text(access_list())
    one = Broker(tmp_path, users=True, more=f"acl_file {path}")
    for name in ("pilot", "dashboard"):
        users = one.folder / "users"
        subprocess.run(["mosquitto_passwd", "-b", str(users), name, PASSWORD], check=True, capture_output=True)
        users.chmod(0o644)

    def client(name: str) -> aiomqtt.Client:
        return aiomqtt.Client("127.0.0.1", one.port, username=name, password=PASSWORD)

    async def main() -> None:
        await one.start()
        try:
            async with (
                alone(tmp_path, one.section()) as service,
                client("pilot") as pilot,
                client("dashboard") as other,
            ):
                await until_connected(service)
                heard: dict[str, list[str]] = {"pilot": [], "dashboard": []}
                for name, each in (("pilot", pilot), ("dashboard", other)):
                    await each.subscribe(f"{BASE}/#", qos=1)
                    heard[name] = []
                # Under the companion's own voice, and as a request.
                await other.publish(f"{BASE}/request/cancel", json.dumps({"transaction": "stranger"}), qos=1)
                await pilot.publish(f"{BASE}/state", "lies", qos=1)
                await pilot.publish(f"{BASE}/request/cancel", json.dumps({"transaction": "pilot"}), qos=1)
                for name, each in (("pilot", pilot), ("dashboard", other)):
                    async with asyncio.timeout(40.0):
                        async for message in each.messages:
                            heard[name].append(f"{message.topic} {bytes(message.payload).decode()}")
                            if message.topic.value == f"{BASE}/response/cancel":
                                break
                for said in heard.values():
                    assert '"transaction":"pilot"' in said[-1]
                    assert any(line.startswith(f"{BASE}/status online") for line in said)
                    assert any(line.startswith(f"{BASE}/state {{") for line in said)
                    assert not any("stranger" in line or "lies" in line for line in said)
                assert service.status()["mqtt"]["good"]
        finally:
            one.kill()

    asyncio.run(main())
