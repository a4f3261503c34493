"""A real ArduPilot on the virtual aircraft: `--model JSON`, two MAVLink links, parameters for measuring."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sim.imu_model import Bias
from sim.scenario import Scenario
from sim.sitl.json_backend import JsonBackend
from sim.sitl.process import LOOPBACK, FirmwareProcess, check_binary, free_tcp_window, free_udp_port
from sim.sitl.vehicle import FirmwareVehicle, SitlVehicle

AXES = ("X", "Y", "Z")
IMUS = 2
_TCP_PORTS = 10


def measuring_parameters(scenario: Scenario, *, gyr_cal: bool) -> dict[str, float]:
    """Return defaults that give the simulated sensors the aircraft's biases and no others (autopilots 9.3).

    The second IMU gets the same physics; the firmware adds the difference between its model and the first.
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


class ArduPilot(FirmwareVehicle):
    """A real ArduPilot with its links and files. SERIAL0 goes to the ground station, SERIAL1 to the companion (UDP).

    The firmware speaks first.

    Args:
        binary: the firmware.
        scenario: see `FirmwareVehicle`.
        folder: see `FirmwareVehicle`; `scripts/` in it is for Lua scripts.
        parameters: defaults that outrank all others.
        companion, ground: addresses of the two links; None: a free port, see `url` and `ground_target`.
    """

    firmware = "ardupilot"
    stored = ("eeprom.bin",)
    system_id = 1

    def __init__(
        self,
        binary: Path,
        scenario: Scenario,
        folder: Path,
        *,
        parameters: Mapping[str, float],
        companion: tuple[str, int] | None = None,
        ground: tuple[str, int] | None = None,
    ) -> None:
        super().__init__(scenario, folder)
        self._binary, self._parameters = check_binary(binary), parameters
        self._companion = companion or (LOOPBACK, free_udp_port())
        self.url = f"udpin:{self._companion[0]}:{self._companion[1]}"
        self.ground_target = ground or (LOOPBACK, free_udp_port())
        self.scripts = folder / "scripts"
        """Folder for Lua scripts, to be filled before a start; scripting is on."""

    def _process_of(self, *model: str) -> FirmwareProcess:
        """Return the binary with this physics, not started: place, date, parameters, free ports, two links."""
        self.scripts.mkdir(exist_ok=True)
        ours = self.folder / "ours.parm"
        ours.write_text("".join(f"{name} {value:.9g}\n" for name, value in self._parameters.items()), encoding="ascii")
        site, heading_deg = self.aircraft.site, self.aircraft.pose.heading_deg % 360.0
        command = [
            str(self._binary),
            "--speedup", "1",
            "--defaults", str(ours),
            "--home", f"{site.latitude_deg:.7f},{site.longitude_deg:.7f},{site.height_m:.2f},{heading_deg:.2f}",
            "--start-time", str(int(self.aircraft.unix_s)),
            "--sysid", str(self.system_id),
            "--base-port", str(free_tcp_window(_TCP_PORTS)),
            "--rc-in-port", str(free_udp_port()),
            "--irlock-port", str(free_udp_port()),
            "--serial0", f"udpclient:{self.ground_target[0]}:{self.ground_target[1]}",
            "--serial1", f"udpclient:{self._companion[0]}:{self._companion[1]}",
            *model,
        ]  # fmt: skip
        return FirmwareProcess(command, self.folder)


class ArduPilotSitl(ArduPilot, SitlVehicle):
    """An `arducopter` (or `arduplane`) of SITL on a scenario's aircraft.

    Args:
        binary, scenario, folder, links: see `ArduPilot`.
        parameters: defaults that outrank all others.
        gyr_cal: INS_GYR_CAL, calibrate the gyros at every boot; off in JSON's own defaults.
    """

    backend: JsonBackend

    def __init__(
        self,
        binary: Path,
        scenario: Scenario,
        folder: Path,
        *,
        parameters: Mapping[str, float] | None = None,
        gyr_cal: bool = False,
        **links: Any,
    ) -> None:
        ours = measuring_parameters(scenario, gyr_cal=gyr_cal) | dict(parameters or {})
        super().__init__(binary, scenario, folder, parameters=ours, **links)
        self.backend = JsonBackend(scenario.aircraft, scenario.flight_controller_imus[0])
        self.samples, self.imus = self.backend.blocks, scenario.flight_controller_imus[:1]

    @property
    def physics_s(self) -> float:
        return self.backend.physics_s

    def true_bias(self, instance: int, t_s: float) -> Bias:
        """Return the true bias: IMU 1's is the model's; IMU 2's adds the difference of the two at the start."""
        first, second = self.scenario.flight_controller_imus[:2]
        bias = first.true_bias(t_s)
        if instance == 1:
            return bias
        moved = np.concatenate(second.true_bias(0.0)) - np.concatenate(first.true_bias(0.0))
        return Bias(bias.gyro_rad_s + moved[:3], bias.accel_m_s2 + moved[3:])

    async def _open(self, stack: contextlib.AsyncExitStack) -> FirmwareProcess:
        await stack.enter_async_context(self.backend)
        addresses = ("--sim-address", LOOPBACK, "--sim-port-in", str(free_udp_port()))
        model = ("--model", f"JSON:{LOOPBACK}", *addresses, "--sim-port-out", str(self.backend.port))
        return self._process_of(*model)
