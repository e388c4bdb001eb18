import gzip

import pytest

from slam.errors import EvaluationError, MapFileError
from slam.storage.files import (
    make_folder,
    numbered_fields,
    parse_floats,
    replacing,
    write_bytes,
    write_lines,
)


def test_a_failed_write_keeps_the_old_file_and_leaves_nothing_behind(tmp_path):
    path = tmp_path / "kept.txt"
    path.write_text("old\n")

    def lines():
        yield "new"
        raise RuntimeError("interrupted")

    with pytest.raises(RuntimeError, match="interrupted"):
        write_lines(path, lines())
    assert path.read_text() == "old\n"
    assert list(tmp_path.iterdir()) == [path]


def test_the_temporary_name_is_hidden_and_keeps_the_suffix(tmp_path):
    with replacing(tmp_path / "picture.png") as temporary:
        assert temporary.parent == tmp_path
        assert temporary.suffix == ".png"
        assert temporary.name.startswith(".")
        temporary.write_bytes(b"x")
        assert not (tmp_path / "picture.png").exists()
    assert (tmp_path / "picture.png").read_bytes() == b"x"


def test_a_missing_folder_is_reported_in_one_line(tmp_path):
    with pytest.raises(MapFileError, match=r"cannot write .*No such file or directory") as caught:
        write_bytes(tmp_path / "absent" / "a.txt", b"x")
    assert "\n" not in str(caught.value)


def test_compressed_bytes_depend_on_the_lines_alone(tmp_path):
    write_lines(tmp_path / "a.gz", ["one", "two"])
    write_lines(tmp_path / "b.gz", ["one", "two"])
    assert (tmp_path / "a.gz").read_bytes() == (tmp_path / "b.gz").read_bytes()
    # The header's time, which would differ from one second to the next.
    assert (tmp_path / "a.gz").read_bytes()[4:8] == bytes(4)
    assert gzip.decompress((tmp_path / "a.gz").read_bytes()) == b"one\ntwo\n"


@pytest.mark.parametrize("name", ["text.txt", "text.txt.gz"])
def test_comments_and_empty_lines_are_passed_over_but_counted(tmp_path, name):
    write_lines(tmp_path / name, ["# head", "", "a  b", "   ", "c"])
    assert list(numbered_fields(tmp_path / name)) == [(3, ["a", "b"]), (5, ["c"])]


def test_unreadable_files_raise_the_callers_error(tmp_path):
    with pytest.raises(EvaluationError, match=r"cannot read .*No such file"):
        list(numbered_fields(tmp_path / "absent.txt", EvaluationError))
    (tmp_path / "binary.txt").write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(MapFileError, match="not a text file"):
        list(numbered_fields(tmp_path / "binary.txt"))
    write_lines(tmp_path / "whole.gz", [str(i) for i in range(1000)])
    (tmp_path / "cut.gz").write_bytes((tmp_path / "whole.gz").read_bytes()[:-400])
    with pytest.raises(MapFileError, match="damaged gzip"):
        list(numbered_fields(tmp_path / "cut.gz"))
    (tmp_path / "plain.gz").write_text("not compressed")
    with pytest.raises(MapFileError, match="damaged gzip"):
        list(numbered_fields(tmp_path / "plain.gz"))


@pytest.mark.parametrize("text", ["nan", "inf", "-inf", "1,5", "0x10"])
def test_only_finite_numbers_pass(text):
    assert parse_floats(["1", "-2.5e-3"], "here") == [1.0, -0.0025]
    with pytest.raises(MapFileError, match=r"^here: "):
        parse_floats(["1", text], "here")


def test_a_folder_that_is_a_file_is_named_with_a_remedy(tmp_path):
    (tmp_path / "house").write_text("mine")
    with pytest.raises(MapFileError, match="give another name"):
        make_folder(tmp_path / "house")
