"""The diagnosis of a deployment: checks contract, timing and plant, and states the result in a sentence."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from sim2real.doctor.contract import Contract, Policy
from sim2real.doctor.deployed import Deployed
from sim2real.doctor.log import Log
from sim2real.doctor.plant import Drives, solve_plant
from sim2real.doctor.search import Finding, shortened
from sim2real.doctor.solve import solve_contract
from sim2real.errors import UsageError

_UNEXPLAINED = 0.45
"""If the replay's error stays above this share of the joints' motion, an unknown fault remains."""

_RATE_BAND, _JITTER, _LOST, _OLDER_S = 0.04, 0.25, 0.02, 0.015


@dataclass(frozen=True)
class Diagnosis:
    """The faults of a deployment.

    Attributes:
        findings: Contract before timing before plant; the largest share of the gap first.
        figures: ``contract``, ``timing`` or ``plant`` -> figures.
        skipped: ``contract``, ``timing`` or ``plant`` -> why it was not checked.
    """

    findings: tuple[Finding, ...]
    figures: Mapping[str, Mapping[str, Any]]
    skipped: Mapping[str, str] = field(default_factory=dict)

    @property
    def faults(self) -> list[str]:
        """The names of the faults, each once."""
        return list(dict.fromkeys(f.fault for f in self.findings))

    @property
    def unexplained(self) -> bool:
        """Whether the model differs from the robot for no known reason."""
        return not self.findings and self.figures.get("plant", {}).get("error_fitted", 0.0) > _UNEXPLAINED

    @property
    def sentence(self) -> str:
        """The diagnosis in one sentence."""
        if self.findings:
            first, more = self.findings[0], len(self.faults) - 1
            also = f", and {more} more" if more else ""
            return f"{first.text[0].upper()}{first.text[1:]} ({first.question}){also}."
        if self.unexplained:
            at = self.figures["plant"]["parting"]
            return (f"None of contract, timing and plant explains it: model and robot part at {at['time_s']:.2f} s, "
                    f"at {at['joint']}.")  # fmt: skip
        return f"Nothing is wrong that the log shows: {', '.join(self.figures)} are as in training."

    def to_dict(self) -> dict[str, Any]:
        """Return the diagnosis as plain data."""
        found = {"sentence": self.sentence, "faults": self.faults, "unexplained": self.unexplained}
        return found | asdict(self)


def diagnose(policy: Policy, log: Log, drives: Drives | None = None, sim: Log | None = None,
             robot_joints: tuple[str, ...] = ()) -> Diagnosis:  # fmt: skip
    """Check contract, timing and plant.

    Args:
        drives: The model; None: the plant is not checked.
        sim: The log of a simulation, whose rate, ages and delay stand for those of the training.
    """
    contract = policy.contract
    found, errors = solve_contract(log, policy, robot_joints)
    more, times = solve_timing(log, contract, sim)
    findings, skipped = [*found, *more], dict[str, str]()
    figures: dict[str, dict[str, Any]] = ({"contract": errors} if errors else {}) | {"timing": times}
    if unread := Deployed(log, policy).unread:
        what = f"the observation's {', '.join(unread)}" if errors else "contract"
        skipped[what] = f"the log has no signals of the sizes of {', '.join(unread)}"
    if drives is None:
        skipped["plant"] = "it needs the model: --mjcf"
    elif log.target is None:
        skipped["plant"] = "the log has no targets"
    else:
        try:
            trained = None if sim is None or sim.target is None else solve_plant(drives, sim, contract)[1]["delay_s"]
            frozen_s = min((f.numbers["from_s"] for f in found if "from_s" in f.numbers), default=np.inf)
            of_plant, figures["plant"] = solve_plant(drives, log.before(frozen_s), contract, trained)
            findings += of_plant
            if drives.still:
                skipped[f"the motion of {shortened(drives.still)}"] = "no action moves it, so the replay holds it still"
        except UsageError as error:
            skipped["plant"] = str(error.args[0])
    # Keep one finding for each fault and question.
    best: dict[tuple[str, str], Finding] = {}
    for finding in findings:
        best.setdefault((finding.fault, finding.question), finding)
    order = {"contract": 0, "timing": 1, "plant": 2}
    ranked = sorted(best.values(), key=lambda f: (order[f.question], -f.share))
    return Diagnosis(tuple(ranked), figures, skipped)


def solve_timing(log: Log, contract: Contract, sim: Log | None = None) -> tuple[list[Finding], dict[str, float]]:
    """Return the faults of the timing of the policy's steps, and figures [Hz, s].

    Args:
        sim: The log of a simulation, whose rate and ages stand for those of the training.
    """
    steps = np.diff(log.t)
    period = float(np.median(steps) if log.grain_s == 0.0 else np.mean(steps[steps < 1.6 * np.median(steps)]))
    wanted = 1.0 / contract.rate_hz if sim is None else float(np.median(np.diff(sim.t)))
    jitter_s = max(0.0, round(float(np.quantile(np.abs(steps - period), 0.9)) - log.grain_s, 6))
    lost = float(np.mean(steps > 1.6 * period + log.grain_s))
    figures = {"rate_hz": 1.0 / period, "trained_rate_hz": 1.0 / wanted, "jitter_s": jitter_s, "lost": lost}
    findings = []

    def check(wrong: bool, fault: str, share: float, name: str, text: str) -> None:
        if wrong:
            findings.append(Finding(fault, "timing", text, share, {name: figures[name]}))

    check(abs(period / wanted - 1.0) > _RATE_BAND, "rate", min(1.0, abs(wanted / period - 1.0)), "rate_hz",
          f"the policy makes {1 / period:.4g} steps in a second, and was trained with {1 / wanted:.4g}")  # fmt: skip
    check(jitter_s > _JITTER * period, "jitter", 0.0, "jitter_s",
          f"a tenth of the steps come {1e3 * jitter_s:.1f} ms or more beside their time")  # fmt: skip
    check(lost > _LOST, "losses", lost, "lost", f"{lost:.1%} of the policy's steps are missing")
    if log.age_s is not None and len(log.age_s):
        age_s = float(np.median(log.age_s))
        figures |= {"age_s": age_s, "age_99_s": float(np.quantile(log.age_s, 0.99))}
        trained_s = 0.0 if sim is None or sim.age_s is None else float(np.median(sim.age_s))
        check(age_s > trained_s + _OLDER_S, "delay", 0.0, "age_s",
              f"each action answers a measurement that is {1e3 * age_s:.0f} ms old")  # fmt: skip
    return findings, figures
