"""A training step with contact beside the same step with contact switched off. Ratios are what counts.

`pytest benchmarks/bench_training.py -k "cp3 or bp5"` prints both for cp3 and bp5: 200 chunks of 5 states, half of them
with a contact, from the tasks' own data; forward, gradient and update; after warm-up. `-k rope` does so for ropes of
10, 50, 100 and 200 points; what memory each needs is that of a process of its own (`-k "rope-200"`), as `max_rss_gb`.
"""

import dataclasses
import resource

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import carom
from carom.learning.dataset import Chunks, closed_contacts
from carom.learning.training.loss import gather_chunks, train_step
from carom.learning.training.optimizer import Rates
from carom.learning.training.start import fresh_state
from carom.simulation.impact import Stepper

CONFIG = carom.LearnConfig()


TRAJECTORIES = {"cp3": 200, "bp5": 200}
"""To draw the chunks from; of ropes, fewer."""


@pytest.fixture(scope="module", params=["cp3", "bp5", "rope", "rope-50", "rope-100", "rope-200"])
def training(request):
    """The arguments of a training step, with contact."""
    system = carom.task(request.param)
    data = carom.make_recording(system, jax.random.key(0), TRAJECTORIES.get(request.param, 20))
    chunks = Chunks.of(data.contact, data.length, CONFIG.states)
    drawn = chunks.draw(np.random.default_rng(0), CONFIG.batch_size, CONFIG.contact_share)
    skeleton = system.with_max_active(int(closed_contacts(data.x, system).max()) + 2)
    state = fresh_state(skeleton, CONFIG, data)
    inputs = (skeleton, jnp.asarray(data.x), jnp.asarray(data.v), *(jnp.asarray(part) for part in drawn))
    with_contact = float(np.mean(np.any(gather_chunks(data.contact, data.contact, *drawn, CONFIG.states)[0], 1)))
    return request.param, inputs, state.unknowns, state.optimizer, with_contact


@pytest.mark.parametrize("contact", [False, True], ids=["contact off", "contact on"])
def test_training_step(benchmark, training, contact):
    name, inputs, unknowns, state, share = training
    stepper = Stepper(dt=jnp.asarray(0.01), project=False, contact=contact)
    width, rates = jnp.asarray(0.1), Rates.of(CONFIG, CONFIG.learning_rate)

    def run():
        return jax.block_until_ready(train_step(inputs, unknowns, state, rates, stepper, CONFIG.states, width)[2])

    run()
    benchmark.group = f"training step, {name}, {share:.0%} of the chunks with a contact"
    benchmark.extra_info.update(
        task=name, contact=contact, most_contacts=inputs[0].max_active, config=dataclasses.asdict(CONFIG)
    )
    benchmark.pedantic(run, rounds=40 if name in TRAJECTORIES else 5, warmup_rounds=5 if name in TRAJECTORIES else 1)
    benchmark.extra_info["max_rss_gb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
