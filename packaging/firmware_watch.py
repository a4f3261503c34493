"""Build a source tree of ArduPilot or PX4, and print what of its parameter names and messages is new to the companion.

SRC is a source tree, built where it stands, or a binary (`arducopter`, `px4`) that is built already. The tests with the
mark `firmware_watch` in tests/sitl run against it; sim/'s doubles are the firmware that the companion knows.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parents[1]


def build(source: Path) -> Path:
    """Build SITL's binary in a source tree, incrementally if it was built before; return its path or exit."""
    if (source / "waf").exists():
        binary = source / "build/sitl/bin/arducopter"
        configure = [] if binary.exists() else [["./waf", "configure", "--board", "sitl"]]
        steps = [*configure, ["./waf", "copter"]]
    elif (source / "boards/px4/sitl").is_dir():
        binary = source / "build/px4_sitl_default/bin/px4"
        steps = [["ninja", "-C", "build/px4_sitl_default"] if binary.exists() else ["make", "px4_sitl_default"]]
    else:
        sys.exit(f"{source}: no source tree of ArduPilot or PX4; name one: make firmware-watch SRC=/path/to/ardupilot")
    for step in steps:
        print("+", *step, flush=True)
        if subprocess.run(step, cwd=source, check=False).returncode:
            sys.exit(f"{source}: the build failed (see above); with a built binary: make firmware-watch SRC={binary}")
    return binary


def run(binary: Path, report: Path) -> None:
    """Run the marked tests against a binary; their results go to `report` (JUnit XML)."""
    firmware = "px4" if binary.name == "px4" else "ardupilot"
    variable = f"{firmware.upper()}_SITL"
    words = ["-q", "-p", "no:cacheprovider", "--no-header", f"--junitxml={report}", "-o", "junit_family=xunit1"]
    chosen = ["-m", "firmware_watch and sitl", "-k", f"{firmware}-sitl", "tests/sitl"]
    command = [sys.executable, "-m", "pytest", *words, *chosen]
    subprocess.run(command, cwd=ROOT, env=os.environ | {variable: str(binary)}, check=False)


def told(report: Path) -> tuple[list[str], bool]:
    """Return the lines to print, and whether every test passed and no name is missing."""
    lines: list[str] = []
    good = False
    for case in ET.parse(report).iter("testcase"):  # noqa: S314 - written by our own tests
        fault = next((each for each in case if each.tag in ("failure", "error", "skipped")), None)
        reason = "" if fault is None else f": {(fault.get('message') or '').partition(chr(10))[0][:200]}"
        good = fault is None and (good or not lines)
        lines.append(f"{'passed' if fault is None else 'FAILED'}  {case.get('name')}{reason}")
        properties = {each.get("name"): each.get("value") for each in case.iter("property")}
        lines += [f"        {kind} names: {properties[kind]}" for kind in ("missing", "new") if kind in properties]
    return lines, good


def main() -> int:
    if len(sys.argv) != 2 or not (source := Path(sys.argv[1]).resolve()).exists():
        sys.exit("usage: make firmware-watch SRC=TREE (of ArduPilot or PX4), or SRC=BINARY (arducopter, px4)")
    binary = source if source.is_file() else build(source)
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        run(binary, report)
        if not report.exists():
            sys.exit("the tests did not run (see above)")
        lines, good = told(report)
    print(f"\n{binary}", *lines, sep="\n")
    return 0 if good else 1


if __name__ == "__main__":
    raise SystemExit(main())
