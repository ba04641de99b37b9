"""Checks of arguments: what is wrong is said at once, by name, where the values are known."""

import importlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from carom.errors import CaromError


def is_known(*values) -> bool:
    """Whether no value is being traced, so that it can be looked at."""
    return not any(isinstance(x, Tracer) for v in values for x in jax.tree.leaves(v))


def as_floats(value) -> jax.Array:
    """`value` as a floating-point array of the default precision, or of its own."""
    if isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jnp.floating):
        return value
    return jnp.asarray(value, dtype=jnp.zeros((), float).dtype)


def require_values(name: str, value, condition, wanted: str) -> None:
    """Raise unless `condition` holds everywhere; traced values pass, they cannot be looked at."""
    if is_known(value, condition) and not np.all(np.asarray(condition)):
        raise CaromError(f"{name} must be {wanted}; it was {_show(value)}.")


def require(condition: bool | np.bool_, message: str) -> None:
    """Raise `CaromError(message)` unless `condition`."""
    if not condition:
        raise CaromError(message)


def optional_package(name: str, user: str, extra: str) -> Any:
    """The package of this name, which `user` needs and the extra of carom brings.

    **Raises:** `CaromError` that says how to get it, or, of one that is there, in its own words what is wrong with it.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        missing = isinstance(error, ModuleNotFoundError) and error.name == name
        own = " ".join(str(error).split())
        raise CaromError(
            f"{user} needs the package {name}, which is not installed: {install(extra)}."
            if missing
            else f"{user} needs the package {name}, which is installed but cannot be imported: {own}"
        ) from error


def install(extra: str) -> str:
    """How to install an extra, as long as no package index has carom."""
    return f"pip install '.[{extra}]' in a checkout of carom"


def _show(value) -> str:
    array = np.asarray(value)
    return str(array.item() if array.ndim == 0 else array.tolist() if array.size <= 12 else f"of shape {array.shape}")
