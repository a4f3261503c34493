"""Faults of the wire, the autopilot, and strangers on the network."""

from __future__ import annotations

import asyncio
import functools
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.campaign.fault import PHASES, Act, Fault, Phase, Scene
from tests.campaign.faults_devices import STILLNESS
from tests.campaign.rough_wire import Stranger, malformed
from tests.support.component import CALIBRATE, CANCEL, UNDO, command_message

link_fault = functools.partial(Fault, room="link")
autopilot_fault = functools.partial(Fault, room="autopilot")
intruder_fault = functools.partial(Fault, room="intruder")

LOST = (
    r"heartbeat|does not answer|no answer|telemetry|not be put back|NOT restored|not read|lost|not seen"
    r"|restart|unknown whether|arm state unknown"
)
ARMED = r"armed|Armed"
WRITES = "writing"


def wire(**what: Any) -> tuple[Act, Act]:

    async def strike(scene: Scene) -> None:
        scene.notes["wire"] = {name: getattr(scene.stage.wire, name) for name in what}
        for name, value in what.items():
            setattr(scene.stage.wire, name, value)

    async def lift(scene: Scene) -> None:
        for name, value in scene.notes["wire"].items():
            setattr(scene.stage.wire, name, value)

    return strike, lift


def switched(**what: Any) -> tuple[Act, Act]:
    """Fields of the double's faults, and back."""

    async def strike(scene: Scene) -> None:
        faults = scene.stage.autopilot.faults
        scene.notes["faults"] = {name: getattr(faults, name) for name in what}
        for name, value in what.items():
            setattr(faults, name, value)

    async def lift(scene: Scene) -> None:
        for name, value in scene.notes["faults"].items():
            setattr(scene.stage.autopilot.faults, name, value)

    return strike, lift


def every(period_s: float, do: Any) -> tuple[Act, Act]:

    async def strike(scene: Scene) -> None:
        async def work() -> None:
            while True:
                do(scene)
                await asyncio.sleep(period_s)

        scene.notes["again"] = asyncio.create_task(work())

    async def lift(scene: Scene) -> None:
        scene.notes["again"].cancel()
        await asyncio.gather(scene.notes["again"], return_exceptions=True)

    return strike, lift


def stranger(scene: Scene, system: int, component: int) -> Stranger:
    """Return the same stranger every time, as its sequence numbers continue."""
    key = ("stranger", system, component)
    if key not in scene.notes:  # type: ignore[comparison-overlap]
        scene.notes[key] = Stranger(lambda: scene.stage.wire, system, component)  # type: ignore[index]
    found: Stranger = scene.notes[key]  # type: ignore[index]
    return found


# --- the link


def _flood(scene: Scene) -> None:
    other = stranger(scene, 9, 1)
    for k in range(150):
        other.say(mavlink.MAVLink_attitude_message(k, 0.1, 0.2, 0.3, 0.0, 0.0, 0.0))


def _neighbour(scene: Scene) -> None:
    """Another vehicle of the same kind: armed, with parameters and IMUs of its own."""
    other = stranger(scene, 2, 1)
    other.beat(armed=True, autopilot=3 if scene.stage.variant.name != "PX4" else 12)
    other.say(mavlink.MAVLink_raw_imu_message(1000, 500, -300, 200, 900, 900, 900, 0, 0, 0, 0, 3000))
    other.say(mavlink.MAVLink_param_value_message(b"INS_GYROFFS_X", 0.5, 9, 1000, 65535))
    other.say(mavlink.MAVLink_param_value_message(b"CAL_GYRO0_XOFF", 0.5, 9, 1000, 65535))
    other.say(mavlink.MAVLink_system_time_message(1_800_000_000_000_000, 5))
    other.say(command_message(CALIBRATE, 0.0, target=(2, 191)))


