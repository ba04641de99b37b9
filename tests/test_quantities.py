"""Quantities: everything that a System holds and that can be learned, fixed or tied, by name."""

import functools
import importlib.resources
import runpy

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from systems import ball_on_floor, disk, heavy_top, pendulum, refused, two_bodies

import carom
from carom.learning.unknowns.quantities import Learned, describe, matches, quantities
from carom.mechanics.bodies import embed_pose

UP = (0.0, 0.0, 1.0)


def boxes() -> carom.System:
    """A box of unequal edges between a table and a wall, as `test_tosses.py` has it, in Coulomb's contact model."""
    box = {"corner_radius": 0.002, "center": (1e-3, 0.0, 2e-3)}
    return carom.System(
        bodies=[carom.RigidBody(0.4, (1e-4, 2e-4, 3e-4))],
        contacts=[
            carom.CornerPlane([0], (0.06, 0.03, 0.015), (0.0, 0.0, 0.0), UP, property=1, **box),
            carom.CornerPlane([0], (0.06, 0.03, 0.015), (1.0, 0.0, 0.0), (-1.0, 0.0, 0.1), property=0, **box),
        ],
        potential=carom.Gravity((0.0, 0.0, -9.81)),
        friction=(0.5, 0.2),
        restitution=(0.9, 0.1),
    )


def capsules() -> carom.System:
    """Two capsules that meet a table, each other and a fixed ball; the balls at their ends are told more than once."""
    ends = [(0.1, 0.0, 0.0), (-0.1, 0.0, 0.0)]
    return carom.System(
        bodies=[carom.RigidBody(1.0, (3e-3, 1e-3, 1e-3)), carom.RigidBody(2.0, (6e-3, 2e-3, 2e-3))],
        contacts=[
            carom.BallPlane([0, 0, 1, 1], ends * 2, (0.02, 0.02, 0.03, 0.03), (0.0, 0.0, 0.0), UP),
            carom.BallBall([(0, 1)], [[ends[0], ends[1]]], [[0.02, 0.03]]),
            carom.BallBall([(1, None)], [[ends[0], (0.0, 0.5, 0.5)]], [[0.03, 0.1]]),
        ],
        potential=carom.Gravity((0.0, 0.0, -9.81)),
        friction=0.3,
        contact_model=carom.CMr(),
    )


def arm() -> carom.System:
    """Two links joined by a pivot, the first on a joint in space."""
    weights = carom.mechanics.constraints.place_weights
    return carom.System(
        bodies=[carom.RigidBody(1.0, (0.02, 0.03)), carom.RigidBody(0.5, (0.01, 0.02))],
        constraints=[
            carom.Joint(0, weights((-0.3, 0.0)), (0.0, 1.0)),
            carom.Pivot(0, weights((0.3, 0.0)), 3, weights((-0.2, 0.1))),
        ],
        potential=carom.Gravity((0.0, -9.81)),
    )


SYSTEMS = {
    "cp3": lambda: carom.task("cp3"),
    "gyro": lambda: carom.task("gyro"),
    "rope": lambda: carom.task("rope"),
    "pucks": lambda: two_bodies(friction=0.0, restitution=1.0, masses=(1.0, 2.0), radii=(0.1, 0.2), rigid=True),
    "heavy top": heavy_top,
    "pendulum": pendulum,
    "boxes": boxes,
    "capsules": capsules,
    "arm": arm,
}


@functools.cache
def made(name: str) -> carom.System:
    return SYSTEMS[name]()


@pytest.fixture(params=list(SYSTEMS))
def system(request):
    return made(request.param)


def numbers(system: carom.System) -> np.ndarray:
    return np.concatenate([np.asarray(leaf).ravel() for leaf in jax.tree.leaves(system)])


def named(system: carom.System, name: str):
    return next(q for q in quantities(system) if q.name == name)


# --- one quantity ---------------------------------------------------------------------------------------------------


def overlap(one, other) -> bool:
    """Whether a change of one is meant to change the other: moments go with a mass, and parts with their whole."""
    masses = {"mass", "first_mass"}
    kinds = {one.label.kind, other.label.kind}
    parts = one.label.part_of == other.name or other.label.part_of == one.name or kinds == {"moments"}
    same_whole = one.label.part_of and one.label.part_of == other.label.part_of
    return bool(
        parts
        or same_whole
        or (one.label.kind in masses and other.label.kind in {"inertia", "moments"})
        or {one.label.part_of, other.label.part_of} & {one.name, other.name}
    )


