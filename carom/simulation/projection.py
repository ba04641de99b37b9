"""Back onto the constraints: positions to `Phi = 0`, velocities to `J_E v = 0`, in the metric of the mass."""

from collections.abc import Callable

from jaxtyping import Array, Float

from carom.mechanics.dynamics import has_equations, saddle_point


def project_state(
    constraints: Callable,
    x: Float[Array, "n d"],
    v: Float[Array, "n d"],
    inverse_mass: Float[Array, "n n"],
    *,
    steps: int = 2,
) -> tuple[Float[Array, "n d"], Float[Array, "n d"]]:
    """Positions after `steps` Gauss-Newton steps `x - M^-1 J^T G^-1 Phi(x)`, and the velocities that fit them.

    Quadratically convergent from the small drift of one time step; differentiable.
    """
    if not has_equations(constraints, x):
        return x, v
    for _ in range(steps):
        saddle = saddle_point(constraints, x, inverse_mass)
        x = x - saddle.from_impulses(saddle.solve(constraints(x))[None])[0]
    saddle = saddle_point(constraints, x, inverse_mass)
    return x, saddle.project(v[None])[0]
