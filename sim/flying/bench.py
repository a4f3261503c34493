"""`python -m sim fly-bench`: flights with known sensor errors, and what `companion flight` makes of their logs."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import math
import sys
import tempfile
import time
from collections import Counter
from collections.abc import AsyncIterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.flight.flight import Knowledge, flights, read
from companion.storage.learned import BiasStore
from companion.storage.records import RecordStore
from sim.companion_process import CompanionProcess
from sim.earth import Array, earth_rate_ned_rad_s
from sim.flying.ardupilot import FlyingArduPilot
from sim.flying.injected import AXES, BIASES, OFFSETS, Row, recovered, rows_of, serial_rows, told, truth_of
from sim.flying.px4 import FlyingPx4
from sim.flying.truth import FlyingAircraft
from sim.flying.vehicle import FlyingVehicle
from sim.imu_model import DEG_H, MG, PARTS
from sim.scenario import FIRST_ACCEL_MG, FIRST_GYRO_DEG_H, demo, site_at
from sim.serve import configuration
from sim.sitl.daemon import READY_WITHIN_S, devices
from sim.sitl.ground import GroundStation
from sim.sitl.ports import LOOPBACK, free_udp_port
from sim.sitl.process import BinaryError
from sim.sitl.residuals import GYROS, ground_station, own_calibration
from sim.thermal import Piece

HELP = "A real firmware flies with known sensor errors: what its log tells of them, and how far it drifts, as tables."
Kind = Literal["calm", "shaken", "warming"]
KINDS: tuple[Kind, ...] = ("calm", "shaken", "warming")
PART, SERIAL_PART = PARTS["icm42688p"], PARTS["bmi088"]
REFERENCE_DEGC = 25.0
LATITUDE_DEG = 45.54
"""Where normal gravity is 9.80665 m/s^2: ArduPilot's physics know no other."""
SETTLED_S, STOOD_S, HEIGHT_M = 12.0, 32.0, 10.0
LEVELS_M_S2 = (2.0, 5.0, 3.0, 7.0, 4.0, 6.0)
"""Amplitudes of the vibration, one after the other."""
LEVEL_S, TURN_DEG = 15.0, 90.0
VIBRATION_HZ = (137.0, 151.0, 163.0)
GYRO_SHAKES_DEG_S = 20.0
"""At full throttle; what SITL names for a copter of 180 mm."""
RISE_K, TCONST_S, FIXED_DEGC = 15.0, 300.0, (15.0, 40.0)
TRUTH_HZ = 25.0
"""While it calibrates it stands: its truth is asked for no oftener, so that nobody is held up when it hurries."""
OFTEN = 5
CALIBRATED_WITHIN_S = 240.0
STORED_S = 3.0
WIND = 3.0, 60.0
MORE = '\n[calibration]\nmin_still_s = {0}\nmax_s = {0}\nat_arm = "off"\n'
"""Noise of PX4's simulated gyros is ten times that of a good part: it stands twice as long."""
SPANS_S = (10, 30)
WITHIN = 1.5
"""Times the floor."""
OFFSETS_OF = {"before": "factory", "own": "the firmware's own", "flown": "ours", "perfect": "perfect"}
_LOGGED = 176126 | 1 | 1 << 18
"""ArduPilot's usual messages, IMU and attitude at the rate of its main loop."""
LOGGING = {
    "ardupilot": {
        "LOG_BITMASK": float(_LOGGED), "LOG_DISARMED": 1.0, "INS_ENABLE_MASK": 1.0, "EK3_IMU_MASK": 1.0,
        **{f"INS_ACC2OFFS_{axis}": 0.0 for axis in AXES},  # of one that is not there
        "SCR_ENABLE": 0.0, "SIM_GYR1_RND": GYRO_SHAKES_DEG_S,
        **{f"SIM_VIB_FREQ_{axis}": hz for axis, hz in zip(AXES, VIBRATION_HZ, strict=True)},
    },
    "px4": {"SDLOG_BACKEND": 1.0, "SDLOG_MODE": 1.0},
}  # fmt: skip


