"""Problems and solutions in few arrays, for the way to the device and back.

Whatever its size, each array that is sent or fetched takes as long as several stages of a small problem.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from teaser_jax.engine.sizes import Size
from teaser_jax.ground.arrays import AnyArray, Placeholder
from teaser_jax.problem import Problem
from teaser_jax.settings import Settings

ROWS = 9  # of the columns: three of the source, three of the target, then one each
BOUND, CONFIDENCE, MASK = 6, 7, 8
OFFSET, SETTINGS = slice(2, 5), 5  # of the numbers
MOST_NUMBERS = 16  # entries of a leaf that travels among the numbers


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PackedProblem:
    """A problem and the numbers of its settings, or a stack of them, in two arrays, or three.

    Attributes:
        columns: Source, target, bounds, confidences and mask, each in one piece.
        numbers: cbar2, the scale (1 where it is not known), how far the frames were moved against each
            other, and the numbers of the settings.
        pairs: Given pairs, padded with (0, 0).
        scale_is_known: Whether the scale is one of the numbers; static.
    """

    columns: Float[AnyArray, "... 9 n"] | Placeholder
    numbers: Float[AnyArray, "... c"] | Placeholder
    pairs: Int[AnyArray, "... m 2"] | Placeholder | None
    scale_is_known: bool = field(metadata={"static": True})

    @property
    def clouds(self) -> tuple[Float[AnyArray, "*batch 3 n"], Float[AnyArray, "*batch 3 n"]]:
        """Source and target, a row a coordinate; views of what is packed."""
        return self.columns[..., 0:3, :], self.columns[..., 3:6, :]

    @property
    def noise_bound(self) -> Float[AnyArray, "*batch n"]:
        """The bound of each match."""
        return self.columns[..., BOUND, :]

    @property
    def mask(self) -> Bool[AnyArray, "*batch n"]:
        """The rows to use."""
        return self.columns[..., MASK, :] > 0

    @property
    def usable(self) -> Bool[np.ndarray, "*batch n"]:
        """Rows of finite numbers that the mask admits."""
        return self.mask & np.isfinite(self.columns[..., : BOUND + 1, :]).all(axis=-2)

    @property
    def cbar2(self) -> Float[AnyArray, "*batch"]:
        """The truncation."""
        return self.numbers[..., 0]

    @property
    def offset(self) -> Float[AnyArray, "*batch 3"]:
        """What to add to the source to make it stand to the target as in the frames as given."""
        return self.numbers[..., OFFSET]

    @property
    def scale(self) -> Float[AnyArray, "*batch"]:
        """The scale, if it is known."""
        return self.numbers[..., 1]


def pack_problem(problem: Problem, settings: Settings, size: Size) -> PackedProblem:
    """Pack a problem on the host, or a stack of them, padded to a size; padding is masked."""
    *front, count, _ = problem.src.shape
    columns = np.zeros((*front, ROWS, size.matches))
    columns[..., 0:3, :count] = np.swapaxes(problem.src, -1, -2)
    columns[..., 3:6, :count] = np.swapaxes(problem.dst, -1, -2)
    columns[..., BOUND, :count], columns[..., CONFIDENCE, :count] = problem.noise_bound, problem.confidence
    columns[..., MASK, :count] = problem.mask
    scale = 1.0 if problem.scale is None else problem.scale
    each = (problem.cbar2, scale, 0.0, 0.0, 0.0, *jax.tree.leaves(settings))
    numbers = np.empty((*front, len(each)))
    for k, number in enumerate(each):
        numbers[..., k] = number
    pairs = None
    if problem.pairs is not None and size.pairs is not None:
        pairs = np.zeros((*front, size.pairs, 2), np.int32)
        pairs[..., : problem.pairs.shape[-2], :] = problem.pairs
    return PackedProblem(columns, numbers, pairs, problem.scale is not None)


def hide_rows(packed: PackedProblem, first: int) -> None:
    """Mask all rows of the problems from ``first`` on, in place; numpy, a stack."""
    packed.columns[first:, MASK] = 0


def unpack_problem(packed: PackedProblem) -> Problem:
    """Unpack one problem, in padded rows; the arrays are of the kind that was packed."""
    src, dst = packed.clouds
    return Problem(
        src=src.T,
        dst=dst.T,
        noise_bound=packed.noise_bound,
        cbar2=packed.cbar2,
        mask=packed.mask,
        confidence=packed.columns[CONFIDENCE],
        scale=packed.scale if packed.scale_is_known else None,
        pairs=packed.pairs,
    )


def unpack_settings(packed: PackedProblem, choices: Any) -> Settings:
    """Unpack the settings, on the device.

    Args:
        packed: What was sent.
        choices: Their structure (``jax.tree.structure``), which is all of them but their numbers.
    """
    return jax.tree.unflatten(choices, list(packed.numbers[SETTINGS:]))


class Place(NamedTuple):
    """Where a leaf of a record travels: in which array of its kind, from which entry, and how it looked."""

    kind: str  # "numbers", "masks" or "others"
    array: int
    start: int
    shape: tuple[int, ...]
    dtype: Any


class Layout(NamedTuple):
    """How a record is taken apart: its structure, and the place of each leaf."""

    structure: Any
    places: tuple[Place, ...]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Packed:
    """Any record of one problem, or of a stack of them, in few arrays.

    Attributes:
        numbers: Its small leaves one after the other, counts and flags too; exact in float64.
        masks: Its masks side by side, (..., n, k), an array for each number of rows n.
        others: The leaves that travel by themselves.
        layout: How to put the record together again; static.
    """

    numbers: Float[AnyArray, "... c"] | Placeholder
    masks: tuple[Bool[AnyArray, "... _ _"] | Placeholder, ...]
    others: tuple[AnyArray, ...]
    layout: Layout = field(metadata={"static": True})


def pack(record: Any) -> Packed:
    """Pack a record of one problem in few arrays, on the device. A leaf that is in it twice travels once."""
    leaves, structure = jax.tree.flatten(record)
    numbers: list[Any] = []
    others: list[Any] = []
    masks: dict[int, list[Any]] = {}
    places: dict[int, Place] = {}
    for leaf in {id(leaf): leaf for leaf in leaves}.values():
        if leaf.ndim > 0 and leaf.dtype == bool:
            beside = masks.setdefault(leaf.shape[0], [])
            kind, array, start = "masks", list(masks).index(leaf.shape[0]), sum(x.shape[1] for x in beside)
            beside.append(leaf.reshape(leaf.shape[0], -1))
        elif leaf.size <= MOST_NUMBERS:
            kind, array, start = "numbers", 0, sum(x.size for x in numbers)
            numbers.append(leaf.reshape(-1))
        else:
            kind, array, start = "others", len(others), 0
            others.append(leaf)
        places[id(leaf)] = Place(kind, array, start, leaf.shape, leaf.dtype)
    widest = jnp.result_type(*(x.dtype for x in numbers if jnp.issubdtype(x.dtype, jnp.floating)))
    return Packed(
        jnp.concatenate([x.astype(widest) for x in numbers]),
        tuple(jnp.concatenate(beside, axis=1) for beside in masks.values()),
        tuple(others),
        Layout(structure, tuple(places[id(leaf)] for leaf in leaves)),
    )


def fetch(packed: Packed) -> Packed:
    """Fetch the arrays to the host, in a tenth of the time of ``jax.device_get`` where that is the device."""
    return jax.tree.map(np.asarray, packed)


def unpack(host: Packed) -> Any:
    """Unpack a record, or a stack of them, in numpy."""
    front = host.numbers.shape[:-1]
    # Most masks are one column: these are laid out so that each is in one piece.
    columns = [np.ascontiguousarray(np.moveaxis(each, -1, 0)) for each in host.masks]

    def taken(place: Place) -> Any:
        kind, array, start, shape, dtype = place
        if kind == "others":
            return host.others[array]
        if kind == "masks" and len(shape) == 1:
            return columns[array][start]
        if kind == "masks":
            return host.masks[array][..., start : start + math.prod(shape[1:])].reshape(*front, *shape)
        if shape == ():
            return host.numbers[..., start].astype(dtype)[()]  # one number is a scalar of numpy
        return host.numbers[..., start : start + math.prod(shape)].reshape(*front, *shape)

    found = {place: taken(place) for place in host.layout.places}
    return jax.tree.unflatten(host.layout.structure, [found[place] for place in host.layout.places])
