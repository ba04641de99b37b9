"""The contact models: against references and each other, derivatives, and how they are chosen."""

import dataclasses
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cone_problems import apply, clarabel_solution, contact_scale, generate
from contact_states import state_of
from systems import ball_on_floor, refused

import carom
from carom.contact.impulses import CONTACT_MODELS
from carom.learning.dataset import Chunks, contact_flags
from carom.learning.model_file import read_model_header
from carom.learning.run import RunFolder
from carom.learning.training.loss import train_step
from carom.learning.training.optimizer import Rates
from carom.learning.training.start import fresh_state
from carom.learning.training.train import learn
from carom.simulation.impact import Stepper
from carom.simulation.rollout import simulate

TINY = carom.LearnConfig(
    epochs=2, chunks_per_epoch=16, batch_size=16, chunk_length=3, width=8, depth=1, checkpoint_every=1, refine=False
)


@eqx.filter_jit
def impulses(model, state):
    return jax.vmap(lambda one: model(one))(state).velocity


def problems(family, d, *, batch=16, contacts=3):
    """Regular and degenerate problems in units in which the largest inverse mass is 1."""
    out = generate(np.random.default_rng(21), family, batch, contacts, d)
    scale = np.maximum(np.einsum("bkk->bk", out.A).max(axis=1), 1e-30)[:, None]
    return out._replace(A=out.A / scale[..., None], lower=out.lower * scale)


# --- CMr ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("family", ["gaussian", "duplicate contacts", "stacked boxes", "ball joint"])
def test_cmr_solves_both_phases_with_a_larger_diagonal(family):
    """By another solver, phase by phase; the velocity between them is that of A itself."""
    epsilon, problem = 0.05, problems(family, 3)
    found = np.asarray(impulses(carom.CMr(epsilon), state_of(problem)))
    error = []
    for b in range(len(found)):
        A, v, friction, restitution, v_star, _ = (x[b] for x in problem)
        present = np.repeat(contact_scale(A[None], 3)[0] > 0, 3)
        softened = A + epsilon * np.diag(present)
        compression, _, _ = clarabel_solution(softened, v, friction, np.zeros(3))
        after = v + apply(A[None], compression[None])[0]
        rebound, _, _ = clarabel_solution(softened, after - v_star, friction, restitution * compression[:, 0])
        size = max(1e-30, np.abs(v).max(), np.abs(v_star).max())
        error.append(np.abs(found[b] - compression - rebound).max() / size)
    # Impulses are unique, as the programs are strongly convex by epsilon: with the gap of 1e-10 at which Clarabel ends
    # they are known to the root of 2 gap / epsilon, 6e-5, in each phase. That far off they are at kinks alone.
    assert max(error) < 1.3e-4


EPSILONS = (1e-2, 1e-4, 1e-7)


@pytest.mark.slow
def test_cmr_becomes_cm_as_epsilon_vanishes():
    problem = problems("gaussian", 2)
    state = state_of(problem)
    exact = impulses(carom.CM(), state)
    np.testing.assert_array_equal(impulses(carom.CMr(0.0), state), exact)
    size = np.maximum(np.abs(problem.v), np.abs(problem.v_star)).max((1, 2), keepdims=True) + 1e-30
    changes = [np.asarray(impulses(carom.CMr(epsilon), state) - exact) for epsilon in EPSILONS]
    worst = [np.abs(apply(problem.A, change) / size).max() for change in changes]
    assert worst[0] > 1e-4  # the first epsilon does something
    assert worst[1] < worst[0] / 10
    assert worst[2] < 1e-4


def test_cmr_of_one_contact_in_closed_form():
    """`A = a`, no friction: compression leaves the share `eps / (a + eps)` of the approach, restitution takes it on."""
    a, epsilon, e = 2.0, 0.5, 0.3
    out = simulate(
        ball_on_floor(restitution=e, gravity=0.0, mass=1 / a),
        jnp.array([[0.0, 0.1]]),
        jnp.array([[0.0, -1.0]]),
        dt=1e-3,
        steps=1,
        compensation_steps=None,
        contact_model=carom.CMr(epsilon),
    )
    compression = 1 / (a + epsilon)
    left = 1 - a * compression
    rebound = max(e * compression, left / (a + epsilon))
    assert np.allclose(out.v[1, 0], [0, -left + a * rebound], atol=1e-8)


