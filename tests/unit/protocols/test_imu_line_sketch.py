"""The Arduino sketch, compiled for this machine against a simulated sensor: its lines say what the sensor measured."""

from __future__ import annotations

import itertools
import math
import shutil
import subprocess
from pathlib import Path

import pytest

from companion.protocols.imus.imu_line import ImuLineDecoder
from companion.samples import ImuSample

pytestmark = pytest.mark.real_clock

SKETCH = Path(__file__).parents[3] / "docs" / "imu_line" / "imu_line.ino"
COMPILER = shutil.which("g++") or shutil.which("clang++")

ARDUINO = r"""
#pragma once
#include <cstdint>
#include <cstdio>
#define HEX 16
static uint32_t clock_us = 4294965000u;  // wraps soon
static uint32_t micros() { return clock_us; }
static void delay(unsigned long ms) { clock_us += 1000 * ms; if (ms >= 1000) throw 1; }
struct Port {
  void begin(unsigned long) {}
  size_t write(const uint8_t *data, size_t count) { return fwrite(data, 1, count, stdout); }
  void print(const char *text) { fputs(text, stdout); }
  void println(int value, int) { printf("%X\r\n", value); }
} static Serial;
"""

WIRE = r"""
#pragma once
#include <cstdlib>
struct TwoWire {
  uint8_t memory[256] = {}, pointer = 0;
  int written = 0, left = 0, bursts = 0;
  void begin() { memory[0x75] = (uint8_t)strtol(getenv("IDENTITY"), nullptr, 16); }
  void setClock(long) {}
  void beginTransmission(uint8_t) { written = 0; }
  void write(uint8_t value) { if (written++ == 0) pointer = value; else memory[pointer++] = value; }
  uint8_t endTransmission(bool = true) { return 0; }
  size_t requestFrom(int, int count) {
    if (pointer == 0x3A) {  // a new sample 5 ms after the last one: accelerometer, temperature, gyro, big-endian
      static const int16_t values[3][7] = {
          {0, 0, 8192, 0, 0, 0, 0}, {-8192, 4096, 1, 340, 655, -655, 1}, {32767, -32768, -1, -3400, 32767, -32768, -1}};
      for (int i = 0; i < 7; i++) {
        memory[0x3B + 2 * i] = (uint8_t)((uint16_t)values[bursts % 3][i] >> 8);
        memory[0x3C + 2 * i] = (uint8_t)values[bursts % 3][i];
      }
      memory[0x3A] = memory[0x38];
      clock_us += 5000;
    }
    if (count == 14 && ++bursts == 3) return 5;  // the third burst fails
    return (size_t)count;
  }
  int read() { return memory[pointer++]; }
} static Wire;
"""

MAIN = r"""
#include "imu_line.ino"
int main() {
  try { setup(); } catch (int) { return 0; }
  if (Wire.memory[0x1B] != 1 << 3 || Wire.memory[0x1C] != 1 << 3 || Wire.memory[0x19] != 4 || Wire.memory[0x1A] != 2)
    return 1;
  for (int i = 0; i < 4; i++) loop();
}
"""


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if COMPILER is None:
        pytest.skip("no C++ compiler on this machine")
    folder = tmp_path_factory.mktemp("sketch")
    for name, text in {"Arduino.h": ARDUINO, "Wire.h": WIRE, "main.cpp": MAIN}.items():
        (folder / name).write_text(text)
    shutil.copy(SKETCH, folder)
    command = [COMPILER, "-std=c++11", "-Wall", "-Wextra", "-Werror", "-I", str(folder), str(folder / "main.cpp")]
    done = subprocess.run([*command, "-o", str(folder / "sketch")], check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder / "sketch"


def output_of(program: Path, identity: str) -> bytes:
    return subprocess.run([program], env={"IDENTITY": identity}, check=True, stdout=subprocess.PIPE).stdout


def test_the_lines_say_what_the_sensor_measured(program: Path) -> None:
    decoder = ImuLineDecoder()
    lines = output_of(program, "68")
    samples = [sample for sample in decoder.feed(lines, 0.0) if isinstance(sample, ImuSample)]
    assert not decoder.rejected
    # The third burst failed: no line, but a gap in the sequence. The fourth shows the first values again.
    assert [sample.sequence for sample in samples] == [0, 1, 3]
    # 500 deg/s and 4 g full scale; the rounding of the line is half a step of its last decimal.
    level, moving, _ = samples
    assert level.gyro_rad_s == (0.0, 0.0, 0.0)
    assert level.accel_m_s2 == pytest.approx([0.0, 0.0, 9.80665], abs=5.1e-5)
    assert level.temperature_degc == 36.53
    lsb_rad_s = math.radians(500 / 32768)
    assert moving.gyro_rad_s == pytest.approx([655 * lsb_rad_s, -655 * lsb_rad_s, lsb_rad_s], abs=5.1e-7)
    assert moving.accel_m_s2 == pytest.approx([-9.80665, 9.80665 / 2, 9.80665 / 8192], abs=5.1e-5)
    assert moving.temperature_degc == pytest.approx(37.53, abs=0.006)
    assert max(map(len, lines.splitlines())) < decoder.LIMIT


def test_the_clock_wraps_as_the_definition_says(program: Path) -> None:
    samples = ImuLineDecoder().feed(output_of(program, "68"), 0.0)
    ticks = [round((sample.t_device_s or 0.0) * 1e6) for sample in samples if isinstance(sample, ImuSample)]
    assert [(later - earlier) % 2**32 for earlier, later in itertools.pairwise(ticks)] == [5000, 10000]


@pytest.mark.parametrize(("identity", "degc"), [("70", 21.0), ("12", 25.0)])
def test_each_family_has_its_own_thermometer(program: Path, identity: str, degc: float) -> None:
    first = ImuLineDecoder().feed(output_of(program, identity), 0.0)[0]
    assert isinstance(first, ImuSample)
    assert first.temperature_degc == degc


def test_an_unknown_sensor_is_named_and_sends_nothing(program: Path) -> None:
    said = output_of(program, "EA")
    decoder = ImuLineDecoder()
    assert decoder.feed(said, 0.0) == []
    assert b"WHO_AM_I = 0xEA" in said


def test_the_document_shows_a_right_line() -> None:
    text = SKETCH.parents[1].joinpath("imu_line.md").read_text(encoding="utf-8")
    (shown,) = [line.strip() for line in text.splitlines() if line.strip().startswith("$IMU,1,")]
    assert len(ImuLineDecoder().feed(shown.encode() + b"\r\n", 0.0)) == 1
