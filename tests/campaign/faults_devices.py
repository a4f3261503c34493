"""Faults of our own sensors: unplugged, silent, wrong, moved."""

from __future__ import annotations

import functools
import re
import struct
from collections.abc import Callable, Iterator

from sim.devices import Frame, VectorNavBinary, vectornav_packet
from sim.motions import Handling, Turn
from sim.pty_device import Setting, heard
from tests.campaign.fault import Act, Fault, Scene

STILLNESS = r"still|moved|moving|wait|spread|disagree|not quiet|jump"
device_fault = functools.partial(Fault, room="device", excused=STILLNESS)

IMU, TILT, COMPASS = "own", "gradienter", "compass"
WHAT = {IMU: "serial IMU", TILT: "gradienter", COMPASS: "compass"}
SHORT = {IMU: "imu", TILT: "gradienter", COMPASS: "compass"}
BAUD = {IMU: 115200, TILT: 9600, COMPASS: 19200}

Mangle = Callable[[list[Frame]], bytes]


def mangled(name: str, make: Callable[[Scene], Mangle]) -> tuple[Act, Act]:

    async def strike(scene: Scene) -> None:
        scene.stage.mangle[name] = make(scene)

    async def lift(scene: Scene) -> None:
        scene.stage.mangle.pop(name, None)

    return strike, lift


def pulled(name: str) -> tuple[Act, Act]:
    async def strike(scene: Scene) -> None:
        await scene.stage.plugs[name].pull_out()

    async def lift(scene: Scene) -> None:
        await scene.stage.plugs[name].put_in()

    return strike, lift


def silenced(name: str) -> tuple[Act, Act]:
    async def strike(scene: Scene) -> None:
        scene.stage.unplugged.add(name)

    async def lift(scene: Scene) -> None:
        scene.stage.unplugged.discard(name)

    return strike, lift


def garbage(scene: Scene) -> Mangle:
    return lambda frames: scene.chance.randbytes(sum(len(frame.data) for frame in frames))


