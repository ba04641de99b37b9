"""Gradient of four RK4 steps through a learned potential: the tableau written out beside `solver.step`."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import pytest

from carom.learning.unknowns.models import NeuralPotential
from carom.simulation.integrators import RK4, flow


@pytest.mark.parametrize("way", ["written out", "solver.step"])
def test_four_steps(benchmark, way):
    potential = NeuralPotential(3, 2, key=jax.random.key(0))
    x, v = (jax.random.normal(jax.random.key(k), (200, 3, 2), jnp.float64) for k in (1, 2))
    solver = RK4()

    def step(field, state):
        if way == "written out":
            return flow(solver, field, state, 0.01)
        term = diffrax.ODETerm(lambda t, y, args: field(y))
        carry = solver.init(term, 0.0, 0.01, state, None)
        return solver.step(term, 0.0, 0.01, state, None, carry, made_jump=False)[0]

    def loss(potential, x, v):
        def one(x, v):
            def field(state):
                return state[1], -jax.grad(potential)(state[0], jnp.eye(3))

            return jax.lax.scan(lambda s, _: (step(field, s), None), (x, v), length=4)[0]

        return sum(jnp.sum(a) for a in jax.vmap(one)(x, v))

    gradient = eqx.filter_jit(eqx.filter_grad(loss))
    benchmark.group = "gradient of four RK4 steps, learned potential, batch 200"
    benchmark.pedantic(lambda: jax.block_until_ready(gradient(potential, x, v)), rounds=20, warmup_rounds=3)
