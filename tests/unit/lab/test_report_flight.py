"""The page of a flight, read by an independent parser."""

from __future__ import annotations

import datetime
import json
import re
from pathlib import Path

import msgspec
import pytest

from companion.cli import main
from companion.estimation.records.flight_record import AXES, Drift, KeptFlight
from companion.lab.report.calibration_page import calibration_page
from companion.lab.report.flight_page import flight_page
from companion.lab.report.source import material
from companion.storage.flights import FlightStore
from companion.storage.learned import BiasStore, KnownImu
from companion.storage.records import RecordStore
from tests.support.flights import LEFT, STEP, UNITS, imu_flight, kept_flight
from tests.support.histories import record
from tests.unit.report.test_pages import LARGEST, Page

NOW = datetime.datetime(2026, 12, 1, 12, 0, tzinfo=datetime.UTC)


def shown(kept: KeptFlight, *others: KeptFlight) -> str:
    return flight_page(3, kept, [one.flight for one in (kept, *others)], NOW)


def test_the_figure_that_counts_stands_at_the_top_and_the_tables_have_the_records_figures() -> None:
    content = shown(kept_flight())
    found = Page(content)
    lead = content.index("30 s without GNSS: 2.1 m (95 %: 5.0 m, 150 starts); with the offsets of before 31.0 m")
    assert lead < content.index("<h2>")
    assert "2026-11-23 08:00 UTC, vehicle 1, 173 s in the air, log 00000012.BIN" in found.text
    assert "Next flight: IMU 1 accel z: 5.1 mg by vibration of the motors: damp the autopilot better." in found.text
    for k, axis in enumerate(AXES):
        for term, value in (("turn_on", LEFT[k]), ("motors", STEP[k]), ("in_flight", LEFT[k] + STEP[k])):
            assert found.exact[f"{term}.1.{axis}"][0] / UNITS[k] == pytest.approx(value)
    assert found.shown["motors.1.accel z"] == "+5.10± 0.60"
    assert found.shown["drift.1.flown.30"] == "2.195 %: 5.0"
    assert found.shown["drift.1.before.60"] == "160.095 %: 384.0"


def test_what_several_flights_say_together_stands_beside_it() -> None:
    together = "2 flights: motors move IMU 1 accel z by +5.1 ± 0.5 mg."
    assert together not in Page(shown(kept_flight())).text
    assert together in Page(shown(kept_flight("a"), kept_flight("b"))).text
    assert together not in Page(shown(kept_flight("a"), kept_flight("b", system_id=2))).text


def test_a_calibration_says_where_flights_have_found_more_than_its_sigma(tmp_path: Path) -> None:
    RecordStore(tmp_path).save(record())
    store, biases = FlightStore(tmp_path), BiasStore(tmp_path)
    identity = {"instance": "1", "gyro": "2752772", "accel": "2753028"}
    biases.write({"fc": KnownImu(identity=identity)})
    for k in range(4):
        store.save(kept_flight(str(k), imu_flight(step=(0.0, 4.0, 45.0, 5.1))))
    text = Page(calibration_page(material(tmp_path, None), NOW)).text
    ends = ", more than σ use, which is of the ground: damp the autopilot better."
    assert text.count(ends) == 2
    # Each to 12 deg/h or 0.6 mg; what all flights have wrong alike is 0.2 mg.
    assert f"4 flights: motors move IMU 1 gyro z by +45 ± 6 deg/h{ends}" in text
    assert f"4 flights: motors move IMU 1 accel z by +5.1 ± 0.4 mg{ends}" in text
    # The figures of the calibration itself are what they were.
    figures = Page(calibration_page(material(tmp_path, None), NOW)).exact
    for path in sorted(store.folder.iterdir()):
        path.unlink()
    bare = Page(calibration_page(material(tmp_path, None), NOW))
    assert bare.exact == figures
    assert "motors move" not in bare.text
    # Of another sensor flights say nothing.
    store.save(kept_flight())
    biases.write({"fc": KnownImu(identity=identity | {"gyro": "7", "accel": "8"})})
    assert "motors move" not in Page(calibration_page(material(tmp_path, None), NOW)).text


