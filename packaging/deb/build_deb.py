"""Builds the Debian package: the companion in a virtual environment of Debian's own Python, below /opt/companion.

For the architecture of the machine that it runs on, without root. By dpkg-deb and this script, not by dh-virtualenv,
which wants debhelper and a source package around it and leaves to us what is most of the work here (one minor version
of Python, nothing that is not needed, no path of the build), nor by nfpm, which only packs and is not in Debian.
"""

from __future__ import annotations

import argparse
import email.message
import email.parser
import gzip
import hashlib
import os
import shutil
import stat
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

HERE: Final = Path(__file__).resolve().parent
PROJECT: Final = HERE.parents[1]
HOME: Final = "opt/companion"
DEFAULT_EXTRAS: Final = "mqtt,recording"
MAINTAINER: Final = "The companion project <nobody@companion.invalid>"
"""Who builds a package to give it to others names himself in DEBFULLNAME and DEBEMAIL."""

SYNOPSIS: Final = "field self-calibration of gyro and accelerometer biases"

NOT_NEEDED: Final = (
    "lxml*",  # only pymavlink's generator of dialects reads XML
    "pymavlink/generator",
    "pymavlink/dialects/v0*",
    "pymavlink/dialects/v1*",
    "zstandard/_cffi*",  # for PyPy
    "zstandard/backend_cffi.py",
    "**/tests",
    "**/*.a",  # for linking with numpy
    "pip*",
    "setuptools*",
)
"""What the wheels bring and the companion never imports, below site-packages."""
ONLY_DIALECTS: Final = ("__init__.py", "ardupilotmega.py", "common.py", "minimal.py", "standard.py")
"""Of MAVLink 2; each of the others is another 1 to 3 MB."""
PLACES: Final = {
    "companion.service": "usr/lib/systemd/system/companion.service",
    "companion-setup.service": "usr/lib/systemd/system/companion-setup.service",
    "rules.d/70-companion.rules": "usr/lib/udev/rules.d/70-companion.rules",
    "modules-load.d/companion.conf": "usr/lib/modules-load.d/companion.conf",
    "companion.toml": "usr/share/doc/companion/examples/companion.toml",
}
"""Of each file in systemd/; the units as they are shipped name /opt/companion already."""
SCRIPTS: Final = ("preinst", "postinst", "prerm", "postrm")


class BuildError(Exception):
    """Why there is no package, in one line."""


def main() -> int:
    """Build it; says where it is and how large."""
    parser = argparse.ArgumentParser(description="Build companion_VERSION_ARCHITECTURE.deb into dist/.")
    parser.add_argument("--python", default="/usr/bin/python3", help="the Python of the target (default: %(default)s)")
    parser.add_argument("--extras", default=DEFAULT_EXTRAS, help="parts to put in (default: %(default)s)")
    parser.add_argument("--work", type=Path, default=PROJECT / "build/deb", help="is emptied (default: build/deb)")
    parser.add_argument("--output", type=Path, default=PROJECT / "dist", help="(default: dist)")
    options = parser.parse_args()
    try:
        package = build(options.python, options.extras, options.work.absolute(), options.output.absolute())
    except BuildError as error:
        print(f"no package: {error}", file=sys.stderr)
        return 1
    print(f"{package}: {package.stat().st_size / 1e6:.1f} MB")
    return 0


