"""The documented frames, valid and invalid, of all families."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, get_args

import pytest

from companion.config import sections
from companion.protocols.registry import PROTOCOLS, Kind
from companion.samples import CompassSample, ImuSample, MagSample, Sample, TiltSample
from tests.support.decoders import make_decoder
from tests.support.frames import big_floats, fletcher

KINDS: dict[str, Kind] = {name: kind for kind, names in reversed(PROTOCOLS.items()) for name in names}
"""One of the kinds under which a device is known; its decoder is the same under all."""
DOCUMENT = json.loads((Path(__file__).parents[2] / "vectors" / "frames.json").read_text(encoding="utf-8"))
FRAMES = [frame for frame in DOCUMENT["frames"] if frame["device"] in KINDS]


def name_of(frame: dict[str, Any]) -> str:
    return f"{frame['device']}-{(frame.get('ascii') or frame['hex']).strip()[:24]}"


def bytes_of(frame: dict[str, Any]) -> bytes:
    return frame["ascii"].encode() if "ascii" in frame else bytes.fromhex(frame["hex"])


def as_decoded(samples: list[Sample]) -> dict[str, Any]:
    """Content of the samples in the document's terms."""
    said: dict[str, Any] = {}
    for sample in samples:
        match sample:
            case ImuSample():
                said |= {"gyro_rad_s": list(sample.gyro_rad_s), "accel_m_s2": list(sample.accel_m_s2)}
            case TiltSample():
                said |= {"x_deg": sample.x_deg, "y_deg": sample.y_deg}
                if sample.temperature_degc is not None:
                    said |= {"temperature_degc": sample.temperature_degc}
            case CompassSample():
                said |= {f"heading_{sample.north}_deg" if sample.north else "heading_deg": sample.heading_deg}
                told = {
                    "pitch_deg": sample.pitch_deg,
                    "roll_deg": sample.roll_deg,
                    "temperature_degc": sample.temperature_degc,
                }
                said |= {key: value for key, value in told.items() if value is not None}
            case MagSample(counts=None):
                said |= {"mag_gauss": list(sample.field_gauss or ())}
            case MagSample():
                said |= {"mag_counts": list(sample.counts or ())}
    return said


def as_documented(frame: dict[str, Any]) -> dict[str, Any]:
    """Document's values that a sample can hold: one heading per sentence, relative to the right north."""
    unused = {"yaw_pitch_roll_deg"} | ({"mag_gauss"} if KINDS[frame["device"]] == "imu" else set())
    decoded = {key: value for key, value in frame["decoded"].items() if key not in unused}
    if "sensor_heading_deg" in decoded:  # HDG: from its magnetic heading the rest follows
        magnetic_deg = decoded["heading_magnetic_deg"]
        if "deviation_deg" in decoded:
            assert decoded["sensor_heading_deg"] + decoded["deviation_deg"] == pytest.approx(magnetic_deg)
        return {"heading_magnetic_deg": magnetic_deg}
    if "$PTNTCCD" in frame.get("ascii", ""):  # the heading of its own magnetometers
        decoded["heading_magnetic_deg"] = decoded.pop("heading_deg")
    return decoded


def test_the_document_has_frames_of_all_families_but_our_own() -> None:
    assert {frame["device"] for frame in FRAMES} == KINDS.keys() - {"imu_line"}
    assert {frame["valid"] for frame in FRAMES} == {True, False}


TOGETHER = [frame for frame in FRAMES if frame["device"] == "witmotion"]
"""Frames accepted only together: see below."""
MESSAGES = [f for f in FRAMES if "frame_id" in f["decoded"] or list(f["decoded"]) == ["yaw_pitch_roll_deg"]]
"""Right, but no measurements."""


G, DEG = 9.80665, math.pi / 180


def in_our_units(decoded: dict[str, Any]) -> dict[str, Any]:
    """The document's words and units for inertial data as those of our samples; the rest as it is."""
    said = dict(decoded)
    if "gyro_deg_s" in said:
        said["gyro_rad_s"] = [value * DEG for value in said.pop("gyro_deg_s")]
    if "accel_g" in said:
        said["accel_m_s2"] = [value * G for value in said.pop("accel_g")]
    if "inclination_g" in said:  # of axes X forward, Y left, Z up: the third is positive
        x, y, z = said.pop("inclination_g")
        said["x_deg"] = math.asin(y / math.hypot(x, y, z)) / DEG
        said["y_deg"] = math.asin(x / math.hypot(x, y, z)) / DEG
    return said


@pytest.mark.parametrize("frame", [f for f in FRAMES if f["device"] == "mip"], ids=name_of)
def test_a_documented_mip_packet_is_read_as_documented(frame: dict[str, Any]) -> None:
    """They hold no rates: what they hold is seen in a packet to which a field with rates has been added."""
    packet, decoded = bytes_of(frame), frame["decoded"]
    assert frame["valid"]
    assert packet[-2:] == fletcher(packet[:-2])
    decoder = make_decoder("imu", "mip")
    assert decoder.feed(packet, 7.0) == []
    reason = "reply" if "ack" in decoded else "non-finite" if None in decoded["accel_g"] else "nothing of use"
    assert decoder.rejected == {reason: 1}
    if "ack" in decoded:
        return
    rates = b"\x0e\x05" + big_floats(0.25, -0.5, 0.75)
    completed = packet[:3] + bytes([packet[3] + len(rates)]) + packet[4:-2] + rates
    samples = decoder.feed(completed + fletcher(completed), 7.0)
    if reason == "non-finite":
        assert samples == []
        assert decoder.rejected == {reason: 2}
        return
    accel_m_s2 = [value * G for value in decoded["accel_g"]]
    assert as_decoded(samples) == {"gyro_rad_s": [0.25, -0.5, 0.75], "accel_m_s2": pytest.approx(accel_m_s2)}


