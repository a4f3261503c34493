"""The daemon's child processes, in the test's own loop or not at all."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Callable

from companion.daemon.interfaces.child import Child, StartChild
from companion.daemon.process.service import Service
from companion.errors import CompanionError, RequestRefusedError
from companion.formats import Object
from companion.links.system.process import ChildSettings
from companion.mqtt.process import MqttProcess


class Idle(Child):
    async def run(self) -> None:
        """Wait until cancelled."""
        await asyncio.get_running_loop().create_future()


class InProcess(Child):
    """The MQTT process's work in this loop; the service answers as the control socket would."""

    def __init__(self, name: str, module: str, settings: ChildSettings, service: Callable[[], Service]) -> None:
        super().__init__(name, module, settings)
        self._service = service
        self.work = MqttProcess(settings, self._ask)

    async def _ask(self, request: Object) -> AsyncGenerator[Object, None]:
        try:
            async for reply in self._service().faces.answer({"face": "mqtt", **request}):
                yield reply
        except RequestRefusedError as error:
            yield {"kind": "error", "reason": str(error), "refusal": error.kind}
        except CompanionError as error:
            yield {"kind": "error", "reason": str(error)}

    def status(self) -> Object:
        return self.work.status()

    async def run(self) -> None:
        await self.work.run()


def in_process(service: Callable[[], Service]) -> StartChild:
    """Return what makes MQTT's child in this loop, and leaves others idle."""

    def make(name: str, module: str, settings: ChildSettings) -> Child:
        return InProcess(name, module, settings, service) if name == "mqtt" else Idle(name, module, settings)

    return make
