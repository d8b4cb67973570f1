"""Questions in SQL about many sessions: what is answered, what is left out, what is locked."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import pytest

from devices.errors import FileFormatError, UsageError
from service.offline.archive.query import MARKERS_SCHEMA, SESSIONS_SCHEMA, find_sessions, run_query
from storage.sessions.reader import SealedFileReader
from tests.service.offline.archives import IDS, recording, sealed, with_a_damaged_page

PEAKS_N = {0: (20.0, 30.0, 40.0), 1: (24.0, 34.0, 44.0, 54.0), 2: (50.0, 50.0, 50.0)}
THIRD_IN_MUD = """
    SELECT session_id, peak_grf_n, peak_sigma_n, is_whole
    FROM stances JOIN sessions USING (session_id)
    WHERE scene = 'mud' AND number = 3 ORDER BY session_id
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two sessions in mud, one on a plate, and one in mud without estimates."""
    data = tmp_path_factory.mktemp("archive")
    for number, peaks_n in PEAKS_N.items():
        sealed(data, number, *peaks_n, scene="plate" if number == 2 else "mud")
    sealed(data, 3, 60.0, is_calibrated=False)
    return data


@pytest.fixture
def data(made: Path, tmp_path: Path) -> Path:
    """A copy of these, to be changed."""
    return Path(shutil.copytree(made, tmp_path / "data"))


def answer(sql: str, *places: Path) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = run_query(find_sessions([str(p) for p in places]), sql).to_pylist()
    return rows


def test_the_peaks_of_all_third_hops_in_mud(made: Path) -> None:
    rows = answer(THIRD_IN_MUD, made)
    assert [row["session_id"] for row in rows] == [IDS[0], IDS[1]]
    for row, peak_n in zip(rows, (40.0, 44.0), strict=True):
        assert row["peak_grf_n"] == pytest.approx(peak_n, abs=5.0)
        assert row["is_whole"]


def test_sessions_markers_and_frames_are_views_of_the_folders(made: Path) -> None:
    sessions = answer("SELECT * FROM sessions ORDER BY session_id", made)
    assert [row["session_id"] for row in sessions] == list(IDS[:4])
    assert [row["scene"] for row in sessions] == ["mud", "mud", "plate", "mud"]
    assert "no estimates" in sessions[3]["problem"]
    counted = answer("SELECT session_id, count(*) AS n FROM frames GROUP BY 1 ORDER BY 1", made)
    assert [row["n"] for row in counted] == [row["frames"] for row in sessions]
    markers = answer("SELECT session_id, label FROM markers ORDER BY 1", made)
    assert markers == [{"session_id": session_id, "label": "=off"} for session_id in IDS[:4]]


def test_frames_have_the_numbers_of_the_sealed_file(made: Path) -> None:
    with SealedFileReader(made / "sessions" / IDS[1] / "frames.parquet") as session:
        (columns,) = session.read_quantities("t_ns", "pressure_raw", "grf_n")
    rows = run_query(
        find_sessions([str(made)]),
        "SELECT t_ns, pressure_raw_1, grf_n FROM frames "  # noqa: S608  # our own words
        f"WHERE session_id = '{IDS[1]}' ORDER BY t_ns",
    )
    assert rows["t_ns"].to_pylist() == columns["t_ns"].tolist()
    assert rows["pressure_raw_1"].to_pylist() == columns["pressure_raw"][:, 1].tolist()
    assert rows["grf_n"].to_pylist() == columns["grf_n"].tolist()


def test_frames_without_estimates_are_null_there(made: Path) -> None:
    sql = f"SELECT count(*) AS n, count(grf_n) AS known FROM frames WHERE session_id = '{IDS[3]}'"  # noqa: S608  # our own words
    (row,) = answer(sql, made)
    assert row["n"] > 0
    assert row["known"] == 0


def test_a_session_in_two_places_is_asked_once(made: Path) -> None:
    count = "SELECT count(*) AS n FROM sessions"
    one = made / "sessions" / IDS[0]
    assert answer(count, made / "sessions" / "*Z-00000[01]") == [{"n": 2}]
    assert answer(count, one, made) == [{"n": 4}]
    with pytest.raises(UsageError, match="no session or folder"):
        find_sessions([str(made / "nowhere")])


def test_a_session_that_is_recording_or_damaged_is_left_out_and_named(data: Path) -> None:
    sessions = data / "sessions"
    recording(data, 4)
    (sessions / IDS[0] / "frames.parquet").unlink()
    text = (sessions / IDS[1] / "session.json").read_bytes()
    (sessions / IDS[1] / "session.json").write_bytes(text.replace(b"trial 1", b"trial 2"))
    with (sessions / IDS[2] / "frames.parquet").open("ab") as file:
        file.write(b"more")
    shutil.copytree(sessions / IDS[3], sessions / IDS[5])
    archive = find_sessions([str(data)])
    assert [session.session_id for session in archive.sessions] == [IDS[3]]
    left_out = {Path(place).name: reason for place, reason in archive.left_out_reasons.items()}
    assert left_out == {
        IDS[0]: "damaged: frames.parquet is missing",
        IDS[1]: "damaged: session.json: it was changed: its text does not match its hash",
        IDS[2]: "damaged: frames.parquet is not as long as session.json says",
        IDS[4]: "it is recording, and not sealed yet",
        IDS[5]: f"it is session {IDS[3]} in another session's folder",
    }


def test_a_session_that_is_there_twice_counts_once_and_the_other_is_named(
    made: Path, data: Path
) -> None:
    archive = find_sessions([str(made), str(data)])
    assert len(archive.sessions) == 4
    assert set(archive.left_out_reasons) == {
        str(data / "sessions" / session_id) for session_id in IDS[:4]
    }


def test_a_damaged_page_is_an_error_and_no_number(data: Path) -> None:
    path = data / "sessions" / IDS[0] / "frames.parquet"
    path.write_bytes(with_a_damaged_page(path))
    with pytest.raises(FileFormatError, match="frames cannot be read"):
        answer("SELECT sum(grf_n) FROM frames", data)


def test_a_damaged_footer_leaves_the_session_out_of_frames_and_sessions(data: Path) -> None:
    path = data / "sessions" / IDS[0] / "frames.parquet"
    content = bytearray(path.read_bytes())
    content[-40] ^= 1
    path.write_bytes(content)
    archive = find_sessions([str(data)])
    sql = "SELECT DISTINCT session_id FROM frames JOIN sessions USING (session_id) ORDER BY 1"
    assert [row["session_id"] for row in run_query(archive, sql).to_pylist()] == list(IDS[1:4])
    assert list(archive.left_out_reasons) == [str(data / "sessions" / IDS[0])]


def test_stances_that_a_session_lacks_are_made_and_kept(data: Path) -> None:
    path = data / "sessions" / IDS[0] / "stances.parquet"
    written, rows = path.read_bytes(), answer(THIRD_IN_MUD, data)
    path.unlink()
    assert answer(THIRD_IN_MUD, data) == rows
    assert path.read_bytes() == written


@pytest.mark.parametrize(
    "sql",
    [
        "SELECT * FROM read_csv('/etc/passwd')",
        "SELECT * FROM '/etc/passwd'",
        "SELECT * FROM read_parquet('{one}/frames.parquet')",
        "SELECT * FROM glob('/*')",
        "SELECT * FROM read_text('{one}/session.json')",
        "SELECT * FROM archive",  # a variable of the program
        "COPY (SELECT 1) TO '{one}/new.csv'",
        "ATTACH '{one}/new.db'",
        "INSTALL httpfs",
        "LOAD httpfs",
        "SET enable_external_access = true",
        "CREATE TABLE more AS SELECT 1",
        "DROP VIEW sessions",
        "SELECT 1; SELECT 2",
        "",
    ],
)
def test_nothing_but_a_select_over_the_views_is_answered(made: Path, sql: str) -> None:
    one = made / "sessions" / IDS[0]
    before = sorted(one.iterdir())
    with pytest.raises(UsageError):
        answer(sql.format(one=one), made)
    assert sorted(one.iterdir()) == before


def test_two_columns_of_one_name_are_refused(made: Path) -> None:
    with pytest.raises(UsageError, match="two columns are called 'a'"):
        answer("SELECT 1 AS a, 2 AS a", made)


def test_sums_of_integers_are_integers_however_great(made: Path) -> None:
    (row,) = answer(
        "SELECT sum(n) AS n, 4 * max(n)::HUGEINT AS great FROM (SELECT 2::BIGINT**62 AS n)", made
    )
    assert row["n"] == 2**62
    assert row["great"] == 2**64


def test_a_question_reads_only_the_views_that_it_selects_from(
    made: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    archive = find_sessions([str(made)])
    # `frames` is a column here, and `stances` a text: neither is opened.
    monkeypatch.setattr(type(archive), "open_frames_dataset", None)
    monkeypatch.setattr(type(archive), "build_stances_table", None)
    sql = "SELECT sum(frames) AS n, 'stances' AS text FROM sessions"
    (row,) = run_query(archive, sql).to_pylist()
    assert isinstance(row["n"], int)


DOCUMENT = (Path(__file__).resolve().parents[4] / "docs" / "query.md").read_text("utf-8")


@pytest.mark.parametrize("sql", re.findall(r"```sql\n(.*?)```", DOCUMENT, re.DOTALL))
def test_every_example_of_the_document_is_answered(made: Path, sql: str) -> None:
    answer(sql, made)


def test_the_first_example_and_its_variant_find_the_third_hops(made: Path) -> None:
    first, variant, *_ = re.findall(r"```sql\n(.*?)```", DOCUMENT, re.DOTALL)
    expected = [(row["session_id"], row["peak_grf_n"]) for row in answer(THIRD_IN_MUD, made)]
    assert len(expected) == 2
    found = {(row["session_id"], row["peak_grf_n"]) for row in answer(first, made)}
    assert found == set(expected)
    assert {(row["session_id"], row["peak_grf_n"]) for row in answer(variant, made)} >= found


def test_every_column_of_sessions_and_events_is_documented() -> None:
    for name in (*SESSIONS_SCHEMA.names, *MARKERS_SCHEMA.names):
        assert f"`{name}`" in DOCUMENT, name
