"""The faces: the component on MAVLink, the control socket, MQTT and the page, all by one door."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import msgspec

from companion.component.component import Component
from companion.config.senders import Senders
from companion.daemon.arming.subsystem import Arming
from companion.daemon.calibrating.subsystem import Calibrating
from companion.daemon.core import Core, Subsystem, Task
from companion.daemon.devices.subsystem import Devices
from companion.daemon.faces.answers import Answers
from companion.daemon.faces.flight_line import define_parameters
from companion.daemon.faces.headline import Headlines
from companion.daemon.heading.subsystem import Heading
from companion.daemon.offsets.subsystem import Offsets
from companion.daemon.recorder.recorder import Recorder
from companion.links.system.request import Object

if TYPE_CHECKING:
    from companion.daemon.faces.mqtt.face import MqttFace
    from companion.web.server import Page


class Faces(Subsystem):
    """By which the daemon is seen and asked."""

    def __init__(
        self,
        core: Core,
        devices: Devices,
        offsets: Offsets,
        calibrating: Calibrating,
        arming: Arming,
        heading: Heading,
        recorder: Recorder,
    ) -> None:
        self._core, self._devices = core, devices
        self.component = Component(
            core.link,
            core.vehicle,
            calibrating.conductor,
            arming.readiness,
            texts=core.texts,
            senders=Senders(core.config.mavlink.allow),
        )
        define_parameters(self.component.parameters, core.config, calibrating.conductor)
        self._headlines = Headlines(core, devices, calibrating.conductor, arming, heading.attitude)
        self.answers = Answers([self, devices, offsets, calibrating, arming, heading, recorder], heading.pose)
        self.mqtt = _mqtt(core, self.answers, calibrating, heading)
        self.page = _page(core, self.answers)

    def status(self) -> Object:  # noqa: D102 - as in the base class
        return {
            "headline": msgspec.to_builtins(self._headlines.now()),
            "vehicle": self._vehicle(),
            "mqtt": None if self.mqtt is None else self.mqtt.status(),
            "page": None if self.page is None else self.page.status(),
        }

    def _vehicle(self) -> Mapping[str, object]:
        vehicle, link = self._core.vehicle, self._core.link
        age_s = vehicle.heartbeat_age_s
        refused = self.component.permission.refused
        return {
            "system_id": vehicle.system_id,
            "firmware": vehicle.firmware,
            "armed": vehicle.arm_state.value,
            "summary": f"{vehicle.name}, {vehicle.arm_state.value}"
            if vehicle.system_id is not None
            else self._devices.not_heard,
            "heartbeat_age_s": None if age_s is None else round(age_s, 1),
            "messages": link.received.total() - link.received["bad"],
            "bad": link.received["bad"],
            "not_sent": link.dropped,
            "signing": self._devices.signing.status(),
            "refused": {f"{system}/{one}": count for (system, one), count in refused.items()},
        }

    def tasks(self) -> Sequence[Task]:  # noqa: D102
        tasks: list[Task] = [("component", self.component.run)]
        if self.mqtt is not None:
            tasks.append(("mqtt", self.mqtt.run))
        if self.page is not None and self._core.only_listening is None:
            tasks.append(("page", self.page.run))
        return tasks


# What nobody asked for costs the start nothing: it is imported only where it is configured.


def _mqtt(core: Core, answers: Answers, calibrating: Calibrating, heading: Heading) -> MqttFace | None:
    if core.config.mqtt is None:
        return None
    from companion.daemon.faces.mqtt.face import MqttFace

    return MqttFace(core, core.config.mqtt, answers, calibrating.conductor, heading.pose)


def _page(core: Core, answers: Answers) -> Page | None:
    if core.config.web is None:
        return None
    from companion.web.server import Page

    return Page(core.config.web.bind, core.config.storage.path, answers.answer, answers.look, core.offload)