@dataclass(frozen=True)
class Draw:
    """What one flight is given; (6,) of gyros and accelerometers, rad/s and m/s^2."""

    kind: Kind
    piece: Piece
    turned_on: Array
    start_degc: float
    step: Array
    """At the motors' start."""
    slope: Array
    """For each m/s^2 of the vibration's amplitude, about its mean."""
    heading_deg: float
    serial: Array
    """Of the companion's own IMU: what it turned on with."""

    def shaken(self, level_m_s2: float) -> Array:
        """What the motors add."""
        return self.step + self.slope * (level_m_s2 - float(np.mean(LEVELS_M_S2)))


def draw(seed: int, number: int) -> Draw:
    """Of one piece for each seed: a power-up, a day and a propeller for each flight."""
    usual = np.concatenate([np.multiply(FIRST_GYRO_DEG_H, DEG_H), np.multiply(FIRST_ACCEL_MG, MG)])
    piece = PART.piece(np.random.default_rng([seed, 1]), usual)
    dice = np.random.default_rng([seed, 1, number])
    kind = KINDS[number % len(KINDS)]
    step, slope = np.zeros(6), np.zeros(6)
    turned_on, degc, heading_deg = piece.turned_on(dice), dice.uniform(*FIXED_DEGC), dice.uniform(0.0, 360.0)
    if kind != "calm":
        step[:3], slope[:3] = dice.normal(0.0, 30.0 * DEG_H, 3), dice.normal(0.0, 10.0 * DEG_H, 3)
        step[5] = dice.choice([-1.0, 1.0]) * dice.uniform(2.0, 6.0) * MG
        slope[5] = dice.normal(0.0, 0.5 * MG)
    serial = SERIAL_PART.piece(np.random.default_rng([seed, 2]), usual).turned_on(dice)
    return Draw(kind, piece, turned_on, degc, step, slope, heading_deg, serial)


@dataclass
class Sensor:
    """The firmware's first IMU, as the bench gives it errors.

    ArduPilot simulates them. PX4's simulated IMU has none: there an offset that is set by so much less is the same.
    """

    ground: GroundStation
    bias: Array = field(default_factory=lambda: np.zeros(6))

    @property
    def _px4(self) -> bool:
        return self.ground.firmware == "px4"

    def parameters(self, offsets: Array) -> dict[str, float]:
        """That stand for so much of offsets."""
        told = offsets - self.bias if self._px4 else offsets
        return dict(zip(OFFSETS[self.ground.firmware], told.tolist(), strict=True))

    async def offsets(self) -> Array:
        """In force."""
        found = np.array([await self.ground.get(name) for name in OFFSETS[self.ground.firmware]])
        return found + self.bias if self._px4 else found

    async def put_offsets(self, offsets: Array) -> None:
        """In force from now on."""
        await self.ground.put_all(self.parameters(offsets))

    async def feel(self, bias: Array) -> None:
        """It reads so much too much from now on."""
        moved = np.flatnonzero(bias != self.bias)
        if self._px4 and len(moved):
            offsets, self.bias = await self.offsets(), bias
            told = self.parameters(offsets)
        else:
            self.bias, told = bias, dict(zip(BIASES, bias.tolist(), strict=True))
        wanted = list(told.items())
        await self.ground.put_all(dict(wanted[k] for k in moved))


