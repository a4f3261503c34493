"""Content of the pages, read by an independent parser."""

from __future__ import annotations

import datetime
import json
import re
from html.parser import HTMLParser
from pathlib import Path

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.cli import main
from companion.physics.units import DEG_H, MG
from companion.report.calibration import calibration_page, read_material
from companion.report.page import unix_s
from companion.samples import Vector
from companion.storage.records import RecordStore
from tests.support.histories import a_season, arming, imu_record, record

NOW = datetime.datetime(2026, 6, 1, 12, 0, tzinfo=datetime.UTC)
LARGEST = 500_000
VOID = {"meta", "br"}


class Page(HTMLParser):
    """Collects what a page holds; fails on tags that do not match."""

    def __init__(self, content: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.rows: list[list[str]] = []
        """The cells of each row of a table."""
        self.feed(content)
        self.close()
        assert self.open == []

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag in VOID:
            return
        self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
        if tag == "td":
            self.rows[-1].append("")

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "style":
            return
        self.words.append(data)
        if "td" in self.open:
            self.rows[-1][-1] += data


def _calibration(folder: Path, wanted: int | None = None) -> str:
    return calibration_page(*read_material(folder, wanted), NOW)


def test_the_figures_are_those_of_the_record(tmp_path: Path) -> None:
    one = record()
    RecordStore(tmp_path).save(one)
    found = Page(_calibration(tmp_path))
    axes = (row for row in found.rows if row[:1] in (["x"], ["y"], ["z"]))
    for imu in one.imus:
        triads = (
            (DEG_H, imu.gyro_bias_rad_s, imu.gyro_sigma_use_rad_s, imu.gyro_sigma_stat_rad_s),
            (MG, imu.accel_bias_m_s2, imu.accel_sigma_use_m_s2, imu.accel_sigma_stat_m_s2),
        )
        for axis in range(3):
            for cell, (unit, biases, sigmas, _) in zip(next(axes)[1:], triads, strict=True):
                assert biases is not None
                assert sigmas is not None
                bias, sigma = map(float, cell.split(" ± "))
                assert bias == pytest.approx(biases[axis] / unit, rel=0.02)
                assert sigma == pytest.approx(sigmas[axis] / unit, rel=0.06)
        for unit, _, _, noise in triads:
            for axis in range(3):
                assert noise is not None
                assert float(next(axes)[1]) == pytest.approx(noise[axis] / unit, rel=0.06)
    for parameter, written in one.imus[0].written.items():
        at = next(k for k, row in enumerate(found.rows) if row and row[0].startswith(f"{parameter}: "))
        before = "unknown" if written.before is None else f"{written.before:.6g}"
        assert found.rows[at + 1][0].startswith(f"{before} → {written.after:.6g}")
        assert f"{parameter}: {written.outcome}" in found.text.replace(" :", ":")
    assert "unknown" in found.text
    assert one.pose is not None
    angles = {row[0]: row[1].removesuffix(" deg").split(" ± ") for row in found.rows if row and " deg" in row[-1]}
    for words, *figures in (
        ("pitch, nose up", one.pose.theta_deg, one.pose.sigma_deg.theta),
        ("heading, true", one.pose.psi_deg, one.pose.sigma_deg.psi),
    ):
        assert [float(each) for each in angles[words]] == pytest.approx(figures, rel=0.06)
    assert "DONE" in found.text
    assert one.reason in found.text


def test_a_page_needs_nothing_else_and_stays_small(tmp_path: Path) -> None:
    names = [f"imu {k}" for k in range(9)]
    store = RecordStore(tmp_path)
    for k in range(230):
        one = record(k, imus=tuple(imu_record(name, k) for name in names), warnings=tuple(["x" * 5000] * 100))
        store.save(one)
    content = calibration_page(*read_material(tmp_path, None), NOW)
    assert len(content.encode()) < LARGEST
    found = Page(content)
    assert "5 more IMUs are not shown" in found.text
    assert not re.search(r"https?:|//[a-z]|url\(|@import|javascript:", content.replace("http-equiv", ""), re.IGNORECASE)
    tags = {tag for tag, _ in found.tags}
    assert not tags & {"script", "link", "img", "iframe", "object", "embed", "form", "base", "a", "use", "image"}
    for _, held in found.tags:
        assert not {"src", "href", "xlink:href", "srcset", "action"} & held.keys()
        assert not any(name.startswith("on") for name in held)
    policies = [held["content"] for _, held in found.tags if held.get("http-equiv") == "Content-Security-Policy"]
    assert len(policies) == 1
    assert (policies[0] or "").startswith("default-src 'none';")


def test_nothing_from_a_file_becomes_a_tag(tmp_path: Path) -> None:
    evil = '</title></style><script>alert(1)</script><img src=x onerror=alert(1)>"\' onload="x" \u202egnp\x00\x1b[2J'
    one = record(
        imus=(msgspec.structs.replace(imu_record(evil), warnings=(evil,)),), reason=evil, warnings=(evil,), system_id=1
    )
    written = {evil: next(iter(one.imus[0].written.values()))}
    imu = msgspec.structs.replace(one.imus[0], written=written)
    assert one.site is not None
    one = msgspec.structs.replace(one, imus=(imu,), site=msgspec.structs.replace(one.site, source=evil), undone_at=evil)
    failed = record(1, state="failed", reason=evil)
    store = RecordStore(tmp_path)
    store.save(one)
    store.save(failed)
    guilty = msgspec.structs.replace(arming(one), reason=evil)
    (tmp_path / "armings.json").write_bytes(msgspec.json.encode([guilty]))
    for content in (
        calibration_page(*read_material(tmp_path, 1), NOW),
        calibration_page(*read_material(tmp_path, 2), NOW),
    ):
        found = Page(content)
        assert {tag for tag, _ in found.tags} <= {
            "html", "head", "meta", "title", "style", "body", "h1", "h2", "h3", "p", "span", "div", "section", "strong",
            "small", "ul", "li", "table", "tr", "th", "td", "br", "figure", "figcaption", "details", "summary",
            "svg", "path", "rect", "text", "circle",
        }  # fmt: skip
        assert not any(name.startswith("on") for _, held in found.tags for name in held)
        assert "<script>alert(1)</script>" in found.text  # as words
        assert not re.search("[\x00\x1b\u202e]", content)


def test_a_failure_says_why(tmp_path: Path) -> None:
    failed = record(
        state="failed", reason="not finished in the time given: hold still: gyro fc moves 0.31 deg/s, max 0.10"
    )
    RecordStore(tmp_path).save(failed)
    found = Page(_calibration(tmp_path))
    assert "FAILED" in found.text
    assert failed.reason in found.text
    assert "Nothing was written to the autopilot" in found.text


def test_a_clock_that_went_back_is_said_and_order_is_used(tmp_path: Path) -> None:
    store = RecordStore(tmp_path)
    for k, year in enumerate((2026, 1970, 1970)):
        store.save(record(k, started_at=f"{year}-01-01T00:0{k}:00.000+00:00"))
    found = Page(_calibration(tmp_path))
    assert "The companion's clock went back in between" in found.text
    assert unix_s("yesterday") is None
    assert unix_s("2026-05-01T10:00:00+02:00") == unix_s("2026-05-01T08:00:00")
    assert "number of the calibration" in found.text


# -------------------------------------------------------------------------------------------------------- the command


def test_the_command_writes_a_file_and_says_where(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    a_season(tmp_path / "kept", 5)
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "kept").rglob("*")}
    target = tmp_path / "page.html"
    arguments = ["report", "--storage", str(tmp_path / "kept"), "-o", str(target), "--json"]
    assert main([*arguments, "-c", str(tmp_path / "none.toml")]) == 0
    assert json.loads(capsys.readouterr().out) == {"state": "done", "reason": "", "file": str(target)}
    assert "Calibration 5" in Page(target.read_text()).text
    assert main(["report", "2", *arguments[1:-1]]) == 0
    assert capsys.readouterr().out == f"{target}\n"
    assert "Calibration 2 " in Page(target.read_text()).text
    # Read-only: nothing in the storage was touched.
    assert before == {path: path.stat().st_mtime_ns for path in (tmp_path / "kept").rglob("*")}


