"""A page shows the text that it was given, and runs none of it: any text, infinite numbers and NaN."""

import math
from html.parser import HTMLParser

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from sim2real.artifacts.summary import ArtifactTable
from sim2real.view.blocks import NoteBlock, PageSection, TableBlock
from sim2real.view.page import write_page

TEXT = st.text(st.characters(codec=None, exclude_categories=()), max_size=20)


class Cells(HTMLParser):
    """Collects the texts of cells, and the names of all tags."""

    def __init__(self):
        super().__init__()
        self.cells, self.tags, self._inside = [], set(), False

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        self._inside = tag in ("td", "th")
        self.cells += [""] * self._inside

    def handle_endtag(self, tag):
        self._inside = self._inside and tag not in ("td", "th")

    def handle_data(self, data):
        if self._inside:
            self.cells[-1] += data


@pytest.mark.night
@given(TEXT, TEXT, st.floats())
@example("<script>alert(1)</script>", "</td><img src=x onerror=alert(2)>", math.nan)
@example("\ud800", '"><svg onload=alert(1)>&amp;', -math.inf)
def test_cells_hold_the_text_and_no_markup(tmp_path_factory, name, text, number):
    table = TableBlock(name, ("name", "value"), [[name, text], *TableBlock.of("n", numbers(name, number)).rows])
    section = PageSection("identify", name, text, blocks=[table, NoteBlock(text)])
    path = write_page(
        tmp_path_factory.mktemp("page") / "report.html", name, [section], run=text, notes=[NoteBlock(name)]
    )
    parser = Cells()
    parser.feed(path.read_bytes().decode())
    parser.close()
    shown = [x.encode("utf-8", "replace").decode() for x in (name, text)]
    assert parser.cells[2:4] == shown
    assert not parser.tags & {"script", "img", "svg"}
    if math.isinf(number):
        assert "∞" in parser.cells[5]


def numbers(name, number):
    return ArtifactTable(("name", "value"), ((name, number),))
