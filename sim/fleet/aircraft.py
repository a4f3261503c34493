"""Simulated aircraft of a fleet: each is a client of the broker, and keeps its items until they are confirmed.

They contain no daemon and no calibration: records are made from known biases, drawn from a seed.
"""

from __future__ import annotations

import asyncio
import contextlib
import datetime
import random
from typing import Any, Final

import aiomqtt
import msgspec

from companion.estimation.records.flight_record import AXES, Drift, ImuFlight, Split, Stages, Term
from companion.estimation.records.record import ArmingRecord, ImuRecord, Record, WrittenParameter
from companion.fleet.collector import stop
from companion.mqtt.fleet import FORMAT_VERSION
from companion.physics.units import DEG_H, MG
from companion.samples import Vector

WINDOW: Final = 8
"""Maximum number of unconfirmed items at a time."""
AGAIN_S: Final = 30.0
FIRST_WAIT_S: Final = 0.2
_NAMES: Final = ("Heron", "Crane", "Kite", "Swift", "Tern", "Stork", "Plover", "Wren", "Gannet", "Osprey")
_GYRO_IDS: Final = (2490378, 2490882)
_ACCEL_IDS: Final = (2490634, 2491138)
_LEAVES: Final = (aiomqtt.MqttError, OSError, TimeoutError)


