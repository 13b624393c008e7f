"""A parameter that the data does not determine is held at its nominal value, if the fit stays as good."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from lag import CONFIG as FAST
from lag import GAIN, LENGTH_S, Model, Params, lag_log, spans

from sim2real.identification import fit as fitting
from sim2real.identification.fit import fit
from sim2real.identification.parameters import Parameter, ParameterTable
from sim2real.identification.residuals import Problem
from sim2real.stages.identify.config import IdentifyConfig
from sim2real.stages.identify.fitting import Fits, determined
from sim2real.stages.identify.inputs import Inputs
from sim2real.stages.identify.judgement import Findings
from sim2real.stages.shared.identification import long_spans

CONFIG = IdentifyConfig(max_delay_s=FAST.max_delay_s, generations=0, terms="auto", horizon_s=LENGTH_S, settle_s=0.0)


class Twice(Model):
    """A lag whose gain is a product of two parameters: any share of one is made up for by the other."""

    shares = (Parameter("first", "1", 1.3, 0.25, 4.0), Parameter("second", "1", 1.1, 0.25, 4.0))
    parameters = ParameterTable(
        [*shares, Model.parameters["tau"], Model.parameters["bias"], Model.parameters["offset"]]
    )

    def params(self, values, start):
        gain = values["first"] * values["second"]
        return {"world": replace(Params(), gain=gain, tau=values["tau"], bias=values["bias"], start=start[0])}


@pytest.mark.night
@pytest.mark.parametrize("long_s", [0.0, 2.0])
def test_one_factor_of_a_product_is_held_and_the_other_is_for_that_value(long_s, monkeypatch):
    episode, SPANS = lag_log(0), spans(0)
    config = replace(CONFIG, long_s=long_s)
    longer = long_spans([episode], 1, config)
    assert bool(longer) == bool(long_s)
    model = Twice()
    wide = fit(Problem(model, [episode], SPANS, LENGTH_S, config), long_spans=longer)
    found = Findings.of(wide, ())
    assert found.check.undetermined
    logs = (SimpleNamespace(episode=episode),)
    inputs = Inputs(None, config, None, model, model.parameters, logs, ("",), 1, SPANS)
    lengths, descend = [], fitting._refine
    monkeypatch.setattr(
        fitting, "_refine", lambda problem, *rest: lengths.append(problem.segment_s) or descend(problem, *rest)
    )
    fits, sentences = determined(Fits(inputs, wide), found.check, found.spread)
    values, (sentence,) = fits.estimate.values, sentences
    held, other = ("first", "second") if "first is held" in sentence else ("second", "first")
    assert f"{held} is held at its nominal value" in sentence
    assert held not in fits.estimate.problem.table.names
    assert values[other] * model.parameters[held].nominal == pytest.approx(GAIN, rel=0.01)
    assert fits.estimate.converged
    assert fits.estimate.loss == pytest.approx(wide.loss, rel=3e-4)
    # Only the last descent is repeated: one on windows could leave the minimum of long segments.
    np.testing.assert_allclose(lengths, [long_s or LENGTH_S])
