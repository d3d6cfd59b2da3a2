"""Rows of bounds in files: they come back bit for bit, and a run goes on from them without losing any."""

from __future__ import annotations

import csv
import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import result_samples

from mitsuba_crb.bound.cramer_rao import PoseBound
from mitsuba_crb.errors import OutputError
from mitsuba_crb.export.pose_files import BEGINNINGS, PoseFiles, write_parquet
from mitsuba_crb.files import jsonable
from mitsuba_crb.measure.pose_table import PoseRow, PoseTable

SETTINGS: dict[str, Any] = {"scene": "räume/a, b.xml", "seed": 0, "size": (4, 3), "white": np.inf}
BOUNDS: list[PoseBound] = [
    dataclasses.replace(
        bound,
        provenance={
            "warnings": ["one\nthing", 'an "other"'],
            "no_bound": ['an "other"'],
            "seconds": {"total": 2.5},
        },
    )
    for bound in result_samples.bounds(np.random.default_rng(3)).values()
]
POSES = [bound.information.pose for bound in BOUNDS]
NAMES = ["1403636579.758555392", "räume, 'a'", "-", "=1+1", *(f"frame {k}" for k in range(len(BOUNDS) - 4))]


@pytest.fixture(params=["json", "csv", "both"])
def files(request: pytest.FixtureRequest, tmp_path: Path) -> dict[str, Path]:
    kinds = ("json", "csv") if request.param == "both" else (request.param,)
    return {f"{kind}_file": tmp_path / f"rows.{kind}" for kind in kinds}


def written(files: dict[str, Path], start: int, end: int) -> dict[int, PoseRow]:
    """What a run finds that goes on to some row and stops there."""
    record = PoseFiles(**files)
    found = record.resume(SETTINGS, POSES)
    for index in range(start, end):
        if index not in found:
            record.add(index, PoseRow.of(NAMES[index], BOUNDS[index]), BOUNDS[index])
    return found


def document(row: PoseRow) -> str:
    return json.dumps(row.to_dict())


def contents(files: dict[str, Path]) -> list[bytes]:
    return [file.read_bytes() for file in files.values()]


def test_rows_come_back_bit_for_bit(files: dict[str, Path]) -> None:
    assert written(files, 0, len(BOUNDS)) == {}
    assert all(data.startswith(BEGINNINGS) for data in contents(files))
    found = written(files, 0, 0)
    assert list(found) == list(range(len(BOUNDS)))
    for index, row in found.items():
        assert document(row) == document(PoseRow.of(NAMES[index], BOUNDS[index]))
    assert PoseFiles(**files).earlier() == jsonable(SETTINGS)


def test_a_run_in_parts_writes_the_file_of_one_in_one_go(files: dict[str, Path]) -> None:
    written(files, 0, len(BOUNDS))
    whole = contents(files)
    for file in files.values():
        file.unlink()
    written(files, 0, 2)
    written(files, 2, 3)
    assert len(written(files, 0, len(BOUNDS))) == 3
    assert contents(files) == whole


def test_a_row_that_was_cut_short_is_written_again(files: dict[str, Path]) -> None:
    written(files, 0, 3)
    whole = contents(files)
    for cut in (1, 7, 100):
        for file, data in zip(files.values(), whole, strict=True):
            file.write_bytes(data[:-cut])
        assert len(written(files, 0, 3)) == 2
        assert contents(files) == whole
    for file, data in zip(files.values(), whole, strict=True):
        file.write_bytes(data[:15])
    assert written(files, 0, 3) == {}
    assert contents(files) == whole


def test_two_runs_do_not_write_over_each_other(files: dict[str, Path]) -> None:
    record = PoseFiles(**files)
    record.resume(SETTINGS, POSES)
    written(files, 0, 2)
    before = contents(files)
    with pytest.raises(OutputError, match="does another run write to it"):
        record.add(0, PoseRow.of(NAMES[0], BOUNDS[0]), BOUNDS[0])
    assert contents(files) == before


def test_rows_that_the_json_lines_have_and_the_csv_lacks_are_added(tmp_path: Path) -> None:
    both = {"json_file": tmp_path / "a.jsonl", "csv_file": tmp_path / "a.csv"}
    written(both, 0, 3)
    expected = both["csv_file"].read_bytes()
    both["csv_file"].unlink()
    assert len(written(both, 0, 3)) == 3
    assert both["csv_file"].read_bytes() == expected


