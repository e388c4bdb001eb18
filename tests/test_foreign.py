"""What strangers wrote: plain before it is shown, small before it is believed."""

from __future__ import annotations

from pathlib import Path

import pytest

from slam.errors import DatasetError
from slam.foreign import from_json, from_yaml, plain, plain_lines

STEERING = "a\x1b[31mb\u202ec\nd\udcff\x9b"


def test_letters_that_steer_are_shown_as_question_marks() -> None:
    assert plain(STEERING) == "a?[31mb?c?d??"
    assert plain("Küche 7: 厨房") == "Küche 7: 厨房"
    assert plain("x" * 300) == "x" * 256 + "..."
    assert plain_lines("one\x07\ntwo") == "one?\ntwo"


def test_every_error_is_one_plain_line() -> None:
    assert str(DatasetError(f"{Path(STEERING)} is empty")) == "a?[31mb?c?d?? is empty"


@pytest.mark.parametrize("text", ["[" * 100_000, '{"a":' * 5000])
def test_deep_nesting_is_no_json(text: str) -> None:
    with pytest.raises(ValueError):
        from_json(text)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[" * 1000, "nested too deep"),
        ("a: &a [x, x]\nb: [*a, *a]\n", "aliases"),
        ("a: &a [*a]\n", "aliases"),
        ("a: [1\n", "expected"),
        ("x" * (1 << 20) + "x", "at most"),
        ("!!python/object/apply:os.system [ls]\n", "could not determine a constructor"),
    ],
)
def test_yaml_that_grows_or_runs_is_refused(text: str, said: str) -> None:
    with pytest.raises(ValueError, match=said) as caught:
        from_yaml(text)
    assert "\n" not in str(caught.value)
    assert from_yaml("{a: 1, b: [x, 1e3]}") == {"a": 1, "b": ["x", "1e3"]}
