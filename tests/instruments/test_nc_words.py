"""The reader of the words of NC programs: plain lines, and lines with expressions."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from errormotion.errors import ProgramError
from errormotion.instruments.nc_words import codes_of, printing, split, words_of

WORDS = st.lists(
    st.tuples(
        st.sampled_from("ABCDEFGHIJKLMNPQRSTUVWXYZ"),
        st.decimals(-9999, 9999, places=3, allow_nan=False).map(str) | st.integers(0, 999).map(str),
    ),
    max_size=8,
)
SPACES = st.sampled_from(["", " ", "\t", "(a G1 comment)", "  "])


@given(words=WORDS, between=SPACES, end=st.sampled_from(["", ";G1 X5", "(M30)"]))
def test_both_functions_read_the_same_words_of_a_plain_line(
    words: list[tuple[str, str]], between: str, end: str
) -> None:
    text = between.join(letter + number for letter, number in words) + end
    block = split(1, text)
    assert [(letter, number) for letter, number, _ in block.words] == words == words_of(text)
    assert "".join(part or "" for part in block.parts) == text
    assert words_of(text.lower()) == words


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("G 4 3 H 1", [("G", "43"), ("H", "1")]),  # a control ignores spaces, within numbers too
        ("g043", [("G", "043")]),
        ("G1 X[1+[2*3]] Y-#5 Z#<depth> (X9)", [("G", "1"), ("X", ""), ("Y", ""), ("Z", "")]),
        ("G1 XSIN[30] YATAN[1]/[2] A5", [("G", "1"), ("X", ""), ("Y", ""), ("A", "5")]),
        ("G1 X##1 Y-[2]F100", [("G", "1"), ("X", ""), ("Y", ""), ("F", "100")]),
        ("#<gm>=[1] #5=COS[60]", []),
        ("G#1 M[3+4]", [("G", ""), ("M", "")]),
    ],
)
def test_the_words_of_a_line_with_expressions(text: str, expected: list[tuple[str, str]]) -> None:
    assert words_of(text) == expected


def test_codes_have_one_form() -> None:
    assert codes_of("N5 G01 G43.10 m030 G[7] X1") == ["G1", "G43.1", "M30", "G"]


def test_a_line_that_prints_is_recognised() -> None:
    assert printing("N10 dprnt[X#5061[53]] (a comment)") == ("DPRNT", "X#5061[53]")
    assert printing("POPEN") == ("POPEN", "")
    assert printing("POPEN G1 X5") is None


@pytest.mark.parametrize("text", ["G1 X1 0", "G1 X\u0663", "G(a)1", "X#1", "O100 sub"])
def test_the_plain_reader_refuses_what_is_no_word(text: str) -> None:
    with pytest.raises(ProgramError, match="line 7"):
        split(7, text)
