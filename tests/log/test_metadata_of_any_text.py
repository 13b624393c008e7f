"""What a log's metadata holds is read again: any text, infinite numbers and NaN, through a real MCAP file."""

import io
import math

from hypothesis import example, given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer

from sim2real.log import session as metadata

TEXT = st.text(st.characters(codec=None, exclude_categories=()), max_size=20)
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | TEXT,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(TEXT, inner, max_size=3),
    max_leaves=8,
)


def same(a, b):
    if isinstance(a, float) and isinstance(b, float) and math.isnan(a):
        return math.isnan(b)
    if isinstance(a, dict):
        return isinstance(b, dict) and a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    if isinstance(a, list):
        return isinstance(b, list) and len(a) == len(b) and all(map(same, a, b))
    return type(a) is type(b) and a == b


@given(st.dictionaries(TEXT, VALUES, max_size=4))
@example({"json": "x", "crc32": "0", "format": "99"})
@example({"robot": "\ud800", "\udfff": "<script>", "nan": math.nan, "inf": [-math.inf]})
def test_metadata_is_read_as_it_was_written(document):
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start("ros2", "test")
    writer.add_metadata(metadata.SESSION, metadata.encode(metadata.SESSION, document))
    writer.finish()
    (record,) = make_reader(io.BytesIO(stream.getvalue())).iter_metadata()
    assert same(document, metadata.decode(record.metadata))