def test_each_is_read_as_it_was_put_and_nothing_else_changes(system):
    every = quantities(system)
    assert len({q.name for q in every}) == len(every)
    read = eqx.filter_jit(lambda system: jnp.stack([q.value(system) for q in every]))
    before, structure = np.asarray(read(system)), jax.tree.structure(system)
    for k, quantity in enumerate(every):
        old = before[k]
        new = old * 1.01 if quantity.label.log else old - 1e-3 if old >= float(quantity.upper) else old + 1e-3
        changed = quantity.put(system, jnp.asarray(new))
        assert jax.tree.structure(changed) == structure
        assert [leaf.dtype for leaf in jax.tree.leaves(changed)] == [leaf.dtype for leaf in jax.tree.leaves(system)]
        after = np.asarray(read(changed))
        assert after[k] == pytest.approx(new, rel=1e-14, abs=1e-15), quantity.name
        others = [j for j, other in enumerate(every) if j != k and not overlap(quantity, other)]
        np.testing.assert_allclose(after[others], before[others], rtol=1e-14, atol=1e-15, err_msg=quantity.name)
        # As it was: but for the rounding of a sum or quotient.
        same = numbers(quantity.put(system, jnp.asarray(old)))
        np.testing.assert_allclose(same, numbers(system), rtol=1e-15, atol=1e-16, err_msg=quantity.name)


def test_free_numbers_make_the_system_again_in_jit(system):
    kinds = {q.label.kind for q in quantities(system)} - {"moments", "half_widths", "gravity_strength", "joint", "ball"}
    learned = Learned.chosen(system, sorted(kinds))
    theta = learned.free()
    assert theta.shape == learned.scale.shape == learned.lower.shape == (len(learned.names),)
    assert len(learned.units) == len(learned.of) == len(learned.names)
    assemble = eqx.filter_jit(lambda learned, theta: learned.assemble(theta))
    assert np.allclose(numbers(assemble(learned, theta)), numbers(learned.skeleton), rtol=1e-13, atol=1e-15)
    moved = learned.project(theta + 0.5 * learned.scale)
    again = learned.free(assemble(learned, moved))
    assert np.allclose(again, moved, rtol=1e-12, atol=1e-13)


def test_geometry_that_was_told_twice_is_one_thing():
    box = made("boxes")
    wider = named(box, "half_width:0").put(box, jnp.asarray(0.07))
    for contact in wider.contacts:
        assert np.allclose(contact.half_widths, (0.12, 0.06, 0.03))
    heavy = named(box, "center_of_mass:0:z").put(box, jnp.asarray(0.004))
    for contact in heavy.contacts:
        assert np.allclose(contact.center, (1e-3, 0.0, -0.004))
    capsule = made("capsules")
    names = [q.name for q in quantities(capsule)]
    assert [n for n in names if n.startswith("ball_radius")] == [
        f"ball_radius:{ball}" for ball in ("0.0", "0.1", "1.0", "1.1", "fixed.0")
    ]
    thick = named(capsule, "ball_radius:1.1").put(capsule, jnp.asarray(0.05))
    assert np.allclose(thick.contacts[0].radii, (0.02, 0.02, 0.03, 0.05))
    assert np.allclose(thick.contacts[1].radii, (0.02, 0.05))
    moved = named(capsule, "center_of_mass:0:y").put(capsule, jnp.asarray(0.01))
    assert np.allclose(moved.contacts[0].centers[:, 1], (-0.01, -0.01, 0, 0))
    assert np.allclose(moved.contacts[1].centers[0, :, 1], (-0.01, 0))
    rope = made("rope")
    hung = named(rope, "anchor:0:x").put(rope, jnp.asarray(0.3))
    assert [float(contact.chain.anchor[0]) for contact in hung.contacts] == [0.3, 0.3]
    assert float(hung.potential.parts[1].anchor[0]) == 0.3


def test_radius_and_wall_of_a_ball_are_those_of_its_gap():
    """A ball that touches the floor: the gap is height - radius - height of the floor."""
    system = ball_on_floor(radius=0.1)
    x = jnp.asarray([[0.4, 0.7]])
    larger = named(system, "radius:0").put(system, jnp.asarray(0.15))
    assert float(larger.gaps(x)[0]) == pytest.approx(0.55)
    raised = named(system, "plane:0").put(system, jnp.asarray(0.2))
    assert float(raised.gaps(x)[0]) == pytest.approx(0.4)
    tilted = named(system, "tilt:0").put(system, jnp.asarray(0.1))
    assert float(tilted.gaps(x)[0]) == pytest.approx((0.7 + 0.1 * 0.4) / np.hypot(1, 0.1) - 0.1)


