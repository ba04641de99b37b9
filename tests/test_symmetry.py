"""A step is the same in every frame, size, unit and labelling; far bodies and the order of bodies change nothing."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import SCENES, frames_of, made
from systems import disk

import carom
from carom.mechanics.bodies import embed_pose, embed_velocity
from carom.simulation.impact import Stepper, closed_contacts
from carom.simulation.rollout import step

COUNT = 24
MODELS = {
    "coulomb": lambda frame: carom.Coulomb(),
    "cm": lambda frame: carom.CM(),
    "cmr": lambda frame: carom.CMr(0.1 / frame.mass),
    "lcp": lambda frame: carom.LCP(),
}


def _steps(name, model):
    """Velocities after a step in the plain frame (and before, for the scale), the residual, and how singular A is.

    `bounce` multiplies the scene's restitutions.
    """

    def one(key, frame, bounce):
        system, x, v = made(name, key, frame, contact_model=MODELS[model](frame))
        system = eqx.tree_at(lambda s: s.restitution, system, bounce * system.restitution)
        stepper = Stepper(dt=1e-3 * frame.time)
        out = step(system, x, v, stepper)
        contacts = closed_contacts(system, x, v, system.inverse_mass_matrix(), stepper)
        size = jnp.sqrt(jnp.maximum(jnp.diagonal(contacts.delassus), 1e-300))
        values = jnp.linalg.eigvalsh(contacts.delassus / size / size[:, None])
        used = jnp.sum(jnp.diagonal(contacts.delassus) > 0)
        least = jnp.sort(values)[len(size) - used]
        points = SCENES[name][1]
        return frame.back(out.v, points), frame.back(v, points), out.residual, least

    return jax.jit(jax.vmap(one, (0, 0, None)))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "model"), list(itertools.product(SCENES, MODELS)))
def test_a_step_is_the_same_in_every_frame_and_unit(name, model):
    """To 1e-9 of the speeds; 1e-7 where contacts are redundant, whose impulses are found to the root of rounding.

    By Newton's hypothesis contacts of joined bodies may ask for velocities that no impulse gives, or that need energy:
    with `lcp` a share of the impacts has no solution and says so; at e = 0 each has one. The epsilon of `cmr` is in
    1/kg: beside bends, whose A is in other units, it is another one in another unit of length.
    """
    if (name, model) in {("spheres", "lcp"), ("machine", "lcp")}:
        pytest.skip("a pyramid of friction has directions of its own")
    steps = _steps(name, model)
    keys = jax.random.split(jax.random.key(7), COUNT)
    frames = frames_of(np.random.default_rng(7), name, COUNT)
    plain = frames.pop("plain")
    for bounce in [1.0, 0.0] if model == "lcp" else [1.0]:
        after, before, residual, least = map(np.asarray, steps(keys, plain, bounce))
        scale = np.maximum(np.abs(after), np.abs(before)).max((1, 2))
        assert np.all(np.abs(after - before).max((1, 2)) > 1e-3 * scale), "no contact acted"
        solved = residual < 1e-8
        assert np.mean(solved) >= (0.5 if model == "lcp" and bounce else 1)
        for which, frame in frames.items():
            if (name, model) == ("chain", "cmr") and np.any(frame.length != 1):
                continue
            out, _, other, _ = map(np.asarray, steps(keys, frame, bounce))
            off = np.abs(out - after).max((1, 2)) / scale
            both = solved & (other < 1e-8)
            allowed = np.where(least > 1e-6, 1e-9, 1e-7)
            worst = np.argmax(np.where(both, off / allowed, 0))
            what = f"{which}: scene {worst} is {off[worst]:.1e} off, eigenvalue {least[worst]:.1e}"
            assert np.all((off <= allowed)[both]), what


def _two_disks_and(far: float | None):
    """A disk that falls on another, which lies in a V of two planes; perhaps a third that hits a plane far off."""
    places = [(0.0, 0.141), (0.02, 0.34)] + ([] if far is None else [(far, 0.29)])
    x0 = jnp.concatenate([embed_pose(jnp.array(p), jnp.eye(2)) for p in places])
    v0 = jnp.concatenate([embed_velocity(jnp.eye(2), jnp.array([0.1, -1.0]), jnp.array([2.0])) for _ in places])
    contacts = [
        carom.DiskPlane([0, 1], (0.0, 0.0), (1.0, 1.0)),
        carom.DiskPlane([0, 1], (0.0, 0.0), (-1.0, 1.0)),
        carom.DiskDisk([(0, 1)]),
    ]
    if far is not None:
        contacts.append(carom.DiskPlane([2], (0.0, 0.2), (0.0, 1.0)))
    return carom.System([disk()] * len(places), (), contacts, carom.Gravity((0.0, -9.81)), 0.4, 0.5), x0, v0


@pytest.mark.slow
@pytest.mark.ci_budget
def test_a_far_body_changes_nothing():
    near, alone = _two_disks_and(10.0), _two_disks_and(None)
    with_it, without = (carom.simulate(s, x, v, dt=0.01, steps=30) for s, x, v in (near, alone))
    assert with_it.contact.sum() >= 3
    np.testing.assert_allclose(with_it.x[:, :6], without.x, atol=1e-12)
    np.testing.assert_allclose(with_it.v[:, :6], without.v, atol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("model", ["coulomb", "cm"])
def test_the_order_of_bodies_and_contacts_changes_nothing(model):
    name = "three_disks"
    order = np.array([2, 0, 1])
    points = np.concatenate([np.arange(3 * b, 3 * b + 3) for b in order])

    def one(key, frame):
        system, x, v = made(name, key, frame, contact_model=MODELS[model](frame))
        back = np.argsort(order)
        contacts = [
            *(
                carom.DiskPlane(back[::-1].tolist(), c.point, c.normal, property=k)
                for k, c in enumerate(system.contacts[1:])
            ),
            carom.DiskDisk([tuple(back[list(pair)].tolist()) for pair in ((1, 2), (0, 1), (2, 0))], property=[2, 0, 1]),
        ][::-1]
        other = carom.System(
            [system.bodies[b] for b in order],
            (),
            contacts,
            system.potential,
            system.friction,
            system.restitution,
            contact_model=MODELS[model](frame),
        )
        stepper = Stepper(dt=1e-3 * frame.time)
        a, b = step(system, x, v, stepper), step(other, x[points], v[points], stepper)
        return a.v[points], b.v, a.residual, b.residual

    keys = jax.random.split(jax.random.key(3), COUNT)
    frame = frames_of(np.random.default_rng(7), name, COUNT)["plain"]
    a, b, *residuals = map(np.asarray, jax.jit(jax.vmap(one))(keys, frame))
    assert max(r.max() for r in residuals) < 1e-8
    np.testing.assert_allclose(a, b, atol=1e-7 * np.abs(a).max())