def build(python: str, extras: str, work: Path, output: Path) -> Path:
    """Build the package.

    Raises:
        BuildError: something that it needs is missing, or a step failed.
    """
    os.umask(0o022)
    interpreter = debian_python(python)
    os.environ.setdefault("SOURCE_DATE_EPOCH", epoch())
    shutil.rmtree(work, ignore_errors=True)
    stage = work / "stage"
    wheels = collect_wheels(interpreter, extras, work)
    packages = install(interpreter, extras, work, wheels, stage)
    prune(packages)
    list_what_is_there(packages)
    retarget(interpreter, stage)
    system_files(stage)
    metadata = read_metadata(next(packages.glob("mavlink_imu_calibration-*.dist-info")))
    version = f"{metadata['Version']}-1+{interpreter.name.replace('thon', '').replace('.', '')}"
    documents(stage, packages, version)
    settle(stage)
    try_out(stage)
    compile_all(stage)
    refuse_traces(stage, work)
    fields = control(stage, work, version, interpreter.name)
    output.mkdir(parents=True, exist_ok=True)
    package = output / f"{fields['Package']}_{version}_{fields['Architecture']}.deb"
    admin(stage, fields)
    # xz: Ubuntu's dpkg-deb would take zstd, which Debian 11 and older tools cannot read.
    run("dpkg-deb", "--build", "--root-owner-group", "-Zxz", stage, package)
    return package


# --- the environment


def debian_python(python: str) -> Path:
    """The interpreter by its full name: /usr/bin/python3.11, whatever python3 means after an upgrade of the system.

    Raises:
        BuildError: it is not the distribution's, too old, or cannot make environments.
    """
    asked = "import sys; print(sys.prefix, '%d.%d' % sys.version_info[:2]); import venv, ensurepip"
    try:
        answer = subprocess.run([python, "-I", "-c", asked], capture_output=True, text=True, check=False)
    except OSError as error:
        raise BuildError(
            f"{python}: {error.strerror}; Debian's Python is needed: sudo apt install python3-venv"
        ) from None
    words = answer.stdout.split()
    if words[:1] != ["/usr"]:
        raise BuildError(
            f"{python} is not Debian's Python, which the package would run with; try --python /usr/bin/python3"
        )
    if answer.returncode:
        raise BuildError(f"{python} has no venv module: sudo apt install python3-venv")
    if tuple(map(int, words[1].split("."))) < (3, 11):
        raise BuildError(f"{python} is Python {words[1]}; the companion needs 3.11 or newer (Debian 12)")
    return Path(f"/usr/bin/python{words[1]}")


def collect_wheels(interpreter: Path, extras: str, work: Path) -> Path:
    """What the lock files name, hash for hash, and the companion, built with what they name too.

    Raises:
        BuildError: there is no lock for an extra, or a step failed.
    """
    locks = [lock_file(name) for name in ("runtime", *filter(None, extras.split(",")))]
    tools, wheels = work / "tools", work / "wheels"
    run(interpreter, "-m", "venv", tools)
    pip, quiet = tools / "bin/pip", ("--quiet", "--disable-pip-version-check")
    run(pip, "install", *quiet, "--require-hashes", "-r", lock_file("build"))
    listed: list[str | Path] = [word for path in locks for word in ("-r", path)]
    run(pip, "download", *quiet, "--require-hashes", "--only-binary", ":all:", "--no-deps", "--dest", wheels, *listed)
    run(pip, "wheel", *quiet, "--no-deps", "--no-build-isolation", "--wheel-dir", wheels, PROJECT)
    return wheels


def lock_file(name: str) -> Path:
    """The lock of an extra.

    Raises:
        BuildError: there is none.
    """
    path = PROJECT / f"requirements/{name}.txt"
    if not path.is_file():
        raise BuildError(f"{path} is not there: the extras are those in pyproject.toml, locked by make lock")
    return path


def install(interpreter: Path, extras: str, work: Path, wheels: Path, stage: Path) -> Path:
    """Make the environment and put the wheels in; returns its site-packages."""
    home = stage / HOME
    run(interpreter, "-m", "venv", "--symlinks", "--without-pip", home)
    pip = (work / "tools/bin/pip", "--python", home / "bin/python3", "install")
    quiet = ("--quiet", "--disable-pip-version-check", "--no-index", "--no-compile", "--find-links", wheels)
    run(*pip, *quiet, f"mavlink-imu-calibration[{extras}]" if extras else "mavlink-imu-calibration")
    return home / "lib" / interpreter.name / "site-packages"