# --- Coulomb --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.ci_budget
def test_coulomb_obeys_the_law_and_cm_lifts_what_slides():
    """Compression (e = 0): gaps close or no force, and friction of mu f_n against the sliding, within the cone."""
    rng = np.random.default_rng(5)
    half = rng.normal(size=(16, 9, 9))
    A = half @ half.transpose(0, 2, 1) / 9 + 0.3 * np.eye(9)
    v = rng.normal(size=(16, 3, 3))
    mu = rng.uniform(0, 0.6, size=(16, 3))
    made = generate(np.random.default_rng(0), "gaussian", 16, 3, 3)
    state = state_of(made._replace(A=A, v=v, v_star=0 * v, friction=mu, restitution=0 * mu))

    def lift(model):
        impulse = np.asarray(impulses(model, state))
        after = v + np.asarray(apply(A, impulse))
        slip = np.linalg.norm(after[..., 1:], axis=-1)
        assert np.all(np.linalg.norm(impulse[..., 1:], axis=-1) <= mu * impulse[..., 0] + 1e-7)
        pressed = impulse[..., 0] > 1e-6
        assert pressed.mean() > 0.3
        power = np.sum(impulse[..., 1:] * after[..., 1:], axis=-1)
        assert np.min(after[..., 0][~pressed]) > -1e-6
        return np.max(np.abs(after[..., 0])[pressed]), np.max(np.abs(power + mu * impulse[..., 0] * slip))

    assert lift(carom.CM())[0] > 0.1
    lifted, against_sliding = lift(carom.Coulomb())
    assert lifted < 1e-8
    assert against_sliding < 1e-8


def one_contact(speed, sliding, friction, restitution):
    """One contact in 2D, of a mass of 1 kg, that approaches and slides."""
    v = np.array([[[-speed, sliding]]])
    made = generate(np.random.default_rng(0), "gaussian", 1, 1, 2)
    return state_of(
        made._replace(
            A=np.eye(2)[None], v=v, v_star=0 * v, friction=np.array([[friction]]), restitution=np.array([[restitution]])
        )
    )


@pytest.mark.slow
@pytest.mark.ci_budget
def test_one_sliding_contact_by_hand():
    """Poisson: the impulse is (1 + e) u_n, and friction mu of it; CM's is larger by what it lifts."""
    state = one_contact(1.0, 2.0, 0.3, 0.5)
    assert np.allclose(impulses(carom.Coulomb(), state)[0, 0], [1.5, -0.45], atol=1e-10)
    assert impulses(carom.CM(), state)[0, 0, 0] > 1.8
    # So much friction that convex programs in turn, with the speed that came out of the last, would lead away.
    rough = one_contact(1.0, 9.0, 1.6, 0.5)
    assert np.allclose(impulses(carom.Coulomb(), rough)[0, 0], [1.5, -2.4], atol=1e-7)


@pytest.mark.slow
def test_fast_impacts_have_less_friction_and_restitution():
    e, mu, speed, losses, pace = 0.8, 0.3, 0.4, (0.3, 0.5), 0.25
    lost = 1 - np.exp(-speed / pace)

    def jump(friction_loss, restitution_loss):
        model = carom.Coulomb(friction_loss, restitution_loss, pace)
        return impulses(model, one_contact(speed, 3.0, mu, e))[0, 0]

    normal = speed * (1 + e * (1 - losses[1] * lost))
    friction = mu * (1 - losses[0] * lost)
    assert np.allclose(jump(*losses), [normal, -friction * normal], atol=1e-8)
    slopes = jax.jacobian(lambda losses: jump(*losses))(jnp.asarray(losses))
    expected = [[0, -speed * e * lost], [mu * lost * normal, friction * speed * e * lost]]
    assert np.allclose(slopes, expected, rtol=1e-5, atol=1e-6)


# --- LCP ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("e", [0.0, 0.6, 1.0])
def test_lcp_and_cm_agree_for_one_contact_without_friction(e):
    """There Newton's and Poisson's hypotheses are one (appendix J), whatever e and the target."""
    problem = problems("gaussian", 2, contacts=1)
    problem = problem._replace(friction=0 * problem.friction, restitution=0 * problem.restitution + e)
    state = state_of(problem)
    one, other = (np.asarray(impulses(model, state)) for model in (carom.CM(), carom.LCP()))
    size = np.abs(problem.v).max((1, 2), keepdims=True) + 1e-30
    assert (one[..., 0] > 0).any()
    # 1e-6 of v: as close as the interior point method comes to an impulse that vanishes.
    np.testing.assert_allclose(apply(problem.A, one - other) / size, 0, atol=1e-6)


