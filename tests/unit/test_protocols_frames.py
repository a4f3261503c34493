"""The documented frames, valid and invalid, of all families."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, get_args

import pytest

from companion import config
from companion.errors import ConfigError
from companion.protocols.registry import PROTOCOLS, Kind, make_decoder
from companion.samples import AttitudeSample, CompassSample, ImuSample, MagSample, Sample, TiltSample

KINDS: dict[str, Kind] = {name: kind for kind, names in reversed(PROTOCOLS.items()) for name in names}
"""One of the kinds under which a device is known; its decoder is the same under all."""
DOCUMENT = json.loads((Path(__file__).parents[1] / "vectors" / "frames.json").read_text(encoding="utf-8"))
FRAMES = [frame for frame in DOCUMENT["frames"] if frame["device"] in KINDS]


def name_of(frame: dict[str, Any]) -> str:
    return f"{frame['device']}-{(frame.get('ascii') or frame['hex']).strip()[:24]}"


def bytes_of(frame: dict[str, Any]) -> bytes:
    return frame["ascii"].encode() if "ascii" in frame else bytes.fromhex(frame["hex"])


def as_decoded(samples: list[Sample]) -> dict[str, Any]:
    """What the samples say, in the document's words."""
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
                if sample.pitch_deg is not None:
                    said |= {"pitch_deg": sample.pitch_deg, "roll_deg": sample.roll_deg}
                if sample.temperature_degc is not None:
                    said |= {"temperature_degc": sample.temperature_degc}
            case AttitudeSample():
                said |= {"yaw_pitch_roll_deg": [sample.yaw_deg, sample.pitch_deg, sample.roll_deg]}
            case MagSample(counts=None):
                said |= {"mag_gauss": list(sample.field_gauss or ())}
            case MagSample():
                said |= {"mag_counts": list(sample.counts or ())}
    return said


def as_documented(frame: dict[str, Any]) -> dict[str, Any]:
    """What of the document's words a sample can say: one heading of a sentence, to the north that is right for it."""
    decoded = dict(frame["decoded"])
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


@pytest.mark.parametrize("frame", FRAMES, ids=name_of)
def test_a_documented_frame_is_read_as_documented(frame: dict[str, Any]) -> None:
    decoder = make_decoder(KINDS[frame["device"]], frame["device"])
    samples = decoder.feed(bytes_of(frame), 7.0)
    if not frame["valid"]:
        assert samples == []
        assert decoder.accepted == 0
        assert decoder.rejected.total() == 1
        return
    said, documented = as_decoded(samples), as_documented(frame)
    assert said.keys() == documented.keys()
    for key, value in documented.items():
        # The documents' figures have three or four decimals.
        assert said[key] == pytest.approx(value, abs=5e-4 if "CCD" in frame.get("ascii", "") else 5e-5), key
    assert decoder.accepted == 1
    assert not decoder.rejected
    assert {sample.t_s for sample in samples} == {7.0}


@pytest.mark.parametrize("device", sorted({frame["device"] for frame in FRAMES if not frame["valid"]}))
def test_an_invalid_frame_does_not_harm_its_neighbours(device: str) -> None:
    valid = [bytes_of(frame) for frame in FRAMES if frame["device"] == device and frame["valid"]]
    invalid = [bytes_of(frame) for frame in FRAMES if frame["device"] == device and not frame["valid"]]
    for good in valid:
        decoder = make_decoder(KINDS[device], device)  # one compass sends one of its sentences at a time, not all
        for bad in invalid:
            decoder.feed(bad + good, 1.0)
        assert decoder.accepted == len(invalid)
        assert decoder.rejected.total() == len(invalid)


def test_the_names_are_those_of_the_configuration() -> None:
    assert set(PROTOCOLS["imu"]) == set(get_args(config.ImuProtocol))
    assert set(PROTOCOLS["gradienter"]) == set(get_args(config.GradienterProtocol))
    assert set(PROTOCOLS["compass"]) == set(get_args(config.CompassProtocol))
    assert all(info.name == name for names in PROTOCOLS.values() for name, info in names.items())
    assert all(info.parity in get_args(config.Parity) for names in PROTOCOLS.values() for info in names.values())


def test_an_unknown_protocol_is_refused_with_what_is_allowed() -> None:
    with pytest.raises(ConfigError, match=r'allowed: "hmr3300", "nmea"'):
        make_decoder("compass", "vectornav")
