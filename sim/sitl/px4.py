"""A real PX4 on the virtual aircraft: `none_iris`, fed by our TCP server, with its companion and ground links."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sim.imu_model import Bias
from sim.scenario import Scenario
from sim.sitl.hil_backend import HilBackend
from sim.sitl.process import LOOPBACK, BinaryError, FirmwareProcess, check_binary, ports_free, unlocked
from sim.sitl.vehicle import FirmwareVehicle, SitlVehicle

INSTANCES = 10
"""Maximum number of instances; beyond ten, the firmware gives several vehicles the same companion port."""
_TCP_SIMULATOR = 4560
UDP_COMPANION, _UDP_COMPANION_LOCAL = 14540, 14580
UDP_GROUND_LOCAL = 18570
_UDP_PAYLOAD_LOCAL, _UDP_GIMBAL_LOCAL = 14280, 13030

MEASURING_PARAMETERS: dict[str, float] = {
    "SDLOG_MODE": -1,  # no logs: a run would leave hundreds of megabytes
    "COM_RC_IN_MODE": 4,  # no radio control, and none expected
    "NAV_DLL_ACT": 0,  # no ground station is no emergency
    "NAV_RCL_ACT": 0,
    "COM_DISARM_PRFLT": -1,  # stays armed until told otherwise
    "CBRK_SUPPLY_CHK": 894281,
    "COM_ARM_WO_GPS": 1,
}
"""Parameters set at the first boot only; later the stored values are the firmware's own."""


def ports_of(instance: int) -> list[tuple[int, socket.SocketKind]]:
    """Return all ports of an instance or its peers, except the ground station's 14550, which all instances share."""
    udp = (UDP_COMPANION, _UDP_COMPANION_LOCAL, UDP_GROUND_LOCAL, _UDP_PAYLOAD_LOCAL, _UDP_GIMBAL_LOCAL)
    return [(_TCP_SIMULATOR + instance, socket.SOCK_STREAM)] + [(p + instance, socket.SOCK_DGRAM) for p in udp]


def free_instance() -> int:
    """Return the first instance whose ports and lock are free."""
    for instance in range(INSTANCES):
        if unlocked(Path(f"/tmp/px4_lock-{instance}")) and ports_free(ports_of(instance)):  # noqa: S108 - PX4's own
            return instance
    raise BinaryError(f"px4: instances 0 to {INSTANCES - 1} are all taken; end one")


class Px4(FirmwareVehicle):
    """An instance of PX4: its ports, its files and its start.

    Links: the firmware sends to 127.0.0.1 port 14540 plus its instance (companion), and to 14550 until a ground station
    has spoken to `ground_target`, then to that one.

    Args:
        binary: the firmware.
        etc: its `etc` folder of start scripts; None: `../etc` of the binary.
        scenario: see `FirmwareVehicle`.
        folder: see `FirmwareVehicle`.
        parameters: set at the first boot, besides `MEASURING_PARAMETERS`.
        instance: instance of the firmware; None: the first that is free.
    """

    firmware = "px4"
    stored = ("parameters.bson", "parameters_backup.bson")
    model: str

    def __init__(
        self,
        binary: Path,
        scenario: Scenario,
        folder: Path,
        *,
        etc: Path | None = None,
        parameters: Mapping[str, float] | None = None,
        instance: int | None = None,
    ) -> None:
        super().__init__(scenario, folder)
        self._binary = check_binary(binary)
        self._etc = (etc if etc is not None else self._binary.parent.parent / "etc").absolute()
        if not (self._etc / "init.d-posix" / "rcS").is_file():
            raise BinaryError(f"--etc: found no init.d-posix/rcS in {self._etc}; give the etc folder of the build")
        self._parameters = MEASURING_PARAMETERS | dict(parameters or {})
        self._environment = {"PX4_SIM_MODEL": self.model, "PX4_SIM_HOST_ADDR": LOOPBACK}
        self.instance = free_instance() if instance is None else instance
        self.system_id = self.instance + 1
        self.companion_port = UDP_COMPANION + self.instance
        self.url = f"udpin:{LOOPBACK}:{self.companion_port}"
        self.ground_target = LOOPBACK, UDP_GROUND_LOCAL + self.instance

    def _process_of(self) -> FirmwareProcess:
        command = [str(self._binary), "-d", "-i", str(self.instance), "-w", str(self.folder), str(self._etc)]
        return FirmwareProcess(command, self.folder)

    async def power_on(self) -> None:
        """Start the binary with its stored parameters; if there are none, with ours."""
        first: dict[str, str] = {}
        if not (self.folder / self.stored[0]).exists():
            first = {f"PX4_PARAM_{name}": f"{value:g}" for name, value in self._parameters.items()}
        self.process.environment = self._environment | first
        await super().power_on()


class Px4Sitl(Px4, SitlVehicle):
    """A `px4` of SITL on a scenario's aircraft; its first two IMUs are sensor 0 and sensor 1."""

    model = "none_iris"
    backend: HilBackend
    instances = (1, 2)

    def __init__(self, binary: Path, scenario: Scenario, folder: Path, **more: Any) -> None:
        super().__init__(binary, scenario, folder, **more)
        self.imus = scenario.flight_controller_imus[:2]
        self.backend = HilBackend(scenario.aircraft, self.imus, port=_TCP_SIMULATOR + self.instance)
        self.samples = self.backend.blocks

    @property
    def physics_s(self) -> float:
        return self.backend.physics_s if self.backend.locked else 0.0

    def true_bias(self, instance: int, t_s: float) -> Bias:
        """Return the true bias; each sensor has a model of its own."""
        return self.imus[instance - 1].true_bias(t_s)

    async def _open(self, stack: contextlib.AsyncExitStack) -> FirmwareProcess:
        await stack.enter_async_context(self.backend)
        return self._process_of()