ALONE = [f for f in FRAMES if f["device"] != "mip" and f not in TOGETHER and f not in MESSAGES]


@pytest.mark.parametrize("frame", ALONE, ids=name_of)
def test_a_documented_frame_is_read_as_documented(frame: dict[str, Any]) -> None:
    decoder = make_decoder(KINDS[frame["device"]], frame["device"])
    samples = decoder.feed(bytes_of(frame), 7.0)
    if not frame["valid"]:
        assert samples == []
        assert decoder.accepted == 0
        assert decoder.rejected.total() == 1
        return
    said, decoded = as_decoded(samples), in_our_units(as_documented(frame))
    latency_us = decoded.pop("latency_us", 0)
    counters = {sample.sequence for sample in samples if isinstance(sample, ImuSample)}
    assert {decoded.pop(key) for key in ("counter", "packet_counter") if key in decoded} == counters - {None}
    assert said.keys() == decoded.keys()
    for key, value in decoded.items():
        # The documents' figures have three or four decimals.
        assert said[key] == pytest.approx(value, abs=5e-4 if "CCD" in frame.get("ascii", "") else 5e-5), key
    assert decoder.accepted == 1
    assert not decoder.rejected
    assert {sample.t_s for sample in samples} == {7.0 - latency_us * 1e-6}


@pytest.mark.parametrize("frame", MESSAGES, ids=name_of)
def test_a_documented_message_is_known_and_no_measurement(frame: dict[str, Any]) -> None:
    assert frame["valid"]
    decoder = make_decoder(KINDS[frame["device"]], frame["device"])
    assert decoder.feed(bytes_of(frame), 7.0) == []
    reason = {2: "reply", None: "nothing of use"}.get(frame["decoded"].get("frame_id"), "echo of a command")
    assert decoder.rejected == {reason: 1}
    assert decoder.accepted == 0


def test_documented_frames_of_one_epoch_are_read_as_documented() -> None:
    accel, gyro, angle = TOGETHER
    assert all(frame["valid"] for frame in TOGETHER)
    decoder = make_decoder("imu", "witmotion")
    imu, tilt = decoder.feed(b"".join(map(bytes_of, [*TOGETHER, accel])), 7.0)
    assert isinstance(imu, ImuSample)
    assert isinstance(tilt, TiltSample)
    assert [x / 9.80665 for x in imu.accel_m_s2] == pytest.approx(accel["decoded"]["accel_g"], abs=5e-5)
    assert imu.temperature_degc == accel["decoded"]["temperature_degc"]
    rates_deg_s = [math.degrees(x) for x in imu.gyro_rad_s]
    assert rates_deg_s == pytest.approx(gyro["decoded"]["gyro_deg_s"], abs=0.031)  # the rounding that it states
    roll, pitch, _ = angle["decoded"]["roll_pitch_yaw_deg"]
    assert (tilt.x_deg, -tilt.y_deg) == pytest.approx((roll, pitch), abs=0.003)
    assert (decoder.accepted, decoder.rejected.total()) == (2, 0)


@pytest.mark.parametrize("frame", TOGETHER, ids=name_of)
def test_a_documented_frame_alone_is_not_believed(frame: dict[str, Any]) -> None:
    decoder = make_decoder("imu", "witmotion")
    assert decoder.feed(bytes_of(frame) + bytes(11), 7.0) == []
    assert decoder.rejected == {"incomplete pair": 1}


@pytest.mark.parametrize("device", sorted({frame["device"] for frame in FRAMES if not frame["valid"]}))
def test_an_invalid_frame_does_not_harm_its_neighbours(device: str) -> None:
    valid = [
        bytes_of(frame) for frame in FRAMES if frame["device"] == device and frame["valid"] and frame not in MESSAGES
    ]
    invalid = [bytes_of(frame) for frame in FRAMES if frame["device"] == device and not frame["valid"]]
    for good in valid:
        decoder = make_decoder(KINDS[device], device)  # one compass sends one of its sentences at a time, not all
        for bad in invalid:
            decoder.feed(bad + good, 1.0)
        assert decoder.accepted == len(invalid)
        assert decoder.rejected.total() == len(invalid)


def test_the_names_are_those_of_the_configuration() -> None:
    assert set(PROTOCOLS["imu"]) == set(get_args(sections.ImuProtocol))
    assert set(PROTOCOLS["gradienter"]) == set(get_args(sections.GradienterProtocol))
    assert set(PROTOCOLS["compass"]) == set(get_args(sections.CompassProtocol))
    assert all(info.name == name for names in PROTOCOLS.values() for name, info in names.items())
    assert all(info.parity in get_args(sections.Parity) for names in PROTOCOLS.values() for info in names.values())
