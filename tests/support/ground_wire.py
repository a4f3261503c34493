"""A ground station without MAVSDK: what `companion.ground` needs of a link, on a wire in memory."""

from __future__ import annotations

from collections.abc import Callable

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.ground.heard import Address, Fields, GroundListener
from companion.links.system.events import Listeners
from tests.support.component import Ground, command_message

COMPANION = Address(1, 191)


def is_final(message: mavlink.MAVLink_message) -> bool:
    return isinstance(message, mavlink.MAVLink_command_ack_message) and message.result != mavlink.MAV_RESULT_IN_PROGRESS


class StationOnTheWire(Ground):
    """pymavlink's packer and parser under an exchange."""

    def __init__(self) -> None:
        super().__init__(245, 190)
        self.on_ack: Listeners[[Address, Fields]] = Listeners()
        self.confirmations: list[int] = []
        self.deaf_to: Callable[[mavlink.MAVLink_message], bool] = lambda message: False
        self.heard = GroundListener(COMPANION.component_id)
        self.values: dict[str, float] = {}
        """The companion's parameters, as if read."""

    def receive(self, data: bytes, t_s: float) -> None:
        known = len(self.received)
        super().receive(data, t_s)
        for _, message in self.received[known:]:
            if self.deaf_to(message):
                continue
            source = Address(message.get_srcSystem(), message.get_srcComponent())
            self.heard.update(message.get_type(), source, message.to_dict(), t_s)
            if isinstance(message, mavlink.MAVLink_command_ack_message):
                self.on_ack.tell(source, message.to_dict())

    def send_command(self, target: Address, command: int, parameters: tuple[float, ...], confirmation: int) -> None:
        self.confirmations.append(confirmation)
        self.send(command_message(command, *parameters, target=target, confirmation=confirmation))

    async def parameters(self, target: Address) -> dict[str, float]:
        return self.values

    async def get_parameter(self, target: Address, name: str) -> float | None:
        return self.values.get(name)
