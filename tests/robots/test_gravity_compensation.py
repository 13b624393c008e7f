"""An arm whose own controller carries its weight: C MuJoCo records, and ``auto`` has to find the share."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from recorded_on_c import play

from sim2real.identification import held_out, residuals, terms
from sim2real.identification.fit import fit
from sim2real.identification.held_out import folds_of
from sim2real.identification.residuals import Problem
from sim2real.identification.segments import Span
from sim2real.identification.terms import TermSearch
from sim2real.robots.model.parameters import ParameterPattern
from sim2real.robots.model.robot import MjcfRobot, RobotConfig
from sim2real.stages.config import IdentifyConfig
from sim2real.stages.shared.identification import offering

STEP_S, PERIOD, SECONDS, SHARE, NOISE = 0.002, 5, 4.0, 0.9, 2e-4
XML = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body name="upper">
  <joint name="shoulder" axis="0 1 0" damping="0.5" armature="0.05"/>
  <inertial pos="0 0 -0.2" mass="3" diaginertia="0.02 0.02 0.02"/></body></worldbody></mujoco>"""
KP = 60.0


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """The robot from its MJCF, and an episode in which its controller carries nine tenths of the weight."""
    path = tmp_path_factory.mktemp("model") / "arm.xml"
    path.write_text(XML)
    spec = mujoco.MjSpec.from_string(XML)
    for body in spec.bodies[1:]:
        body.gravcomp = SHARE
    model = spec.compile()
    t = STEP_S * PERIOD * np.arange(round(SECONDS / STEP_S / PERIOD))
    goals = (0.8 * np.sin(2.1 * t) + 0.4 * np.sin(5.3 * t))[:, None]
    episode = play(model, goals, lambda k, _, data: KP * (goals[k] - data.qpos), PERIOD, NOISE)
    patterns = (ParameterPattern("kp"), ParameterPattern("damping"))
    config = RobotConfig(path, ("shoulder",), ("goal",), step_s=STEP_S, rate_hz=100.0, terms=patterns)
    config = replace(config, sigma_rad=NOISE)
    return MjcfRobot(config), episode


@pytest.mark.night
@pytest.mark.parametrize("kept", [pytest.param(5, marks=pytest.mark.night), 3])
def test_auto_finds_that_the_controller_carries_the_weight(recorded, monkeypatch, kept):
    """Sets of terms are compared on fewer segments where all would take long: a part has as many errors as ever."""
    robot, episode = recorded
    config = IdentifyConfig(terms="auto", generations=0, folds=3, max_delay_s=0.02, free_run_s=0.0)
    model = offering(robot, "gravcomp").identifiable(0.02)
    table = model.parameters.with_terms(["gravcomp"])
    spans = [Span(0, begin) for begin in np.arange(0.2, SECONDS - 0.8, 0.6)]
    widest = fit(Problem(model, [episode], spans, 0.6, config, table))
    of_segment = 0.6 / STEP_S * (residuals._BESIDE + 1) * len(widest.problem.table)
    monkeypatch.setattr(terms, "MOST_OF_SETS", kept * of_segment + 1)
    parts, sets = folds_of(widest.problem, 3), []
    search = TermSearch(widest, parts, config.settle_s, config.free_run_s, sets.append)
    simulated, ahead = [], held_out._ahead
    monkeypatch.setattr(
        held_out, "_ahead", lambda windows, *rest: (simulated.append(windows), ahead(windows, *rest))[1]
    )
    found = search.select()
    assert search.segments == kept
    assert sets[:2] == ["no term", "gravcomp"]
    assert {len(windows.train) for windows in simulated} == {5}
    assert found.chosen.names(table) == ("gravcomp",)
    values = table.decode(found.chosen.x, table.of_terms(found.chosen.present))
    assert float(values["gravcomp"]) == pytest.approx(SHARE, abs=0.02)
    assert float(values["kp"]) == pytest.approx(KP, rel=0.02)
    errors = {t.names(table): t.error for t in found.trials}
    assert errors["gravcomp",] < 0.1 * errors[()]


def test_the_share_is_the_models_own_unless_it_is_chosen_and_none_without_gravity(recorded, tmp_path):
    robot, _ = recorded
    assert "gravcomp" not in {p.what for p in robot.placed}
    offered = {p.what: p.parameter for p in robot.with_optional_terms("auto").placed}
    assert offered["gravcomp"].without == 0.0
    for change, without in (
        ('<body name="upper"', '<body gravcomp="1" name="upper"'),
        ("<option", '<option gravity="0 0 0"'),
    ):
        path = tmp_path / "changed.xml"
        path.write_text(XML.replace(change, without))
        other = MjcfRobot(replace(robot.config, model=path)).with_optional_terms("auto")
        found = {p.what: p.parameter for p in other.placed}
        assert ("gravcomp" in found) == ("gravity" not in without)
        if "gravcomp" in found:
            assert found["gravcomp"].without == 1.0
            text = other.exported(
                {p.parameter.name: p.parameter.nominal for p in other.placed} | {"gravcomp": 0.6}
            ).mjcf
            assert text.count('gravcomp="0.6"') == 1
