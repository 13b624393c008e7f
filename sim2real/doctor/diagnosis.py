"""All questions about one deployment, cheap ones first, and the sentence that answers them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from sim2real.doctor.contract import Policy
from sim2real.doctor.log import Log
from sim2real.doctor.plant import Drives, solve_plant
from sim2real.doctor.solve import Finding, solve_contract
from sim2real.doctor.timing import solve_timing
from sim2real.errors import UsageError

_UNEXPLAINED = 0.45
"""A replay whose error stays above this share of the joints' motion has a cause that no question names."""


@dataclass(frozen=True)
class Diagnosis:
    """What is wrong with a deployment.

    Attributes:
        findings: The largest share of its gap first, contract before timing before plant.
        figures: Question -> its figures.
        skipped: Question -> why it was not asked.
    """

    findings: tuple[Finding, ...]
    figures: Mapping[str, Mapping[str, Any]]
    skipped: Mapping[str, str] = field(default_factory=dict)

    @property
    def faults(self) -> list[str]:
        """The names of what is wrong, each once."""
        return list(dict.fromkeys(f.fault for f in self.findings))

    @property
    def unexplained(self) -> bool:
        """Whether model and robot part, and no question says why."""
        return not self.findings and self.figures.get("plant", {}).get("error_fitted", 0.0) > _UNEXPLAINED

    @property
    def sentence(self) -> str:
        """The answer in one sentence."""
        if self.findings:
            first, more = self.findings[0], len(self.faults) - 1
            also = f", and {more} more" if more else ""
            return f"{first.text[0].upper()}{first.text[1:]} ({first.question}){also}."
        if self.unexplained:
            at = self.figures["plant"]["parting"]
            return (f"None of contract, timing and plant explains it: model and robot part at {at['time_s']:.2f} s, "
                    f"at {at['joint']}.")  # fmt: skip
        asked = " and ".join(q for q in ("contract", "timing", "plant") if q in self.figures)
        return f"Nothing is wrong that the log shows: {asked} are as in training."

    def to_dict(self) -> dict[str, Any]:
        """Return the diagnosis as plain data."""
        findings = [{"fault": f.fault, "question": f.question, "text": f.text, "share": round(f.share, 4),
                     "numbers": dict(f.numbers)} for f in self.findings]  # fmt: skip
        return {"sentence": self.sentence, "faults": self.faults, "findings": findings, "figures": dict(self.figures),
                "skipped": dict(self.skipped), "unexplained": self.unexplained}  # fmt: skip


def diagnose(policy: Policy, log: Log, drives: Drives | None = None, sim: Log | None = None,
             robot_joints: tuple[str, ...] = ()) -> Diagnosis:  # fmt: skip
    """Ask the three questions.

    Args:
        drives: The model; None: the plant is not asked.
        sim: The log of a simulation, whose rate, ages and delay count as those of the training.
    """
    contract = policy.contract
    found, errors = solve_contract(log, policy, robot_joints)
    more, times = solve_timing(log, contract, sim)
    findings, figures, skipped = [*found, *more], {"contract": errors, "timing": times}, {}
    if drives is None:
        skipped["plant"] = "it needs the model: --mjcf"
    elif log.target is None:
        skipped["plant"] = "the log has no targets"
    else:
        try:
            trained = None if sim is None or sim.target is None else solve_plant(drives, sim, contract)[1]["delay_s"]
            of_plant, figures["plant"] = solve_plant(drives, log, contract, trained)
            findings += of_plant
        except UsageError as error:
            skipped["plant"] = str(error.args[0])
    # One line for each fault and question.
    best: dict[tuple[str, str], Finding] = {}
    for finding in findings:
        best.setdefault((finding.fault, finding.question), finding)
    order = {"contract": 0, "timing": 1, "plant": 2}
    ranked = sorted(best.values(), key=lambda f: (order[f.question], -f.share))
    return Diagnosis(tuple(ranked), figures, skipped)
