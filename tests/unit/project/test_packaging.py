"""Distribution: the wheel, and the sources of the Debian package and the BlueOS extension.

The Debian package itself is built and tried out in a clean root by `make deb-test`. An image is built nowhere here: its
Dockerfile is read by a parser of others, and its labels are held against what BlueOS expects of them.
"""

from __future__ import annotations

import fnmatch
import re
import shutil
import subprocess
import sys
import sysconfig
import tomllib
import zipfile
from pathlib import Path

import pytest
from dockerfile_parse import DockerfileParser

import companion

pytestmark = pytest.mark.real_clock

PROJECT = Path(__file__).resolve().parents[3]
DEB = PROJECT / "packaging/deb"
BLUEOS = PROJECT / "packaging/blueos"
PYPROJECT = tomllib.loads((PROJECT / "pyproject.toml").read_text())


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, as `pip install .` builds it, without the network."""
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    built = subprocess.run(command, cwd=PROJECT, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    (path,) = folder.glob("*.whl")
    return path


def test_the_wheel_has_every_file_of_the_companion_and_of_the_service(wheel: Path) -> None:
    def below(folder: str) -> set[str]:
        files = (path for path in (PROJECT / folder).rglob("*") if path.is_file() and "__pycache__" not in path.parts)
        return {str(path.relative_to(PROJECT)) for path in files}

    service = {f"companion/installation/{name}" for name in below("systemd")}
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    assert len(service) >= 4
    assert "companion/lua/companion_arming.lua" in names
    assert {name for name in names if ".dist-info/" not in name} == below("companion") | service


def test_an_installed_wheel_needs_nothing_of_the_checkout(wheel: Path, tmp_path: Path) -> None:
    home = tmp_path / "home"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(home)], check=True)
    pip = [sys.executable, "-m", "pip", "--python", str(home / "bin/python"), "--disable-pip-version-check"]
    subprocess.run([*pip, "install", "-q", "--no-deps", "--no-index", str(wheel)], check=True)
    (packages,) = (home / "lib").glob("python*/site-packages")
    # What it depends on is that of these tests. An editable companion among it has a .pth, not followed from here.
    (packages / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")

    def run(*words: str) -> str:
        command = [str(home / "bin/companion"), *words]
        done = subprocess.run(command, cwd=tmp_path, env={}, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout

    where = subprocess.run(
        [home / "bin/python", "-c", "import companion; print(companion.__file__)"],
        cwd=tmp_path, env={}, capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    assert where.startswith(str(packages))
    assert run("--version") == f"companion {companion.__version__}\n"
    assert run("autopilot", "script") == (PROJECT / "companion/lua/companion_arming.lua").read_text()
    root = tmp_path / "root"
    run("service", "install", "--root", str(root), "--prefix", "/usr")
    unit = (root / "usr/lib/systemd/system/companion.service").read_text()
    assert f"\nExecStart={home}/bin/companion -c " in unit


def test_the_versions_agree() -> None:
    assert PYPROJECT["project"]["version"] == companion.__version__
    assert labels()["version"] == companion.__version__


# --- the Debian package


def test_the_package_takes_the_units_as_they_are() -> None:
    home = re.search(r'^HOME: Final = "(.+)"$', (DEB / "build_deb.py").read_text(), re.MULTILINE)
    assert home is not None
    for name, words in (
        ("companion.service", "-c /etc/companion/companion.toml run"),
        ("companion-setup.service", "setup --page 0.0.0.0:8191"),
    ):
        assert f"\nExecStart=/{home[1]}/bin/companion {words}\n" in (PROJECT / "systemd" / name).read_text()


@pytest.mark.parametrize("script", ["preinst", "postinst", "prerm", "postrm"])
def test_the_maintainer_scripts_are_shell(script: str) -> None:
    lines = (DEB / script).read_text().splitlines()
    assert lines[0] == "#!/bin/sh"
    assert "set -e" in lines
    subprocess.run(["/bin/sh", "-n", str(DEB / script)], check=True)


# --- the extension for BlueOS


def dockerfile(**arguments: str) -> DockerfileParser:
    return DockerfileParser(path=str(BLUEOS / "Dockerfile"), env_replace=True, build_args=arguments)


def labels(**arguments: str) -> dict[str, str]:
    return dict(dockerfile(**arguments).labels)


def test_the_paths_of_the_dockerfile_are_there_and_let_into_the_build() -> None:
    ignored = (BLUEOS / "Dockerfile.dockerignore").read_text().split()
    assert ignored[0] == "*"
    let_in = [line.removeprefix("!") for line in ignored if line.startswith("!")]
    sources = []
    for instruction in dockerfile().structure:
        if instruction["instruction"] == "COPY" and "--from=" not in instruction["value"]:
            *names, _ = instruction["value"].split()
            sources += names
    assert len(sources) >= 6
    for name in sources:
        assert (PROJECT / name).exists()
        assert any(fnmatch.fnmatch(name, pattern) for pattern in let_in), name
    # What is installed is what is locked, for parts that there are.
    locks = set(re.findall(r"-r /src/requirements/([a-z]+)\.txt", (BLUEOS / "Dockerfile").read_text()))
    assert locks >= {"build", "runtime"}
    assert locks - {"build", "runtime"} <= set(PYPROJECT["project"]["optional-dependencies"])
    # All that the build of the wheel reads is copied.
    needed = {"pyproject.toml", PYPROJECT["project"]["readme"], *PYPROJECT["project"]["license-files"]}
    needed |= set(PYPROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"])
    needed |= set(PYPROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["force-include"])
    assert needed <= set(sources)


def test_the_extension_starts_with_a_configuration_and_keeps_an_edited_one(tmp_path: Path) -> None:
    script = (BLUEOS / "start").read_text()
    for folder in ("etc/companion", "opt/companion", "bin"):
        (tmp_path / folder).mkdir(parents=True)
    for place in ("/etc/", "/opt/"):
        script = script.replace(place, f"{tmp_path}{place}")
    (tmp_path / "opt/companion/companion.toml").write_text("# sample\n")
    fake = tmp_path / "bin/companion"
    fake.write_text('#!/bin/sh\necho "$@"\n')
    fake.chmod(0o755)
    path = f"{tmp_path}/bin:{Path(shutil.which('cp') or '').parent}"
    configuration = tmp_path / "etc/companion/companion.toml"

    def start() -> tuple[str, str]:
        done = subprocess.run(["/bin/sh", "-c", script], env={"PATH": path}, capture_output=True, text=True, check=True)
        return done.stdout, done.stderr

    out, words = start()
    assert out == f"-c {configuration} run\n"
    assert "this is the sample configuration" in words
    assert configuration.read_text() == "# sample\n"
    configuration.write_text("# mine\n")
    assert start() == (out, "")
    assert configuration.read_text() == "# mine\n"
