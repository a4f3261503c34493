"""Libraries of the daemon that the MQTT process must not load: each costs more than 8 MiB."""

from __future__ import annotations

import subprocess
import sys

import pytest

pytestmark = pytest.mark.real_clock


def test_the_process_loads_neither_numpy_nor_the_mavlink_dialect_with_a_fleet_either() -> None:
    code = "import sys, companion.mqtt.process, companion.mqtt.fleet; print(*sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True, timeout=60)
    loaded = run.stdout.split()
    assert "companion.mqtt.fleet_sources" in loaded
    assert not {"numpy", "pymavlink", "serial"}.intersection(loaded)