def link_faults() -> list[Fault]:
    rows = [
        ("loss", "30 % of all packets are lost", wire(loss=0.3), None, (4.0, 9.0)),
        ("cut", "nothing passes in either direction", wire(cut=True), r"heartbeat", (4.0, 9.0)),
        ("duplicates", "half of the packets come twice", wire(duplicate=0.5), None, (4.0, 9.0)),
        ("reordering", "a third of the packets are overtaken by later ones", wire(reorder=0.3), None, (4.0, 9.0)),
        ("delay", "everything is a second late", wire(late_s=1.0), None, (4.0, 9.0)),
        ("half-frames", "of a fifth of the packets only a part comes", wire(tear=0.2), None, (4.0, 9.0)),
        ("bit-errors", "a bit of every tenth packet is wrong", wire(flip=0.1), None, (4.0, 9.0)),
        ("flood", "1500 messages a second of another system", every(0.1, _flood), None, (2.0, 4.0)),
        ("neighbour", "another vehicle is heard: armed, with its own values", every(0.2, _neighbour), None, (4.0, 8.0)),
    ]
    return [
        link_fault(
            f"link-{name}",
            does,
            *acts,
            lasts_s=lasts_s,
            names=names,
            excused=f"{LOST}|{STILLNESS}|reboot|rejected|changed|could not be",
        )
        for name, does, acts, names, lasts_s in rows
    ]


# --- the autopilot


async def reboot(scene: Scene) -> None:
    scene.stage.autopilot.reboot(down_s=scene.chance.uniform(0.3, 4.0))


async def reboot_in_write(scene: Scene) -> None:
    scene.stage.autopilot.faults.reboot_after_writes = scene.chance.randint(1, 6)


async def echo_only(scene: Scene) -> None:
    scene.stage.autopilot.faults.echo_without_effect = True


async def restart_whole(scene: Scene) -> None:
    """Restart the autopilot: stored values come into use."""
    scene.stage.autopilot.faults.echo_without_effect = False
    scene.stage.autopilot.reboot(down_s=1.0)
    await asyncio.sleep(2.0)


async def arm(scene: Scene) -> None:
    scene.stage.autopilot.arm()


async def arm_in_write(scene: Scene) -> None:
    scene.stage.autopilot.faults.arm_after_writes = scene.chance.randint(1, 6)


async def disarm(scene: Scene) -> None:
    faults = scene.stage.autopilot.faults
    faults.arm_after_writes = faults.reboot_after_writes = None
    scene.stage.autopilot.disarm()


def _toggle(scene: Scene) -> None:
    autopilot = scene.stage.autopilot
    if autopilot.armed:
        autopilot.disarm()
    else:
        autopilot.arm()


def _gyro_x(scene: Scene) -> str:
    return "CAL_GYRO0_XOFF" if scene.stage.variant.name == "PX4" else "INS_GYROFFS_X"


async def foreign_write(scene: Scene) -> None:
    """Set an offset from another station, and restore it later."""
    stage, name = scene.stage, _gyro_x(scene)
    scene.notes["somebody else"] = name
    scene.notes["value"] = stage.autopilot.parameter(name)
    stage.autopilot.write_as_another_station(name, 0.0123)


def _offsets(scene: Scene) -> set[str]:
    axis = scene.chance.choice("XYZ")
    sensor = scene.chance.choice(("GYR", "ACC"))
    if scene.stage.variant.name == "PX4":
        return {f"CAL_{'GYRO' if sensor == 'GYR' else sensor}0_{axis}OFF"}
    return {f"INS_{sensor}OFFS_{axis}"}


def at_one(field: str) -> tuple[Act, Act]:
    async def strike(scene: Scene) -> None:
        setattr(scene.stage.autopilot.faults, field, _offsets(scene))

    async def lift(scene: Scene) -> None:
        setattr(scene.stage.autopilot.faults, field, set())

    return strike, lift


def _second(scene: Scene) -> None:
    """Another firmware under the same ids, as two boards out of the box have them."""
    stranger(scene, 1, 1).beat(autopilot=3 if scene.stage.variant.name == "PX4" else 12)


async def change_id(scene: Scene) -> None:
    _set_id(scene, 7)


async def change_id_back(scene: Scene) -> None:
    _set_id(scene, 1)


def _set_id(scene: Scene, system: int) -> None:
    autopilot = scene.stage.autopilot
    autopilot.reboot(down_s=1.0)
    for channel in autopilot.channels:
        channel._codec.srcSystem = system


