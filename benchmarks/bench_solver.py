"""Forward and gradient of friction-cone problems: carom beside moreau, qpax and cvxpylayers with diffcp.

Every tool gets the same batch. A round starts from `A`, `v` and `friction` as double-precision arrays of the tool's
own framework and ends with the losses `sum(weight * f)`, the impulses `f` and the gradients of the losses with
respect to `A`, `v` and `friction`, all ready. Compilation and symbolic set-up are outside. Each tool has several
sensible configurations; all are checked against a reference, and the fastest that is accurate enough is timed.
"""

import time
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.problems import DIM, collisions, objective, violation

pytestmark = [
    pytest.mark.filterwarnings("default"),  # other packages' warnings are theirs
    pytest.mark.timeout(1800),
]

CONTACTS = (1, 4, 8)
CHECKED = 100  # problems of a batch that are compared with the reference
# Largest errors of a configuration that may be timed.
OBJECTIVE, LIMITS, GRADIENT = 1e-6, 1e-6, 1e-3
SECONDS = 10.0  # of timed rounds for each tool and number of contacts, 5 to 50 rounds


class Output(NamedTuple):
    loss: object  # (B,)
    f: object  # (B, K, 3)
    gradients: tuple  # with respect to A, v, friction


# --- The tools: each gives its configurations as {label: function without arguments that runs the batch} ----------


def _jax_runner(problems, solve):
    """`solve(A, v, friction) -> f` of one problem, with loss and gradient, batched and compiled."""

    def loss(A, v, friction, weight):
        f = solve(A, v, friction)
        return jnp.sum(weight * f), f

    batched = jax.jit(jax.vmap(jax.value_and_grad(loss, argnums=(0, 1, 2), has_aux=True)))
    arrays = [jnp.asarray(x) for x in problems]

    def run():
        (value, f), gradients = jax.block_until_ready(batched(*arrays))
        return Output(value, f, gradients)

    return run


def _column_scale(friction):
    """(1, mu, mu) for each contact, flat: with `f = scale * y` the limits are those of the standard cone."""
    return jnp.stack([jnp.ones_like(friction), friction, friction], axis=1).reshape(-1)


def carom_configurations(problems):
    import carom

    def solve(A, v, friction):
        return carom.solve_impulse(A, v, friction, jnp.zeros_like(friction))

    return {"solve_impulse": _jax_runner(problems, solve)}


def moreau_configurations(problems):
    import moreau
    import moreau.jax

    batch, k = problems.friction.shape
    n = DIM * k
    tolerance = 1e-8

    def solver(direct, method):
        settings = moreau.Settings(
            device="cpu",
            solver="ipm",
            batch_size=batch,
            enable_grad=True,
            ipm_settings=moreau.IPMSettings(
                tol_gap_abs=tolerance,
                tol_gap_rel=tolerance,
                tol_feas=tolerance,
                direct_solve_method=method,
                diff_method="exact",
            ),
        )
        dense = np.arange(n + 1) * n, np.tile(np.arange(n), n)
        if direct:
            specs = [moreau.DirectConeSpec(kind="soc", indices=list(range(DIM * i, DIM * (i + 1)))) for i in range(k)]
            cones, m = moreau.Cones(dir_cones=specs), 0
        else:
            cones, m = moreau.Cones(so_cone_dims=[DIM] * k), n
        # The runner compiles the whole; a jit of its own inside would be lost work.
        return moreau.jax.Solver(
            n, m, *dense, np.arange(m + 1), np.arange(m), cones, settings=settings, jit=False
        ), jnp.zeros(m)

    def with_slacks(method):
        """Slacks (mu f_n, f_t) in the cone: friction enters the constraint matrix."""
        instance, b = solver(False, method)

        def solve(A, v, friction):
            ones = jnp.ones_like(friction)
            rows = -jnp.stack([friction, ones, ones], axis=1).reshape(-1)
            return instance.solve(A.reshape(-1), rows, v.reshape(-1), b).x.reshape(v.shape)

        return _jax_runner(problems, solve)

    def with_direct_cones(method):
        """`f = scale * y` with y itself in the cone: friction enters the objective, no slacks."""
        instance, b = solver(True, method)

        def solve(A, v, friction):
            scale = _column_scale(friction)
            quadratic = (A * scale * scale[:, None]).reshape(-1)
            y = instance.solve(quadratic, jnp.zeros(0), scale * v.reshape(-1), b).x
            return (scale * y).reshape(v.shape)

        return _jax_runner(problems, solve)

    forms = {"slack cones": with_slacks, "direct cones": with_direct_cones}
    return {
        f"moreau.jax, {form}, {method}, exact derivative, tol 1e-8": make(method)
        for form, make in forms.items()
        for method in ("qdldl", "faer-1t")
    }