def test_a_sliding_contact_does_not_lift_off_with_lcp():
    """Coulomb's law in closed form: `v_n^+ = e approach`, `f_t = -mu f_n`; CM lifts off by mu times the slip."""
    mu, e, slip = 0.5, 0.6, 3.0
    out = simulate(
        ball_on_floor(friction=mu, restitution=e, gravity=0.0),
        jnp.array([[0.0, 0.1]]),
        jnp.array([[slip, -1.0]]),
        dt=1e-3,
        steps=1,
        compensation_steps=None,
        contact_model="lcp",
    )
    np.testing.assert_allclose(out.v[1, 0], [slip - mu * (1 + e), e], atol=1e-12)


def test_a_block_slides_to_rest_with_lcp():
    """`v^2 / (2 mu g)`, without the hops of CM: it stays on the floor."""
    mu, speed = 0.4, 2.0
    out = simulate(
        ball_on_floor(friction=mu),
        jnp.array([[0.0, 0.1]]),
        jnp.array([[speed, 0.0]]),
        dt=1e-3,
        steps=1000,
        contact_model="lcp",
    )
    assert float(out.x[-1, 0, 0]) == pytest.approx(speed**2 / (2 * mu * 9.81), rel=2e-3)  # friction sets in dt late
    assert float(out.v[-1, 0, 0]) == pytest.approx(0, abs=1e-12)
    assert np.abs(out.x[:, 0, 1] - 0.1).max() < 1e-4


def test_restitution_can_leave_zero_with_lcp():
    """At e = 0 and without a target the derivative is that of a rebound which sets in: `dv_n^+ / de` = approach."""

    def after(e):
        system = ball_on_floor(gravity=0.0)
        system = eqx.tree_at(lambda s: s.restitution, system, e[None])
        out = simulate(
            system,
            jnp.array([[0.0, 0.1]]),
            jnp.array([[0.0, -1.5]]),
            dt=1e-3,
            steps=1,
            compensation_steps=None,
            contact_model="lcp",
        )
        return out.v[1, 0, 1]

    assert float(jax.grad(after)(jnp.asarray(0.0))) == pytest.approx(1.5, rel=1e-9)


# --- Derivatives through a step ------------------------------------------------------------------------------------


def before_contact(dataset):
    """Recorded states from which a step ends in a contact."""
    trajectory, time = np.nonzero(dataset.train.contact)
    return jnp.asarray(dataset.train.x[trajectory, time - 1]), jnp.asarray(dataset.train.v[trajectory, time - 1])


@pytest.mark.slow
@pytest.mark.parametrize("model", [pytest.param("lcp", marks=pytest.mark.ci_budget), "cmr", "coulomb"])
def test_derivatives_through_a_step_of_cp3(model, cp3, cp3_data):
    """By all that states and systems consist of, against differences, for many impacts at once."""
    system = eqx.tree_at(lambda s: s.restitution, cp3.with_contact_model(model), jnp.array([0.4]))
    x0, v0 = (a[:64] for a in before_contact(cp3_data))
    arrays, rest = eqx.partition(system, eqx.is_inexact_array)
    rng = np.random.default_rng(4)
    point = jax.tree.map(lambda a: jnp.broadcast_to(a, (len(x0), *a.shape)), arrays), x0, v0
    step = jax.tree.map(lambda a: jnp.asarray(rng.normal(size=a.shape)) * a, point)
    weight = jnp.asarray(rng.normal(size=x0.shape))

    def pull(point):
        def after(arrays, x, v):
            # No gradient flows through the target velocity (appendix G): without it differences see no more than it.
            options = {"dt": 0.01, "steps": 1, "project": False, "compensation_steps": None}
            return simulate(eqx.combine(arrays, rest), x, v, **options).v[1]

        pulled = jnp.sum(weight * jax.vmap(after)(*point), axis=(1, 2))
        return jnp.sum(pulled), pulled

    both = jax.jit(jax.value_and_grad(pull, has_aux=True))
    h = 1e-6
    gradient = both(point)[1]
    here, ahead, behind = (both(jax.tree.map(lambda a, da, t=t: a + t * da, point, step))[0][1] for t in (0.0, h, -h))
    assert all(np.isfinite(g).all() for g in jax.tree.leaves(gradient))
    for g in (gradient[0].friction, gradient[0].restitution, *jax.tree.leaves(gradient[0].contact_model)):
        assert (np.asarray(g) != 0).any()
    along = jax.tree.map(lambda g, s: jnp.sum(g * s, axis=tuple(range(1, g.ndim))), gradient, step)
    derivative = sum(jax.tree.leaves(along))
    # Transitions between open, sticking and sliding are where the two one-sided differences differ.
    one, other = (ahead - here) / h, (here - behind) / h
    scale = 1 + np.abs(derivative)
    smooth = np.abs(one - other) < 1e-3 * scale
    assert smooth.mean() > 0.8
    # Rounding, and for cmr the 1e-10 to which problems are solved, over h.
    assert np.max((np.abs((one + other) / 2 - derivative) / scale)[smooth]) < 1e-5


