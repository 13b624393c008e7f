"""The report: complete, escaped, self-contained, and without an error in a real browser."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
import synthetic_run
from installed import need
from sketches import sketched

from sim2real.artifacts.identification import Identification, Judgement, WorstSecond
from sim2real.errors import Sim2RealError
from sim2real.view.blocks import MISSING, number
from sim2real.view.identification import identify_banner
from sim2real.view.page import report

CHROMIUM = next((path for n in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(n))), None)
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--enable-logging=stderr",
)  # fmt: skip


class Page(HTMLParser):
    """Collects what a page consists of, and checks that its elements are nested in order."""

    VOID = frozenset({"meta", "link", "br", "img", "input", "hr"})

    def __init__(self, text: str) -> None:
        super().__init__()
        self.stack: list[str] = []
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.feed(text)
        assert not self.stack

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.stack.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.stack.pop() == tag

    def handle_data(self, data):
        if self.stack and self.stack[-1] != "style":
            self.words.append(data.strip())

    def values(self, name: str) -> list[str]:
        return [attrs[name] or "" for _, attrs in self.elements if name in attrs]


@pytest.fixture(autouse=True)
def figures_as_data():
    """Sketch the figures of all pages: tests/view/test_figures.py compares them."""
    with sketched():
        yield


@pytest.fixture(scope="module")
def path(finished_run):
    """The report of a run, whose first figure is drawn."""
    with sketched(pictures=1) as figures:
        written = report(finished_run)
    assert len(figures) >= 8
    return written


@pytest.fixture(scope="module")
def page(path):
    return Page(path.read_text(encoding="utf-8"))


def test_the_numbers_are_there(page):
    words = set(page.words)
    assert {"21.08", "rad/s²/V", "26.96", "21.10", "ok", "about friction"} <= words
    assert {"44.80", "44.60", "ms"} <= words, "delays are given in ms"
    assert {"first upright", "1.375", "1.340", "0.03500"} <= words, "the gap table"
    assert {"44.8 ± 0.1 ms", "truth 44.6 ms", "98%"} <= words, "the tiles"
    assert {"gate.limit", "2", "ab" * 32} <= words, "configuration and hashes"
    assert {"bus p50", "bus max", "1.230"} <= words, "the time on the bus"
    assert {"6.700", "6.500 to 6.900", "2.000 to 4.000", "%"} <= words, "links"


def test_of_wrong_parameters_the_sentence_comes_before_the_numbers(page):
    words = [word for word in page.words if word]
    begin = next(i for i, word in enumerate(words) if word.startswith("Measure 'friction' better: 2 half-widths"))
    first = words.index("friction", begin)
    assert words[first - 4 : first] == ["\u22122", "\u22121", "+1", "+2"]
    assert words[first : first + 5] == ["friction", "rad/s\u00b2", "3.000", "0.2500", "\u22122"]
    assert words[first + 9] == synthetic_run.EVIL


def test_an_unexplained_second_makes_an_accepted_identification_doubtful():
    worst = WorstSecond("elbow", "q", "rad", "a.mcap", 5.1, 6.1, 0.8, 0.49)
    found = Identification("robot", (), Judgement("accepted", ()), (), worst=worst)
    banners = [
        identify_banner(replace(found, worst=replace(worst, share_of_motion=share))) for share in (0.49, 0.5, None)
    ]
    assert [banner.tone for banner in banners] == ["good", "doubt", "doubt"]
    assert banners[1].title.startswith("Accepted, but the model does not explain one second")


def test_every_stage_has_a_section_ids_are_unique_and_links_lead_to_them(page):
    sections = [attrs["id"] for tag, attrs in page.elements if tag == "section"]
    assert sections == ["record", "identify", "train", "deploy"]
    ids, links = page.values("id"), {attrs["href"][1:] for tag, attrs in page.elements if tag == "a"}
    assert len(ids) == len(set(ids))
    assert set(sections) <= links <= set(ids)
    assert "b" not in {tag for tag, _ in page.elements}, "names become no markup"
    assert synthetic_run.EVIL in page.words


def test_nothing_is_fetched_and_nothing_runs(page):
    for name in ("src", "href", "xlink:href", "srcset", "data", "action"):
        assert all(v.startswith("#") for v in page.values(name)), name
    assert not {"script", "link", "iframe", "object", "img"} & {tag for tag, _ in page.elements}
    styles = " ".join(page.values("style"))
    assert set(re.findall(r"url\((.)", styles)) <= {"#"}
    assert "default-src 'none'; style-src 'unsafe-inline'; img-src data:" in page.values("content")


def test_it_can_be_read_without_seeing_it(page):
    assert {"lang": "en"} in [attrs for tag, attrs in page.elements if tag == "html"]
    tables = [tag for tag, _ in page.elements if tag == "table"]
    captions = [tag for tag, _ in page.elements if tag == "caption"]
    assert len(tables) == len(captions) > 5
    assert {"col", "row"} == set(page.values("scope"))
    for tag, attrs in page.elements:
        assert tag != "svg" or (attrs["role"] == "img" and attrs["aria-label"])


def test_a_record_alone_makes_a_report(tmp_path):
    run = tmp_path / "pendulum" / "run"
    synthetic_run.write_stage(run, "record")
    text = report(run).read_text(encoding="utf-8")
    assert '<section id="record"' in text
    assert '<section id="train"' not in text


@pytest.mark.parametrize(
    ("status", "error", "told"),
    [
        ("failed", "Sim2RealError: <i>no</i>", "failed (&lt;i&gt;no&lt;/i&gt;)"),
        ("interrupted", "KeyboardInterrupt: ", "interrupted"),
    ],
)
def test_the_newest_finished_attempt_is_shown_and_a_newer_failure_is_told(only, status, error, told):
    run = only("identify")
    failed = run / "identify.2"
    failed.mkdir()
    manifest = {
        **{"pipeline": "pendulum", "stage": "identify", "inputs": {}, "outputs": {}},
        **{"status": status, "error": error, "started": "2026-11-22T08:00:00+00:00"},
    }
    (failed / "manifest.json").write_text(json.dumps(manifest))
    text = report(run).read_text(encoding="utf-8")
    assert f"The newest attempt at identify is {told}: this page shows identify." in text
    assert "21.08" in text


def test_a_log_that_was_cut_is_shown_with_a_note(only):
    run = only("record")
    log = run / "record" / "session.mcap"
    log.write_bytes(log.read_bytes()[: int(0.6 * log.stat().st_size)])
    text = report(run).read_text(encoding="utf-8")
    assert "is not whole" in text
    assert "actuator.action [V]" in text


def test_a_deployment_without_a_simulation_is_shown_with_late_steps_and_pauses(run):
    result = synthetic_run.result(simulated=False)
    result["episodes"][1] = {**result["episodes"][0], "late": {"agent": 0.032, "sensor": 0.0}, "paused_s": 0.4}
    (run / "deploy" / "result.json").write_text(json.dumps(result))
    np.savez(run / "deploy" / "simulation.npz")
    text = report(run).read_text(encoding="utf-8")
    words = Page(text).words
    assert {"first upright", "1.375"} <= set(words)
    assert "1.340" not in words
    assert text.count("late steps of agent: 3.2%; lost in pauses: 0.4 s.</figcaption>") == 1
    assert "late steps of sensor" not in text


def test_a_dry_run_is_shown_without_a_simulation(only):
    run = only("deploy")
    document = {"format": 5, "episodes": [{"real": {}}] * 2, "dry_run": True}
    (run / "deploy" / "result.json").write_text(json.dumps(document))
    (run / "deploy" / "simulation.npz").unlink()
    words = Page(report(run).read_text(encoding="utf-8")).words
    assert "Dry run: the robot did not move" in words
    assert not {"Robot and simulation", "success on the robot"} & set(words)


def test_the_success_shown_is_that_of_the_policy_in_the_bundle(only):
    """The best evaluation of the best seed, as on the console; later evaluations may be worse."""
    history = synthetic_run.history(2)
    history["success"] = [[0.1, 0.2] for _ in history["success"]]
    history["success"][-2] = [0.3, 0.87]
    run = only("train")
    (run / "train" / "history.json").write_text(json.dumps({**history, "best_seed": 1}))
    assert "87%" in Page(report(run).read_text(encoding="utf-8")).words


def test_a_failed_stage_is_no_stage_that_is_yet_to_come(run):
    path = run / "deploy" / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"status": "failed"}))
    words = Page(report(run).read_text(encoding="utf-8")).words
    assert "failed" in words
    assert "not yet" not in words


def test_one_seed_and_missing_numbers_are_shown(only):
    run = only("identify", "train")
    (run / "train" / "history.json").write_text(json.dumps({**synthetic_run.history(1), "best_seed": 0}))
    data = synthetic_run.parameters(truth=False)
    del data["posterior"]
    data |= {"verdict": {"status": "", "reasons": []}, "logs": []}
    (run / "identify" / "parameters.json").write_text(json.dumps(data))
    words = Page(report(run).read_text(encoding="utf-8")).words
    assert "one seed" in words
    assert "truth" not in words


MALFORMED = {
    "no parameters": ("identify", "parameters.json", b"{}", "missing required field"),
    "no archive": ("identify", "free_runs.npz", b"PK", "free_runs.npz is malformed"),
    "ragged": (
        "train",
        "history.json",
        b'{"steps":[1],"returns":[[1],[2,3]],"success":[[1]],"seconds":[1]}',
        "malformed",
    ),
    "no episodes": ("deploy", "result.json", b'{"episodes":[]}', "no episode"),
    "missing": ("deploy", "simulation.npz", None, "cannot read"),
    "no log": ("record", "session.mcap", b"nothing", "session.mcap"),
}


@pytest.mark.parametrize("case", MALFORMED)
def test_what_is_malformed_is_named_with_a_hint(only, case):
    stage, name, content, message = MALFORMED[case]
    run = only(stage)
    path = run / stage / name
    path.unlink() if content is None else path.write_bytes(content)
    with pytest.raises(Sim2RealError, match=re.escape(message)) as caught:
        report(run)
    assert caught.value.hint
    assert not (run / "report.html").exists()
    with pytest.raises(Sim2RealError, match="no finished stage"):
        report(run.parent)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (21.0784, "21.08"), (0.0, "0"), (6.4e-5, "6.400e\u22125"), (-0.25, "\u22120.2500"), (12345.6, "1.235e4"),
        (1_064_960, "1\u202f064\u202f960"), (None, MISSING), (float("nan"), MISSING), (float("inf"), "∞"),
        (True, "yes"),
    ],
)  # fmt: skip
def test_numbers_are_written_for_people(value, text):
    assert number(value) == text


def test_a_browser_shows_it_without_an_error(path, tmp_path):
    need(CHROMIUM, "chromium")
    url = path.resolve().as_uri()
    command = [CHROMIUM, *FLAGS, f"--user-data-dir={tmp_path}", "--dump-dom", url]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    assert "CONSOLE" not in done.stderr
    dom = Page(done.stdout)
    assert [attrs["id"] for tag, attrs in dom.elements if tag == "section"] == ["record", "identify", "train", "deploy"]
    assert sum(tag == "svg" for tag, _ in dom.elements) == done.stdout.count("<figure")
    assert synthetic_run.EVIL in dom.words