def wrong_speed(name: str) -> Callable[[Scene], Mangle]:
    mine, theirs = Setting(BAUD[name]), Setting(BAUD[name] // 2 if name == IMU else 38400)
    return lambda _: lambda frames: b"".join(heard(frame.data, mine, theirs) for frame in frames)


def damaged(scene: Scene) -> Mangle:

    def mangle(frames: list[Frame]) -> bytes:
        data = b"".join(frame.data for frame in frames)
        return bytes(byte for byte in data if scene.chance.random() > 0.02)

    return mangle


def flood(scene: Scene) -> Mangle:
    return lambda frames: b"".join(frame.data for frame in frames) + scene.chance.randbytes(120_000)


def stuck_imu(scene: Scene) -> Mangle:
    reading = [0.001, -0.002, 0.0015, 0.1, -0.2, -9.79]

    def mangle(frames: list[Frame]) -> bytes:
        return b"".join(vectornav_packet(_startup_s(frame.data), reading, 30.0) for frame in frames)

    return mangle


def spiky_imu(scene: Scene) -> Mangle:

    def mangle(frames: list[Frame]) -> bytes:
        out = b""
        for frame in frames:
            if scene.chance.random() < 0.1:
                wild = scene.chance.choice((1e6, 34.9, -80.0))
                out += vectornav_packet(_startup_s(frame.data), [wild] * 3 + [wild * 9.8] * 3, 30.0)
            else:
                out += frame.data
        return out

    return mangle


def nan_imu(scene: Scene) -> Mangle:
    values = [scene.chance.choice((float("nan"), float("inf"))) for _ in range(6)]
    return lambda frames: b"".join(vectornav_packet(_startup_s(frame.data), values, 30.0) for frame in frames)


def _startup_s(packet: bytes) -> float:
    return float(struct.unpack_from("<Q", packet, 6)[0]) * 1e-9


def spiky_tilt(scene: Scene) -> Mangle:
    def mangle(frames: list[Frame]) -> bytes:
        wild = b"X=+44.999\r\nY=-37.123\r\n"
        return b"".join(wild if scene.chance.random() < 0.15 else frame.data for frame in frames)

    return mangle


def repeats_last(scene: Scene) -> Mangle:
    last: list[bytes] = []

    def mangle(frames: list[Frame]) -> bytes:
        if frames and not last:
            last.append(frames[-1].data)
        return b"".join(last[0] for _ in frames) if last else b""

    return mangle


async def stick_and_tilt(scene: Scene) -> None:
    """The gradienter hangs, and then somebody sets the aircraft down differently.

    In between lie whole seconds of the IMUs: without one nobody could know that it was tilted since.
    """
    stage = scene.stage
    stage.mangle[TILT] = repeats_last(scene)
    now_s = stage.aircraft.time_at(stage.now_s)
    stage.aircraft.add(Turn(start_s=now_s + 2.5, duration_s=1.0, roll_deg=7.0, pitch_deg=-4.0))


async def unstick(scene: Scene) -> None:
    """It has been said by now, whatever goes on: by the status, in the log, and to the ground stations."""
    stage = scene.stage
    faces = {"status": stage.words(), "log": stage.said.lines, "ground station": stage.ground.texts()}
    if scene.phase == "armed":
        faces["headline"] = [stage.service.status()["headline"]["reason"]]
    silent = [
        face
        for face, lines in faces.items()
        if not any(re.search(r"gradienter.*stuck|: stuck:", line) for line in lines)
    ]
    stage.mangle.pop(TILT, None)
    assert not silent, f"a stuck gradienter is not named by: {', '.join(silent)}"


async def handle(scene: Scene) -> None:
    stage = scene.stage
    duration_s = scene.chance.uniform(1.0, 6.0)
    now_s = stage.aircraft.time_at(stage.now_s)
    stage.aircraft.add(Handling(start_s=now_s, duration_s=duration_s, seed=scene.chance.randrange(99)))


async def set_down(scene: Scene) -> None:
    stage = scene.stage
    now_s = stage.aircraft.time_at(stage.now_s)
    angles = {name: scene.chance.uniform(-12.0, 12.0) for name in ("roll_deg", "pitch_deg", "heading_deg")}
    stage.aircraft.add(Turn(start_s=now_s, duration_s=1.5, **angles))


async def restart_imu(scene: Scene) -> None:
    """Restart the clock of the IMU at zero after a moment without power."""
    stage = scene.stage
    stage.devices[IMU].power_on(stage.aircraft.time_at(stage.now_s) + 0.4)


async def double_rate(scene: Scene) -> None:
    stage = scene.stage
    device = stage.devices[IMU]
    assert isinstance(device, VectorNavBinary)
    scene.notes["rate"] = device
    stage.devices[IMU] = faster = VectorNavBinary(stage.own_model, rate_hz=2 * device.rate_hz)
    faster.power_on(stage.aircraft.time_at(stage.now_s))


async def usual_rate(scene: Scene) -> None:
    stage = scene.stage
    stage.devices[IMU] = device = scene.notes["rate"]
    device.power_on(stage.aircraft.time_at(stage.now_s))


async def swap(scene: Scene) -> None:
    plugs = scene.stage.plugs
    plugs[TILT], plugs[COMPASS] = plugs[COMPASS], plugs[TILT]


def _each() -> Iterator[Fault]:
    for name, what in WHAT.items():
        short = SHORT[name]
        yield device_fault(
            f"{short}-unplugged", f"the {what}'s plug is pulled and put in again", *pulled(name),
            names=r"nobody listens|closed the connection|refused|reset by peer"
        )  # fmt: skip
        yield device_fault(
            f"{short}-silent", f"the {what} says nothing", *silenced(name), lasts_s=(4.5, 9.0),
            names=r"silent|asked anew"
        )  # fmt: skip
        if name == COMPASS:
            continue
        yield device_fault(
            f"{short}-garbage", f"random bytes come in the place of the {what}'s", *mangled(name, garbage),
            lasts_s=(4.5, 9.0), names=r"bytes come, but no|damaged"
        )  # fmt: skip
        if name != IMU:
            continue  # what such noise looks like is the decoders' business: tests/e2e/test_serial_misbehaviour.py
        yield device_fault(
            f"{short}-baud", f"the {what}'s line is read at another speed", *mangled(name, wrong_speed(name)),
            lasts_s=(4.5, 9.0), names=r"bytes come, but no|damaged|silent"
        )  # fmt: skip


def faults() -> list[Fault]:
    return [
        *_each(),
        device_fault(
            "imu-stuck",
            "the serial IMU repeats one reading with a clock that goes on",
            *mangled(IMU, stuck_imu),
            lasts_s=(4.0, 8.0),
            names=r"stuck",
        ),
        device_fault("imu-spikes", "one reading in ten of the serial IMU cannot be", *mangled(IMU, spiky_imu)),
        device_fault(
            "imu-nan",
            "the serial IMU gives NaN and infinity in whole frames",
            *mangled(IMU, nan_imu),
            lasts_s=(4.5, 8.0),
            names=r"NaN|no valid|not finite|non-finite",
        ),
        device_fault(
            "imu-clock",
            "the serial IMU starts anew, its clock from zero",
            restart_imu,
            names=r"restarted|clock went back|started anew|jumped",
        ),
        device_fault(
            "imu-double-rate",
            "the serial IMU sends twice as often",
            double_rate,
            usual_rate,
        ),
        device_fault(
            "gradienter-spikes",
            "the gradienter jumps by 40 deg now and then",
            *mangled(TILT, spiky_tilt),
        ),
        device_fault(
            "gradienter-stolen-bytes",
            "a second reader takes one of the gradienter's bytes in fifty",
            *mangled(TILT, damaged),
            lasts_s=(4.5, 9.0),
            names=r"damaged",
        ),
        device_fault(
            "gradienter-stuck",
            "the gradienter hangs while somebody tilts the aircraft",
            stick_and_tilt,
            unstick,
            lasts_s=(9.0, 14.0),
            names=r"stuck",
        ),
        device_fault(
            "compass-flood",
            "the compass sends over a megabyte a second",
            *mangled(COMPASS, flood),
            lasts_s=(4.0, 7.0),
            names=r"sends more than",
        ),
        device_fault(
            "swapped-plugs",
            "gradienter and compass are swapped and swapped back",
            swap,
            swap,
            lasts_s=(5.0, 9.0),
            names=r"this is (hmr3300|inclinometer)|bytes come, but no",
        ),
        device_fault("handled", "the aircraft is taken in hand and put back", handle),
        device_fault("set-down-differently", "the aircraft is set down in another pose", set_down),
    ]
