"""Writes dist/companion.cdx.json: what the package consists of besides the companion, as CycloneDX.

From requirements/*.txt and nothing else: an environment is made of exactly these files, hash for hash, and described.
Run by the Python of the tools (`make sbom`).
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

PROJECT: Final = Path(__file__).resolve().parents[1]
OUTPUT: Final = PROJECT / "dist/companion.cdx.json"
WORK: Final = PROJECT / "build/sbom"
SCHEMA: Final = "1.6"
_PINNED: Final = re.compile(r"^([A-Za-z0-9._-]+)==([^\s;\\]+)", re.MULTILINE)
_VALIDATE: Final = (
    "import sys\n"
    "from cyclonedx.schema import SchemaVersion\n"
    "from cyclonedx.validation.json import JsonStrictValidator\n"
    "error = JsonStrictValidator(SchemaVersion.V1_6).validate_str(sys.stdin.read())\n"
    "sys.exit(f'no valid CycloneDX: {error}' if error is not None else 0)\n"
)


class SbomError(Exception):
    """Why there is none, in one line."""


def main() -> int:
    """Write it; says where it is and how much is in it."""
    parser = argparse.ArgumentParser(description=f"Write {OUTPUT.relative_to(PROJECT)}.")
    parser.add_argument("--extras", default="mqtt,recording", help="parts of the companion (default: %(default)s)")
    options = parser.parse_args()
    try:
        found = describe(["runtime", *filter(None, options.extras.split(","))])
    except SbomError as error:
        print(f"no SBOM: {error}", file=sys.stderr)
        return 1
    print(f"{OUTPUT}: {len(found['components'])} components, each with purl and licence; valid CycloneDX {SCHEMA}")
    return 0


def describe(names: list[str]) -> dict[str, Any]:
    """Make the environment, describe and check it, write the file.

    Raises:
        SbomError: a step failed, or something is unknown of a component.
    """
    files = [PROJECT / f"requirements/{name}.txt" for name in names]
    for path in files:
        if not path.is_file():
            raise SbomError(f"{path.relative_to(PROJECT)}: no such file; the extras are those in pyproject.toml")
    shutil.rmtree(WORK, ignore_errors=True)
    run(sys.executable, "-m", "venv", "--without-pip", str(WORK))
    python = str(WORK / "bin/python")
    listed = [word for path in files for word in ("-r", str(path))]
    run(sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--disable-pip-version-check",
        "--require-hashes", "--only-binary", ":all:", "--no-deps", *listed)  # fmt: skip
    about = ("--pyproject", str(PROJECT / "pyproject.toml"), "--spec-version", SCHEMA)
    text = run(sys.executable, "-m", "cyclonedx_py", "environment", python, *about, "--output-reproducible")
    bom: dict[str, Any] = without_references(json.loads(text))
    check(bom, files)
    text = json.dumps(bom, indent=1, sort_keys=True, ensure_ascii=False) + "\n"
    run(sys.executable, "-c", _VALIDATE, given=text)
    OUTPUT.parent.mkdir(exist_ok=True)
    OUTPUT.write_text(text, encoding="utf-8")
    return bom


def without_references(value: Any) -> Any:
    """Take away addresses: where something was fetched from is this machine's business; the purl says what it is."""
    if isinstance(value, dict):
        return {key: without_references(item) for key, item in value.items() if key != "externalReferences"}
    return [without_references(item) for item in value] if isinstance(value, list) else value


def check(bom: dict[str, Any], files: list[Path]) -> None:
    """Hold what was described against the lock.

    Raises:
        SbomError: a component is not in the lock, or lacks its purl or licence.
    """
    pinned = set(pins(files))
    for component in bom["components"]:
        name, version = component["name"], component["version"]
        if (normal(name), version) not in pinned:
            raise SbomError(f"{name} {version} is not in requirements/")
        if not component.get("purl", "").startswith("pkg:pypi/"):
            raise SbomError(f"{name} {version} has no purl")
        if not component.get("licenses"):
            raise SbomError(f"{name} {version} has no licence")
    missing = {name for name, _ in pinned} - {normal(component["name"]) for component in bom["components"]}
    if missing:
        raise SbomError(f"{', '.join(sorted(missing))}: in requirements/, but not described")


def pins(files: list[Path]) -> Iterator[tuple[str, str]]:
    """Name and version of all that the lock files pin."""
    for path in files:
        for name, version in _PINNED.findall(path.read_text(encoding="utf-8")):
            yield normal(name), version


def normal(name: str) -> str:
    """A distribution's name as it is compared."""
    return re.sub(r"[-_.]+", "-", name).lower()


def run(*command: str, given: str | None = None) -> str:
    """What a command prints.

    Raises:
        SbomError: it failed; its own words stand on stderr.
    """
    done = subprocess.run(command, input=given, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        raise SbomError(f"{' '.join(command[1:4])} ... ended with exit code {done.returncode}")
    return done.stdout


if __name__ == "__main__":
    sys.exit(main())
