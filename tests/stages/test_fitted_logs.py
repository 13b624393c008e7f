"""A log that was fitted is found again: as it is, copied, imported once more, or cut."""

import hashlib
from types import SimpleNamespace

import numpy as np
import pytest

from sim2real.artifacts.recording import Recording
from sim2real.artifacts.run import Source
from sim2real.errors import UsageError
from sim2real.graph.episode import Episode
from sim2real.identification.model import Channel
from sim2real.stages.shared.identification import require_apart, was_fitted

CHANNELS = (
    Channel("position", "velocity", 0.001, 0.01, index=0, label="a"),
    Channel("position", "velocity", 0.001, 0.01, index=1, label="b"),
)
MODEL = SimpleNamespace(sensor="sensor", channels=CHANNELS)
STEP = 2 * np.pi / 4096


def motion(seed, count=1000):
    """Readings of two encoders: the same kind of motion, with noise of its own."""
    rng = np.random.default_rng(seed)
    read = np.sin(0.02 * np.arange(count))[:, None] * [1.0, 0.5] + 0.002 * rng.normal(size=(count, 2))
    return STEP * np.round(read / STEP)


FITTED = motion(0)


def log(folder, name, read, text=None):
    path = folder / name
    if text is not None:
        path.write_text(text)
    return Recording(path, Episode(steps={}, messages={}, outputs={"sensor": {"position": read}}))


def identified(samples=True):
    """Segments of 100 samples of the first log, the last two held out; a second log is held out whole."""
    rows = {"position[0]_measured": FITTED[:, 0], "position[1]_measured": FITTED[:, 1]}
    number = np.arange(1000) // 100
    rows |= {"segment": number, "held_out": number >= 8, "recording": np.zeros(1000, int)}
    sources = [Source(n, hashlib.sha256(n.encode()).hexdigest()) for n in ("fitted.mcap", "held.mcap")]
    rows = {n: np.concatenate([v, v[-1:]]) for n, v in rows.items()}
    rows["recording"][-1] = 1
    return SimpleNamespace(logs=sources, samples={n: v.astype(v.dtype) for n, v in rows.items()} if samples else {})


@pytest.mark.parametrize(
    ("read", "text", "said"),
    [
        (FITTED, "fitted.mcap", "is fitted.mcap, which"),
        (motion(1), "fitted.mcap", "is fitted.mcap, which"),  # by the hash alone
        (FITTED, "imported once more", "holds measurements"),
        (FITTED.astype(np.float32), "other bytes", "holds measurements"),
        (FITTED[130:420], "cut", "holds measurements"),
        (np.concatenate([motion(1), FITTED[200:300]]), "joined", "holds measurements"),
        (FITTED, None, "holds measurements"),  # never written
        (FITTED[800:], "what was held out of it", None),
        (motion(1), "held.mcap", None),  # held out whole
        (motion(1), "later", None),
        (0 * FITTED, "at rest", None),
        (FITTED[:10], "short", None),
    ],
)
def test_what_was_fitted_is_found_again(tmp_path, read, text, said):
    logs = [log(tmp_path, "later.mcap", read, text)]
    (sentence,) = was_fitted(identified(), logs, MODEL)
    assert (said or "") in sentence
    assert bool(sentence) == bool(said)


def test_an_older_file_without_columns_still_has_hashes(tmp_path):
    copy, new = log(tmp_path, "copy.mcap", FITTED, "fitted.mcap"), log(tmp_path, "new.mcap", FITTED, "other")
    found = was_fitted(identified(False), [copy, new], MODEL)
    assert found == ["it is fitted.mcap, which these parameters were identified from", ""]


@pytest.mark.parametrize(
    ("fitted", "held_out", "said"),
    [
        ([("a", 0)], [("b", 1)], None),
        ([("a", 0), ("b", 1)], [("c", 2)], None),
        ([("a", 0)], [("a", 0)], "is to be held out"),
        ([("a", 0), ("b", 1)], [("other bytes", 1)], "is to be held out"),
        ([("a", 0), ("a", 0)], [], "fitted twice"),
    ],
)
def test_a_log_is_fitted_once_or_held_out(tmp_path, fitted, held_out, said):
    of = [[log(tmp_path, f"{w}{i}.mcap", motion(s), t) for i, (t, s) in enumerate(rows)]
          for w, rows in (("fitted", fitted), ("held", held_out))]  # fmt: skip
    if said is None:
        require_apart(*of, MODEL)
        return
    with pytest.raises(UsageError, match=said):
        require_apart(*of, MODEL)