class BenchFlight:
    """One power-up from the bench to the end of its log."""

    def __init__(self, drawn: Draw, vehicle: FlyingVehicle, ground: GroundStation, folder: Path) -> None:
        self._drawn, self._vehicle, self._ground, self._folder = drawn, vehicle, ground, folder
        self._sensor = Sensor(ground)
        self._steering: asyncio.Task[None] | None = None
        self.own: dict[str, float] = {}
        """What the firmware's own calibration sets."""
        self.motors_s = self.end_s = math.nan
        """On its clock."""
        self._z_shaken = math.nan
        self.serial: list[Row] = []
        """What the calibration has found of the companion's own IMU."""

    @property
    def _on_earth(self) -> Array:
        """ArduPilot's physics do not turn the Earth: its rate is an error of the sensor while one calibrates."""
        if self._vehicle.firmware == "px4":
            return np.zeros(6)
        rate = self._vehicle.aircraft.body_from_ned(self._vehicle.now_s) @ earth_rate_ned_rad_s(LATITUDE_DEG)
        return np.concatenate([rate, np.zeros(3)])

    async def power_up(self) -> None:
        """The sensor as this power-up has it, with the offsets of the factory."""
        drawn = self._drawn
        usual = drawn.piece.usual
        bias = drawn.turned_on
        if self._vehicle.firmware == "px4":
            bias = bias + drawn.piece.curve.at(drawn.start_degc - REFERENCE_DEGC)
        else:
            await self._ground.put_all(_temperature(drawn))
        await self._vehicle.sleep(SETTLED_S)
        await self._sensor.feel(bias + self._on_earth)
        await self._sensor.put_offsets(usual)
        if self._vehicle.firmware == "px4":
            await self._vehicle.sleep(STORED_S)
            await self._vehicle.power_cycle()  # it takes small offsets at its start only
            await self._vehicle.sleep(SETTLED_S)
        words = await own_calibration(self._vehicle, self._ground, *GYROS)
        print(f"own gyro calibration: {words}", file=sys.stderr, flush=True)
        own = await self._sensor.offsets()
        await self._sensor.put_offsets(usual)
        self.own = self._sensor.parameters(np.concatenate([own[:3], usual[3:]]))

    async def calibrate(self, boot: int) -> None:
        """By the real daemon, on another start of its board for each flight.

        Raises:
            RuntimeError: it failed.
        """
        vehicle, folder = self._vehicle, self._folder
        scenario, environment = vehicle.scenario, {"COMPANION_BOOT_ID": f"{boot:032x}"}
        host, port = vehicle.url.removeprefix("udpin:").rsplit(":", 1)
        text = configuration(scenario, directory=folder, udp=(host, int(port)))
        still_s = 40 if vehicle.firmware == "px4" else 20
        (folder / "companion.toml").write_text(text + MORE.format(still_s), encoding="utf-8")
        scenario.serial_imu.turn_on(self._drawn.serial[:3], self._drawn.serial[3:])
        async with devices(scenario, folder), CompanionProcess(folder, environment=environment) as daemon:
            await daemon.ready(READY_WITHIN_S)
            record = await daemon.calibrate(CALIBRATED_WITHIN_S, progress=asyncio.subprocess.DEVNULL)
        if record["state"] != "done":
            raise RuntimeError(f"calibration: {record['reason']}")
        self.serial = serial_rows(record, scenario.serial_imu.mean_bias(vehicle.now_s - still_s, vehicle.now_s))

    async def fly(self, speed: float) -> None:
        """Stand, take off, hover while it shakes more and less; the log ends in the air.

        Raises:
            TimeoutError: it does not take off.
        """
        vehicle, ground, sensor = self._vehicle, self._ground, self._sensor
        bias = sensor.bias - self._on_earth
        if vehicle.firmware == "ardupilot":
            await sensor.feel(bias)
        else:
            self._z_shaken = float((await sensor.offsets() - bias - self._drawn.step)[5])
        await vehicle.sleep(STORED_S)
        await vehicle.hasten(ground, speed)
        await vehicle.sleep(STORED_S)
        await self._quieten()
        await vehicle.sleep(STOOD_S)
        if vehicle.sticks_us:
            self._steering = asyncio.create_task(vehicle.steer(ground))
        await asyncio.gather(vehicle.take_off(ground, HEIGHT_M), self._motors_start(bias))
        await vehicle.hold(ground)
        for number, level in enumerate(LEVELS_M_S2):
            await self._shake(bias, level)
            if number == len(LEVELS_M_S2) // 2:
                await vehicle.turn(ground, TURN_DEG)
            await vehicle.sleep(LEVEL_S)
        self.end_s = vehicle.physics_s

    async def _quieten(self) -> None:
        """What comes often is asked for once a second: at many times real time it would hold up all answers."""
        since_s = asyncio.get_running_loop().time()
        await asyncio.sleep(1.0)
        numbers = Counter(
            message.get_msgId() for _, message in self._ground.timed(mavlink.MAVLink_message, since_s=since_s)
        )
        for number in (number for number, count in numbers.items() if count > OFTEN):
            await self._ground.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, number, 1e6, wait_s=0.0)

    async def _motors_start(self, bias: Array) -> None:
        since_s = asyncio.get_running_loop().time()
        armed = mavlink.MAV_MODE_FLAG_SAFETY_ARMED
        await self._ground.wait_for(
            lambda: any(beat.base_mode & armed for beat in self._ground.vehicle_heartbeats(since_s)), 90.0, "arming"
        )
        self.motors_s = self._vehicle.physics_s
        await self._shake(bias, LEVELS_M_S2[0])

    async def _shake(self, bias: Array, level_m_s2: float) -> None:
        if self._vehicle.firmware == "ardupilot":
            await self._ground.put("SIM_ACC1_RND", level_m_s2)
            await self._sensor.feel(bias + self._drawn.shaken(level_m_s2))
        elif self._drawn.step[5]:
            # A step of more than 1 mg is all that it takes in the air. Once more each time: nobody waits for an answer.
            self._ground.send_put(OFFSETS["px4"][5], self._z_shaken)

    async def close(self) -> None:
        """End what was begun."""
        if self._steering is not None:
            self._steering.cancel()
            await asyncio.gather(self._steering, return_exceptions=True)