def prune(packages: Path) -> None:
    """Take away what is never imported; `try_out` sees whether it is."""
    for pattern in NOT_NEEDED:
        for path in sorted(packages.glob(pattern)):
            remove(path)
    for path in sorted((packages / "pymavlink/dialects/v20").iterdir()):
        if path.name not in ONLY_DIALECTS:
            remove(path)


def list_what_is_there(packages: Path) -> None:
    """Take out of the wheels' lists of files what is not there, and the scripts, which named this machine's paths."""
    for record in sorted(packages.glob("*.dist-info/RECORD")):
        lines = record.read_text(encoding="utf-8").splitlines(keepends=True)
        names = [line.rsplit(",", 2)[0].strip('"') for line in lines]
        kept = [line for line, name in zip(lines, names, strict=True) if (packages / name).is_file()]
        record.write_text("".join(line for line in kept if not line.startswith("../")), encoding="utf-8")


def remove(path: Path) -> None:
    """Remove a file or a folder; one that went with its folder is gone already."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def retarget(interpreter: Path, stage: Path) -> None:
    """Make the environment what it would be, had it been made in /opt/companion."""
    home = stage / HOME
    for path in sorted((home / "bin").iterdir()):
        path.unlink()
    (home / "bin/python3").symlink_to(interpreter)
    script = f"#!/{HOME}/bin/python3\nimport sys\n\nfrom companion.cli import main\n\nsys.exit(main())\n"
    (home / "bin/companion").write_text(script)
    (home / "bin/companion").chmod(0o755)
    lines = ("home = /usr/bin", "include-system-site-packages = false", f"executable = {interpreter}")
    (home / "pyvenv.cfg").write_text("".join(f"{line}\n" for line in lines))
    # By this the companion knows that its service is the package's: see companion/installation/install.py.
    (home / "packaged-by").write_text("apt\n")
    for name in ("include", "share"):
        shutil.rmtree(home / name, ignore_errors=True)
    (stage / "usr/bin").mkdir(parents=True)
    (stage / "usr/bin/companion").symlink_to(f"/{HOME}/bin/companion")


def compile_all(stage: Path) -> None:
    """Compile for the target: a small board would take seconds at every start, as the service may not write there."""
    python = stage / HOME / "bin/python3"
    mode = ("--invalidation-mode", "timestamp")
    run(python, "-I", "-m", "compileall", "-q", *mode, "-s", stage, "-p", "/", stage / HOME / "lib")
    settle(stage)


def try_out(stage: Path) -> None:
    """Import all that the package has of ours, with nothing but what it has: nothing that is needed was left out."""
    code = (
        "import importlib, pkgutil, companion\n"
        "left_out = {'mavsdk', 'sqlalchemy', 'psycopg'}\n"
        "for module in pkgutil.walk_packages(companion.__path__, 'companion.'):\n"
        "    if module.name.endswith('__main__'):\n"
        "        continue\n"
        "    try:\n"
        "        importlib.import_module(module.name)\n"
        "    except ModuleNotFoundError as error:\n"
        "        if str(error.name).split('.')[0] not in left_out:\n"
        "            raise\n"
        "for distribution in importlib.metadata.distributions():\n"
        "    for name in (distribution.read_text('top_level.txt') or '').split():\n"
        "        if not name.startswith('_') and name not in left_out:\n"
        "            importlib.import_module(name)\n"
    )
    code = code.replace("import importlib, ", "import importlib, importlib.metadata, ")
    run(stage / HOME / "bin/python3", "-I", "-B", "-c", code)


def refuse_traces(stage: Path, work: Path) -> None:
    """Look for paths of this machine.

    Raises:
        BuildError: a file names the folder in which it was built.
    """
    for path in regular_files(stage):
        if str(work).encode() in path.read_bytes():
            raise BuildError(f"{path} names {work}, which the target does not have")


# --- what lies around it


def system_files(stage: Path) -> None:
    """Units, udev rules, modules, sample configuration, manual page."""
    for source, place in PLACES.items():
        target = stage / place
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(PROJECT / "systemd" / source, target)
    manual = stage / "usr/share/man/man1"
    manual.mkdir(parents=True)
    zip_to(manual / "companion.1.gz", (HERE / "companion.1").read_text())
    overrides = stage / "usr/share/lintian/overrides/companion"
    overrides.parent.mkdir(parents=True)
    shutil.copyfile(HERE / "lintian-overrides", overrides)


def documents(stage: Path, packages: Path, version: str) -> None:
    """What /usr/share/doc has to have, and our own documents, for the airfield without internet."""
    folder = stage / "usr/share/doc/companion"
    shutil.copytree(PROJECT / "docs", folder / "docs", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copyfile(PROJECT / "README.md", folder / "README.md")
    zip_to(folder / "changelog.gz", (PROJECT / "CHANGELOG.md").read_text())
    when = subprocess.run(
        ["date", "--utc", "--rfc-email", f"--date=@{os.environ['SOURCE_DATE_EPOCH']}"],
        capture_output=True, text=True, check=True,
    ).stdout.strip()  # fmt: skip
    entry = f"companion ({version}) unstable; urgency=medium\n\n  * See changelog.gz.\n\n -- {maintainer()}  {when}\n"
    zip_to(folder / "changelog.Debian.gz", entry)
    year = when.split()[3]
    parts = []
    for information in sorted(packages.glob("*.dist-info")):
        metadata = read_metadata(information)
        licence = metadata["License-Expression"] or (metadata["License"] or "").strip().partition("\n")[0]
        where = "/" + str(information.relative_to(stage))
        parts.append(f"  {metadata['Name']} {metadata['Version']}: {licence or 'see its files'}\n    {where}\n")
    (folder / "copyright").write_text(
        f"companion: Copyright (c) {year} its authors; licensed under the Apache License, version 2.0.\n"
        "On Debian systems its text is in /usr/share/common-licenses/Apache-2.0.\n\n"
        "The package also has, each with the text of its licence in the folder named below it (LGPL:\n"
        "/usr/share/common-licenses/LGPL-3; what pymavlink consists of is here as source):\n\n" + "".join(parts)
    )


def zip_to(path: Path, text: str) -> None:
    """Write gzip without a time and name of its own."""
    path.write_bytes(gzip.compress(text.encode(), 9, mtime=0))


def settle(stage: Path) -> None:
    """Give every file the one time and mode that it will have, so that the same input makes the same package."""
    when = int(os.environ["SOURCE_DATE_EPOCH"])
    for path in [stage, *sorted(stage.rglob("*"))]:
        if path.is_symlink():
            os.utime(path, (when, when), follow_symlinks=False)
            continue
        executable = path.is_dir() or path.parent == stage / HOME / "bin"
        path.chmod(0o755 if executable else 0o644)
        os.utime(path, (when, when))


def control(stage: Path, work: Path, version: str, python: str) -> dict[str, str]:
    """The fields of DEBIAN/control.

    python3.11 and not python3: the environment's compiled parts fit that one minor version. When the system moves to
    another, apt keeps python3.11 for us, or says that companion would have to go; nothing breaks in silence.
    """
    size = sum(max(path.stat().st_size, 1) for path in regular_files(stage))
    description = (
        f"{SYNOPSIS}\n"
        " A daemon for the companion computer of a small aircraft. While the aircraft\n"
        " stands still, a two-axis tilt sensor (gradienter) and a magnetic compass say\n"
        " how it stands, and with that what its gyros and accelerometers should read;\n"
        " the rest is their bias. It is written to the parameters of the autopilot\n"
        " (ArduPilot or PX4, over MAVLink) and read back.\n"
        " .\n"
        " After the installation: sudo companion setup"
    )
    return {
        "Package": "companion",
        "Version": version,
        "Architecture": output_of("dpkg", "--print-architecture"),
        "Maintainer": maintainer(),
        "Installed-Size": str(-(-size // 1024)),
        "Depends": f"{python}, {libraries(stage, work)}",
        "Recommends": "systemd, udev",
        "Section": "science",
        "Priority": "optional",
        "Description": description,
    }


def libraries(stage: Path, work: Path) -> str:
    """On which libraries, since which version, the compiled parts depend, as dpkg-shlibdeps finds it."""
    # Where it is, dpkg-shlibdeps knows what is the package's own.
    (stage / "DEBIAN").mkdir()
    compiled = [path for path in regular_files(stage) if ".so" in path.name]
    (work / "debian").mkdir()
    (work / "debian/control").write_text("Source: companion\n\nPackage: companion\nArchitecture: any\n")
    found = output_of("dpkg-shlibdeps", "-O", "--warnings=0", "--ignore-missing-info", *map(str, compiled), cwd=work)
    return found.removeprefix("shlibs:Depends=")


def admin(stage: Path, fields: dict[str, str]) -> None:
    """The DEBIAN folder."""
    folder = stage / "DEBIAN"
    (folder / "control").write_text("".join(f"{name}: {value}\n" for name, value in fields.items()))
    sums = ""
    for path in regular_files(stage):
        if not path.is_relative_to(folder):
            digest = hashlib.md5(path.read_bytes(), usedforsecurity=False).hexdigest()
            sums += f"{digest}  {path.relative_to(stage)}\n"
    (folder / "md5sums").write_text(sums)
    for name in SCRIPTS:
        shutil.copyfile(HERE / name, folder / name)
        (folder / name).chmod(0o755)


# --- small things


def maintainer() -> str:
    """As Debian's own tools are told it."""
    name, address = os.environ.get("DEBFULLNAME"), os.environ.get("DEBEMAIL")
    return f"{name} <{address}>" if name and address else MAINTAINER


