"""What it costs to let impacts act at the time at which they happen, beside the end of a step. Ratios are what counts.

`pytest benchmarks/bench_events.py --benchmark-only`: 200 trajectories of `bp5` of 50 steps, with at most one event a
step; the motion alone, and with its gradient by states and contact properties.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest

import carom

BATCH, STEPS, DT = 200, 50, 0.01


@pytest.fixture(scope="module")
def start():
    system = carom.task("bp5")
    return system, *carom.sample(system, jax.random.key(0), BATCH)


@pytest.mark.parametrize("gradient", [False, True], ids=["motion", "motion and gradient"])
@pytest.mark.parametrize("impact", ["step", "event"])
def test_impacts(benchmark, start, impact, gradient):
    system, x0, v0 = start

    def loss(parts):
        x0, v0, friction, restitution = parts
        changed = eqx.tree_at(lambda s: (s.friction, s.restitution), system, (friction, restitution))
        out = carom.simulate(changed, x0, v0, dt=DT, steps=STEPS, impact=impact, max_events=1)
        return jnp.sum(out.x[:, -1] ** 2)

    compiled = jax.jit(jax.grad(loss) if gradient else loss)
    parts = (x0, v0, system.friction, system.restitution)

    def run():
        return jax.block_until_ready(compiled(parts))

    run()
    benchmark.group = f"{'motion and gradient' if gradient else 'motion'}, bp5, {BATCH} x {STEPS} steps"
    benchmark.pedantic(run, rounds=20, warmup_rounds=2)
