"""Stages that take up what the real ones do and leave small files, and a run with them."""

import os
import signal
from dataclasses import replace
from pathlib import Path

from sim2real.artifacts.deployment import Changed, Deployment, Drift, EpisodeRow, Finding, Reason, Verdict
from sim2real.artifacts.identification import ROUND_TRIP, Estimate, Identification, Judgement
from sim2real.artifacts.run import STAGES, TAKES, Source, attempts, newest, open_stage, portable, sha256
from sim2real.commands.loop import run_all
from sim2real.commands.stages import RunFlags
from sim2real.stages.load import load_robot

TRIP = Estimate(ROUND_TRIP, "s", "derived", "", 0.0, 0.02, "ok")
FRICTION = Changed("friction", "rad/s^2", 6.0, 12.0, 11.0, 13.0, 0.9, 1e-20)


STAGES_OF = {"re-identify": ("identify",), "re-train": ("train",)}


def verdict(status, success=0.5, reason="why", seconds=18.0, drift=False, stages=None):
    """Return a deployment that was judged so."""
    alarms = Drift((FRICTION if drift else replace(FRICTION, p=0.8),), 0.05, ("friction",) if drift else (), seconds)
    judged = Verdict(status, (Reason(Finding.UNTESTED, reason),), stages or STAGES_OF.get(status, ()))
    return Deployment((EpisodeRow({"success": success}, {"success": 1.0}),), drift=alarms, verdict=judged)


class Stages:
    """Stages that only write small files; the process may die in one.

    Args:
        root: Folder of all runs.
        verdicts: Of each deployment that finishes: a status, a deployment, or an error that is raised.
    """

    def __init__(self, root, verdicts=("re-identify", "fine")):
        self.root, self.verdicts = root, [*verdicts]
        self.calls, self.die, self.refused = [], None, 0

    def __call__(self, stage, config, run_dir):
        here = len(self.calls)
        self.calls.append((stage, config))
        inputs = {}
        if stage == "identify" and config.log:
            inputs = {f"log_{i}": Path(log) for i, log in enumerate(config.log)}
        elif stage in TAKES:
            before, output = TAKES[stage]
            inputs = {output: newest(self.root, "pendulum", before, run_dir).output(output)}
        number = 0 if run_dir is None else sum(a.finished for a in attempts(run_dir, stage))
        with open_stage(self.root, "pendulum", stage, config, inputs, run_dir) as opened:
            self._die(here, "within")
            content = f"{opened.folder} {number}"  # no two outputs are the same
            if stage == "record":
                opened.output("log", "session.mcap").write_text(content)
            if stage == "identify":
                logs = tuple(Source(portable(path, opened.run_dir), sha256(path)) for path in inputs.values())
                Identification("pendulum", logs, Judgement("accepted", (content,)), (TRIP,)).write(
                    opened.output("parameters", "parameters.json")
                )
            if stage == "train":
                opened.output("bundle", "bundle").mkdir()
                (opened.folder / "bundle" / "policy.json").write_text(content)
            if stage == "deploy":
                opened.output("log_0", "episode_0.mcap").write_text(content)
                found = self.verdicts[number + self.refused]
                if isinstance(found, Exception):
                    self.refused += 1
                    raise found
                (verdict(found) if isinstance(found, str) else found).save(opened.folder)
                opened.output("result", "result.json")
        self._die(here, "after")
        return opened.result

    def _die(self, call, when):
        if self.die == (call, when):
            os.kill(os.getpid(), signal.SIGKILL)

    def run(self, iterations=5, resume=None, train=None, deploy=None, **told):
        """Run; return the run folder."""
        robot = load_robot("pendulum")
        stages = {stage: getattr(robot.defaults, stage) for stage in STAGES}
        stages["train"] = replace(robot.defaults.train, **(train or {}))
        stages["deploy"] = deploy or robot.defaults.deploy
        flags = RunFlags(iterations=iterations, runs=self.root, resume=resume, **stages, **told)
        run_all(robot, flags, self)
        (run_dir,) = (self.root / "pendulum").iterdir()
        return run_dir