def _temperature(drawn: Draw) -> dict[str, float]:
    """Of ArduPilot's simulated IMU: its curve, and this power-up's warmth."""
    half_k = 45.0
    found = {
        "SIM_IMUT1_ENABLE": 1.0, "SIM_IMUT1_TMIN": REFERENCE_DEGC - half_k, "SIM_IMUT1_TMAX": REFERENCE_DEGC + half_k,
        "SIM_IMUT_FIXED": 0.0 if drawn.kind == "warming" else drawn.start_degc,
        "SIM_IMUT_START": drawn.start_degc - 0.5 * RISE_K, "SIM_IMUT_END": drawn.start_degc + 0.5 * RISE_K,
        "SIM_IMUT_TCONST": TCONST_S,
    }  # fmt: skip
    for n, powers in enumerate(drawn.piece.curve.powers, 1):
        names = [f"SIM_IMUT1_{kind}{n}_{axis}" for kind in ("GYR", "ACC") for axis in AXES]
        found |= dict(zip(names, (powers * 1e6).tolist(), strict=True))
    return found


@contextlib.asynccontextmanager
async def bench_flight(binary: Path, drawn: Draw, folder: Path, series: Path) -> AsyncIterator[BenchFlight]:
    """The firmware and a ground station; neither devices nor a daemon yet.

    Args:
        binary: the firmware.
        drawn: what it is given.
        folder: of this flight; does not exist.
        series: of what the companion keeps from one flight to the next.

    Raises:
        BinaryError: the firmware cannot be run.
        TimeoutError: something did not come up.
    """
    unix_s = time.time()
    aircraft = FlyingAircraft(site_at(LATITUDE_DEG, 9.0, 0.0, unix_s), heading_deg=drawn.heading_deg, unix_s=unix_s)
    scenario = demo(unix_s=unix_s, aircraft=aircraft)
    vehicle: FlyingVehicle
    if "px4" in binary.name:
        vehicle = FlyingPx4(binary, scenario, folder, wind=WIND, parameters=LOGGING["px4"], truth_hz=TRUTH_HZ)
    else:
        companion = LOOPBACK, free_udp_port()
        vehicle = FlyingArduPilot(
            binary, scenario, folder, companion=companion, wind=WIND, parameters=LOGGING["ardupilot"],
            reads_each=round(1000.0 / TRUTH_HZ),
        )  # fmt: skip
    async with vehicle, ground_station(vehicle) as ground:
        await ground.wait_for(lambda: bool(ground.vehicle_heartbeats()), 60.0, "a heartbeat")
        flight = BenchFlight(drawn, vehicle, ground, series)
        try:
            yield flight
        finally:
            await flight.close()


async def fly(binary: Path, seed: int, number: int, folder: Path, speed: float) -> dict[str, Any]:
    """One flight, and what its log has told: kind, rows, drift.

    Raises:
        BinaryError, RuntimeError, TimeoutError: it did not come about.
    """
    drawn, series = draw(seed, number), folder / "companion"
    series.mkdir(parents=True, exist_ok=True)
    here = folder / f"{number:02d}"
    async with bench_flight(binary, drawn, here, series) as flight:
        await flight.power_up()
        await flight.calibrate(1000 * seed + number)
        await flight.fly(speed)
    logs = sorted([*here.rglob("*.BIN"), *here.rglob("*.ulg")], key=lambda path: path.stat().st_mtime)
    if not logs:
        raise RuntimeError(f"no log in {here}")
    flown = told(logs[-1])
    # What a calibration without errors would have set: for what is there just before the motors.
    before_s = flight.motors_s - np.arange(1.0, 30.0, 0.1)
    left, _ = flown.left(before_s, flight.motors_s)
    names = OFFSETS[flown.firmware]
    perfect = flown.at(before_s[:1], names)[0] + left.mean(axis=0)
    others = {"own": flight.own, "perfect": dict(zip(names, perfect.tolist(), strict=True))}
    by_truth, by_ekf = await said_of(logs[-1], series / "state", others)
    rows = [*flight.serial, *rows_of(by_ekf, truth_of(flown, by_ekf, flight.end_s))]
    drift = {
        name: {each["seconds"]: each["median_m"] for each in spans}
        for name, spans in by_truth["imus"][0]["drift"].items()
    }
    # PX4's simulated board does not warm.
    kind = "shaken" if flown.firmware == "px4" and drawn.kind == "warming" else drawn.kind
    found = {"kind": kind, "rows": rows, "drift": {name: [of[s] for s in SPANS_S] for name, of in drift.items()}}
    (here / "said.json").write_text(json.dumps({"by truth": by_truth, "by EKF": by_ekf}), encoding="utf-8")
    (here / "found.json").write_text(json.dumps(found), encoding="utf-8")
    return found


