"""The tests that continuous integration skips: each reason to skip, and why CI may accept it."""

import re
from collections.abc import Iterable

import pytest

ACCEPTED = {
    r"no (node tutorial|composition document) in .*SIM2REAL_SEEDS\)": (
        "The two documents that the project starts from are not ours to publish. Their examples are in "
        "tests/composer/seed_examples.py and docs/, and run there; the skipped tests compare those with the documents."
    ),
    r".*SIM2REAL_DATA names the folder of the public recordings|no recordings in .*": (
        "The public recordings are large and have licences of their own. CI fits the logs of datasets/, and "
        "the same readers read files that the tests write."
    ),
    r"pip install stable-baselines3 \(installs PyTorch\)": (
        "PyTorch has 2 GB. The vector environment that stable-baselines3 is given is tested without it."
    ),
    r"images without a display: .*": (
        "A driver for OpenGL without a display is the machine's. What is drawn is tested with a false context; the two "
        "skipped tests compare pixels of a driver with dm_control's."
    ),
    r"no software Vulkan \(mesa-vulkan-drivers\) is installed|chromium is not installed": (
        ".ci/run installs both where it is root and has apt. Figures and pages are tested as data without them."
    ),
}
"""Pattern that the whole reason to skip matches -> why it is accepted."""


def reason(report: pytest.TestReport) -> str:
    """Return the reason of a skipped test, without pytest's own word before it."""
    text = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
    return text.removeprefix("Skipped: ")


def unknown(reports: Iterable[pytest.TestReport]) -> list[str]:
    """Return ``test: reason`` of the tests that were skipped for a reason that is not accepted."""
    skipped = ((report.nodeid, reason(report)) for report in reports)
    return [f"{test}: {why}" for test, why in skipped if not any(re.fullmatch(known, why) for known in ACCEPTED)]


def check(session: pytest.Session) -> None:
    """Let a session fail, with ``--known-skips``, where a test was skipped for a reason that is not accepted."""
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if reporter is None or not session.config.option.known_skips or hasattr(session.config, "workerinput"):
        return  # of several workers, the one process that hears of all tests checks
    found = unknown(reporter.stats.get("skipped", []))
    if found:
        reporter.write_line("\nskipped for a reason that tests/skips.py does not accept:", red=True)
        for line in found:
            reporter.write_line(f"  {line}")
        session.exitstatus = session.exitstatus or pytest.ExitCode.TESTS_FAILED