def test_what_is_not_known_and_what_nobody_can_see_is_said() -> None:
    text = Page(shown(kept_flight())).text
    assert "Not known: temperature, vibration." in text
    assert "per minute: change in each minute of flight" in text
    assert "vibration: change for" not in text
    assert "accel x, y: not counted, in the air nothing tells them from tilt" in text
    assert "0.1 deg off make 8 m in 30 s" in text
    bare = msgspec.structs.replace(
        imu_flight(drifts={}),
        moments=(),
        notes=("it did not fly, or too shortly to tell anything",),
        calibration=None,
        axes=tuple(
            msgspec.structs.replace(axis, in_flight=None, ekf=None, turn_on=None, motors=None, trend=None)
            for axis in imu_flight().axes
        ),
    )
    flight = kept_flight("1", bare, began_at=None)
    text = Page(shown(flight)).text
    assert "time unknown" in text
    assert "offsets of no calibration known here" in text
    assert "It did not fly, or too shortly to tell anything." in text


def test_dots_lie_where_the_biases_were_and_the_offsets_are_zero() -> None:
    found = Page(shown(kept_flight()))
    (plot,) = [
        part.split("</svg>")[0]
        for part in shown(kept_flight()).split("<svg")
        if "<title>IMU 1: accel z</title>" in part
    ]
    marks = re.findall(r'd="([^"]*)" class="mark sz"', plot)[0]
    heights = [float(y) for y in re.findall(r"M[\d.]+ ([\d.]+)", marks)]
    (zero,) = [float(y) for y in re.findall(r'd="M[\d.]+ ([\d.]+)L[^"]*" class="run past"', plot)]
    values = [one.left[3] / UNITS[3] for one in imu_flight().moments]
    # A triangle's tip is 4.5 above its middle; upwards is less. A dot is as far from the line as its value is from 0.
    off = [zero - 4.5 - height for height in heights]
    per_mg = (max(off) - min(off)) / (max(values) - min(values))
    assert off == pytest.approx([per_mg * value for value in values], abs=0.3)
    assert len([1 for tag, held in found.tags if tag == "svg" and held.get("class") == "plot"]) == 7


def test_the_page_stays_small_and_nothing_of_a_file_becomes_a_tag() -> None:
    evil = '</title></style><script>alert(1)</script>"\' onload="x" \u202egnp\x00'
    names = ["flown", *(f"{evil}{k}" for k in range(30))]
    imus = [imu_flight(k + 1, minutes=20.0, drifts=dict.fromkeys(names, (1.0, 2.0, 1e300))) for k in range(6)]
    imus[0] = msgspec.structs.replace(imus[0], notes=(evil,), calibration=evil)
    flight = msgspec.structs.replace(kept_flight("1", *imus).flight, began_at=evil, notes=(evil,) * 3)
    content = shown(msgspec.structs.replace(kept_flight(), log=evil, flight=flight))
    assert len(content.encode()) < LARGEST
    found = Page(content)
    assert not {tag for tag, _ in found.tags} & {"script", "img", "a", "link"}
    assert "\u202e" not in content
    assert "2 more IMUs are not shown" in found.text


def test_a_drift_of_nothing_and_one_without_end_are_drawn() -> None:
    imu = msgspec.structs.replace(
        imu_flight(), drift={"flown": [Drift(10.0, 3, 0.0, 1e-9)], "before": [Drift(30.0, 3, 1e12, 1e15)]}
    )
    found = Page(shown(kept_flight("1", imu)))
    assert "drift.1.flown.10" in found.shown


def test_the_command_makes_the_page_of_the_latest_or_of_a_number(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = ["--storage", str(tmp_path)]
    assert main(["report", "--flight", *folder]) == 1
    nothing = f"companion: no flight yet: nothing is in {tmp_path}/flights (companion flight LOG reads one)\n"
    assert capsys.readouterr().err == nothing
    store = FlightStore(tmp_path)
    for key in ("a", "b"):
        store.save(kept_flight(key))
    assert main(["report", "--flight", "--json", "-o", str(tmp_path), *folder]) == 0
    file = json.loads(capsys.readouterr().out)["file"]
    assert file == f"{tmp_path}/companion-flight-000002.html"
    assert "<h1>Flight 2</h1>" in Path(file).read_text()
    assert main(["report", "--flight", "1", "-o", "-", *folder]) == 0
    assert "<h1>Flight 1</h1>" in capsys.readouterr().out
    assert main(["report", "--flight", "7", *folder]) == 1
    assert capsys.readouterr().err == "companion: no flight 7; there are number 1 to 2 (companion history)\n"
    (tmp_path / "flights/000002.json").write_bytes(b"{}")
    assert main(["report", "--flight", *folder]) == 1
    assert capsys.readouterr().err.startswith(f"companion: {tmp_path}/flights/000002.json: cannot be used: ")
    for words in (["--flight", "0"], ["1", "--flight"]):
        with pytest.raises(SystemExit, match="2"):
            main(["report", *words, *folder])
