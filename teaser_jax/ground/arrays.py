"""Arrays of numpy and of JAX alike: which of the two, what can be known of them, how they are read."""

from __future__ import annotations

from collections.abc import Iterator
from types import ModuleType
from typing import TYPE_CHECKING, Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from teaser_jax.ground.forks import check_fork

AnyArray: TypeAlias = Any  # numpy's on the host, JAX's on the device: what lives on both sides
Number: TypeAlias = float | int | np.floating | np.integer


if TYPE_CHECKING:
    Placeholder: TypeAlias = Any
else:

    class _MayStandForAnArray(type):
        def __instancecheck__(cls, value: object) -> bool:
            if not (hasattr(value, "shape") and hasattr(value, "dtype")):
                return True
            return value.dtype == jax.dtypes.float0 or (value.dtype == bool and value.shape == ())

    class Placeholder(metaclass=_MayStandForAnArray):
        """What a record may hold in the place of an array: JAX rebuilds records from other things, too.

        That is an axis of ``vmap``, a sharding, whatever no array ``jax.tree.map`` returned, its answer to a
        question about each array (one truth value), and the tangents of truth values, which have no numbers.
        Shapes without numbers (``jax.ShapeDtypeStruct``) pass for arrays.
        """


CONCRETE = (np.ndarray, float, int, type(None))


def namespace(*arrays: object) -> ModuleType:
    """Return ``jax.numpy`` if any array is JAX's (tracers included), ``numpy`` otherwise.

    Host results stay float64 although JAX may run with 64-bit types switched off.
    """
    return jnp if any(isinstance(a, jax.Array) for a in arrays) else np


def is_traced(*values: Any) -> bool:
    """Tell whether any leaf of the values is a tracer, so that its number is not known."""
    # Iterators cannot be looked into, and JAX warns of them.
    unclear = [x for x in values if not isinstance(x, CONCRETE) and not isinstance(x, Iterator)]
    return bool(unclear) and any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(unclear))


def inside_jit() -> bool:
    """Tell whether this code runs while JAX traces a program, so that even constants become tracers."""
    check_fork()
    with jax.transfer_guard("allow"):
        return isinstance(jnp.zeros(()), jax.core.Tracer)


def rounded_product(a: Array, b: Array) -> Array:
    """Compute the product a b, rounded before anything is added to it.

    Compilers fuse a product and a sum where their vectors happen to allow it, so that the last bit
    would depend on the place in a batch. A comparison between the two prevents that; a reduction of
    precision to what it is already, a barrier and a cast to bits are all optimised away.

    Gradients: exact.
    """
    product = a * b
    return jnp.maximum(product, jnp.finfo(product.dtype).min)


def safe_norm(vectors: Float[Array, "*k d"]) -> Float[Array, "*k"]:
    """Compute the lengths along the last axis, with derivative zero (not NaN) at zero."""
    return safe_sqrt(jnp.sum(vectors * vectors, axis=-1))


def safe_sqrt(squares: Float[Array, "*k"]) -> Float[Array, "*k"]:
    """Compute the square root, with derivative zero (not infinite) at zero."""
    positive = squares > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, squares, 1)), 0)


def inner_products(a: Float[Array, "n d"], b: Float[Array, "m d"]) -> Float[Array, "n m"]:
    """Multiply every row of ``a`` with every row of ``b``, in full precision on every backend.

    Gradients: exact.
    """
    return jnp.matmul(a, b.T, precision=lax.Precision.HIGHEST)


def squared_distances(a: Float[Array, "n d"], b: Float[Array, "m d"]) -> Float[Array, "n m"]:
    """Square the distance of every row of ``a`` from every row of ``b``.

    Computed as |a|^2 + |b|^2 - 2 a.b, one product of matrices: rows should lie about the origin, or the
    squares of far coordinates cancel.

    Gradients: exact.
    """
    return jnp.sum(a * a, axis=1)[:, None] + jnp.sum(b * b, axis=1)[None] - 2 * inner_products(a, b)


def at_least_float32(values: AnyArray) -> Float[Array, "..."]:
    """Convert to a JAX array of float32 or wider.

    Integers would cut bounds, and half precision has no linear algebra.

    Raises:
        ValueError: For complex numbers.
    """
    check_fork()
    values = jnp.asarray(values)
    if jnp.issubdtype(values.dtype, jnp.complexfloating):
        raise ValueError("complex numbers were received: points are real.")
    return values.astype(float32_or_wider(values.dtype))


def float32_or_wider(dtype: Any) -> np.dtype:
    """Choose the kind of number to compute in: that of the values, or float32 where it is wider."""
    with jax.numpy_dtype_promotion("standard"):  # whatever JAX is set to: nothing is mixed in silence here
        return jnp.promote_types(dtype, jnp.float32)


def as_numpy(value: Any, name: str) -> np.ndarray:
    """Read anything with ``__array__`` or ``__dlpack__``, or nested lists, as a numpy view or copy.

    Args:
        value: What the user gave.
        name: The name of the argument, for the error.

    Raises:
        ValueError: If the value is missing or cannot be read as an array.
    """
    if value is None:
        raise ValueError(f"{name} is missing: None was given where numbers are needed.")
    if getattr(value, "requires_grad", False):  # a tensor of PyTorch
        raise ValueError(
            f"{name} requires a gradient, which would be lost here: pass {name}.detach(). Gradients flow "
            "through jax.grad of solve, refit and soft_solve."
        )
    if str(getattr(value, "dtype", "")) == "torch.bfloat16":  # which numpy does not know
        value = value.float()
    try:
        if isinstance(value, np.ma.MaskedArray):
            return _without_hidden(value)
        if hasattr(value, "__dlpack__") and not hasattr(value, "__array__"):
            return np.from_dlpack(value)
        return np.asarray(value)
    except (TypeError, ValueError, RuntimeError, BufferError) as error:
        raise ValueError(
            f"{name} cannot be read as an array ({type(value).__name__}: {error}). Give an array on "
            "the host, or anything with __array__ or __dlpack__."
        ) from error


def as_array(value: Any, name: str) -> AnyArray:
    """Return an array of JAX as it is, and read any other value as numpy: ValueError if that fails."""
    return value if isinstance(value, jax.Array) else as_numpy(value, name)


def _without_hidden(array: np.ma.MaskedArray) -> np.ndarray:
    """Replace hidden entries, which must not come back as numbers: by NaN, or False among truth values."""
    if not np.ma.is_masked(array):
        return array.data
    if array.dtype.kind == "b":
        return array.filled(False)
    return np.ma.filled(array.astype(np.float64) if array.dtype.kind in "iu" else array, np.nan)
