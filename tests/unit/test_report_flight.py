"""The page of a flight, read by an independent parser."""

from __future__ import annotations

import datetime
import json
import re
from pathlib import Path

import msgspec
import pytest

from companion.calibration.records.flight_record import AXES, Drift
from companion.cli import main
from companion.report.flight_page import flight_page
from companion.storage.flights import FlightStore
from tests.support.flights import LEFT, STEP, UNITS, imu_flight, kept_flight
from tests.unit.test_report_pages import LARGEST, Page

NOW = datetime.datetime(2026, 12, 1, 12, 0, tzinfo=datetime.UTC)


def test_the_figure_that_counts_stands_at_the_top_and_the_tables_have_the_records_figures() -> None:
    content = flight_page(3, kept_flight(), NOW)
    found = Page(content)
    lead = content.index("30 s without GNSS: 2.1 m (95 %: 5.0 m, 150 starts); with the offsets of before 31.0 m")
    assert lead < content.index("<h2>")
    assert "2026-11-23 08:00 UTC, vehicle 1, 173 s in the air, log 00000012.BIN" in found.text
    assert "Next flight: IMU 1 accel z: 5.1 mg of rectification at hover throttle: its damping." in found.text
    for k, axis in enumerate(AXES):
        for term, value in (("turn_on", LEFT[k]), ("motors", STEP[k]), ("in_flight", LEFT[k] + STEP[k])):
            assert found.exact[f"{term}.1.{axis}"][0] / UNITS[k] == pytest.approx(value)
    assert found.shown["motors.1.accel z"] == "+5.10± 0.60"
    assert found.shown["drift.1.flown.30"] == "2.195 %: 5.0"
    assert found.shown["drift.1.before.60"] == "160.095 %: 384.0"


def test_what_is_not_known_and_what_nobody_can_see_is_said() -> None:
    text = Page(flight_page(3, kept_flight(), NOW)).text
    assert "Not known: temperature, per m/s^2." in text
    assert "accel x, y: not counted, a hover does not tell them from tilt" in text
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
    text = Page(flight_page(3, flight, NOW)).text
    assert "time unknown" in text
    assert "offsets of no calibration known here" in text
    assert "It did not fly, or too shortly to tell anything." in text


def test_dots_lie_where_the_biases_were_and_the_offsets_are_zero() -> None:
    found = Page(flight_page(3, kept_flight(), NOW))
    (plot,) = [
        part.split("</svg>")[0]
        for part in flight_page(3, kept_flight(), NOW).split("<svg")
        if "IMU 1, accel z: bias left over against time" in part
    ]
    marks = re.findall(r'd="([^"]*)" class="mark sz"', plot)[0]
    heights = [float(y) for y in re.findall(r"M[\d.]+ ([\d.]+)", marks)]
    (zero,) = [float(y) for y in re.findall(r'd="M[\d.]+ ([\d.]+)L[^"]*" class="run past"', plot)]
    values = [one.left[3] / UNITS[3] for one in imu_flight().moments]
    # A triangle's tip is 4.5 above its middle; upwards is less.
    shares = [(zero - 4.5 - height) / value for height, value in zip(heights, values, strict=True) if abs(value) > 0.6]
    assert shares == pytest.approx([shares[0]] * len(shares), rel=0.08)
    assert shares[0] > 0.0
    assert len([1 for tag, held in found.tags if tag == "svg" and held.get("class") == "plot"]) == 7


def test_the_page_stays_small_and_nothing_of_a_file_becomes_a_tag() -> None:
    evil = '</title></style><script>alert(1)</script>"\' onload="x" \u202egnp\x00'
    names = ["flown", *(f"{evil}{k}" for k in range(30))]
    imus = [imu_flight(k + 1, minutes=20.0, drifts=dict.fromkeys(names, (1.0, 2.0, 1e300))) for k in range(6)]
    imus[0] = msgspec.structs.replace(imus[0], notes=(evil,), calibration=evil)
    flight = msgspec.structs.replace(kept_flight("1", *imus).flight, began_at=evil, notes=(evil,) * 3)
    content = flight_page(3, msgspec.structs.replace(kept_flight(), log=evil, flight=flight), NOW)
    assert len(content.encode()) < LARGEST
    found = Page(content)
    assert not {tag for tag, _ in found.tags} & {"script", "img", "a", "link"}
    assert "\u202e" not in content
    assert "2 more IMUs are not shown" in found.text


def test_a_drift_of_nothing_and_one_without_end_are_drawn() -> None:
    imu = msgspec.structs.replace(
        imu_flight(), drift={"flown": [Drift(10.0, 3, 0.0, 1e-9)], "before": [Drift(30.0, 3, 1e12, 1e15)]}
    )
    found = Page(flight_page(3, kept_flight("1", imu), NOW))
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
    assert capsys.readouterr().err.startswith(f"companion: {tmp_path}/flights/000002.json: not a readable flight: ")
    for words in (["--flight", "0"], ["1", "--flight"]):
        with pytest.raises(SystemExit, match="2"):
            main(["report", *words, *folder])