def test_a_plane_that_two_families_meet_turns_as_one():
    bodies = [carom.PointMass(1.0, 0.1), carom.PointMass(1.0, 0.2)]
    contacts = [
        carom.DiskPlane([0], (0.0, 0.0), (0.0, 1.0), property=0),
        carom.DiskPlane([1], (3.0, 0.0), (0.0, 2.0), property=1),  # the same line by another point
        carom.DiskPlane([1], (0.0, 5.0), (0.0, -1.0), property=1),
    ]
    system = carom.System(bodies, contacts=contacts, friction=(0.1, 0.2), restitution=(0.3, 0.4))
    assert [q.name for q in quantities(system) if q.label.kind == "plane"] == ["plane:0", "plane:1"]
    tilted = named(system, "tilt:0").put(system, jnp.asarray(0.2))
    gaps = tilted.gaps(jnp.asarray([[1.0, 1.0], [1.0, 1.0]]))
    assert float(gaps[0] + 0.1) == pytest.approx(float(gaps[1] + 0.2))
    assert float(gaps[0] + 0.1) == pytest.approx(1.2 / np.hypot(1, 0.2))


def test_a_heavier_body_keeps_its_shape_and_ratios_stay_with_the_first_mass():
    pucks = made("pucks")
    heavier = named(pucks, "mass:1").put(pucks, jnp.asarray(3.0))
    assert np.allclose(heavier.masses, (1, 3))
    assert np.allclose(heavier.bodies[1].moments, disk(3.0, 0.2).moments)
    scaled = named(pucks, "first_mass").put(heavier, jnp.asarray(0.5))
    assert np.allclose(scaled.masses, (0.5, 1.5))
    assert np.allclose(scaled.bodies[0].moments, disk(0.5, 0.1).moments)
    assert float(named(pucks, "inertia:0").value(scaled)) == pytest.approx(0.5 * 0.1**2 / 2)  # m r^2 / 2
    # Inertia is put after mass, whatever the order in which they were named.
    learned = Learned.chosen(pucks, ["inertia", "mass"])
    again = learned.free(learned.assemble(learned.free() + 0.3))
    assert np.allclose(again, learned.free() + 0.3)


def test_a_joint_that_is_elsewhere_holds_another_material_point():
    top = made("heavy top")
    moved = named(top, "joint:0:z").put(top, jnp.asarray(-0.5))
    turn = jnp.eye(3)
    assert np.allclose(moved.constraints(embed_pose(jnp.array([0.0, 0.0, 0.5]), turn)), 0)
    lower = named(top, "center_of_mass:0:z").put(top, jnp.asarray(-0.1))  # 0.1 m nearer to the joint
    assert np.allclose(lower.constraints(embed_pose(jnp.array([0.0, 0.0, 0.2]), turn)), 0)


# --- bounds ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "bound", "inward"), [("friction:0", 0.0, 1.0), ("restitution:0", 0.0, 1.0), ("restitution:0", 1.0, -1.0)]
)
def test_bounds_are_reached_exactly_and_left_again(name, bound, inward):
    system = made("cp3")
    quantity, at = named(system, name), jnp.asarray(bound)
    assert float(quantity.from_free(at)) == bound
    assert float(quantity.from_free(at - 0.3 * inward)) == bound
    assert float(jax.grad(quantity.from_free)(at)) == 1
    assert float(jax.grad(quantity.from_free)(at - 0.3 * inward)) == 0
    assert float(quantity.from_free(at + 0.3 * inward)) == pytest.approx(bound + 0.3 * inward)


def test_what_is_near_to_a_bound_can_be_tried_there():
    learned = Learned.chosen(made("cp3"), ["mass:1", "friction", "restitution", "gravity:y"])
    near = learned.at_bounds(jnp.asarray([0.001, 0.019, 0.985, -9.81]))
    assert near.tolist() == [0.001, 0.0, 1.0, -9.81]
    assert learned.at_bounds(jnp.asarray([0.001, 0.021, 0.975, -9.81])).tolist() == [0.001, 0.021, 0.975, -9.81]


@functools.cache
def every_of(name: str):
    return quantities(made(name))