# |f_t1| + |f_t2| <= mu f_n: the pyramid of 4 facets inside the cone, its edges along the tangents.
PYRAMID = np.array([[-1.0, a, b] for a in (1, -1) for b in (1, -1)])


def qpax_configurations(problems):
    import qpax

    k = problems.friction.shape[1]
    n = DIM * k
    facets = jnp.asarray(np.kron(np.eye(k), PYRAMID))
    none = jnp.zeros((0, n)), jnp.zeros(0)
    # In two steps, as qpax does: solve to `solver_tol`, then relax to `target_kappa`, where the derivative is taken.
    # At its default of 1e-3 the derivative is that of a smoothed problem, off by tens of percent; 1e-8 costs no more.
    knobs = {"solver_tol": 1e-8, "target_kappa": 1e-8, "max_iter": 50}

    def make(backend, scaled):
        def solve(A, v, friction):
            scale = _column_scale(friction)
            if scaled:
                Q, q, G, unscale = A * scale * scale[:, None], scale * v.reshape(-1), facets, scale
            else:
                columns = jnp.stack([friction, jnp.ones_like(friction), jnp.ones_like(friction)], axis=1)
                Q, q, G, unscale = A, v.reshape(-1), facets * columns.reshape(-1), 1.0
            y = qpax.solve_qp_primal(Q, q, *none, G, jnp.zeros(4 * k), backend=backend, **knobs)
            return (unscale * y).reshape(v.shape)

        return _jax_runner(problems, solve)

    return {
        f"{name}, friction in the {place}, solver_tol 1e-8, target_kappa 1e-8": make(backend, scaled)
        for backend, name in (("e", "explicit"), ("i", "implicit"))
        for scaled, place in ((False, "facets"), (True, "objective"))
    }


def cvxpylayers_configurations(problems):
    import cvxpy as cp
    import torch
    from cvxpylayers.torch import CvxpyLayer

    batch, k = problems.friction.shape
    n = DIM * k

    def make(scaled, solver_args):
        f = cp.Variable(n)
        # diffcp knows linear objectives only: the quadratic form goes in by a factor, A = L L^T.
        factor, linear, friction = cp.Parameter((n, n)), cp.Parameter(n), cp.Parameter(k, nonneg=True)
        parameters = [factor, linear] if scaled else [factor, linear, friction]
        limits = [
            cp.SOC(f[DIM * i] if scaled else friction[i] * f[DIM * i], f[DIM * i + 1 : DIM * (i + 1)]) for i in range(k)
        ]
        problem = cp.Problem(cp.Minimize(cp.sum_squares(factor @ f) / 2 + linear @ f), limits)
        layer = CvxpyLayer(problem, parameters, [f], solver_args=solver_args)
        A, v, mu, weight = (torch.tensor(x) for x in problems)
        inputs = [x.requires_grad_() for x in (A, v, mu)]
        ones = torch.ones_like(mu)

        def run():
            root = torch.linalg.cholesky(A).mT
            if scaled:
                scale = torch.stack([ones, mu, mu], dim=-1)
                (y,) = layer(root * scale.reshape(batch, 1, n), (scale * v).reshape(batch, n))
                impulse = scale * y.reshape(v.shape)
            else:
                (y,) = layer(root, v.reshape(batch, n), mu)
                impulse = y.reshape(v.shape)
            loss = (weight * impulse).sum((1, 2))
            return Output(loss.detach(), impulse.detach(), torch.autograd.grad(loss.sum(), inputs))

        return run

    methods = {
        # Tolerances: Clarabel's own, 1e-8. "dense" was faster and more accurate than "lsqr" and "lsmr".
        "Clarabel tol 1e-8, dense derivative": {"solve_method": "Clarabel", "mode": "dense"},
        "SCS eps 1e-9, dense derivative": {
            "solve_method": "SCS",
            "mode": "dense",
            "eps": 1e-9,
            "max_iters": 100_000,
        },
    }
    return {
        f"torch, diffcp, {label}, friction in the {place}": make(scaled, solver_args)
        for label, solver_args in methods.items()
        for scaled, place in ((False, "cones"), (True, "objective"))
    }


