"""Identification: the way from a log to a verdict, in ten calls.

``sim2real.identify(robot, recording)`` does this and more, such as refits without parts of the log. The steps::

    import numpy as np

    import sim2real
    from sim2real.identification import predictions, uncertainty, verdict
    from sim2real.identification.config import FitConfig
    from sim2real.identification.fit import fit
    from sim2real.identification.residuals import Problem
    from sim2real.identification.segments import Span

    LENGTH_S, SETTLE_S, HORIZON_S = 1.3, 0.3, 1.0

    # Open the robot and the log, and make the graph whose parameters are identified.
    robot = sim2real.load_robot("pendulum")  # 1
    episode = sim2real.Recording.load("datasets/pendulum/chirp.mcap").episode  # 2
    config = FitConfig()
    model = robot.identifiable(config.max_delay_s)  # 3

    # Cut the log into segments of LENGTH_S: the first three quarters are fitted, the rest is held out.
    begins_s = np.arange(0.3, episode.duration_s - LENGTH_S - 0.2, LENGTH_S)
    spans = [Span(0, float(begin_s), begin_s < 0.75 * episode.duration_s) for begin_s in begins_s]

    # Search, then refine: the estimate is where the simulated segments differ least from the measured ones.
    estimate = fit(Problem(model, [episode], spans, LENGTH_S, config))  # 4

    # Linearise the residuals at the estimate: intervals follow from the derivatives, and which parameters the log
    # determines.
    at = estimate.problem.linearise(estimate.x)  # 5
    spread = uncertainty.from_linearised(estimate.problem, at)  # 6
    determined = uncertainty.determined(estimate.problem, at)  # 7

    # Predict the held-out segments: SETTLE_S of each give its initial state, HORIZON_S are compared.
    models = {"identified": estimate.values, "nominal": {p.name: p.nominal for p in model.parameters}}
    columns = predictions.samples(estimate.windows, models, SETTLE_S)  # 8
    positions = predictions.positions(model, robot.units)
    errors = predictions.errors(columns, list(models), positions, SETTLE_S, HORIZON_S)  # 9

    # Judge: the estimate must predict every position better than every baseline, within its bounds.
    left = None if estimate.converged else estimate.left
    judgement = verdict.judge(errors, estimate.problem.table, at.x, spread, determined, left=left)  # 10
    for line in (judgement.status, *judgement.reasons):
        print(line)

In the order of the data: ``segments``, ``rollouts``, ``residuals``, ``search``, ``fit``, ``uncertainty``,
``predictions``, ``held_out``, ``terms``, ``expected``, ``lacks``, ``verdict``; beside it ``delays``, ``drift``,
``export``.
"""
