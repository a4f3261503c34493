"""Any file gives one line about its fault, or a result; never a traceback."""

from __future__ import annotations

import contextlib
import io
import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from companion.cli import main as companion
from tests.support.extent import extent

HEAD = "t_s,gx_rad_s,gy_rad_s,gz_rad_s,ax_m_s2,ay_m_s2,az_m_s2,temperature_degc,tilt_x_deg,tilt_y_deg,heading_deg"
SETTINGS = settings(
    max_examples=extent(whole=1000, a_slice=15),
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


def good_lines() -> list[str]:
    """12 s at 20 Hz of everything that a log may hold."""
    rng = np.random.default_rng(1)
    lines = [HEAD]
    for number in range(240):
        gyro, accel = rng.normal(0.0, 1e-4, 3), np.add(rng.normal(0.0, 1e-3, 3), [0.1, 0.2, -9.8])
        values = [number / 20.0, *gyro, *accel, 25.0, 0.5, -0.5, 40.0]
        lines.append(",".join(f"{value:.9g}" for value in values))
    return lines


GOOD = good_lines()
CELLS = st.one_of(
    st.sampled_from(
        ["", "nan", "inf", "-inf", "1e308", "-1e308", "1e-320", "0", "-0", "1e12", "1e15", "9" * 400, "x", '"', "1,2",
         "1;2", "0x10", "1_0", "٣", "\x00", "\ud800", "2026-05-01T12:00:00", "9999-12-31T23:59:59", "0001-01-01",
         "\u2028", "#", "deg/s"]
    ),
    st.floats().map(repr),
    st.text(max_size=8),
)  # fmt: skip


def said(path: Path, *arguments: str) -> tuple[int, str, str]:
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = companion([*arguments, str(path), "--json"])
    return code, out.getvalue(), err.getvalue()


def no_constant(word: str) -> float:
    raise ValueError(f"{word} is no JSON")


COMMANDS = [
    ["log", "replay", "--latitude-deg", "40", "--height-m", "50"],
    ["log", "replay", "--pitch-deg", "0", "--roll-deg", "0", "--rate", "20"],
    ["log", "replay", "--windows", "10"],
    ["log", "profile"],
]


def assert_one_line_or_a_result(path: Path, command: list[str]) -> None:
    code, out, err = said(path, *command)
    assert code in {0, 1, 2}
    assert len(err.splitlines()) <= 1 or command[1] == "profile", err
    if code != 2:
        answer = json.loads(out, parse_constant=no_constant)
        assert answer["state"] == ("done" if code == 0 else "failed")
        assert code == 0 or answer["reason"]
    else:
        assert err


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
@SETTINGS
@given(data=st.data())
def test_a_log_with_cells_that_nobody_expects(tmp_path: Path, command: list[str], data: st.DataObject) -> None:
    lines = list(GOOD)
    for _ in range(data.draw(st.integers(1, 6))):
        at = data.draw(st.integers(0, len(lines) - 1))
        fields = lines[at].split(",")
        match data.draw(st.integers(0, 5)):
            case 0:
                del lines[at : at + data.draw(st.integers(1, 100))]
                lines = lines or [HEAD]
            case 1:
                lines.insert(at, data.draw(CELLS))
            case 2:
                lines[at] = ",".join(fields[: data.draw(st.integers(0, len(fields)))])
            case _:
                fields[data.draw(st.integers(0, len(fields) - 1))] = data.draw(CELLS)
                lines[at] = ",".join(fields)
    path = tmp_path / "log.csv"
    path.write_bytes("\n".join(lines).encode("utf-8", "surrogatepass"))
    assert_one_line_or_a_result(path, command)


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
@SETTINGS
@given(
    head=st.sampled_from([b"", b"\xff\xfe", b"\xfe\xff", b"\xef\xbb\xbf", HEAD.encode() + b"\n", b"ULog\x01\x12\x35"]),
    body=st.binary(max_size=400),
)
def test_bytes_of_any_kind(tmp_path: Path, command: list[str], head: bytes, body: bytes) -> None:
    path = tmp_path / "log.csv"
    path.write_bytes(head + body)
    assert_one_line_or_a_result(path, command)


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_what_is_asked_of_a_good_log_is_answered(tmp_path: Path, command: list[str]) -> None:
    """Else the others would see nothing but refusals."""
    path = tmp_path / "log.csv"
    path.write_text("\n".join(GOOD) + "\n", encoding="utf-8")
    code, out, err = said(path, *command)
    assert command[1] == "replay" or "a profile needs 60 s" in err
    if "--windows" not in command and command[1] == "replay":
        assert (code, json.loads(out)["state"]) == (0, "done"), err + out[:300]
