"""The topics of one vehicle."""

from __future__ import annotations

from companion.config.sections import Mqtt

ONLINE = b"online"
OFFLINE = b"offline"


class Topics:
    """All topics under one base, such as "companion/1"."""

    def __init__(self, base: str) -> None:
        self.base = base
        self.status = f"{base}/status"
        self.state = f"{base}/state"
        self.record = f"{base}/calibration/state"
        self.progress = f"{base}/calibration/progress"
        self.attitude = f"{base}/attitude"
        self.requests = f"{base}/request/+"

    @property
    def kept(self) -> tuple[str, ...]:
        """Those that the broker keeps."""
        return self.status, self.state, self.record

    def request(self, command: str) -> str:
        """Where a command is asked for."""
        return f"{self.base}/request/{command}"

    def response(self, command: str) -> str:
        """Where a command is answered."""
        return f"{self.base}/response/{command}"

    def command_in(self, topic: str) -> str | None:
        """The command that a request's topic names; None for another topic."""
        prefix = f"{self.base}/request/"
        return topic.removeprefix(prefix) if topic.startswith(prefix) else None


def base_of(settings: Mqtt, system_id: int) -> str:
    """What the topics of a vehicle begin with."""
    return settings.base_topic or f"companion/{system_id}"


def client_id_of(settings: Mqtt, base: str) -> str:
    """Who we are to the broker.

    The same after every restart: so our own old connection, and its last will with it, gives way to the new one.
    """
    return settings.client_id or base.replace("/", "-")
