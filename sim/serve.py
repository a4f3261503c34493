"""Command line of the simulator: devices on pseudo-terminals, the autopilot on UDP, and how to connect to them."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import dataclasses
import hashlib
import math
import os
import shlex
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Coroutine, Iterable, Sequence
from pathlib import Path

from sim.accuracy import cli as accuracy
from sim.aircraft import Pose
from sim.devices import SerialDevice
from sim.hands import HANDS, PLACEMENT_DEG, PROPPED_DEG, Hands, take_lines
from sim.imu_model import DEG_H, MG, ImuModel
from sim.motions import MOTIONS, TURN_DEG_S, motions_of
from sim.pty_device import PtyDevice, Setting
from sim.scenario import (
    COMPASSES,
    DEMO_DEVICES,
    DEMO_POSE,
    GRADIENTER_OFFSET_DEG,
    GRADIENTERS,
    IMUS,
    Devices,
    Scenario,
    demo,
    fit,
)
from sim.station import open_udp

DEFAULT_UDP = "127.0.0.1:14550"
FLAT_POSE = Pose(0.6, -0.4, 40.0)  # On a steeper spot the gradienter's zero is less exact: `align zero` warns
TRUTH_S = 60.0
"""Duration over which `describe` averages biases: the longest measurement of a calibration."""
_PROFILES = {"white_only": "icm42688p", "perfect": "icm42688p"}
"""Noise profiles to tell the companion for sensor types that only the simulator has."""
FIRMWARE_COMMANDS = {
    "ardupilot": "a real ArduPilot SITL binary on this aircraft, and the devices",
    "px4": "a real PX4 SITL binary on this aircraft, and the devices",
    "residuals": "what each calibration leaves in a real autopilot, as a table",
    "compasses": "heading error that each compass calibration leaves on a real autopilot, as a table",
}
"""Commands that `sim.sitl.cli` handles."""


def parser() -> argparse.ArgumentParser:
    top = argparse.ArgumentParser(
        prog="python -m sim",
        description="A virtual aircraft that stands still somewhere near Beijing: its sensors and its autopilot.",
    )
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, text in (
        ("devices", "serial IMU, gradienter and compass on pseudo-terminals"),
        ("autopilot", "an ArduPilot or PX4 double on UDP"),
        ("all", "both, on one aircraft"),
    ):
        command = commands.add_parser(name, help=text, description=text)
        add_world_options(command)
        command.add_argument(
            "--warms", type=float, nargs=3, metavar=("AIR", "RISE", "SECONDS"),
            help="air at so many degC, in which it gets so many kelvin warmer by itself, with that time constant; its"
            " IMUs have curves over temperature, by the seed (default: 25 degC, and nothing warms)",
        )  # fmt: skip
        command.add_argument(
            "--power-up", type=int, default=0, metavar="N",
            help="the same aircraft switched on another day: its biases are off by what its parts scatter (default 0)",
        )  # fmt: skip
        if name != "autopilot":
            tables: tuple[Iterable[str], ...] = (IMUS, GRADIENTERS, COMPASSES)
            for role, table, usual in zip(Devices._fields, tables, DEMO_DEVICES, strict=True):
                command.add_argument(
                    f"--{role}", choices=tuple(table), default=usual,
                    help=f"family of the {role} (default {usual}); one name for two of them: one device on one port",
                )  # fmt: skip
            command.add_argument(
                "--without", nargs="+", choices=Devices._fields, default=(), metavar="DEVICE",
                help="leave out one or more of imu, gradienter, compass",
            )  # fmt: skip
            command.add_argument("--dir", type=Path, help="folder for the ports (default: a new one)")
        if name != "devices":
            command.add_argument(
                "--udp", type=address, metavar="HOST:PORT", default=DEFAULT_UDP,
                help=f"where the autopilot sends to (default {DEFAULT_UDP})",
            )  # fmt: skip
            command.add_argument(
                "--ground", type=address, metavar="HOST:PORT", help="second port, for a ground station"
            )  # fmt: skip
            command.add_argument(
                "--firmware", choices=("ardupilot", "px4"), default="ardupilot",
                help="whose manners the autopilot has (default ardupilot)",
            )  # fmt: skip
            command.add_argument(
                "--signing", metavar="PASSPHRASE",
                help="sign, and take only what is signed with this key, as autopilots do that were given one",
            )  # fmt: skip
            command.add_argument(
                "--gyr-cal", action="store_true", help="INS_GYR_CAL = 1: ArduPilot calibrates its gyros at boot"
            )
        add_hands(command)
        command.add_argument(
            "--zero", type=float, nargs=2, metavar=("X", "Y"), default=GRADIENTER_OFFSET_DEG,
            help="what the gradienter shows too much, degrees (default 0.003 -0.002)",
        )  # fmt: skip
    commands.add_parser("demo", help="the whole chain, with a result to look at")
    commands.add_parser("fleet", help="thirty aircraft, a broker and a fleet's collector with its page, until Ctrl-C")
    for name, text in FIRMWARE_COMMANDS.items():
        commands.add_parser(name, help=text)
    commands.add_parser("fly", help="a real firmware flies with our heading, and something fails")
    commands.add_parser("recordings", help="is sigma honest on recordings of real sensors at rest")
    commands.add_parser("rest", help="a log of an IMU at rest for hours, to try `companion log profile` with")
    accuracy.add_options(commands.add_parser("accuracy", help=accuracy.HELP))
    return top


def add_world_options(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--pose", type=float, nargs=3, metavar=("PITCH", "ROLL", "HEADING"),
        default=(DEMO_POSE.pitch_deg, DEMO_POSE.roll_deg, DEMO_POSE.heading_deg),
        help="degrees: nose up +, right side down +, clockwise from true north (default 5 -3 40; --hands 0.6 -0.4 40)",
    )  # fmt: skip
    command.add_argument("--seed", type=int, default=0, help="the same seed gives the same noise (default 0)")
    command.add_argument(
        "--motion", choices=MOTIONS, default="still",
        help="what happens to it all the time: a slow turn; a sea with that turn; a running engine with both",
    )  # fmt: skip
    command.add_argument(
        "--turn", type=float, metavar="DEG_S", default=TURN_DEG_S,
        help=f"how fast that turn is (default {TURN_DEG_S:g})",
    )  # fmt: skip


def add_hands(command: argparse.ArgumentParser) -> None:
    command.add_argument("--hands", action="store_true", help=f"move the aircraft by lines typed here: {HANDS}")
    command.set_defaults(pose=None)


def pose_of(arguments: argparse.Namespace) -> Pose:
    if arguments.pose is None:
        return FLAT_POSE if arguments.hands else DEMO_POSE
    return Pose(*arguments.pose)


def hands_of(arguments: argparse.Namespace, scenario: Scenario) -> Hands | None:
    """Return the hands that obey typed lines, if --hands is given."""
    if not arguments.hands:
        return None
    return Hands(scenario.aircraft, placement_deg=PLACEMENT_DEG, propped_deg=PROPPED_DEG, seed=arguments.seed)


def address(text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not host or not port.isdigit() or not 0 < int(port) < 65536:
        raise argparse.ArgumentTypeError(f"found {text!r}; allowed: HOST:PORT with a port from 1 to 65535")
    return host, int(port)


def configuration(scenario: Scenario, *, directory: Path | None, udp: tuple[str, int] | None) -> str:
    """Return a companion configuration for the devices and autopilot that are served; comments say what is missing."""
    lines = ["[mavlink]"]
    if udp is not None and directory is not None:
        ports = " ".join(shlex.quote(str(directory / name)) for name in scenario.ports)
        lines = [f"# Or by questions: companion -c companion.toml setup {ports} --udp {udp[1]}", *lines]
    if udp is None:
        lines.append("# no autopilot is simulated here; `python -m sim autopilot` is one")
    lines.append(f'url = "udpin:{udp[0]}:{udp[1]}"' if udp else f'url = "udpin:{DEFAULT_UDP}"')
    if udp is not None:
        part = scenario.flight_controller_imus[0].spec.name
        lines += ["", "[[imu]]", 'name = "fc"', 'source = "autopilot"', "instance = 1"]
        lines.append(f'profile = "{_PROFILES.get(part, part)}"')
    if directory is None:
        site = scenario.aircraft.site
        lines += ["", f"# no gradienter, no compass; the site is {site.latitude_deg} {site.longitude_deg}"]
        return "\n".join(lines) + "\n"
    part = scenario.serial_imu.spec.name
    for role, head, last in (
        ("imu", '[[imu]]\nname = "own"\nsource = "serial"', f'profile = "{_PROFILES.get(part, part)}"'),
        ("gradienter", "[gradienter]", f'law = "{scenario.gradienter_law}"'),
        ("compass", "[compass]", 'reference = "magnetic"'),
    ):
        if role not in scenario.without:
            lines += ["", head, *_device_lines(scenario, directory, role), last]
    # Beside the ports, so that no root is needed to try.
    lines += ["", "[control]", f'socket = "{directory / "control.sock"}"']
    lines += ["", "[storage]", f'directory = "{directory / "state"}"']
    lines += ["", "# A page for a browser: remove the # of these two lines.", "# [web]", '# bind = "127.0.0.1:8191"']
    if udp is None:
        site = scenario.aircraft.site
        lines += ["", "[vehicle]", f"latitude_deg = {site.latitude_deg}", f"longitude_deg = {site.longitude_deg}"]
        lines.append(f"height_m = {site.height_m}")
    return "\n".join(lines) + "\n"


def _device_lines(scenario: Scenario, directory: Path, role: str) -> list[str]:
    device: SerialDevice = getattr(scenario, role)
    fitting = fit(role, device.protocol)
    port = next(name for name, each in scenario.ports.items() if each is device)
    lines = [f'port = "{directory / port}"', f"baud = {device.baud}", f'protocol = "{device.protocol}"']
    if any(fitting.mounting_deg):
        lines.append(f"mounting = {list(fitting.mounting_deg)}")
    if max(map(abs, getattr(device, "offset_deg", ()) or (0.0,))) > 0.01:
        # A zero that nobody has measured: that is for `companion align` to do.
        lines.append("sigma_deg = 0.1")
    elif fitting.sigma_deg is not None:
        lines.append(f"sigma_deg = {fitting.sigma_deg:g}")
    return lines


def describe(scenario: Scenario, *, devices: bool, autopilot: bool, t_s: float = 0.0) -> str:
    """Describe the truth in a few lines: pose at aircraft time `t_s`, biases averaged over the minute before."""
    pose = scenario.aircraft.pose_at(t_s) if t_s else scenario.aircraft.pose
    when = f"of the last minute, at {t_s:.0f} s" if t_s else "at the start"
    roll_deg = math.remainder(pose.roll_deg, 360.0)
    angles = f"pitch {pose.pitch_deg:g}, roll {roll_deg:g}, heading {pose.heading_deg % 360.0:g} deg"
    lines = [f"# The truth {when}: {angles}; declination {scenario.aircraft.site.declination_deg:.2f} deg"]
    models: list[tuple[str, ImuModel]] = []
    if autopilot:
        models += [(f"autopilot IMU {n}", model) for n, model in enumerate(scenario.flight_controller_imus, 1)]
    if devices:
        models.append(("serial IMU", scenario.serial_imu))
    for name, model in models:
        gyro, accel = model.mean_bias(max(t_s - TRUTH_S, 0.0), t_s)
        rates = ", ".join(f"{value / DEG_H:.1f}" for value in model.mounting @ gyro)
        forces = ", ".join(f"{value / MG:.3f}" for value in model.mounting @ accel)
        lines.append(f"# {name} ({model.spec.name}): gyro bias {rates} deg/h; accelerometer bias {forces} mg")
    return "\n".join(lines) + "\n"


async def serve(
    scenario: Scenario,
    *,
    directory: Path | None = None,
    udp: tuple[str, int] | None = None,
    ground: tuple[str, int] | None = None,
    started: asyncio.Event | None = None,
    hands: Hands | None = None,
    beside: Coroutine[None, None, None] | None = None,
) -> None:
    """Serve until cancelled: devices if there is a directory, the autopilot if there is an address to send to.

    The tasks of `beside` run with them.
    """
    async with contextlib.AsyncExitStack() as stack:
        scenario.aircraft.begin(asyncio.get_running_loop().time())
        running: list[asyncio.Task[None]] = []
        if directory is not None:
            for name, device in scenario.ports.items():
                pty = await stack.enter_async_context(PtyDevice(device, directory / name, line=Setting(device.baud)))
                running.append(asyncio.create_task(pty.wait_closed(), name=f"watch {name}"))
        if udp is not None:
            companion = await open_udp(scenario.autopilot, target=udp)
            stack.callback(companion.close)
            running.append(asyncio.create_task(scenario.autopilot.run(), name="sim autopilot"))
        if udp is not None and ground is not None:
            station = await open_udp(scenario.autopilot.ground, target=ground)
            stack.callback(station.close)
        if hands is not None:

            def truth(t_s: float) -> str:
                autopilot = udp is not None or beside is not None
                text = describe(scenario, devices=directory is not None, autopilot=autopilot, t_s=t_s)
                return text.removeprefix("# ").rstrip()

            told = take_lines(hands, scenario.aircraft, lambda words: print(f"# {words}", flush=True), truth)
            running.append(asyncio.create_task(told, name="hands"))
        if beside is not None:
            running.append(asyncio.create_task(beside, name="beside"))
        if started is not None:
            started.set()
        try:
            await asyncio.gather(*running)
        finally:
            for task in running:
                task.cancel()
            await asyncio.gather(*running, return_exceptions=True)


def main(argv: Sequence[str]) -> int:
    arguments = parser().parse_args(argv)
    devices, autopilot = arguments.command != "autopilot", arguments.command != "devices"
    scenario = demo(
        pose=pose_of(arguments),
        seed=arguments.seed,
        unix_s=time.time(),
        motions=motions_of(arguments.motion, seed=arguments.seed, turn_deg_s=arguments.turn),
        gradienter_offset_deg=(arguments.zero[0], arguments.zero[1]),
        gyr_cal_at_boot=autopilot and arguments.gyr_cal,
        firmware=arguments.firmware if autopilot else "ardupilot",
        devices=(arguments.imu, arguments.gradienter, arguments.compass) if devices else DEMO_DEVICES,
        warms=arguments.warms,
        power_up=arguments.power_up,
    )
    scenario = dataclasses.replace(scenario, without=frozenset(getattr(arguments, "without", ())))
    directory: Path | None = None
    made_here = devices and arguments.dir is None
    if devices:
        directory = Path(tempfile.mkdtemp(prefix="companion-sim-")) if made_here else arguments.dir.absolute()
    udp = arguments.udp if autopilot else None
    text = describe(scenario, devices=devices, autopilot=autopilot)
    if autopilot and arguments.signing is not None:
        # As Mission Planner and MAVProxy make a key of a passphrase; time is 10 us since 2015.
        key = hashlib.sha256(arguments.signing.encode()).digest()
        scenario.autopilot.require_signatures(key, int((time.time() - 1420070400) * 1e5))
        text += "# It wants signatures: put the passphrase into a file (chmod 600), and below [mavlink]\n"
        text += '# signing_key_file = "/path/of/that/file"\n'
    if arguments.motion != "still":
        text += '# What it stands on moves: it waits, and says so, unless [vehicle] says platform = "deck"\n'
    text += configuration(scenario, directory=directory, udp=udp)
    hands = hands_of(arguments, scenario)
    try:
        ground = arguments.ground if autopilot else None
        return asyncio.run(
            run_until_stopped(
                lambda started: serve(
                    scenario, directory=directory, udp=udp, ground=ground, started=started, hands=hands
                ),
                lambda: text,
            )
        )
    except OSError as error:
        print(f"python -m sim: {error}", file=sys.stderr)
        return 1
    finally:
        if made_here and directory is not None:
            with contextlib.suppress(OSError):
                os.rmdir(directory)


async def run_until_stopped(
    serve: Callable[[asyncio.Event], Coroutine[None, None, None]], text: Callable[[], str]
) -> int:
    """Serve until Ctrl-C or SIGTERM, and print how to use it once it is up; return the exit code.

    Args:
        serve: serves until cancelled, and sets the event when everything is up. Its exceptions are raised here.
        text: returns truth and configuration, once everything is up.
    """
    started = asyncio.Event()
    serving = asyncio.create_task(serve(started))
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, serving.cancel)

    async def announce() -> None:
        await started.wait()
        print("# Ready. Save these lines as companion.toml and run: companion -c companion.toml run")
        print("# Ctrl-C ends the simulation.")
        print("# Gyro biases wander by some 10 deg/h in minutes: with --hands, the line `truth` shows them.")
        print(text(), flush=True)

    announcing = asyncio.create_task(announce())
    with contextlib.suppress(asyncio.CancelledError):
        await serving
    announcing.cancel()
    await asyncio.gather(announcing, return_exceptions=True)
    return 0