class Tool(NamedTuple):
    configurations: object
    pyramid: bool = False


TOOLS = {
    "carom": Tool(carom_configurations),
    "moreau": Tool(moreau_configurations),
    "qpax": Tool(qpax_configurations, pyramid=True),
    "cvxpylayers": Tool(cvxpylayers_configurations),
}


# --- Accuracy ---------------------------------------------------------------------------------------------------


class Reference(NamedTuple):
    """Solutions of the first problems and derivatives of their losses along a random direction."""

    objective: np.ndarray  # (CHECKED,)
    direction: tuple  # dA, dv, dfriction
    derivative: np.ndarray  # (CHECKED,)


_REFERENCES = {}


def reference(problems, *, pyramid):
    """Made by Clarabel, one problem at a time, at 1e-12 or, where it does not get there, at 1e-10.

    NaN where it does not get there either. The derivatives are central differences.
    """
    key = problems.friction.shape, pyramid
    if key not in _REFERENCES:
        rng = np.random.default_rng(1)
        size = np.trace(problems.A, axis1=1, axis2=2) / problems.A.shape[1]
        dA = rng.normal(size=problems.A.shape) * size[:, None, None]
        direction = dA + dA.swapaxes(1, 2), rng.normal(size=problems.v.shape), problems.friction * 1.0
        step = 1e-5

        def loss(sign):
            A, v, friction = (x + sign * step * dx for x, dx in zip(problems, direction, strict=False))
            f = _clarabel(problems._replace(A=A, v=v, friction=friction), pyramid)
            return np.sum(problems.weight * f, axis=(1, 2))

        value = objective(problems, _clarabel(problems, pyramid))
        _REFERENCES[key] = Reference(value, direction, (loss(1) - loss(-1)) / (2 * step))
    return _REFERENCES[key]


def _clarabel(problems, pyramid):
    clarabel = pytest.importorskip("clarabel", reason="the reference needs clarabel: pip install '.[test,bench]'")
    from scipy import sparse

    k = problems.friction.shape[1]
    cones = [clarabel.NonnegativeConeT(4 * k)] if pyramid else [clarabel.SecondOrderConeT(DIM)] * k
    f = []
    for A, v, friction, _ in zip(*problems, strict=True):
        columns = np.stack([friction, np.ones(k), np.ones(k)], axis=1).reshape(-1)
        rows = np.kron(np.eye(k), PYRAMID) if pyramid else -np.eye(DIM * k)
        G = sparse.csc_matrix(rows * columns)
        P, impulse = sparse.csc_matrix(np.triu(A)), np.full((k, DIM), np.nan)
        for tolerance in (1e-12, 1e-10):
            settings = clarabel.DefaultSettings()
            settings.verbose = False
            settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tolerance
            found = clarabel.DefaultSolver(P, v.reshape(-1), G, np.zeros(G.shape[0]), cones, settings).solve()
            if str(found.status) in ("Solved", "AlmostSolved"):
                impulse = np.array(found.x).reshape(k, DIM)
                break
        f.append(impulse)
    return np.stack(f)


