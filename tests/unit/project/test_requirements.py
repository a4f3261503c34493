"""The lock files: every dependency pinned within its range and with its hashes, and nothing of where it was fetched."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
from packaging.markers import default_environment
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[3]
FOLDER = ROOT / "requirements"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
EXTRAS: dict[str, list[str]] = PROJECT["project"]["optional-dependencies"]
RUNTIME: list[str] = PROJECT["project"]["dependencies"]
NAMES = sorted(path.stem for path in FOLDER.glob("*.txt"))


def lines_of(text: str) -> list[str]:
    """The file's requirements, each in one line; comments are gone."""
    joined = text.replace("\\\n", " ")
    return [line.strip() for line in joined.splitlines() if line.strip() and not line.strip().startswith("#")]


def lock(name: str) -> list[str]:
    return lines_of((FOLDER / f"{name}.txt").read_text(encoding="utf-8"))


def pins(lines: list[str]) -> dict[str, list[tuple[str, Requirement]]]:
    """Pinned versions by canonical name, each with its requirement."""
    found: dict[str, list[tuple[str, Requirement]]] = {}
    for line in lines:
        requirement = Requirement(line.split(" --hash=")[0].strip())
        (only,) = requirement.specifier
        assert only.operator == "==", line
        found.setdefault(canonicalize_name(requirement.name), []).append((only.version, requirement))
    return found


def wanted(name: str) -> list[Requirement]:
    """Requirements of pyproject.toml (or the .in file), with our own extras resolved."""
    if (FOLDER / f"{name}.in").is_file():
        return [Requirement(line) for line in lines_of((FOLDER / f"{name}.in").read_text(encoding="utf-8"))]
    declared = [*RUNTIME, *EXTRAS.get(name, ())]
    for each in list(declared):
        if (own := Requirement(each)).name == "mavlink-imu-calibration":
            declared.remove(each)
            declared += [word for extra in own.extras for word in EXTRAS[extra]]
    return [Requirement(each) for each in declared]


def out_of_step(requirements: list[Requirement], lines: list[str]) -> list[str]:
    """Declared requirements that are not pinned within their range."""
    locked = pins(lines)
    return [
        str(requirement)
        for requirement in requirements
        if not (versions := locked.get(canonicalize_name(requirement.name), []))
        or not all(requirement.specifier.contains(version) for version, _ in versions)
    ]


def test_there_is_a_lock_for_every_extra() -> None:
    assert set(NAMES) == {"runtime", "build", "tools", *EXTRAS}


@pytest.mark.parametrize("name", NAMES)
def test_what_is_declared_is_locked_within_its_range(name: str) -> None:
    assert out_of_step(wanted(name), lock(name)) == [], "run make lock"


@pytest.mark.parametrize("name", NAMES)
def test_every_line_has_hashes_and_no_place(name: str) -> None:
    text = (FOLDER / f"{name}.txt").read_text(encoding="utf-8")
    assert "://" not in text
    assert "--index" not in text
    assert "--find" not in text
    for line in lock(name):
        assert re.search(r"(?: --hash=sha256:[0-9a-f]{64})+$", line), line[:80]


@pytest.mark.parametrize("name", [name for name in NAMES if name not in ("tools", "build")])
def test_what_is_tested_is_what_is_installed(name: str) -> None:
    """One version of each for the same Python, in all files."""
    tested = {package: {version for version, _ in versions} for package, versions in pins(lock("dev")).items()}
    for package, versions in pins(lock(name)).items():
        assert {version for version, _ in versions} == tested[package], package


def test_the_boards_of_the_field_have_their_wheels() -> None:
    """x86-64 and aarch64, Debian 12 (Python 3.11) to 13 (3.13): each has exactly one version of everything."""
    for python in ("3.11", "3.12", "3.13"):
        for machine in ("x86_64", "aarch64"):
            environment = {
                **{key: str(value) for key, value in default_environment().items()},
                "python_version": python, "python_full_version": f"{python}.2", "platform_machine": machine,
                "sys_platform": "linux",
            }  # fmt: skip
            for name in ("runtime", "mqtt", "recording", "ground"):
                for package, versions in pins(lock(name)).items():
                    chosen = [
                        version for version, one in versions if one.marker is None or one.marker.evaluate(environment)
                    ]
                    assert len(chosen) == 1, (package, python, machine)


def test_the_build_system_is_the_locked_one() -> None:
    assert [str(each) for each in wanted("build")] == PROJECT["build-system"]["requires"]