@settings(max_examples=50, deadline=None)
@given(st.sampled_from(["cp3", "rope", "boxes", "capsules"]), st.floats(-30, 30), st.data())
def test_values_are_physical_whatever_the_free_numbers(name, free, data):
    quantity = data.draw(st.sampled_from(every_of(name)))
    value = quantity.from_free(jnp.asarray(free))
    assert float(quantity.lower) <= float(value) or value == pytest.approx(float(quantity.lower), rel=1e-12)
    assert float(value) <= float(quantity.upper) or value == pytest.approx(float(quantity.upper), rel=1e-12)
    again = float(quantity.from_free(quantity.to_free(value)))
    assert again == pytest.approx(float(value), rel=1e-12)
    if quantity.label.log and np.exp(free) > float(quantity.lower):
        assert float(value) > 0


def test_limits_of_a_chain_stay_in_their_order():
    learned = Learned.chosen(made("rope"), ["shortest", "longest", "bend"])
    assert learned.names == ("bend:0", "shortest:1", "longest:1")
    bend, shortest, longest = learned.physical(learned.project(learned.free() + jnp.asarray([50.0, 50.0, -50.0])))
    assert bend == np.pi
    assert shortest == pytest.approx(0.05)
    assert longest == pytest.approx(0.05)


# --- choices --------------------------------------------------------------------------------------------------------


def test_names_are_chosen_by_beginnings_and_patterns():
    assert matches("friction", "friction:0")
    assert matches("moments:0", "moments:0:x")
    assert matches("*:0", "radius:0")
    assert not matches("mass", "first_mass")
    assert not matches("friction", "friction_loss")
    assert not matches("radius:1", "radius:12")
    cp3 = made("cp3")
    assert Learned.chosen(cp3, ["radius:?", "mass:*", "gravity:y"]).names == (
        "mass:1",
        "mass:2",
        "gravity:y",
        "radius:0",
        "radius:1",
        "radius:2",
    )
    assert Learned.chosen(cp3, ["radius", "friction"], fix=["radius:1"]).names == ("friction:0", "radius:0", "radius:2")
    assert Learned.chosen(cp3, ["friction", "rod:*="], fix=["friction", "rod"]).names == ()
    assert np.array_equal(numbers(Learned.chosen(cp3, []).assemble(jnp.zeros(0))), numbers(cp3))


def test_tied_quantities_have_one_number():
    cp3 = made("cp3")
    learned = Learned.chosen(cp3, ["radius:*=", "rod:0=rod:2", "restitution", "radius"])
    assert learned.names == ("restitution:0", "radius:*", "rod:0=rod:2")
    assert np.allclose(learned.physical(learned.free()), (0.0, 0.1, 0.35))  # of radii of 0.05, 0.15 and 0.1 the mean
    system = learned.assemble(learned.free().at[1].set(0.12))
    assert np.allclose(system.radii, 0.12)


def test_a_uniform_field_is_learned_where_none_was_told():
    pucks, rope = made("pucks"), made("rope")
    learned = Learned.chosen(pucks, ["gravity"])
    system = learned.assemble(jnp.asarray([0.3, -2.0]))
    x = jnp.zeros((6, 2)).at[0].set(jnp.array([1.0, 2.0])).at[3].set(jnp.array([0.5, 0.0]))
    assert float(system.potential_energy(x)) == pytest.approx(-(0.3 * 1 - 2.0 * 2) - 2 * 0.3 * 0.5)
    assert jax.tree.structure(Learned.chosen(pucks, ["friction"]).skeleton) == jax.tree.structure(pucks)
    stretched = eqx.tree_at(lambda s: s.potential, rope, rope.potential.parts[1])  # springs alone
    both = Learned.chosen(stretched, ["gravity", "stiffness:0"])
    assert both.names == ("stiffness:0", "gravity:x", "gravity:y")
    assert np.allclose(both.physical(both.free()), [50.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["fricton"], "'fricton' is nothing that can be learned of this system: it has mass:1,2, first_mass"),
        (["fricton"], "Did you mean 'friction'?"),
        (
            ["radius:7"],
            "it has mass:1,2, first_mass, friction:0, restitution:0, gravity:x,y, gravity_strength, radius:0",
        ),
        (["epsilon"], "(it belongs to the contact model cmr)"),
        (["radius:*=friction"], "ties different things"),
        (["radius:0=radius:1", "radius:1=radius:2"], "radius:1 is tied twice"),
        (["gravity:y", "gravity_strength"], "gravity:y is a part of gravity_strength"),
    ],
)
def test_what_cannot_be_learned_is_said_by_name(names, message):
    with refused(message):
        Learned.chosen(made("cp3"), names)