async def said_of(log: Path, storage: Path, others: Mapping[str, Mapping[str, float]]) -> list[dict[str, Any]]:
    """What the companion says of a log's last flight: by the simulator's truth, and by the EKF as of every real one."""
    known = Knowledge(records=RecordStore(storage).history(), biases=BiasStore(storage).all(), others=others)
    *_, boot = read(log, lambda share: None)
    return [
        msgspec.to_builtins((await flights(each, known))[-1])
        for each in (boot, msgspec.structs.replace(boot, truth=None))
    ]


def tables(found: Sequence[dict[str, Any]]) -> list[str]:
    """Of all flights: what was recovered, and the drift."""
    lines = recovered([Row(*row) for each in found for row in each["rows"]])
    for kind in (*KINDS, "all"):
        some = [each["drift"] for each in found if kind in (each["kind"], "all")]
        if not some:
            continue
        lines += ["", f"{kind}, {len(some)} flights" + "".join(f"{f'{s} s':>12}{'of perfect':>12}" for s in SPANS_S)]
        floor = np.median([each["perfect"] for each in some], axis=0)
        for name, words in OFFSETS_OF.items():
            values = np.median([each[name] for each in some], axis=0)
            lines.append(
                f"  {words:20}" + "".join(f"{v:10.2f} m{v / f:12.2f}" for v, f in zip(values, floor, strict=True))
            )
    return lines


def parser() -> argparse.ArgumentParser:
    """Of `python -m sim fly-bench`."""
    command = argparse.ArgumentParser(prog="python -m sim fly-bench", description=HELP)
    command.add_argument("--binary", type=Path, help="the firmware: arducopter or px4 (without: the tables of --dir)")
    command.add_argument("--flights", type=int, default=15, help="how many (default 15)")
    command.add_argument("--first", type=int, default=0, metavar="N", help="number of the first (default 0)")
    command.add_argument("--seed", type=int, default=1, help="of the sensor; each flight is another power-up of it")
    command.add_argument("--speed", type=float, default=5.0, help="times real time, once it has calibrated (default 5)")
    command.add_argument("--dir", type=Path, help="keep all files here (default: a new folder)")
    return command


def main(argv: Sequence[str]) -> int:
    """Fly; 0 if all flights came about, 2 if one did not."""
    arguments = parser().parse_args(argv)
    folder = (arguments.dir or Path(tempfile.mkdtemp(prefix="companion-bench-"))).absolute()
    worst = 0
    for number in range(arguments.first, arguments.first + arguments.flights) if arguments.binary else ():
        try:
            found = asyncio.run(
                fly(arguments.binary, arguments.seed, number, folder / str(arguments.seed), arguments.speed)
            )
        except (BinaryError, RuntimeError, TimeoutError, OSError, KeyError, ValueError) as error:
            print(f"flight {number}: did not come about: {type(error).__name__}: {error}", file=sys.stderr, flush=True)
            worst = 2
            continue
        missed = [Row(*row) for row in found["rows"]]
        missed = [row for row in missed if not abs(row.found - row.true) <= 2.0 * row.sigma]
        print(f"flight {number}, {found['kind']}: {found['drift']}; beyond 2 sigma: {missed}", flush=True)
    seen = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(folder.rglob("found.json"))]
    print("\n".join(tables(seen)))
    print(f"Logs and the firmware's files: {folder}", file=sys.stderr)
    return worst