# --- Learning ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_training_step_with_lcp_has_finite_gradients(cp3, cp3_data):
    """The paper's LCP baseline had none (appendix J)."""
    config = dataclasses.replace(TINY, contact_model="lcp")
    skeleton, train = config.prepare(cp3), cp3_data.train
    assert isinstance(skeleton.contact_model, carom.LCP)
    chunks = Chunks.of(contact_flags(train, skeleton), train.length, config.chunk_length)
    drawn = chunks.draw(np.random.default_rng(0), config.batch_size, 1.0)
    assert chunks.count()[1] > 0
    state = fresh_state(skeleton, config)
    stepper = Stepper(dt=jnp.asarray(train.dt), project=False)
    rates = Rates.of(config, config.learning_rate)
    data = (skeleton, jnp.asarray(train.x), jnp.asarray(train.v), *map(jnp.asarray, drawn))
    new, _, error, overflow, bad = train_step(
        data, state.unknowns, state.optimizer, rates, stepper, config.chunk_length, jnp.asarray(0.1)
    )
    assert not bad  # neither the loss nor a gradient
    assert np.isfinite(error)
    assert overflow == 0
    for name in ("friction", "restitution", "log_mass_ratio"):
        assert np.all(np.asarray(getattr(new, name)) != np.asarray(getattr(state.unknowns, name)))


@pytest.mark.slow
def test_epsilon_is_learned_reported_and_saved(cp3, cp3_data, tmp_path):
    config = dataclasses.replace(TINY, contact_model="cmr", epsilon="learn")
    run = RunFolder.create(tmp_path / "run", {})
    system, report = learn(cp3, cp3_data, config, run=run, progress=False)
    run.close()
    assert report.skipped_steps == 0
    assert report.epsilon == float(system.contact_model.epsilon)
    assert report.epsilon > 0
    values = [m["epsilon"] for m in run.metrics()]
    assert len({0.01, *values}) == 3  # another each epoch
    carom.save_model(tmp_path / "model.carom", system, compensation_steps=None)
    again = carom.load_model(tmp_path / "model.carom")
    assert float(again.contact_model.epsilon) == report.epsilon
    assert read_model_header(tmp_path / "model.carom")["compensation_steps"] is None


@pytest.mark.slow
def test_a_learned_epsilon_vanishes_where_contacts_do_not_yield(cp3, cp3_data):
    """Data of CM. The paper's epsilon took its restitution with it: 0.453 for a true 0 (table S.7)."""
    system, report = learn(cp3, cp3_data, carom.LearnConfig(contact_model="cmr", epsilon="learn"), progress=False)
    assert report.epsilon is not None
    assert report.epsilon < 1e-4
    assert float(system.restitution[0]) < 1e-3
    assert abs(float(system.friction[0]) - 0.5) < 1e-4


# --- Choice ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "kind"), CONTACT_MODELS.items(), ids=list(CONTACT_MODELS))
def test_a_contact_model_is_chosen_by_name_or_given(name, kind):
    system = carom.task("cp3", contact_model=name)
    assert type(system.contact_model) is kind
    given = kind()
    assert carom.task("cp3", contact_model=given).contact_model is given
    assert type(carom.System([carom.PointMass(1.0)], contact_model=name).contact_model) is kind


def test_simulate_takes_another_contact_model_than_the_systems():
    system = ball_on_floor(friction=0.5, gravity=0.0).with_contact_model("cm")
    start = jnp.array([[0.0, 0.1]]), jnp.array([[3.0, -1.0]])
    options = {"dt": 1e-3, "steps": 1}
    over = simulate(system, *start, contact_model="lcp", **options)
    own = simulate(system.with_contact_model("lcp"), *start, **options)
    np.testing.assert_array_equal(over.v, own.v)
    assert np.abs(over.v - simulate(system, *start, **options).v).max() > 0.1


def test_a_saved_model_has_its_contact_model_again(tmp_path, cp3):
    path = tmp_path / "model.carom"
    for model in (carom.CM(), carom.CMr(0.25), carom.Coulomb(0.1, 0.2, 0.5), carom.LCP(8)):
        carom.save_model(path, cp3.with_contact_model(model))
        again = carom.load_model(path).contact_model
        assert eqx.tree_equal(again, model)
    data = re.sub(rb', "header_sha256": "[0-9a-f]+"', b"", path.read_bytes())
    header, _, payload = data.partition(b'"name": "lcp"')
    path.write_bytes(header + b'"name": "new"' + payload)
    with refused("was learned with the contact model 'new'"):
        carom.load_model(path)


