"""What the page of a training says of wrong parameters."""

import numpy as np
import pytest

from sim2real.artifacts.sensitivity import Moved, Sensitivity
from sim2real.view.sections import sensitivity_blocks


@pytest.fixture(scope="module")
def blocks(tmp_path_factory):
    folder = tmp_path_factory.mktemp("train")
    multiples = np.array([-2.0, -1.0, 1.0, 2.0])
    values = 3.0 + 0.25 * multiples
    parameters = [
        Moved(name, "rad/s^2", 3.0, 0.25, values, np.array(success))
        for name, success in (("<b>gain</b>", (1.0, 1.0, 0.95, 0.9)), ("friction", (0.2, 0.9, 1.0, 1.0)))
    ]
    Sensitivity.of(multiples, 0.98, 16, parameters).save(folder / "sensitivity.json")
    return sensitivity_blocks(folder)


def test_the_sentence_comes_before_the_numbers(blocks):
    note, table = blocks
    assert note.text.startswith("Measure 'friction' better: 2 half-widths")
    assert table.columns[-4:] == ["\u22122", "\u22121", "+1", "+2"]
    assert table.rows[0] == ["friction", "rad/s²", "3.000", "0.2500", "\u22122", "0.20", "0.90", "1.00", "1.00"]
    assert [row[0] for row in table.rows] == ["friction", "<b>gain</b>"]


def test_without_it_the_page_is_as_before(tmp_path):
    assert sensitivity_blocks(tmp_path) == []