@pytest.mark.parametrize(
    ("more", "reason"),
    [
        (["7"], "no calibration 7; there are number 1 to 3"),
        (["2"], "000002.json: cannot be used: "),
        (["-o", "{folder}/none/x.html"], "there is no folder "),
    ],
)
def test_what_cannot_be_done_is_said_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], more: list[str], reason: str
) -> None:
    a_season(tmp_path, 3)
    (tmp_path / "records" / "000002.json").write_bytes(b"{")
    assert main(["report", *(word.format(folder=tmp_path) for word in more), "--storage", str(tmp_path), "--json"]) == 1
    said = capsys.readouterr()
    answer = json.loads(said.out)
    assert answer["state"] == "failed"
    assert reason in answer["reason"]
    assert len(said.err.splitlines()) == 1


def test_what_was_held_back_is_not_shown_as_in_force(tmp_path: Path) -> None:
    imu = msgspec.structs.replace(imu_record(), held_back=("accel",))
    gyros_alone = msgspec.structs.replace(
        imu_record("own", 1), accel_bias_m_s2=None, accel_sigma_stat_m_s2=None, accel_sigma_use_m_s2=None
    )
    RecordStore(tmp_path).save(record(imus=(imu, gyros_alone)))
    found = Page(_calibration(tmp_path))
    assert found.text.count("Held back: accelerometer measured, not written.") == 1
    assert found.text.count("Accelerometer not determined: not requested") == 1


_floats = st.floats(allow_nan=False, allow_infinity=False)
_axes = st.tuples(_floats, _floats, _floats)
_times = st.one_of(st.datetimes().map(lambda t: t.isoformat()), st.text(max_size=30))


_COLUMNS = (
    "gyro_bias_rad_s", "gyro_sigma_stat_rad_s", "gyro_sigma_use_rad_s",
    "accel_bias_m_s2", "accel_sigma_stat_m_s2", "accel_sigma_use_m_s2",
)  # fmt: skip


@settings(max_examples=25)
@given(
    axes=st.lists(_axes, min_size=6, max_size=6),
    temperatures=st.lists(st.none() | _floats, min_size=3, max_size=3),
    started=st.lists(_times, min_size=3, max_size=3),
    words=st.text(),
)
def test_whatever_a_record_holds_gives_pages(
    axes: list[Vector], temperatures: list[float | None], started: list[str], words: str
) -> None:
    records = []
    for k, (temperature, at) in enumerate(zip(temperatures, started, strict=True)):
        columns = dict(zip(_COLUMNS, axes[k:] + axes[:k], strict=True))
        imu = msgspec.structs.replace(imu_record(), name=words, temperature_degc=temperature, **columns)
        records.append((k, record(k, imus=(imu,), started_at=at, reason=words)))
    drawn = [
        held
        for tag, held in Page(calibration_page(records, [], [words], NOW)).tags
        if tag in {"path", "rect", "circle", "text"}
    ]
    assert not any(re.search("nan|inf", str(value)) for held in drawn for key, value in held.items() if key != "class")


# ---------------------------------------------------------------------------------------------------------- a browser