def read_metadata(information: Path) -> email.message.Message:
    """What a distribution says of itself."""
    return email.parser.Parser().parsestr((information / "METADATA").read_text(encoding="utf-8"), headersonly=True)


def epoch() -> str:
    """Return the time of the latest commit, or of the change log where there is no git."""
    # git refuses to read what another user owns; building it is more trust than reading it.
    asked = ["git", "-c", f"safe.directory={PROJECT}", "-C", str(PROJECT), "log", "-1", "--format=%ct"]
    try:
        answer = subprocess.run(asked, capture_output=True, text=True, check=False).stdout.strip()
    except FileNotFoundError:
        answer = ""
    return answer or str(int((PROJECT / "CHANGELOG.md").stat().st_mtime))


def regular_files(folder: Path) -> Iterator[Path]:
    """All files below a folder, sorted."""
    for path in sorted(folder.rglob("*")):
        if stat.S_ISREG(path.lstat().st_mode):
            yield path


def run(*command: str | Path) -> None:
    """Run a command.

    Raises:
        BuildError: it is missing, or failed.
    """
    output_of(*command, capture=False)


def output_of(*command: str | Path, capture: bool = True, cwd: Path | None = None) -> str:
    """What a command prints, without its last newline.

    Raises:
        BuildError: it is missing, or failed.
    """
    words: Sequence[str] = [str(word) for word in command]
    pipe = subprocess.PIPE if capture else None
    try:
        done = subprocess.run(words, stdout=pipe, text=True, check=False, cwd=cwd)
    except FileNotFoundError as error:
        raise BuildError(f"{error.filename} is not there: sudo apt install dpkg-dev") from None
    if done.returncode:
        raise BuildError(f"{' '.join(words[:4])} ... ended with exit code {done.returncode}")
    return (done.stdout or "").strip()


if __name__ == "__main__":
    sys.exit(main())