def errors(problems, output, *, pyramid):
    """How far `output` is from the reference on the first problems, as the entries of a row of the results."""
    some = problems.first(CHECKED)
    exact = reference(some, pyramid=pyramid)
    known = np.isfinite(exact.objective) & np.isfinite(exact.derivative)
    assert known.mean() > 0.9, "the reference is incomplete"
    f = np.asarray(output.f)
    gradients = [np.asarray(g)[:CHECKED] for g in output.gradients]
    pairs = zip(gradients, exact.direction, strict=True)
    derivative = sum(np.sum((g * d).reshape(g.shape[0], -1), axis=1) for g, d in pairs)
    objective_error = _relative(objective(some, f[:CHECKED]), exact.objective)[known]
    gradient_error = _relative(derivative, exact.derivative)[known]
    return {
        "objective_error": float(np.max(objective_error)),
        "violation": float(np.max(violation(problems, f, pyramid=pyramid))),
        "gradient_error": float(np.median(gradient_error)),
        "gradient_error_95": float(np.quantile(gradient_error, 0.95)),
    }


def _relative(value, exact):
    """Error relative to the exact value, or to the usual one of these problems where the collision is slight."""
    return np.abs(value - exact) / np.maximum(np.abs(exact), np.nanmedian(np.abs(exact)))


def accurate(row):
    # Written so that NaN fails.
    return row["objective_error"] <= OBJECTIVE and row["violation"] <= LIMITS and row["gradient_error"] <= GRADIENT


# --- Timing -----------------------------------------------------------------------------------------------------


def _seconds(run, *, rounds):
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return min(times)


class _OtherLoad:
    """Share of the machine's processor time that other processes used while inside of the `with`; None if unknown."""

    share = None

    def __enter__(self):
        self.start = self._read()
        return self

    def __exit__(self, *_):
        if self.start is not None:
            busy, total, own = (b - a for a, b in zip(self.start, self._read(), strict=True))
            self.share = max(busy - own, 0) / max(total, 1e-9)

    @staticmethod
    def _read():
        stat = Path("/proc/stat")
        if not stat.exists():
            return None
        ticks = [int(x) for x in stat.read_text(encoding="ascii").split("\n", 1)[0].split()[1:9]]
        idle = ticks[3] + ticks[4]
        tick = 0.01  # USER_HZ is 100 wherever Linux is
        return (sum(ticks) - idle) * tick, sum(ticks) * tick, time.process_time()


def fastest(tool, problems):
    """The fastest accurate configuration: label, function, row of results so far; and what was tried."""
    tried, best = [], None
    for label, run in tool.configurations(problems).items():
        row = {"configuration": label, **errors(problems, run(), pyramid=tool.pyramid)}
        rounds = 5 if _seconds(run, rounds=1) < 1 else 1
        row["us"] = 1e6 * _seconds(run, rounds=rounds) / problems.friction.shape[0]
        tried.append(row)
        if accurate(row) and (best is None or row["us"] < best[1]["us"]):
            best = run, row
    return best, tried


@pytest.mark.parametrize("tool", TOOLS)
@pytest.mark.parametrize("contacts", CONTACTS)
def test_forward_and_gradient(benchmark, results, pytestconfig, contacts, tool):
    batch = pytestconfig.getoption("--solver-batch")
    problems = collisions(contacts, batch)
    row = {"contacts": contacts, "tool": tool, "limits": "pyramid of 4 facets" if TOOLS[tool].pyramid else "cone"}
    results.append(row)
    row.update(status="failed", reason="see the test's error")
    try:
        best, tried = fastest(TOOLS[tool], problems)
    except ImportError as error:
        row.update(status="not run", reason=str(error))
        pytest.skip(f"{tool}: {error}")
    row["tried"] = tried
    if best is None:
        row["reason"] = "no configuration was accurate enough"
        pytest.fail(f"{tool}: {row['reason']}: {tried}")
    run, found = best
    if not benchmark.enabled:
        row.update(status="not run", reason="pytest-benchmark is switched off")
        return
    rounds = int(np.clip(SECONDS / (found["us"] * 1e-6 * batch), 5, 50))
    benchmark.group = f"{contacts} contacts, batch {batch}"
    with _OtherLoad() as others:
        benchmark.pedantic(run, rounds=rounds, warmup_rounds=1)
    times = np.array(benchmark.stats.stats.data) / batch * 1e6
    row.pop("reason")
    row.update(
        {k: v for k, v in found.items() if k != "us"},
        status="run",
        us_min=float(times.min()),
        us_median=float(np.median(times)),
        rounds=rounds,
        others=others.share,
    )
