"""Escaping, embedding and numbers in words."""

import html
import json
import math

import pytest

from epipole.report import markup


@pytest.mark.parametrize("text", ["a<b>&'\"", "</script>", "plain.jpg", "Grüße/日本.jpg"])
def test_escape_is_undone_by_a_reader_and_leaves_no_markup(text: str) -> None:
    escaped = markup.escape(text)
    assert html.unescape(escaped) == text
    assert not set("<>\"'") & set(escaped)


def test_escape_replaces_what_no_page_may_hold() -> None:
    assert markup.escape("a\x00b\udcffc\x1b") == "a\ufffdb\ufffdc\ufffd"
    markup.escape("\ud800").encode("utf-8")


def test_json_block_cannot_be_left_and_keeps_its_data() -> None:
    data = {"names": ["</script><b>", "<!--", "\udcff", "a&b"], "x": [1.5, None]}
    block = markup.json_block("d", data)
    inner = block.removeprefix('<script type="application/json" id="d">').removesuffix("</script>")
    assert "<" not in inner
    assert json.loads(inner) == data


def test_json_block_refuses_nan() -> None:
    with pytest.raises(ValueError, match="JSON"):
        markup.json_block("d", [math.nan])


def test_numbers_in_words() -> None:
    assert markup.count(1234567) == "1\u202f234\u202f567"
    assert [markup.plural(n, "pair") for n in (0, 1, 2)] == ["0 pairs", "1 pair", "2 pairs"]
    assert (markup.number(0.456), markup.number(math.nan)) == ("0.46", "–")
    assert [markup.seconds(s) for s in (0.04, 12.34, 59.96, 60.0, 3599.7, 7385.0)] == [
        "0.04 s",
        "12.3 s",
        "60.0 s",
        "1 min 00 s",
        "1 h 00 min",
        "2 h 03 min",
    ]
