"""Learned models as one file: a line of JSON that describes it, then the arrays. Loading it never runs code."""

import hashlib
import io
import json
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from carom.atomic import write_whole
from carom.checks import require
from carom.contact.impulses import CONTACT_MODELS, ContactModel, contact_model_name, contact_model_settings
from carom.errors import CaromError
from carom.learning.unknowns.baselines import describe_baseline, rebuild_baseline
from carom.learning.unknowns.body_quantities import gravity_path, with_field
from carom.learning.unknowns.models import NeuralPotential
from carom.simulation.impact import COMPENSATION_STEPS, ImpactRule
from carom.system import System

MAGIC = b"carom model 1\n"


def save_model(
    path: str | Path,
    system: System,
    *,
    formulation: str = "lagrangian",
    compensation_steps: float | None = COMPENSATION_STEPS,
    impact: ImpactRule = "step",
) -> None:
    """Save a learned system. To load it again, its skeleton is needed (a task's is found by its name).

    **Arguments:** `path`, of the file; `system`, with its contact model; `formulation`, `compensation_steps` and
    `impact`, how it was simulated when it was learned.

    **Raises:** `CaromError` if the file cannot be written.
    """
    body = io.BytesIO()
    eqx.tree_serialise_leaves(body, system)
    payload = body.getvalue()
    header: dict[str, Any] = {
        "task": system.name,
        "formulation": formulation,
        "points": system.n_points,
        "dim": system.dim,
        "compensation_steps": compensation_steps,
        "impact": impact,
        "field": gravity_path(system) is not None,
        "contact_model": {
            "name": contact_model_name(system.contact_model),
            **contact_model_settings(system.contact_model),
        },
        "potential": None,
        "network": None,
        "baseline": describe_baseline(system),
        "sha256": hashlib.sha256(payload).hexdigest(),
    }
    if isinstance(system.potential, NeuralPotential):
        header["potential"] = "learned"
    if isinstance(system.potential, NeuralPotential) and system.potential.network is not None:
        network = system.potential.network
        header["network"] = {
            "width": network.width_size,
            "depth": network.depth,
            "dtype": str(network.layers[0].weight.dtype),
        }
    header["header_sha256"] = _header_checksum(header)
    write_whole(Path(path), MAGIC + json.dumps(header).encode() + b"\n" + payload)


NEEDED = {"task", "formulation", "points", "dim", "network", "sha256"}
KEYS = NEEDED | {"compensation_steps", "impact", "field", "contact_model", "potential", "baseline", "header_sha256"}
"""What a header may have; older files lack some."""


def _header_checksum(header: dict[str, Any]) -> str:
    """SHA-256 over a header without its own."""
    rest = {name: value for name, value in header.items() if name != "header_sha256"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()


def read_model_header(path: str | Path) -> dict[str, Any]:
    """What a model file says of itself: task, formulation, compensation steps, impacts, contact model, sizes."""
    return {"compensation_steps": COMPENSATION_STEPS, "impact": "step", **_read(Path(path))[0]}


def load_model_into(path: str | Path, skeleton: System) -> System:
    """The learned system of a file, with the structure of `skeleton` and the contact model of the file.

    A contact model of your own class is taken from the skeleton, with the numbers of the file.

    **Raises:** `CaromError` if the file cannot be read, is damaged, or belongs to another system.
    """
    header, payload = _read(Path(path))
    shape = (header["points"], header["dim"])
    require(
        shape == (skeleton.n_points, skeleton.dim),
        f"the model {path} is of a system with {shape[0]} points in {shape[1]}D; the skeleton has "
        f"{skeleton.n_points} in {skeleton.dim}D. Give the skeleton it was learned with.",
    )
    network = header["network"]
    if network is not None or header.get("potential") == "learned":
        sizes = {} if network is None else {"width": network["width"], "depth": network["depth"]}
        dtype = jnp.float32 if network is None else jnp.dtype(network["dtype"])
        potential = NeuralPotential.of(skeleton, None, dtype=dtype, key=jax.random.key(0), **sizes)
        if network is None:
            potential = eqx.tree_at(lambda p: p.network, potential, None)
        skeleton = eqx.tree_at(lambda s: s.potential, skeleton, potential)
    elif header.get("field"):
        skeleton = with_field(skeleton)  # a uniform field may have been learned of a system that has none
    skeleton = skeleton.with_contact_model(_contact_model(path, header) or skeleton.contact_model)
    if header.get("baseline") is not None:
        skeleton = rebuild_baseline(header["baseline"], skeleton)
    try:
        return eqx.tree_deserialise_leaves(io.BytesIO(payload), skeleton)
    except (RuntimeError, ValueError, EOFError, TypeError) as error:
        raise CaromError(
            f"the model {path} does not fit the skeleton ({str(error).splitlines()[0]}). Give the skeleton it was "
            "learned with, in the same precision."
        ) from error


def _contact_model(path: str | Path, header: dict[str, Any]) -> ContactModel | None:
    settings = dict(header.get("contact_model", {}))
    name = settings.pop("name", None)
    if name is None:
        return None
    require(
        name in CONTACT_MODELS,
        f"the model {path} was learned with the contact model {name!r}, which this version of carom does not have.",
    )
    # A model of an older version may have settings that there are no more: how many programs were solved for Coulomb.
    known = contact_model_settings(CONTACT_MODELS[name]())
    return CONTACT_MODELS[name](**{key: value for key, value in settings.items() if key in known})


def _read(path: Path) -> tuple[dict[str, Any], bytes]:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise CaromError(f"cannot read the model {path}: {error.strerror}.") from error
    require(
        data.startswith(MAGIC), f"{path} is not a carom model. Give a model.carom file that `carom learn` has made."
    )
    line, _, payload = data[len(MAGIC) :].partition(b"\n")
    try:
        header = json.loads(line)
    except ValueError as error:
        raise CaromError(
            f"the model {path} is damaged: its header cannot be read. Use a copy, or learn again."
        ) from error
    sound = isinstance(header, dict) and NEEDED <= header.keys() <= KEYS
    require(
        sound and header.get("header_sha256", _header_checksum(header)) == _header_checksum(header),
        f"the model {path} is damaged: its header is not as it was written. Use a copy, or learn again.",
    )
    require(
        hashlib.sha256(payload).hexdigest() == header["sha256"],
        f"the model {path} is damaged: its checksum does not match. Use a copy, or learn again.",
    )
    return header, payload