def test_a_single_body_has_no_mass_ratio():
    with refused("'mass' is nothing that can be learned of this system (a single body has no ratio of masses)"):
        Learned.chosen(made("boxes"), ["mass"])


def test_single_precision_stays_single():
    with jax.enable_x64(False):
        system = two_bodies(masses=(1.0, 2.0))
        learned = Learned.chosen(system, ["friction", "mass", "radius", "gravity"])
        new = learned.assemble(learned.free() + jnp.float32(0.1))
    assert {leaf.dtype for leaf in jax.tree.leaves(new)} == {np.dtype("float32")}


# --- derivatives ----------------------------------------------------------------------------------------------------


def impact_of_disk(e, mu, height, radius, mass, inertia, gravity, start, speed, time):
    """Closed form: a disk that does not turn falls from `start` with `speed` (2,) onto a floor, and slides there.

    Where it is, how fast, and how fast it turns after `time`.
    """
    fall = start[1] - radius - height
    down = jnp.sqrt(speed[1] ** 2 + 2 * gravity * fall)
    hit = (down + speed[1]) / gravity
    push = mu * (1 + e) * down  # of friction, over the mass: it slides to the right, and is held back
    along, spin, left = speed[0] - push, -push * mass * radius / inertia, time - hit
    x = start[0] + speed[0] * hit + along * left
    y = height + radius + e * down * left - gravity * left**2 / 2
    return jnp.stack([x, y, along, e * down - gravity * left, spin])


@pytest.mark.slow
def test_derivatives_through_an_impact_are_those_of_its_closed_form():
    system = carom.System(
        bodies=[disk(1.5, 0.1)],
        contacts=[carom.DiskPlane([0], (0.0, 0.2), (0.0, 1.0))],
        potential=carom.Gravity((0.0, -9.81)),
        friction=0.1,
        restitution=0.6,
    )
    names = ("inertia:0", "friction:0", "restitution:0", "gravity_strength", "radius:0", "plane:0")
    learned = Learned.chosen(system, names)
    assert learned.names == names
    start, speed = jnp.array([0.3, 0.35]), jnp.array([3.0, -1.0])
    x = embed_pose(start, jnp.eye(2))

    def simulated(theta):
        motion = carom.simulate(learned.assemble(theta), x, jnp.tile(speed, (3, 1)), dt=0.02, steps=4, impact="event")
        place, v = motion.x[-1], motion.v[-1]
        axes = place[1:] - place[0]
        spin = (axes[0, 0] * (v[1] - v[0])[1] - axes[0, 1] * (v[1] - v[0])[0])[None]
        return jnp.concatenate([place[0], v[0], spin])

    def closed(theta):
        inertia, mu, e, gravity, radius, height = learned.physical(theta)
        return impact_of_disk(e, mu, height, radius, 1.5, inertia, gravity, start, speed, 0.08)

    theta = learned.free()
    both = jax.jit(lambda t: jax.vmap(lambda u: jax.jvp(simulated, (t,), (u,)), out_axes=(None, 1))(jnp.eye(6)))
    end, jacobian = both(theta)
    # Free flight is exact, and when it hits is a root found to rounding. Then the disk turns by up to 0.1 rad a step,
    # which the integrator, of fourth order, follows to a share of 0.1^4 / 720 of the spin.
    np.testing.assert_allclose(end, closed(theta), rtol=1e-6)
    np.testing.assert_allclose(jacobian, jax.jacfwd(closed)(theta), rtol=1e-6, atol=1e-8)


# --- lists ----------------------------------------------------------------------------------------------------------


def test_the_list_of_a_system_has_all_and_a_new_file_has_it(system):
    rows = describe(system)
    assert {name for name, *_ in rows} >= {q.name for q in quantities(system)}
    assert all(len(row) == 4 for row in rows)


def test_a_new_file_lists_what_can_be_learned_of_its_system():
    path = importlib.resources.files("carom.cli") / "new_system.txt"
    system = runpy.run_path(str(path))["system"]
    expected = [f'#     "{name}",  # {of}: {value} {unit}'.rstrip() for name, of, value, unit in describe(system)]
    lines = path.read_text().splitlines()
    first = lines.index("# unknown = [")
    assert lines[first + 1 : first + 1 + len(expected)] == expected
    assert lines[first + 1 + len(expected)] == "# ]"
