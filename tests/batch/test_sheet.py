"""Sheets: what they may say, and that every mistake is named with its line before anything starts."""

from __future__ import annotations

from pathlib import Path

import pytest
from toy import toy_dag

from cleargs.batch.scenes import Scene, read_scenes
from cleargs.batch.sheet import SheetError
from cleargs.errors import InputError
from cleargs.pipeline.dag import Dag


@pytest.fixture
def dag(tmp_path: Path) -> Dag:
    (tmp_path / "empty.toml").touch()
    (tmp_path / "cubes.toml").write_text("[square]\npower = 3\n")
    for name in ("attic", "barn"):
        (tmp_path / name).mkdir()
    return toy_dag(tmp_path / "journal")


def read(folder: Path, dag: Dag, name: str, text: str) -> dict[str, Scene]:
    (folder / name).write_text(text)
    return {scene.name: scene for scene in read_scenes(folder / name, dag)}


def mistakes(folder: Path, dag: Dag, name: str, text: str) -> dict[int, list[str]]:
    """Line -> what is wrong there."""
    with pytest.raises(SheetError) as caught:
        read(folder, dag, name, text)
    found: dict[int, list[str]] = {}
    for problem in caught.value.problems:
        found.setdefault(problem.line, []).append(problem.text)
    return found


TOML = """\
recipe = "empty.toml"
[set]
count.limit = 5
[resources.square]
minutes = 90

[[scene]]
name = "attic"
input = "attic"

[[scene]]
name = "barn"
input = "barn"
recipe = "cubes.toml"
set.count.mode = "padded"
[scene.resources.square]
gpus = 1
"""

CSV = """\
name,input,recipe,count.limit,count.mode,resources.square.minutes,resources.square.gpus
attic,attic,empty.toml,5,,90,

barn,barn,cubes.toml,5,padded,90,1
"""


@pytest.mark.parametrize(("name", "text"), [("sheet.toml", TOML), ("sheet.csv", CSV)])
def test_both_kinds_of_sheet_say_the_same(tmp_path: Path, dag: Dag, name: str, text: str) -> None:
    scenes = read(tmp_path, dag, name, text)
    attic, barn = (scenes[key].config.document() for key in ("attic", "barn"))
    assert (attic["count"]["limit"], attic["count"]["mode"], attic["square"]["power"]) == (5, "plain", 2)
    assert (barn["count"]["limit"], barn["count"]["mode"], barn["square"]["power"]) == (5, "padded", 3)
    assert (scenes["attic"].wanted["square"].minutes, scenes["attic"].wanted["square"].gpus) == (90, None)
    assert (scenes["barn"].wanted["square"].minutes, scenes["barn"].wanted["square"].gpus) == (90, 1)
    assert scenes["attic"].wanted["count"].minutes is None
    assert scenes["barn"].source == tmp_path / "barn"


def test_all_mistakes_of_a_toml_sheet_with_their_lines(tmp_path: Path, dag: Dag) -> None:
    found = mistakes(
        tmp_path,
        dag,
        "sheet.toml",
        """\
recipe = "empty.toml"

[[scene]]
name = "attic"
input = "nowhere"
[scene.set]
count.limit = 0
square.powr = 3

[[scene]]
name = "attic"
imput = "barn"
recipe = "missing.toml"

[[scene]]
input = "barn"
[scene.resources.square]
minutes = -1
[scene.resources.cube]
minutes = 5
""",
    )
    assert sorted(found) == [5, 7, 8, 10, 11, 12, 13, 15, 18, 19]
    assert "nowhere" in found[5][0]
    assert "count.limit" in found[7][0] and "at least 1" in found[7][0]
    assert "did you mean square.power" in found[8][0]
    assert found[10] == ["the scene has no input"]
    assert "taken on line 4" in found[11][0]
    assert "did you mean input" in found[12][0]
    assert "missing.toml" in found[13][0]
    assert found[15] == ["the scene has no name"]
    assert "resources.square.minutes" in found[18][0]
    assert "'cube'" in found[19][0]


def test_all_mistakes_of_a_csv_sheet_with_their_lines(tmp_path: Path, dag: Dag) -> None:
    found = mistakes(
        tmp_path,
        dag,
        "sheet.csv",
        """\
name,input,recipe,square.power
attic,attic,empty.toml,9
"a b",barn,empty.toml,
../x,barn,empty.toml,2
""",
    )
    assert sorted(found) == [2, 3, 4]
    assert "square.power = 9" in found[2][0]
    crowded = mistakes(
        tmp_path, dag, "sheet.csv", "name,input,input,\na,attic,attic,,more\nb,nowhere\nc,attic,,x\n"
    )
    assert sorted(crowded) == [1, 2, 3, 4]
    assert "'x' stands below ''" in " ".join(crowded[4])


@pytest.mark.parametrize("text", ["name;input\na;attic\n", "attic,attic\n", "\n"])
def test_a_csv_sheet_without_its_header_is_told_so(tmp_path: Path, dag: Dag, text: str) -> None:
    found = mistakes(tmp_path, dag, "sheet.csv", text)
    assert sorted(found) == [1]
    assert [line.partition(";")[0] for line in found[1]] == [
        "there is no column input",
        "there is no column name",
    ]


def test_a_quote_that_is_not_closed_swallows_no_scene(tmp_path: Path, dag: Dag) -> None:
    found = mistakes(tmp_path, dag, "sheet.csv", 'name,input\n"attic,attic\nbarn,barn\n')
    assert found == {3: ["no CSV: unexpected end of data"]}


def test_what_a_spreadsheet_writes_is_read(tmp_path: Path, dag: Dag) -> None:
    """A byte order mark, line ends of two characters, columns and rows without a word."""
    text = "\ufeffname,input,recipe,,\r\nattic,attic,empty.toml,,\r\n,,,,\r\n"
    assert list(read(tmp_path, dag, "sheet.csv", text)) == ["attic"]


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ('input = " "', "the scene has no input"),
        (f'name = "{"n" * 101}"', "at most 100"),
        ("resources.square.memory_gb = inf", "less than or equal to"),
        ("resources.square.memory_gb = nan", "resources.square.memory_gb"),
        ("resources.square.minutes = 1000000000", "less than or equal to"),
        ("resources.square = 5", "resources.square is a table of cpus, memory_gb, minutes, gpus"),
    ],
)
def test_values_that_no_job_could_take(tmp_path: Path, dag: Dag, line: str, said: str) -> None:
    given = {"name": 'name = "attic"', "input": 'input = "attic"'} | {line.partition(" ")[0]: line}
    found = mistakes(
        tmp_path, dag, "sheet.toml", "\n".join(['recipe = "empty.toml"', "[[scene]]", *given.values()])
    )
    assert [said in text for texts in found.values() for text in texts] == [True]
    assert min(found) > 2, "the line is that of the value"


@pytest.mark.parametrize("text", ["", "[[scene", "scene = 3", "recipe = 'empty.toml'"])
def test_what_is_no_sheet_is_one_plain_error(tmp_path: Path, dag: Dag, text: str) -> None:
    with pytest.raises(InputError):
        read(tmp_path, dag, "sheet.toml", text)
