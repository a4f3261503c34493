"""A real ArduPilot on the virtual aircraft: `--model JSON`, two MAVLink links, parameters fit for measuring."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from sim.aircraft import VirtualAircraft
from sim.imu_model import Bias, ImuModel
from sim.scenario import Scenario
from sim.sitl.json_backend import JsonBackend
from sim.sitl.ports import LOOPBACK, free_tcp_window, free_udp_port
from sim.sitl.process import FirmwareProcess, check_binary
from sim.sitl.samples import SampleBlocks
from sim.sitl.vehicle import SitlVehicle

AXES = ("X", "Y", "Z")
IMUS = 2
_TCP_PORTS = 10


def measuring_parameters(scenario: Scenario, *, gyr_cal: bool) -> dict[str, float]:
    """Defaults under which the simulated sensors have the aircraft's biases and no others (autopilots 9.3).

    The second IMU hears the same physics; what its model has more than the first is added in the firmware.
    """
    first, second = (model.true_bias(0.0) for model in scenario.flight_controller_imus[:2])
    table = {
        "SIM_DRIFT_SPEED": 0.0,
        "SIM_RATE_HZ": 1000.0,  # as its sensors are sampled: every frame is one reading
        "SIM_IMUT_FIXED": scenario.aircraft.temperature_degc(0.0),
        "INS_GYR_CAL": float(gyr_cal),
        "FRAME_CLASS": 1.0,
        "FRAME_TYPE": 0.0,
        "SERIAL0_PROTOCOL": 2.0,
        "SERIAL1_PROTOCOL": 2.0,
        "SCR_ENABLE": 1.0,
        "FS_THR_ENABLE": 0.0,
        "FS_GCS_ENABLE": 0.0,
        "DISARM_DELAY": 0.0,
    }
    for axis, number in zip(AXES, range(3), strict=True):
        for imu in ("", "2"):
            # All exactly zero would mean "never calibrated".
            table[f"INS_ACC{imu}OFFS_{axis}"] = 1e-5
            table[f"INS_ACC{imu}SCAL_{axis}"] = 1.0
        table[f"SIM_GYR2_BIAS_{axis}"] = float(second.gyro_rad_s[number] - first.gyro_rad_s[number])
        table[f"SIM_ACC2_BIAS_{axis}"] = float(second.accel_m_s2[number] - first.accel_m_s2[number])
    return table


class ArduPilotLinks:
    """Its two links and its files. SERIAL0 goes to the ground station, SERIAL1 to the companion, both UDP."""

    folder: Path
    _companion: tuple[str, int]
    _ground: tuple[str, int]

    @property
    def url(self) -> str:
        """The companion listens where SERIAL1 sends to."""
        return f"udpin:{self._companion[0]}:{self._companion[1]}"

    @property
    def ground_target(self) -> tuple[str, int]:
        """Where SERIAL0 sends to."""
        return self._ground

    @property
    def scripts(self) -> Path:
        """Where Lua scripts go, before a start; scripting is on."""
        return self.folder / "scripts"

    @property
    def stored(self) -> tuple[str, ...]:
        """The image of its EEPROM."""
        return ("eeprom.bin",)


class ArduPilotSitl(ArduPilotLinks, SitlVehicle):
    """An `arducopter` (or `arduplane`) of SITL on a scenario's aircraft.

    The firmware speaks first.

    Args:
        binary: the firmware.
        scenario: see `FirmwareVehicle`.
        folder: see `FirmwareVehicle`; `scripts/` in it is where Lua scripts go.
        defaults: parameter files of the firmware's own format, read before ours.
        parameters: defaults that outrank all others.
        gyr_cal: INS_GYR_CAL, whether it calibrates its gyros at every boot; JSON's own default is not.
        companion, ground: where the two links go; None: to a free port, see `url` and `ground_target`.
        system_id: MAVLink system.

    Raises:
        BinaryError: the binary is missing or not executable.
    """

    firmware = "ardupilot"

    def __init__(
        self,
        binary: Path,
        scenario: Scenario,
        folder: Path,
        *,
        defaults: Sequence[Path] = (),
        parameters: Mapping[str, float] | None = None,
        gyr_cal: bool = False,
        companion: tuple[str, int] | None = None,
        ground: tuple[str, int] | None = None,
        system_id: int = 1,
    ) -> None:
        super().__init__(scenario, folder)
        self._binary = check_binary(binary)
        self._defaults = [path.absolute() for path in defaults]
        self._parameters = measuring_parameters(scenario, gyr_cal=gyr_cal) | dict(parameters or {})
        self._companion = companion or (LOOPBACK, free_udp_port())
        self._ground = ground or (LOOPBACK, free_udp_port())
        self.system_id = system_id
        self.backend = JsonBackend(scenario.aircraft, scenario.flight_controller_imus[0])

    @property
    def physics_s(self) -> float:
        """The firmware's simulated time since its boot."""
        return self.backend.physics_s

    @property
    def backend_boots(self) -> int:
        """Starts seen."""
        return self.backend.boots

    @property
    def samples(self) -> SampleBlocks:
        """The back end's."""
        return self.backend.blocks

    @property
    def imus(self) -> tuple[ImuModel, ...]:
        """The one model that is sent."""
        return (self.scenario.flight_controller_imus[0],)

    def true_bias(self, instance: int, t_s: float) -> Bias:
        """IMU 1 is the model; IMU 2 is the same, moved by the difference of the two at the start."""
        first, second = self.scenario.flight_controller_imus[:2]
        bias = first.true_bias(t_s)
        if instance == 1:
            return bias
        moved = np.concatenate(second.true_bias(0.0)) - np.concatenate(first.true_bias(0.0))
        return Bias(bias.gyro_rad_s + moved[:3], bias.accel_m_s2 + moved[3:])

    async def _open(self, stack: contextlib.AsyncExitStack) -> FirmwareProcess:
        await stack.enter_async_context(self.backend)
        self.scripts.mkdir(exist_ok=True)
        ours = self.folder / "measuring.parm"
        ours.write_text("".join(f"{name} {value:.9g}\n" for name, value in self._parameters.items()), encoding="ascii")
        return FirmwareProcess(self._command(ours), self.folder)

    def _command(self, ours: Path) -> list[str]:
        return [
            *common_arguments(
                self._binary, self.aircraft, [*self._defaults, ours],
                system_id=self.system_id, ground=self._ground, companion=self._companion,
            ),
            "--model", f"JSON:{LOOPBACK}",
            "--sim-address", LOOPBACK,
            "--sim-port-in", str(free_udp_port()),
            "--sim-port-out", str(self.backend.port),
        ]  # fmt: skip


def common_arguments(
    binary: Path,
    aircraft: VirtualAircraft,
    defaults: Sequence[Path],
    *,
    system_id: int,
    ground: tuple[str, int],
    companion: tuple[str, int],
) -> list[str]:
    """A SITL binary and what it is told whatever its physics: place, date, parameter files, free ports, two links."""
    site, heading_deg = aircraft.site, aircraft.pose.heading_deg % 360.0
    return [
        str(binary),
        "--speedup", "1",
        "--defaults", ",".join(map(str, defaults)),
        "--home", f"{site.latitude_deg:.7f},{site.longitude_deg:.7f},{site.height_m:.2f},{heading_deg:.2f}",
        "--start-time", str(int(aircraft.unix_s)),
        "--sysid", str(system_id),
        "--base-port", str(free_tcp_window(_TCP_PORTS)),
        "--rc-in-port", str(free_udp_port()),
        "--irlock-port", str(free_udp_port()),
        "--serial0", f"udpclient:{ground[0]}:{ground[1]}",
        "--serial1", f"udpclient:{companion[0]}:{companion[1]}",
    ]  # fmt: skip
