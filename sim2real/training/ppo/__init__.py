"""Proximal policy optimisation (PPO) of several seeds in one compiled program.

``train`` compiles one program that trains every seed from one evaluation to the next, and calls it
``config.evaluations`` times. Written as a loop of Python for one seed, the program is::

    for update_number in range(config.updates_per_evaluation):
        # Collect: play rollout_steps rows of all copies with the current policy, with exploration noise.
        policy = make_policy(env, config, networks, state.params, state.normaliser)
        key_rollout, _, _ = keys(state)
        copies, rows = collect(env, config, policy, state.copies, state.update, key_rollout)

        # Update: advantages of the rows, then epochs x minibatches gradient steps, then the normaliser.
        state, figures = update(env, config, networks, state, copies, rows)

    # Evaluate: play one episode per copy, without exploration noise.
    policy = make_policy(env, config, networks, state.params, state.normaliser)
    figures |= evaluate(env, config, policy, key)

and ``update`` does::

    batch, critic_carry = prepare(state, policy, rows, config, networks)   # values, log densities, advantages by gae()
    for shuffle in shuffles:                                               # config.epochs of them
        for minibatch in batch[shuffle]:                                   # config.minibatches, all rows of some copies
            gradient = jax.grad(loss)(params, minibatch, config, networks)
            params, optimiser = optimiser.update(gradient, optimiser, params)
    normaliser = update_normaliser(normaliser, rows.observation, rows.valid)

After each call the host checks the figures, writes a checkpoint, and reports progress (``trainer.train``).

Files:

- ``trainer.py``: ``train``; the state before the first update; the compiled program; the loop on the host
- ``rollout.py``: ``collect``, ``evaluate``
- ``update.py``: ``TrainState``, ``prepare``, ``update``; the normaliser, Adam
- ``losses.py``: ``unroll``, ``gae``, ``loss``
- ``checkpoint.py``: a training after an evaluation, and its file
"""