def autopilot_faults() -> list[Fault]:
    write_only: dict[Phase, str] = {phase: "it shows in a write only" for phase in PHASES if phase == "armed"}
    return [
        autopilot_fault("reboot", "the autopilot restarts", reboot, names=r"reboot", excused=f"{LOST}|{STILLNESS}"),
        autopilot_fault(
            "reboot-in-write",
            "the autopilot restarts at one of the writes",
            reboot_in_write,
            disarm,
            lasts_s=(8.0, 14.0),
            excused=f"reboot|{LOST}|{STILLNESS}",
            not_in=write_only,
        ),
        autopilot_fault(
            "arms",
            "the pilot arms, and disarms later",
            arm,
            disarm,
            names=ARMED,
            excused=LOST,
            not_in={"armed": "it is armed already"},
        ),
        autopilot_fault(
            "arms-in-write",
            "the pilot arms at one of the writes",
            arm_in_write,
            disarm,
            lasts_s=(6.0, 14.0),
            excused=ARMED,
            not_in=write_only,
        ),
        autopilot_fault(
            "arm-toggling",
            "armed and disarmed every 0.7 s",
            every(0.7, _toggle)[0],
            every(0.7, _toggle)[1],
            names=ARMED,
            excused=f"{LOST}|{STILLNESS}",
        ),
        autopilot_fault(
            "refuses",
            "PARAM_SET of one offset is refused",
            *at_one("refuse"),
            lasts_s=(12.0, 16.0),
            # Before 4.8 there is no word for a refusal: the answer is the value as it was.
            excused=r"refuse|answered another value",
            not_in=write_only,
        ),
        autopilot_fault(
            "echoes-only",
            "PARAM_SET is stored and echoed, and the old value stays in use",
            echo_only,
            restart_whole,
            lasts_s=(14.0, 18.0),
            not_in=write_only,
            # It ends with a restart, which may come in the middle of the next attempt.
            excused=r"does not use|not in use|no effect|did not follow|still off|reboot|restart|unknown whether",
        ),
        autopilot_fault(
            "other-value",
            "the answer to PARAM_SET carries another value",
            *at_one("wrong_echo"),
            lasts_s=(12.0, 16.0),
            excused=r"OFF|reads? back|another value|changed",
            not_in=write_only,
        ),
        autopilot_fault(
            "silent",
            "heartbeats and telemetry go on, but nothing is answered",
            *switched(silent=True),
            lasts_s=(6.0, 12.0),
            excused=LOST,
        ),
        autopilot_fault(
            "one-parameter-unanswered",
            "one offset can neither be read nor set",
            *at_one("ignore"),
            lasts_s=(8.0, 14.0),
            excused=f"{LOST}|OFF",
        ),
        autopilot_fault(
            "no-heartbeat",
            "the heartbeat stays away, all else goes on",
            *switched(heartbeat_off=True),
            # Shorter gaps than 5 s are nobody's fault: then a calibration may end well, and nothing is said.
            lasts_s=(6.0, 9.0),
            # PX4 answers with a heartbeat when it is asked for one, as it is then.
            variants=("ArduPilot 4.8", "ArduPilot 4.6"),
            names=r"heartbeat",
            excused=LOST,
        ),
        autopilot_fault(
            "no-telemetry",
            "nothing but heartbeats and answers is sent",
            *switched(telemetry_off=True),
            lasts_s=(4.0, 8.0),
            names=r"imu fc|telemetry|no .*IMU|fc: ",
            excused=f"{LOST}|{STILLNESS}|fc",
        ),
        autopilot_fault(
            "frozen-imu",
            "the autopilot's IMU messages repeat the last values",
            *switched(frozen_imu=True),
            lasts_s=(4.0, 8.0),
            excused=f"{STILLNESS}|frozen|same|does not use|fc|reboot|unknown whether",
        ),
        autopilot_fault(
            "foreign-writer",
            "another station sets an offset to nonsense",
            foreign_write,
            excused=r"somebody|someone|changed|set |NOT restored|OFF|does not use",
        ),
        autopilot_fault(
            "gyro-calibration-fails",
            "ArduPilot's own gyro calibration does not converge",
            *switched(gyro_calibration_fails=True),
            variants=("ArduPilot 4.8", "ArduPilot 4.6"),
            lasts_s=(12.0, 16.0),
            excused=r"gyro calibration|gyro",
            not_in=write_only,
        ),
        autopilot_fault(
            "two-autopilots",
            "a second firmware has the same system id",
            *every(0.5, _second),
            lasts_s=(3.0, 8.0),
            names=r"two autopilots",
            excused=f"{LOST}|{STILLNESS}|two autopilots",
        ),
        autopilot_fault(
            "other-system-id",
            "it restarts with another system id, and later with its own",
            change_id,
            change_id_back,
            lasts_s=(5.0, 9.0),
            names=r"heartbeat|reboot",
            excused=f"{LOST}|reboot",
            variants=("ArduPilot 4.8", "ArduPilot 4.6"),
        ),
    ]


