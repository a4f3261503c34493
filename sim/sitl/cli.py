"""`python -m sim ardupilot | px4 | residuals | compasses`: a real firmware on the virtual aircraft, until Ctrl-C."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from sim.hands import Hands
from sim.imu_model import PARTS
from sim.motions import motions_of
from sim.scenario import FIRST_GYRO_DEG_H, Scenario, demo
from sim.serve import (
    FIRMWARE_COMMANDS,
    add_hands,
    add_world_options,
    address,
    configuration,
    describe,
    hands_of,
    pose_of,
    run_until_stopped,
    serve,
)
from sim.sitl.ardupilot import ArduPilotSitl
from sim.sitl.process import BinaryError
from sim.sitl.px4 import Px4Sitl
from sim.sitl.vehicle import SitlVehicle

SERVING = ("ardupilot", "px4")
COMPANION_UDP, GROUND_UDP = "127.0.0.1:14540", "127.0.0.1:14550"


def parser() -> argparse.ArgumentParser:
    top = argparse.ArgumentParser(prog="python -m sim", description="A real firmware on the virtual aircraft.")
    commands = top.add_subparsers(dest="command", required=True)
    for name, text in FIRMWARE_COMMANDS.items():
        command = commands.add_parser(name, help=text, description=text)
        command.add_argument("--binary", type=Path, required=True, help="the firmware: arducopter, arduplane or px4")
        _add_aircraft(command)
        if name in SERVING:
            add_hands(command)
            command.add_argument(
                "--dir", type=Path, help="folder for the ports and the firmware's files (default: a new one)"
            )
        if name == "ardupilot":
            for option, default, who in (
                ("--udp", COMPANION_UDP, "companion"),
                ("--ground", GROUND_UDP, "ground station"),
            ):
                command.add_argument(
                    option, type=address, metavar="HOST:PORT", default=default,
                    help=f"where the {who} listens (default {default})",
                )  # fmt: skip
        if name != "ardupilot":
            command.add_argument("--etc", type=Path, help="PX4's etc folder (default: ../etc of the binary)")
    residuals = commands.choices["residuals"]
    residuals.add_argument(
        "--listen", type=float, default=0.0, metavar="SECONDS",
        help="how long the companion hears the sensors before it is asked (default 0)",
    )  # fmt: skip
    only = residuals.add_mutually_exclusive_group()
    only.add_argument("--companion-only", action="store_true", help="leave the firmware's own calibrations out")
    only.add_argument("--own-only", action="store_true", help="leave the companion out")
    return top


def _add_aircraft(command: argparse.ArgumentParser) -> None:
    add_world_options(command)
    command.add_argument(
        "--gyro-bias", type=float, nargs=3, metavar=("X", "Y", "Z"), default=FIRST_GYRO_DEG_H,
        help="of the flight controller's first IMU in deg/h (default %(default)s)",
    )  # fmt: skip
    command.add_argument(
        "--part", choices=sorted(PARTS), default="icm42688p", help="what that IMU is (default icm42688p)"
    )
    command.add_argument(
        "--gyr-cal", action="store_true", help="ArduPilot calibrates its gyros at every boot (INS_GYR_CAL = 1)"
    )


def scenario_of(arguments: argparse.Namespace) -> Scenario:
    return demo(
        pose=pose_of(arguments),
        seed=arguments.seed,
        unix_s=time.time(),
        motions=motions_of(arguments.motion, seed=arguments.seed, turn_deg_s=arguments.turn),
        part=arguments.part,
        gyro_deg_h=arguments.gyro_bias,
    )


def vehicle_of(arguments: argparse.Namespace, scenario: Scenario, folder: Path) -> SitlVehicle:
    """Return the firmware that the options name, not started."""
    if arguments.command == "px4" or (arguments.command not in SERVING and arguments.binary.name.startswith("px4")):
        return Px4Sitl(arguments.binary, scenario, folder, etc=arguments.etc)
    links = {"companion": arguments.udp, "ground": arguments.ground} if arguments.command == "ardupilot" else {}
    return ArduPilotSitl(arguments.binary, scenario, folder, gyr_cal=arguments.gyr_cal, **links)


def main(argv: Sequence[str]) -> int:
    """Run a command until it is done or interrupted; return the exit code."""
    arguments = parser().parse_args(argv)
    made_here = getattr(arguments, "dir", None) is None
    folder = Path(tempfile.mkdtemp(prefix="companion-sim-")) if made_here else arguments.dir.absolute()
    scenario = scenario_of(arguments)
    try:
        vehicle = vehicle_of(arguments, scenario, folder / "firmware")
        if arguments.command == "residuals":
            from sim.sitl.residuals import DECK, STILL, report

            more = DECK if arguments.motion in ("sea", "engine") else STILL
            return asyncio.run(
                report(
                    vehicle, folder, more, listen_s=arguments.listen,
                    own=not arguments.companion_only, companion=not arguments.own_only,
                )
            )  # fmt: skip
        if arguments.command == "compasses":
            from sim.sitl import compasses

            return asyncio.run(compasses.report(vehicle, folder))
        hands = hands_of(arguments, scenario)
        return asyncio.run(
            run_until_stopped(
                lambda started: _serve(vehicle, scenario, folder, started, hands),
                lambda: _words(vehicle, scenario, folder),
            )
        )
    except KeyboardInterrupt:
        return 130
    except (BinaryError, OSError) as error:
        print(f"python -m sim {arguments.command}: {error}", file=sys.stderr)
        return 1
    finally:
        if made_here:  # but not what a companion may have stored beside it
            shutil.rmtree(folder / "firmware", ignore_errors=True)
            with contextlib.suppress(OSError):
                os.rmdir(folder)


async def _serve(
    vehicle: SitlVehicle, scenario: Scenario, folder: Path, started: asyncio.Event, hands: Hands | None
) -> None:
    """Run firmware and devices until cancelled."""
    async with vehicle:
        await serve(scenario, directory=folder, started=started, hands=hands, beside=vehicle.process.wait())


def _words(vehicle: SitlVehicle, scenario: Scenario, folder: Path) -> str:
    host, port = vehicle.url.removeprefix("udpin:").rsplit(":", 1)
    text = describe(scenario, devices=True, autopilot=True)
    text += f"# Firmware: process {vehicle.process.pid}, its files and log in {vehicle.folder}\n"
    if vehicle.firmware == "px4":
        to = ":".join(map(str, vehicle.ground_target))
        text += f"# Ground station: listen on UDP 14550, or speak first to UDP {to}\n"
    else:
        text += f"# Ground station: listen on UDP {':'.join(map(str, vehicle.ground_target))}\n"
    return text + configuration(scenario, directory=folder, udp=(host, int(port)))
