"""The tables of README and guides are those of the records of the benchmarks."""

import json
from pathlib import Path
from types import SimpleNamespace

import pages
import pytest

PAGE = "a\n<!-- t: one -->\nold\n<!-- end of t -->\nb\n<!-- t: two -->\nkept\n<!-- end of t -->\n"


@pytest.fixture
def page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A page with two tables, and a benchmark whose record has the first one."""
    module = SimpleNamespace(FILE=tmp_path / "t.json", tables=lambda record: record)
    module.FILE.write_text(json.dumps({"one": "new\n"}))
    monkeypatch.setattr(pages, "benchmark", lambda name: {"t": module}[name])
    monkeypatch.setattr(pages, "PAGES", (tmp_path / "page.md",))
    (tmp_path / "page.md").write_text(PAGE)
    return tmp_path / "page.md"


def test_tables_are_written_between_their_markers(page: Path) -> None:
    pages.write_pages()
    assert page.read_text() == PAGE.replace("old", "new")


def test_a_page_that_differs_and_a_table_without_a_record_are_found(page: Path) -> None:
    with pytest.raises(SystemExit) as found:
        pages.write_pages(check=True)
    assert page.read_text() == PAGE
    assert "page.md has other tables than the records" in str(found.value)
    assert "page.md has tables that are not in their record: t: two" in str(found.value)
    (page.parent / "t.json").write_text(json.dumps({"one": "old\n", "two": "kept\n"}))
    pages.write_pages(check=True)


def test_a_linked_sheet_is_written_beside_its_page(page: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = SimpleNamespace(
        FILE=page.parent / "t.json", tables=lambda record: record, sheets=lambda _: {"-b": "x,y\n"}
    )
    monkeypatch.setattr(pages, "benchmark", lambda name: {"t": module}[name])
    page.write_text("[all](t-b.csv)\n<!-- t: one -->\nnew\n<!-- end of t -->\n")
    with pytest.raises(SystemExit, match="t-b.csv has other figures than the record"):
        pages.write_pages(check=True)
    pages.write_pages()
    assert (page.parent / "t-b.csv").read_text() == "x,y\n"
    pages.write_pages(check=True)


def test_a_record_of_its_own_is_printed_and_leaves_the_pages_alone(
    page: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = page.parent / "other.json"
    other.write_text(json.dumps({"one": "other\n"}))
    pages.publish("t", other)
    assert page.read_text() == PAGE
    assert "one\nother\n" in capsys.readouterr().out
    pages.publish("t", page.parent / "t.json")
    assert page.read_text() == PAGE.replace("old", "new")


def test_a_table_is_markdown() -> None:
    assert pages.markdown(("a", "b"), [("1", "2"), ("3", "")]) == "| a | b |\n| --- | --- |\n| 1 | 2 |\n| 3 |  |\n"


@pytest.mark.slow
def test_the_pages_have_the_tables_of_the_records() -> None:
    pages.write_pages(check=True)
    shown = {name for page in pages.PAGES for name, _, _ in pages.TABLE.findall(page.read_text(encoding="utf-8"))}
    assert shown == {
        "results",
        "table1",
        "table2",
        "additions",
        "finetune",
        "completeness",
        "tutorial",
        "sweep",
        "successors",
    }