# --- strangers


def _malformed(scene: Scene) -> None:
    for _ in range(20):
        scene.stage.wire.inject(malformed(scene.chance))


def _spoofed_commands(scene: Scene) -> None:
    """Requests that are not for us, or claim to be from ourselves, or from nobody."""
    for system, component, target in (
        (1, 191, (1, 191)),
        (255, 190, (0, 0)),
        (255, 190, (1, 0)),
        (255, 190, (2, 191)),
        (255, 190, (1, 1)),
    ):
        one = stranger(scene, system, component)
        for command in (CALIBRATE, CANCEL, UNDO):
            one.say(command_message(command, 0.0, target=target))


def _says_disarmed(scene: Scene) -> None:
    stranger(scene, 1, 1).beat(autopilot=12 if scene.stage.variant.name == "PX4" else 3)


_FORGES, _FORGES_NO_LONGER = every(0.02, _says_disarmed)


async def forge_and_arm(scene: Scene) -> None:
    """Forge "disarmed" all the time while the pilot arms."""
    await _FORGES(scene)
    await asyncio.sleep(scene.chance.uniform(0.0, 2.0))
    scene.stage.autopilot.arm()
    scene.notes["armed_s"] = scene.stage.now_s


async def no_longer_forged(scene: Scene) -> None:
    armed_s = scene.notes["armed_s"]
    # What left before the arming was known arrives within that.
    written = [write.name for write in scene.stage.autopilot.writes if write.armed and write.t_s > armed_s + 0.05]
    await disarm(scene)
    await _FORGES_NO_LONGER(scene)
    assert not written, f"written while the autopilot was armed: {written}"


def _our_own_ids(scene: Scene) -> None:
    one = stranger(scene, 1, 191)
    one.beat(kind=18, autopilot=8)
    one.beat(kind=2, autopilot=3, armed=True)


def _fake_autopilots(scene: Scene) -> None:
    """Heartbeats that pretend: other components of our system, other systems, ids that nobody may have."""
    for system, component in ((1, 2), (1, 0), (0, 1), (9, 1), (1, 190)):
        stranger(scene, system, component).beat(armed=scene.chance.random() < 0.5)
    stranger(scene, 1, 154).beat(kind=mavlink.MAV_TYPE_GIMBAL, autopilot=3, armed=True)


def _spoofed_values(scene: Scene) -> None:
    """Parameters and telemetry under another component of our system, and acknowledgements of things never asked."""
    one = stranger(scene, 1, 100)
    one.say(mavlink.MAVLink_param_value_message(_gyro_x(scene).encode(), 0.4, 9, 1000, 65535))
    one.say(mavlink.MAVLink_raw_imu_message(1000, 0, 0, 0, 900, 900, 900, 0, 0, 0, 0, 3000))
    one.say(mavlink.MAVLink_command_ack_message(31010, 0, 0, 0, 1, 191))
    stranger(scene, 1, 1).say(mavlink.MAVLink_command_ack_message(31010, 4, 0, 0, 1, 191))


def _forged_dates_and_places(scene: Scene) -> None:
    """Under the autopilot's own ids, beside what it says itself: a year that no calendar has, the equator, 20 km up."""
    one, boot_ms = stranger(scene, 1, 1), round((scene.stage.service.core.vehicle.boot.latest or (0.0, 0.0))[0] * 1e3)
    one.say(mavlink.MAVLink_system_time_message(2**63, boot_ms))
    for lat, alt in ((1000, 50_000), (400_000_000, 20_000_000)):
        one.say(mavlink.MAVLink_global_position_int_message(boot_ms, lat, 1_160_000_000, alt, 0, 0, 0, 0, 0))


def _announced_offset(scene: Scene) -> None:
    stranger(scene, 1, 1).say(mavlink.MAVLink_param_value_message(_gyro_x(scene).encode(), 0.3, 9, 1000, 65535))


def _asks_to_arm(scene: Scene) -> None:
    one = stranger(scene, 1, 1)
    for _ in range(20):
        one.say(command_message(3001, 1.0, target=(1, 191)))