class Sticky(carom.ContactModel):
    """A contact model of a user's own: everything stops."""

    share: jax.Array

    def __call__(self, state, *, smoothing=0.0):
        stops = jnp.any(state.active.active)
        return carom.Jump(jnp.where(stops, -self.share * state.v, 0), jnp.zeros(()))


def test_a_contact_model_of_ones_own(tmp_path, cp3, cp3_data):
    system = cp3.with_contact_model(Sticky(jnp.asarray(0.5)))
    x0, v0 = (a[:1] for a in before_contact(cp3_data))
    free = simulate(cp3, x0, v0, dt=0.01, steps=1, contact_model=Sticky(jnp.asarray(0.0)))
    out = simulate(system, x0, v0, dt=0.01, steps=1)
    np.testing.assert_allclose(out.v[:, 1], free.v[:, 1] / 2, rtol=1e-12)
    carom.save_model(tmp_path / "model.carom", system)
    again = carom.load_model(tmp_path / "model.carom", cp3.with_contact_model(Sticky(jnp.asarray(0.0))))
    assert float(again.contact_model.share) == 0.5


def test_bad_contact_models_are_refused_by_name(cp3, cp3_data):
    message = "contact_model must be one of 'cm', 'cmr', 'lcp', 'coulomb', or a ContactModel; it was "
    x0, v0 = jnp.zeros((1, 2)), jnp.zeros((1, 2))
    with refused(message + "'cmx'"):
        carom.task("cp3", contact_model="cmx")
    with refused(message + "3"):
        carom.System([carom.PointMass(1.0)], contact_model=3)
    with refused(message + "<class"):
        simulate(ball_on_floor(), x0, v0, dt=0.01, steps=1, contact_model=carom.CM)
    with refused(message + "'CM'"):
        carom.make_recording(cp3, jax.random.key(0), 2, contact_model="CM")
    with refused(message + "'soft'"):
        learn(cp3, cp3_data, dataclasses.replace(TINY, contact_model="soft"))
    with refused("epsilon must be a finite number of at least 0; it was -0.1"):
        carom.CMr(-0.1)
    with refused("epsilon must be one number; its shape was (2,)"):
        carom.CMr([0.1, 0.2])
    with refused("epsilon must be a finite number of at least 0; it was nan"):
        learn(cp3, cp3_data, dataclasses.replace(TINY, contact_model="cmr", epsilon=float("nan")))
    with refused("epsilon belongs to the contact model cmr; the contact model was CM"):
        learn(cp3, cp3_data, dataclasses.replace(TINY, epsilon=0.1))
    with refused("epsilon must be"):
        learn(cp3, cp3_data, dataclasses.replace(TINY, contact_model="cmr", epsilon="fit"))
    with refused('epsilon "learn" starts from'):
        learn(cp3.with_contact_model(carom.CMr(0.0)), cp3_data, dataclasses.replace(TINY, epsilon="learn"))
    with refused("facets must be even and at least 4; it was 5"):
        carom.LCP(5)
    with refused("friction_loss must be a share from 0 to 1; it was -0.1"):
        carom.Coulomb(friction_loss=-0.1)
    with refused("smoothing must be 0 with the contact model Coulomb"):
        simulate(ball_on_floor(), x0 + 0.2, v0, dt=0.01, steps=1, contact_model="coulomb", smoothing=0.1)
    with refused("friction_loss must be one number; its shape was (2,)"):
        carom.Coulomb([0.1, 0.2])
    with refused("restitution_loss must be a share from 0 to 1; it was 1.5"):
        carom.Coulomb(restitution_loss=1.5)
    with refused("loss_speed must be a positive speed in m/s; it was 0"):
        carom.Coulomb(loss_speed=0.0)
    with refused("smoothing must be 0 with the contact model LCP"):
        simulate(ball_on_floor(), x0 + 0.2, v0, dt=0.01, steps=1, contact_model="lcp", smoothing=0.1)


def test_epsilon_of_the_configuration_or_of_the_skeleton(cp3):
    config = dataclasses.replace(TINY, contact_model="cmr")
    assert float(config.prepare(cp3).contact_model.epsilon) == 0.01
    own = cp3.with_contact_model(carom.CMr(0.2))
    assert float(config.prepare(own).contact_model.epsilon) == 0.2
    assert float(TINY.prepare(own).contact_model.epsilon) == 0.2
    assert float(dataclasses.replace(config, epsilon=0.3).prepare(own).contact_model.epsilon) == pytest.approx(0.3)
