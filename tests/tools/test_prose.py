"""The check of the prose: each pattern is found, its plain form is not."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools.prose import (
    Passage,
    Pattern,
    comment_passages,
    load_patterns,
    main,
    page_passages,
    passages,
    python_passages,
    search,
    template_passages,
)

PATTERNS = load_patterns()


def found(*parts: Passage) -> list[tuple[int, str]]:
    """Return line and pattern of each find in ``parts``."""
    return [(find.line, find.pattern.name) for find in search(Path("text"), parts, PATTERNS)]


@pytest.mark.parametrize("pattern", PATTERNS, ids=lambda pattern: pattern.name)
def test_pattern_finds_its_example_and_not_the_plain_form(pattern: Pattern) -> None:
    assert (1, pattern.name) in found(Passage(1, pattern.bad))
    assert found(Passage(1, pattern.good)) == []
    assert pattern.plain


@pytest.mark.parametrize(
    "text",
    [
        "What does a stage read? Files.",
        "How to film. How many frames are enough?",
        "When a run stops, its work is kept.",
        "Results that lie in [0, 1] so far; there is no such file, and it is no longer free.",
        "Take the time for it. The header says so, as far as headers can say.",
        "In place of its own values. Ten frames, a second camera.",
    ],
)
def test_plain_english_is_not_found(text: str) -> None:
    assert found(Passage(1, text)) == []


def test_code_in_backquotes_is_not_found() -> None:
    assert found(*python_passages('"""Return ``beside``, or `What`."""\n# `reckon` it\n')) == []
    page = "Run `What beside`.\n\n```\nWhat lies in a run\n```\n[page](beside.md)\n"
    assert found(*page_passages(page)) == []
    assert found(*template_passages("{% if beside %}{{ whoever }}{% endif %}${beside}")) == []


MODULE = '''"""A module.

What it does.
"""

LIMIT = 3  # of a run
"""Of the frames."""


def run(count: int) -> str:
    # A comment over two
    # lines that is beside the code.
    message = f"{count} frames a run of {LIMIT}"
    return message + (
        "the result "
        "lies in a folder" + " of the user"
    )
'''


def test_finds_name_lines_of_docstrings_and_messages() -> None:
    expected = [(3, "What"), (6, "Of"), (7, "Of"), (12, "beside"), (13, "N a M"), (16, "lie")]
    assert sorted(found(*python_passages(MODULE))) == expected
    assert sorted(found(*python_passages(MODULE, messages=False))) == expected[:-2]


def test_phrase_may_go_over_a_line_end() -> None:
    assert found(*comment_passages("x = 1\n# It is next\n# to nothing.\n# Done.\n")) == [(2, "hardly")]
    assert found(*comment_passages("x = 1 # next\n# to nothing\n")) == []


def test_strings_of_tests_do_not_count(tmp_path: Path) -> None:
    for folder, number in (("tests", 0), ("cleargs", 1)):
        file = tmp_path / folder / "module.py"
        file.parent.mkdir()
        file.write_text('name = "a file beside it"\n')
        assert len(found(*passages(file))) == number


def test_command_prints_place_words_and_plain_form(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "page.md"
    file.write_text("# Page\n\nA file\nbeside it.\n")
    (tmp_path / "image.png").write_bytes(b"\x89PNG")
    assert main([str(tmp_path)]) == 1
    assert capsys.readouterr().out.startswith(f'{file}:4: "beside" -> next to')
    assert main(["--count", str(tmp_path)]) == 1
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["beside", "0", "1"] in rows and ["all", "1"] in rows
    file.write_text("A file next to it.\n")
    assert main([str(tmp_path)]) == 0