def _sign(scene: Scene, *, demanded: bool) -> None:
    """The autopilot signs what it sends; where it demands signatures it takes nothing without one."""
    codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    codec.robust_parsing = True
    signing = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    signing.signing.secret_key = b"K" * 32
    signing.signing.sign_outgoing = True
    signing.signing.timestamp = 1

    def change(data: bytes, inbound: bool) -> bytes | None:
        if not inbound:
            return None if demanded else data
        out = b""
        for message in codec.parse_buffer(data) or ():
            if message.get_type() == "BAD_DATA":
                continue
            signing.srcSystem, signing.srcComponent = message.get_srcSystem(), message.get_srcComponent()
            signing.seq = message.get_seq()
            out += message.pack(signing)
        return out

    scene.stage.wire.change = change


async def signs(scene: Scene) -> None:
    _sign(scene, demanded=False)


async def demands_signatures(scene: Scene) -> None:
    _sign(scene, demanded=True)


async def unsigned(scene: Scene) -> None:
    """An autopilot that takes what is unsigned as well is not complained of."""
    scene.stage.wire.change = None
    assert not _told_of_signatures(scene), "said of an autopilot that takes unsigned messages"


async def no_longer_demanded(scene: Scene) -> None:
    """It has been said by now, once, whether or not anybody has asked the autopilot for something."""
    told, status = _told_of_signatures(scene), any(_WANTS in words for words in scene.stage.words())
    scene.stage.wire.change = None
    assert told == 1, f"that it wants signatures is said {told} times in the log"
    assert status, "the status does not say that it wants signatures"


_WANTS = "the autopilot wants signatures"


def _told_of_signatures(scene: Scene) -> int:
    return sum(_WANTS in line for line in scene.stage.said.lines)


def intruder_faults() -> list[Fault]:
    return [
        intruder_fault(
            "malformed",
            "oversized, cut, unknown and wrongly summed frames, 400 a second",
            *every(0.05, _malformed),
            excused=f"{LOST}|{STILLNESS}",
        ),
        intruder_fault(
            "spoofed-commands",
            "requests to others, and as if from ourselves",
            *every(0.3, _spoofed_commands),
        ),
        intruder_fault(
            "forged-disarmed",
            "50 disarmed heartbeats a second under the autopilot's ids, and the pilot arms",
            forge_and_arm,
            no_longer_forged,
            lasts_s=(6.0, 12.0),
            names=r"two autopilots, or a forger",
            excused=f"{LOST}|{ARMED}|{STILLNESS}",
        ),
        intruder_fault(
            "our-own-ids", "somebody beats under our own system and component id", *every(0.3, _our_own_ids)
        ),
        intruder_fault(
            "fake-autopilots",
            "heartbeats of pretended autopilots, some armed",
            *every(0.2, _fake_autopilots),
        ),
        intruder_fault(
            "spoofed-values",
            "values, telemetry and acknowledgements of another component",
            *every(0.1, _spoofed_values),
        ),
        intruder_fault(
            "forged-places",
            "dates and places that cannot be, under the autopilot's ids",
            *every(0.2, _forged_dates_and_places),
            excused=r"position|height",
        ),
        intruder_fault(
            "announced-offset",
            "an offset that is not in force is announced under the autopilot's ids",
            *every(2.5, _announced_offset),
            excused=r"OFF|somebody|changed",
        ),
        intruder_fault(
            "arm-question-flood",
            "PX4 asks 400 times a second whether it may arm (command 3001)",
            *every(0.05, _asks_to_arm),
            variants=("PX4",),
            at_arm="gate",
            excused=STILLNESS,
            lasts_s=(2.0, 4.0),
        ),
        intruder_fault(
            "signed",
            "everything that comes is signed (MAVLink 2 signing)",
            signs,
            unsigned,
            lasts_s=(4.0, 9.0),
        ),
        intruder_fault(
            "signatures-demanded",
            "the autopilot signs, and takes nothing that is not signed",
            demands_signatures,
            no_longer_demanded,
            lasts_s=(14.0, 20.0),
            names=r"it signs what it sends|the autopilot wants signatures",
            excused=LOST,
        ),
    ]


def faults() -> list[Fault]:
    return [*link_faults(), *autopilot_faults(), *intruder_faults()]
