"""What a collector knows of an IMU model, by a real broker, to an aircraft that comes later."""

from __future__ import annotations

import asyncio
from pathlib import Path

import aiomqtt
import pytest

from companion.config.sections import Mqtt
from companion.daemon.biases.model_priors import TOPIC, ModelPriors
from companion.fleet.collector import Collector, stop
from companion.fleet.store import Store
from tests.support.broker import KINDS, Kind, broker
from tests.support.fleet import check
from tests.unit.test_fleet_priors import MODEL, fill, rows


@pytest.mark.parametrize("kind", KINDS)
def test_it_waits_at_the_broker(kind: Kind, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("companion.fleet.collector.PRIORS_AFTER_S", 0.0)
    store = Store(str(tmp_path / "fleet.sqlite"))
    store.prepare()
    fill(store, [rows(k) for k in range(8)])
    models = ModelPriors(tmp_path, lambda: {"fc": MODEL})

    async def main() -> None:
        async with broker(tmp_path, kind) as one:
            settings = Mqtt(host="127.0.0.1", port=one.port)
            collecting = asyncio.create_task(Collector(settings, store, mqtt_5=kind == "mosquitto").run())
            async with asyncio.timeout(60.0):
                # Whoever comes before hears it at once, whoever comes later of the broker.
                for retained in (False, True):
                    async with aiomqtt.Client("127.0.0.1", one.port) as aircraft:
                        await aircraft.subscribe(f"{TOPIC}+", qos=1)
                        message = await anext(aircraft.messages)
                        assert isinstance(message.payload, bytes)
                        check("prior", message.payload)
                        models.take(message.topic.value, message.payload)
                    if retained:
                        assert message.retain
            await stop([collecting])

    asyncio.run(main())
    assert models.of("fc", "gyro") is not None