class Aircraft:
    """One aircraft with two IMUs.

    `told` has the payloads of its items by sequence number; `biases` the true biases by sequence number and IMU.
    """

    def __init__(self, number: int, seed: int = 1) -> None:
        self._dice = random.Random(seed * 100_003 + number)
        self.name = f"{_NAMES[number % len(_NAMES)]} {number // len(_NAMES) + 1}"
        self.id = f"{number:08x}".ljust(36, "0")[::-1].replace("0", "1", 1)
        self.epoch = f"{self._dice.getrandbits(64):016x}"
        self.told: dict[int, bytes] = {}
        self.biases: dict[int, dict[str, tuple[Vector, Vector]]] = {}
        self.confirmed: set[int] = set()
        self.deliveries = 0
        self.again_s = AGAIN_S
        self.moved_rad_s = 0.0
        """Step of the bias of the first gyro of its second IMU: a fault."""
        self._of_imus = [(self._triad(120.0 * DEG_H), self._triad(4.0 * MG)) for _ in range(2)]
        self._changed = asyncio.Event()
        self._wanted: set[int] = set()
        self._calibration: str | None = None

    def _triad(self, sigma: float) -> Vector:
        return self._dice.gauss(0.0, sigma), self._dice.gauss(0.0, sigma), self._dice.gauss(0.0, sigma)

    # --- what happens to it

    def tell(self, kind: str, at: datetime.datetime, body: Any) -> int:
        """Store an item until it is confirmed; return its sequence number."""
        sequence = len(self.told) + 1
        item = {"format_version": FORMAT_VERSION, "aircraft": self.id, "epoch": self.epoch, "sequence": sequence}
        self.told[sequence] = msgspec.json.encode(
            {**item, "kind": kind, "at": _iso(at), "clock": "good", "body": msgspec.to_builtins(body)}
        )
        self._changed.set()
        return sequence

    def calibrate(self, at: datetime.datetime, reason: str = "", *, held_back: bool = False) -> int:
        """Calibrate at a new power-up; with a `reason`, the calibration fails."""
        degc = self._dice.uniform(15.0, 45.0)
        true = {} if reason else {f"fc{k + 1}": self._power_up(k, degc) for k in range(2)}
        imus = tuple(self._imu(name, k, degc, *each) for k, (name, each) in enumerate(sorted(true.items())))
        if held_back:
            imus = (msgspec.structs.replace(imus[0], held_back=("gyro",)), *imus[1:])
        record = Record(
            state="failed" if reason else "done",
            reason=reason,
            warnings=(),
            started_at=_iso(at),
            duration_s=round(self._dice.uniform(12.0, 60.0), 1),
            pose=None,
            site=None,
            imus=imus,
            system_id=1,
        )
        sequence = self.tell("calibration", at + datetime.timedelta(seconds=record.duration_s), record)
        if not reason:
            self.biases[sequence], self._calibration = true, record.started_at
        return sequence

    def arm(self, at: datetime.datetime) -> int:
        known = self._calibration is not None
        arming = ArmingRecord(
            armed_at=_iso(at),
            state="calibrated" if known else "uncalibrated",
            reason="" if known else "never calibrated",
            at_arm="warn",
            calibration=self._calibration,
            calibrated_ago_s=None,
            confirmed_ago_s=None,
            gyro_sigma_use_rad_s=3.5 * DEG_H if known else None,
            accel_sigma_use_m_s2=0.12 * MG if known else None,
        )
        return self.tell("arming", at, arming)

    def undo(self, at: datetime.datetime) -> int:
        of, self._calibration = self._calibration, None
        return self.tell("undo", at, {"what": "calibration", "of": of, "undone_at": _iso(at)})

    def learn(self, at: datetime.datetime) -> None:
        """Report the temperature curves of its IMUs."""
        for k in range(2):
            true = [(degc, *self._biases(k, degc)) for degc in range(15, 46)]
            gyro = [{"degc": degc, "gyro_deg_h": _in(DEG_H, of), "sigma_deg_h": (5.0,) * 3} for degc, of, _ in true]
            accel = [{"degc": degc, "accel_mg": _in(MG, of), "sigma_mg": (0.1,) * 3} for degc, _, of in true]
            known = {"imu": f"fc{k + 1}", "power_ups": len(self.biases), "days": len(self.biases)}
            self.tell("curve", at, {**known, "curve": gyro, "accel_curve": accel})

    def fly(self, at: datetime.datetime) -> int:
        """Make a flight whose log is read on the aircraft."""
        nothing: dict[str, Any] = dict.fromkeys((*ImuFlight.__struct_fields__, *Split.__struct_fields__))
        imus = []
        for k in range(2):
            axes = []
            for axis in AXES:
                sigma = 5.0 * DEG_H if axis.startswith("gyro") else 0.2 * MG
                before, step = self._dice.gauss(0.0, sigma), self._dice.gauss(0.0, 2.0 * sigma)
                terms = {"in_flight": before + step, "turn_on": before, "motors": step}
                axes.append({**nothing, "axis": axis, **{name: Term(terms[name], sigma) for name in terms}})
            about = {"imu": k + 1, "rate_hz": 400.0, "gyro_id": _GYRO_IDS[k], "accel_id": _ACCEL_IDS[k]}
            drift = {"flown": [Drift(30.0, 60, median := round(self._dice.uniform(1.5, 4.0), 1), 2.4 * median)]}
            its = {"calibration": self._calibration, "axes": axes, "drift": drift, "notes": ()}
            imus.append({**nothing, **about, **its})
        flight = {"key": f"{self.epoch} {_iso(at)}", "system_id": 1, "began_at": _iso(at), "reference": "ekf"}
        flight |= {"stages": Stages(40.0, 42.0, 45.0, 610.0, 612.0), "imus": imus, "notes": ()}
        log = {"format_version": 1, "log": "00000012.BIN", "read_at": _iso(at)}
        return self.tell("flight", at + datetime.timedelta(minutes=15), {**log, "flight": flight})

    def live(self, until: datetime.datetime, flights: int, days: float = 90.0) -> None:
        """Make flights in the days before, each with a calibration; some fail, some are undone."""
        days_ago = sorted((self._dice.uniform(0.05, days) for _ in range(flights)), reverse=True)
        for ago in days_ago:
            at = until - datetime.timedelta(days=ago)
            fate = self._dice.random()
            self.calibrate(at, "not still: gyro x 0.31 deg/s" if fate < 0.06 else "")
            if fate > 0.96 and self._calibration is not None:
                self.undo(at + datetime.timedelta(minutes=2))
            self.arm(at + datetime.timedelta(minutes=5))

    def _biases(self, imu: int, degc: float) -> tuple[Vector, Vector]:
        gyro, accel = self._of_imus[imu]
        x, y, z = (bias + (degc - 25.0) * DEG_H for bias in gyro)
        return (x + self.moved_rad_s * imu, y, z), accel

    def _power_up(self, imu: int, degc: float) -> tuple[Vector, Vector]:
        gyro, accel = self._biases(imu, degc)
        x, y, z = (bias + each for bias, each in zip(gyro, self._triad(5.0 * DEG_H), strict=True))
        return (x, y, z), accel

    def _imu(self, name: str, k: int, degc: float, gyro: Vector, accel: Vector) -> ImuRecord:
        def measured(true: Vector, sigma: float) -> Vector:
            x, y, z = (each + self._dice.gauss(0.0, sigma) for each in true)
            return x, y, z

        return ImuRecord(
            name=name,
            samples=3000,
            temperature_degc=round(degc, 1),
            gyro_bias_rad_s=measured(gyro, 1.0 * DEG_H),
            gyro_sigma_stat_rad_s=(1.0 * DEG_H,) * 3,
            gyro_sigma_use_rad_s=(3.5 * DEG_H,) * 3,
            accel_bias_m_s2=measured(accel, 0.05 * MG),
            accel_sigma_stat_m_s2=(0.05 * MG,) * 3,
            accel_sigma_use_m_s2=(0.12 * MG,) * 3,
            covariance=None,
            residual_gyro_rad_s=None,
            residual_accel_m_s2=None,
            written={
                f"CAL_GYRO{k}_XOFF": WrittenParameter(before=0.0, after=gyro[0], read_back=gyro[0], outcome="stored")
            },
            gyro_id=_GYRO_IDS[k],
            accel_id=_ACCEL_IDS[k],
        )

    # --- how it tells

    @property
    def hello(self) -> bytes:
        """Return the hello message, which describes the stored items."""
        return msgspec.json.encode(
            {
                "format_version": FORMAT_VERSION,
                "aircraft": self.id,
                "name": self.name,
                "epoch": self.epoch,
                "first": 1,
                "last": len(self.told),
                "at": _iso(datetime.datetime.now(tz=datetime.UTC)),
            }
        )

    async def run(self, host: str, port: int) -> None:
        """Stay connected to the broker until cancelled; reconnect after every loss."""
        while True:
            with contextlib.suppress(*_LEAVES):
                async with aiomqtt.Client(host, port, identifier=f"aircraft-{self.id}") as client:
                    tasks = [asyncio.create_task(self._hear(client)), asyncio.create_task(self._tell(client))]
                    try:
                        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
                    finally:
                        await stop(tasks)
            await asyncio.sleep(FIRST_WAIT_S)

    async def _tell(self, client: aiomqtt.Client) -> None:
        for what in ("confirmed", "wanted"):
            await client.subscribe(f"fleet/{self.id}/{what}", qos=1)
        await client.publish(f"fleet/{self.id}/hello", self.hello, qos=1, retain=True)
        due_s: dict[int, float] = {}
        loop = asyncio.get_running_loop()
        while True:
            self._changed.clear()
            for sequence in self._wanted:
                self.confirmed.discard(sequence)
                due_s.pop(sequence, None)
            self._wanted.clear()
            waiting = [sequence for sequence in self.told if sequence not in self.confirmed][:WINDOW]
            for sequence in waiting:
                if due_s.get(sequence, 0.0) <= loop.time():
                    due_s[sequence] = loop.time() + self.again_s
                    self.deliveries += 1
                    await client.publish(f"fleet/{self.id}/item", self.told[sequence], qos=1)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(self.again_s if waiting else None):
                    await self._changed.wait()

    async def _hear(self, client: aiomqtt.Client) -> None:
        async for message in client.messages:
            said = msgspec.json.decode(message.payload, type=dict[str, Any])
            if said["epoch"] != self.epoch:
                continue
            named = {number for first, last in said["sequences"] for number in range(first, last + 1)}
            into = self.confirmed if message.topic.value.endswith("/confirmed") else self._wanted
            into |= named & self.told.keys()
            self._changed.set()


def _in(unit: float, axes: Vector) -> list[float]:
    return [round(each / unit, 3) for each in axes]


def _iso(at: datetime.datetime) -> str:
    return at.astimezone(datetime.UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
