"""Checks of arguments: what is wrong is said at once, by name, where the values are known."""

import contextlib
import importlib
import operator
from collections.abc import Callable, Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from carom.errors import CaromError


def is_known(*values) -> bool:
    """Whether no value is being traced, so that it can be looked at.

    Inside of `jit` whatever JAX computes of known values is traced: compute with numpy, or under
    `jax.ensure_compile_time_eval()`.
    """
    return not any(isinstance(x, Tracer) for v in values for x in jax.tree.leaves(v))


def as_floats(value) -> jax.Array:
    """`value` as a floating-point array of the default precision, or of its own, but of no less than single."""
    if isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jnp.floating):
        return value if value.dtype.itemsize >= 4 else value.astype(jnp.float32)
    with at_once_if_known(value):
        return jnp.asarray(value, dtype=jnp.zeros((), float).dtype)


def at_once_if_known(*values) -> contextlib.AbstractContextManager:
    """Inside of `jit`, compute at once what depends on nothing but `values`, if they are known: so is the result."""
    return jax.ensure_compile_time_eval() if is_known(*values) else contextlib.nullcontext()


def require_values(name: str, value, holds: Callable[..., bool | np.bool_ | np.ndarray], wanted: str, *others) -> None:
    """Raise unless `holds` of `value` (and of `others`) as numpy arrays, everywhere.

    Values that are traced pass: they cannot be looked at.
    """
    if is_known(value, others) and not np.all(holds(*(np.asarray(x, float) for x in (value, *others)))):
        raise CaromError(f"{name} must be {wanted}; it was {_show(value)}.")


def positive(x: np.ndarray) -> np.ndarray | np.bool_:
    """Whether numbers are above zero, and finite."""
    return (x > 0) & np.isfinite(x)


def not_negative(x: np.ndarray) -> np.ndarray | np.bool_:
    """Whether numbers are zero or above, and finite."""
    return (x >= 0) & np.isfinite(x)


def is_share(x: np.ndarray) -> np.ndarray | np.bool_:
    """Whether numbers are from zero to one."""
    return (x >= 0) & (x <= 1)


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


def whole(name: str, value) -> int:
    """`value` as the whole number that it is, such as an index.

    **Raises:** `CaromError` for anything else, 0.7 and 1.0 too, which names `name`.
    """
    try:
        return operator.index(value)
    except (TypeError, jax.errors.JAXTypeError):
        shown = "traced by JAX (indices must be known)" if isinstance(value, Tracer) else repr(value)
        raise CaromError(f"{name} must be whole numbers; one was {shown}.") from None


def whole_numbers(name: str, values: Iterable, *, once: bool = False) -> tuple[int, ...]:
    """`values` as whole numbers, each different from the others where it may be there only `once`."""
    numbers = tuple(whole(name, value) for value in values)
    twice = [n for n in numbers if numbers.count(n) > 1] if once else []
    require(not twice, f"{name} must be different from each other; {twice[0] if twice else ''} was there twice.")
    return numbers


def _show(value) -> str:
    array = np.asarray(value)
    return str(array.item() if array.ndim == 0 else array.tolist() if array.size <= 12 else f"of shape {array.shape}")
