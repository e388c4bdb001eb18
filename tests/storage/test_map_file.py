"""The file of a map: rows, seals, and everything that must be refused."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import pytest

from slam.errors import MapFileError
from slam.storage.map_file import MapFile
from slam.storage.map_tables import CHECKPOINT, FACTORS, FRAMES, GRIDS, META, SCHEMA_VERSION, TABLES

ROW = ("lidar match", 3, 4, 1, 0, None, b"motion", b"covariance")


def sealed(path: Path, rows: int = 3) -> Path:
    file = MapFile.create(path)
    file.add_meta("log_name", "a log")
    for _ in range(rows):
        file.append(FACTORS, *ROW)
    file.seal()
    return path


def edit(path: Path, *statements: str) -> None:
    with sqlite3.connect(path) as connection:
        for statement in statements:
            connection.execute(statement)
    connection.close()


def refusal(path: Path) -> str:
    """Why a map is refused by whoever reads all of it."""
    with pytest.raises(MapFileError) as caught:
        file = MapFile.read(path)
        try:
            for table in TABLES:
                for number in range(file.count(table)):
                    file.row(table, number)
        finally:
            file.close()
    assert len(str(caught.value).splitlines()) == 1
    return str(caught.value)


class TestRows:
    def test_what_is_written_is_read(self, tmp_path: Path) -> None:
        file = MapFile.read(sealed(tmp_path / "map.db"))
        assert file.finished and file.meta()["log_name"] == "a log"
        assert [file.count(table) for table in (FACTORS, FRAMES, META)] == [3, 0, 2]
        assert list(file.rows(FACTORS)) == [ROW] * 3
        assert file.row(FACTORS, 2) == ROW
        file.close()

    def test_one_file_is_left_and_its_bytes_follow_from_its_rows(self, tmp_path: Path) -> None:
        one = sealed(tmp_path / "map.db")
        assert [path.name for path in tmp_path.iterdir()] == ["map.db"]
        other = MapFile.create(tmp_path / "other.db")
        other.add_meta("log_name", "a log")
        other.append(CHECKPOINT, 0, b"x" * 100_000)
        for _ in range(3):
            other.append(FACTORS, *ROW)
            other.commit()  # how often is a matter of time
        other.seal()
        assert (tmp_path / "other.db").read_bytes() == one.read_bytes()
        assert one.stat().st_size < 60_000

    def test_tidying_up_twice_changes_nothing(self, tmp_path: Path) -> None:
        """Killed between its last word and the end of the tidying up, a map is tidied up again."""
        path = sealed(tmp_path / "map.db")
        before = path.read_bytes()
        again = MapFile.resume(path)
        assert again is not None and again.finished
        again.compact()
        assert path.read_bytes() == before

    def test_reading_writes_nothing(self, tmp_path: Path) -> None:
        path = sealed(tmp_path / "map.db")
        before = path.read_bytes()
        file = MapFile.read(path)
        with pytest.raises(MapFileError, match="cannot be written"):
            file.append(FACTORS, *ROW)
        file.close()
        assert path.read_bytes() == before
        assert [path.name for path in tmp_path.iterdir()] == ["map.db"]

    def test_a_folder_names_its_map(self, tmp_path: Path) -> None:
        sealed(tmp_path / "map.db")
        MapFile.read(tmp_path).close()

    @pytest.mark.parametrize("name", ["with blank.db", "what?.db", "100%.db", "a#b.db"])
    def test_any_name_will_do(self, tmp_path: Path, name: str) -> None:
        MapFile.read(sealed(tmp_path / name)).close()


class TestGoingOn:
    def test_what_was_committed_is_there(self, tmp_path: Path) -> None:
        path = tmp_path / "map.db"
        file = MapFile.create(path)
        file.append(FACTORS, *ROW)
        file.before_commit(lambda: file.append(GRIDS, "flushed", 0, 0, 0.1, b"", b""))
        file.commit()
        file.append(FACTORS, *ROW)  # lost
        file.close()
        assert "is not finished" in refusal(path) and "--resume" in refusal(path)
        again = MapFile.resume(path)
        assert again is not None and not again.finished
        assert (again.count(FACTORS), again.count(GRIDS)) == (1, 1)
        again.append(FACTORS, *ROW)
        again.seal()
        MapFile.read(path).close()

    def test_nothing_to_go_on_with(self, tmp_path: Path) -> None:
        assert MapFile.resume(tmp_path / "map.db") is None
        (tmp_path / "map.db").write_bytes(b"")
        assert MapFile.resume(tmp_path / "map.db") is None
        file = MapFile.create(tmp_path / "early.db")
        file.close()  # before the first commit
        assert MapFile.resume(tmp_path / "early.db") is None

    def test_two_at_once(self, tmp_path: Path) -> None:
        file = MapFile.create(tmp_path / "map.db")
        file.commit()
        with pytest.raises(MapFileError, match="another run is writing it"):
            MapFile.resume(tmp_path / "map.db")
        file.close()

    def test_another_file_is_not_gone_on_with(self, tmp_path: Path) -> None:
        (tmp_path / "text.db").write_text("no database\n" * 100)
        with pytest.raises(MapFileError, match="not a database"):
            MapFile.resume(tmp_path / "text.db")
        edit(tmp_path / "other.db", "CREATE TABLE a (b)")
        with pytest.raises(MapFileError, match="no map of Scanweave"):
            MapFile.resume(tmp_path / "other.db")

    def test_a_new_map_takes_the_place_of_anything(self, tmp_path: Path) -> None:
        path = tmp_path / "map.db"
        for left in (path, tmp_path / "map.db-wal", tmp_path / "map.db-journal"):
            left.write_text("left behind")
        sealed(path)
        MapFile.read(path).close()
        with pytest.raises(MapFileError, match="cannot be made"):
            MapFile.create(tmp_path / "no folder" / "map.db")


class TestRefused:
    def test_what_is_no_map(self, tmp_path: Path) -> None:
        assert "no map at" in refusal(tmp_path)
        assert "no map at" in refusal(tmp_path / "missing.db")
        (tmp_path / "text.db").write_text("no database\n" * 100)
        assert "not an SQLite file" in refusal(tmp_path / "text.db")
        (tmp_path / "empty.db").write_bytes(b"")
        assert "not an SQLite file" in refusal(tmp_path / "empty.db")
        edit(tmp_path / "other.db", "CREATE TABLE a (b)")
        assert "no map of Scanweave" in refusal(tmp_path / "other.db")

    def test_a_newer_one(self, tmp_path: Path) -> None:
        edit(sealed(tmp_path / "map.db"), f"PRAGMA user_version = {SCHEMA_VERSION + 1}")
        assert f"schema {SCHEMA_VERSION + 1}, this Scanweave reads up to" in refusal(tmp_path / "map.db")

    @pytest.mark.parametrize("beside", ["map.db-wal", "map.db-journal"])
    def test_one_that_is_being_written(self, tmp_path: Path, beside: str) -> None:
        sealed(tmp_path / "map.db")
        (tmp_path / beside).write_bytes(b"")
        assert "is not finished" in refusal(tmp_path / "map.db")

    @pytest.mark.parametrize(
        ("statement", "parts"),
        [
            ("UPDATE factors SET target = 5 WHERE number = 1", ["table factors, row 1", "checksum"]),
            ("UPDATE factors SET loop = 0 WHERE number = 2", ["table factors, row 2", "checksum"]),
            ("UPDATE factors SET motion = 'motion' WHERE number = 0", ["table factors, row 0", "checksum"]),
            ("UPDATE factors SET kept = 0.5 WHERE number = 0", ["table factors, row 0", "checksum"]),
            ("UPDATE factors SET checksum = x'00' WHERE number = 0", ["table factors", "sealed"]),
            ("DELETE FROM factors WHERE number = 1", ["table factors", "without a gap"]),
            ("DELETE FROM factors WHERE number = 2", ["table factors has 2 rows", "sealed were 3"]),
            ("UPDATE factors SET number = 9 WHERE number = 2", ["table factors", "without a gap"]),
            ("INSERT INTO journal VALUES (0, x'00', 0, x'')", ["table journal has 1 rows"]),
            ("UPDATE meta SET value = 'b log' WHERE number = 0", ["table meta, row 0", "checksum"]),
            ("DELETE FROM meta WHERE key = 'seal'", ["is not finished"]),
            ("DROP TABLE grids", ["tables are not those"]),
            ("ALTER TABLE grids ADD COLUMN more", ["tables are not those"]),
            ("CREATE TRIGGER t AFTER INSERT ON grids BEGIN SELECT 1; END", ["tables are not those"]),
            ("CREATE VIEW v AS SELECT * FROM grids", ["tables are not those"]),
        ],
    )
    def test_what_was_changed_since(self, tmp_path: Path, statement: str, parts: list[str]) -> None:
        edit(sealed(tmp_path / "map.db"), statement)
        said = refusal(tmp_path / "map.db")
        assert [part for part in parts if part not in said] == [], said

    def test_swapped_rows(self, tmp_path: Path) -> None:
        path = tmp_path / "map.db"
        file = MapFile.create(path)
        for n in range(2):
            file.append(GRIDS, f"grid {n}", n, n, 0.1, b"", b"")
        file.seal()
        edit(path, "UPDATE grids SET number = 1 - number + 10", "UPDATE grids SET number = number - 10")
        assert "table grids" in refusal(path)

    @pytest.mark.parametrize("share", [0.1, 0.5, 0.99])
    def test_a_cut_file(self, tmp_path: Path, share: float) -> None:
        path = sealed(tmp_path / "map.db", rows=2000)
        content = path.read_bytes()
        path.write_bytes(content[: int(share * len(content))])
        refusal(path)

    def test_pages_that_sqlite_finds_wrong(self, tmp_path: Path) -> None:
        file = MapFile.read(sealed(tmp_path / "map.db"))
        file.check_pages()
        file.close()

    @pytest.mark.parametrize("seal", ["", "[]", "[[1]]", "{"])
    def test_a_seal_that_is_none(self, tmp_path: Path, seal: str) -> None:
        path = sealed(tmp_path / "map.db")
        checksum = META.checksum(1, ("seal", seal)).hex()
        edit(path, f"UPDATE meta SET value = '{seal}', checksum = x'{checksum}' WHERE key = 'seal'")
        assert "table meta, row 1" in refusal(path)