def test_every_line_of_json_is_a_bound_document(tmp_path: Path) -> None:
    file = tmp_path / "rows.jsonl"
    written({"json_file": file}, 0, 3)
    for index, line in enumerate(file.read_text().splitlines()):
        found = json.loads(line)
        assert (found["index"], found["name"]) == (index, NAMES[index])
        assert found["schema"] == "mitsuba-crb/bound/1"
        assert np.array_equal(found["information"], BOUNDS[index].information.matrix)


def test_the_csv_is_a_plain_table(tmp_path: Path) -> None:
    file = tmp_path / "rows.csv"
    written({"csv_file": file}, 0, len(BOUNDS))
    with file.open(newline="", encoding="utf-8") as text:
        rows = list(csv.DictReader(text))
    assert [row["name"] for row in rows] == NAMES
    assert [float(row["position_std_x"]) for row in rows] == [float(b.position_std[0]) for b in BOUNDS]
    assert len(file.read_text(encoding="utf-8").splitlines()) == len(BOUNDS) + 1


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"seed": 1}, "seed = 0, not 1"),
        ({"scene": "b.xml"}, "scene = 'räume/a, b.xml', not 'b.xml'"),
        ({"poses": {"count": 3}}, "poses = None, not"),
        ({"more": 1}, "more = None, not 1"),
    ],
)
def test_another_run_is_refused_by_what_differs_and_nothing_is_touched(
    files: dict[str, Path], change: dict[str, Any], words: str
) -> None:
    written(files, 0, 2)
    before = contents(files)
    with pytest.raises(OutputError, match="holds bounds with") as refused:
        PoseFiles(**files).resume({**SETTINGS, **change}, POSES)
    assert words in str(refused.value)
    assert contents(files) == before


OTHERS = [
    b"a,b\n1,2\n",
    b"a",
    b'{\n  "schema": "mitsuba-crb/bound/1"\n}\n',
    b'{"schema": "mitsuba-crb/validate/2"}',
    b"\xff\xfe\n\x00",
    b'{"index": 0}\n',
    b'{"index": "a", "row": {}, "settings": {}}\n',
    b"index,name,settings\n0,a,no JSON\n",
    b"index,name,other\n0,a,b\n",
]


@pytest.mark.parametrize("data", OTHERS)
def test_a_file_of_something_else_is_refused_and_left_alone(files: dict[str, Path], data: bytes) -> None:
    for file in files.values():
        file.write_bytes(data)
    with pytest.raises(OutputError, match="exists and is no"):
        PoseFiles(**files)
    assert contents(files) == [data] * len(files)


def test_a_damaged_row_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "rows.csv"
    written({"csv_file": file}, 0, 2)
    file.write_text(file.read_text(encoding="utf-8").replace("seen", "soon", 3).replace("1.", "one.", 1))
    with pytest.raises(OutputError, match="is damaged"):
        written({"csv_file": file}, 0, 2)


def test_an_empty_file_is_begun(files: dict[str, Path]) -> None:
    for file in files.values():
        file.touch()
    assert written(files, 0, 1) == {}
    assert len(written(files, 0, 1)) == 1


def test_parquet_holds_the_same_columns_with_their_types(tmp_path: Path) -> None:
    io = pytest.importorskip("arro3.io")
    table = PoseTable(
        tuple(PoseRow.of(name, bound) for name, bound in zip(NAMES, BOUNDS, strict=True)),
        tuple(range(len(BOUNDS))),
        len(BOUNDS),
        SETTINGS,
    )
    write_parquet(tmp_path / "rows.parquet", table)
    read = io.read_parquet(tmp_path / "rows.parquet").read_all()
    written({"csv_file": tmp_path / "rows.csv"}, 0, len(BOUNDS))
    header = (tmp_path / "rows.csv").read_text(encoding="utf-8").partition("\n")[0].split(",")
    assert read.schema.names == header
    for name, values in table.columns().items():
        assert repr(read[name].to_pylist()) == repr(values)


def test_without_its_library_parquet_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "arro3.io", None)
    with pytest.raises(OutputError, match=r"pip install 'mitsuba_crb\[parquet\]'"):
        write_parquet(tmp_path / "rows.parquet", PoseTable((), (), 0, {}))
