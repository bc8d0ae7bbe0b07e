"""What the fuzz draws from: problems as users hand them over and worse, and what may come of them."""

from __future__ import annotations

import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

import teaser_jax as tj

PACKAGE = str(Path(tj.__file__).parent)
BOUND = 0.05
SIZES = (8, 20, 32)  # one padded size, so that few programs are compiled

# What stands in the place of an argument when something went wrong before.
ODD = [
    None, "", "a", "nan", b"b", [], {}, (), set(), object(), len, slice(1), Ellipsis, True, False, 1j, "0.1",
    0, -1, 1, 3, 2**31, 2**63, 10**400, -(10**400), 0.5, -0.0, 1e300, -1e300, 1e-300, 5e-324,
    float("nan"), float("inf"), -float("inf"), [1, [2, 3]], [[1, 2], [3]], [None], ["a", "b"], [0.1, 0.2],
    np.float32(0.1), np.float64(0.1), np.int8(3), np.bool_(True), np.array(0.1), np.array([0.1]), np.zeros(0),
    np.zeros((0, 3)), np.zeros(3), np.zeros((3, 0)), np.zeros((3, 20)), np.zeros((20, 4)), np.zeros((20, 2)),
    np.zeros((2, 20, 3)), np.ones(20), np.ones(20, bool), np.arange(20), np.full((20, 3), np.nan),
    np.full((20, 3), np.inf), np.ones((20, 3), complex), np.ones((20, 3), "U1"), np.ones((20, 3), "S1"),
    np.ones((20, 3), object), np.array(None), np.array("a"),
    np.zeros((20, 3), "datetime64[s]"), np.zeros((20, 3), np.longdouble), np.zeros((20, 3), ">f4"),
    np.zeros(20, [("x", float)]), np.zeros(20, [("x", float), ("y", float), ("z", float)]),
    np.ma.masked_all((20, 3)), np.ma.masked_equal(np.eye(20, 3), 1), np.ma.masked,
    np.eye(3), np.eye(4), -np.eye(3), np.full((3, 3), np.nan), range(20), [True] * 20, [0, 2, 5],
    [[0, 1], [1, 2]], np.array([[0, 99]]), np.array([[-1, 0]]), iter([1, 2]), Path("x"), Counter("ab"),
]  # fmt: skip


@dataclass
class Case:
    """A problem of the fuzz, and what is known of its answer."""

    kind: str
    src: Any
    dst: Any
    known: dict[str, Any]
    truth: tj.Pose | None = None  # of the right matches
    right: np.ndarray | None = None  # source points that must come to lie where the truth takes them
    hopeless: bool = False  # there is no right pose: it must never be ok


def draw_pose(rng: np.random.Generator, scale: float = 1.0) -> tj.Pose:
    return tj.Pose(tj.synthetic.draw_rotation(rng), rng.normal(size=3), np.asarray(scale))


def noise(rng: np.random.Generator, n: int) -> np.ndarray:
    return rng.uniform(-1, 1, (n, 3)) * (BOUND / 2)


def ordinary(rng: np.random.Generator) -> Case:
    """A fair problem: what the truth is can be told."""
    n = int(rng.choice(SIZES))
    scale = float(rng.choice([1.0, 1.0, rng.uniform(0.5, 2)]))
    src, truth = rng.normal(size=(n, 3)), draw_pose(rng, scale)
    dst = truth.apply(src) + noise(rng, n)
    wrong = rng.random(n) < rng.choice([0, 0.3, 0.7])
    dst[wrong] = rng.normal(size=(wrong.sum(), 3)) * 2
    known = {} if scale == 1 else {"scale": rng.choice([scale, None])}
    return Case("ordinary", src, dst, known, truth, src[~wrong])


def all_wrong(rng: np.random.Generator) -> Case:
    n = int(rng.choice(SIZES))
    return Case("all wrong", rng.normal(size=(n, 3)), rng.normal(size=(n, 3)), {}, hopeless=True)


def mirrored(rng: np.random.Generator) -> Case:
    case = ordinary(rng)
    case.dst = truth = draw_pose(rng).apply(case.src * [1, 1, -1]) + noise(rng, len(case.src))
    return Case("mirrored", case.src, truth, {}, hopeless=True)


def by_position(rng: np.random.Generator) -> Case:
    """The nearest neighbours of two clouds that have nothing to do with each other, most beyond the bound."""
    src, cloud = rng.random((32, 3)), rng.random((200, 3))
    nearest = np.argmin(np.sum((src[:, None] - cloud[None]) ** 2, axis=2), axis=1)
    return Case("by position", src, cloud[nearest], {"noise_bound": 0.02}, hopeless=True)


def copies(rng: np.random.Generator) -> Case:
    case = ordinary(rng)
    rows = rng.integers(0, rng.integers(1, 6), len(case.src))
    return Case("copies", case.src[rows], case.dst[rows], case.known)


def flat(rng: np.random.Generator) -> Case:
    """On a plane, a line, a point, exactly or nearly."""
    case = ordinary(rng)
    thin = np.array([1, rng.choice([0, 1e-12, 1]), rng.choice([0, 1e-6])]) * rng.choice([0, 1, 1, 1])
    src = case.src * thin
    return Case("flat", src, draw_pose(rng).apply(src), {})


def few(rng: np.random.Generator) -> Case:
    n = int(rng.integers(0, 5))
    src = rng.normal(size=(n, 3))
    return Case("few", src, draw_pose(rng).apply(src) if n else src, {})


def resized(rng: np.random.Generator) -> Case:
    """Units of all sizes, of the two clouds alike or not."""
    case = ordinary(rng)
    size = 10.0 ** rng.choice([-300, -100, -30, -12, -6, -3, 3, 6, 12, 30, 60, 100, 300])
    case.known = {"noise_bound": BOUND * size}
    if rng.random() < 0.3:
        return Case("resized", case.src * size, case.dst, {"scale": None})
    return Case("resized", case.src * size, case.dst * size, case.known)


def far(rng: np.random.Generator) -> Case:
    case = ordinary(rng)
    return Case("far", case.src + 10.0 ** rng.integers(1, 14), case.dst - 10.0 ** rng.integers(1, 14), {})


def with_odd_rows(rng: np.random.Generator) -> Case:
    """Some rows hold no numbers, or absurd ones."""
    case = ordinary(rng)
    for cloud in (case.src, case.dst):
        rows = rng.random(len(cloud)) < 0.1
        cloud[rows, rng.integers(0, 3)] = rng.choice([np.nan, np.inf, -np.inf, 1e30, 1e300, 0, -1e6])
    return Case("odd rows", case.src, case.dst, case.known)


def with_odd_numbers(rng: np.random.Generator) -> Case:
    """Bounds, confidences, truncations and scales at the ends of what there is."""
    case = ordinary(rng)
    n = len(case.src)

    def odd(shape: Any = ()) -> Any:
        some = 10.0 ** rng.uniform(-12, 12, shape)
        return np.where(rng.random(shape) < 0.3, rng.choice([0, -1, np.nan, np.inf, 1e300, 1e-300]), some)

    choices = {
        "noise_bound": lambda: odd(rng.choice([0, n]) or ()),
        "confidence": lambda: odd(rng.choice([0, n]) or ()),
        "cbar2": odd,
        "scale": odd,
        "mask": lambda: rng.random(n) < rng.choice([0, 0.1, 0.5]),
        "pairs": lambda: rng.integers(0, n, (32, 2)),
    }
    for name in rng.choice(list(choices), rng.integers(1, 4), replace=False):
        case.known[str(name)] = choices[str(name)]()
    return Case("odd numbers", case.src, case.dst, case.known)


KINDS: dict[Callable[[np.random.Generator], Case], float] = {
    ordinary: 4, all_wrong: 4, mirrored: 2, by_position: 0.5, copies: 1, flat: 2, few: 1, resized: 2, far: 1,
    with_odd_rows: 2, with_odd_numbers: 3,
}  # fmt: skip


def draw(rng: np.random.Generator) -> Case:
    """Draw a problem of any kind, complete."""
    kinds, weights = list(KINDS), np.array(list(KINDS.values()))
    case = kinds[rng.choice(len(kinds), p=weights / weights.sum())](rng)
    case.known.setdefault("noise_bound", BOUND)
    return case


def _structured(points: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(points).view([(axis, float) for axis in "xyz"]).reshape(-1)


# How points are handed over: the numbers stay what they are.
FORMS: list[Callable[[np.ndarray], Any]] = [
    np.ndarray.tolist, lambda x: [tuple(row) for row in x], np.asfortranarray, lambda x: x.astype(object),
    lambda x: x.astype(">f8"), lambda x: x.astype(np.longdouble), lambda x: x[::-1][::-1],
    lambda x: np.ma.masked_array(x, np.zeros(x.shape, bool)), _structured,
]  # fmt: skip
# What goes wrong with them on the way.
MISTAKES: list[Callable[[np.ndarray], Any]] = [
    np.transpose, lambda x: x[:, :2], lambda x: x[:-1], lambda x: x[None], np.ravel, lambda x: x.astype(str),
    lambda x: np.pad(x, ((0, 0), (0, 1))), lambda x: x.astype(complex), lambda x: x[:0], lambda x: x > 0,
    lambda x: [row.tolist() for row in x] + [[1.0]], lambda x: np.round(x).astype(np.int8).astype(float),
    lambda x: x.astype(np.float16).astype(float), lambda x: x * 0, lambda x: np.full_like(x, np.nan),
]  # fmt: skip


def spoiled(rng: np.random.Generator, case: Case) -> Case:
    """Hand a problem over in another form, or wrong."""
    some = Case(case.kind, case.src, case.dst, dict(case.known), case.truth, case.right, case.hopeless)
    with np.errstate(all="ignore"):  # numbers that another kind cannot hold
        if rng.random() < 0.3:
            some.src, some.dst = (FORMS[rng.integers(len(FORMS))](x) for x in (case.src, case.dst))
        if rng.random() < 0.4:
            name = str(rng.choice(["src", "dst", "both"]))
            mistake = MISTAKES[rng.integers(len(MISTAKES))]
            some.src = mistake(case.src) if name != "dst" else some.src
            some.dst = mistake(case.dst) if name != "src" else some.dst
            some.truth, some.hopeless = None, False
    if rng.random() < 0.4:
        name = str(rng.choice(["src", "dst", *OPTIONS]))
        value = ODD[rng.integers(len(ODD))]
        some.truth, some.hopeless = None, False
        if name in ("src", "dst"):
            setattr(some, name, value)
        else:
            some.known[name] = value
    return some


OPTIONS = ("noise_bound", "scale", "cbar2", "mask", "confidence", "pairs")


def outcome(call: Callable[[], Any], told: Any, *refusals: type[Exception]) -> Any:
    """Return what a call returns; None where it refused in the words of this package. Else an error.

    Args:
        call: What to do.
        told: What it was about, for the error.
        refusals: Kinds of errors that are documented.
    """
    try:
        return call()
    except BaseException as error:
        where, words = traceback.extract_tb(error.__traceback__)[-1], str(error)
        documented = isinstance(error, refusals or ValueError) and where.filename.startswith(PACKAGE)
        if documented and len(words) > 20 and "\n" not in words:
            return None
        error.add_note(f"the fuzz was at {told!r}")
        raise


def check_pose(case: Case, pose: tj.Pose, status: Any, inliers: np.ndarray, *, slack: float = 1.0) -> None:
    """Check what is promised of every answer: finite, a rotation, and no ``ok`` that is false."""
    told = f"{case.kind} {case.known} -> {tj.Status(int(status)).name}"
    rotation, scale = np.asarray(pose.rotation, float), float(pose.scale)
    assert np.isfinite(pose.matrix).all(), told
    eps = 1e-9 if np.asarray(pose.rotation).dtype == np.float64 else 1e-5
    assert np.abs(rotation @ rotation.T - np.eye(3)).max() < eps, told
    assert np.linalg.det(rotation) > 0, told
    assert scale > 0, told
    if int(status) != tj.Status.OK:
        return
    assert inliers.sum() >= 5, told
    assert not case.hopeless, f"a false ok: {told}"
    if case.truth is not None and case.right is not None and len(case.right):
        off = np.asarray(pose.apply(case.right)) - case.truth.apply(case.right)
        reach = slack * 4 * BOUND
        assert np.linalg.norm(off, axis=1).max() <= reach, f"an ok that is wrong: {told}"


def seeds(door: int, count: int) -> Iterator[np.random.Generator]:
    """Make a generator for each input, so that any of them can be drawn again by its number."""
    for k in range(count):
        yield np.random.default_rng([door, k])


def stacked(problems: list[tj.Problem]) -> tj.Problem:
    """Stack problems of one structure in numpy."""
    return jax.tree.map(lambda *x: np.stack(x), *problems)


DEAR = ("error_bounds", "certify", "certify_rotation")  # up to 30 ms each: drawn less often
Doors = dict[str, tuple[Callable[..., Any], dict[str, Any]]]


def odd_calls(
    door: int,
    count: int,
    subjects: list[Any],
    doors: Callable[[Any], Doors],
    look: Callable[[str, Any], Any],
) -> None:
    """Call functions with arguments that fit, one or two of which were replaced.

    Args:
        door, count: See ``seeds``.
        subjects: What the arguments are made of.
        doors: Functions with arguments that fit, of a subject.
        look: What must hold of what they return.
    """
    made = [doors(subject) for subject in subjects]
    came: Counter = Counter()
    for rng in seeds(door, count):
        some = made[rng.integers(len(made))]
        rare = np.array([0.2 if name in DEAR else 1.0 for name in some])
        name = str(rng.choice(list(some), p=rare / rare.sum()))
        call, fitting = some[name]
        given, which = dict(fitting), list(fitting)
        for _ in range(rng.choice([0, 1, 1, 1, 1, 2])):
            given[which[rng.integers(len(which))]] = ODD[rng.integers(len(ODD))]
        told = (name, {x: y for x, y in given.items() if y is not fitting[x]})
        found = outcome(lambda call=call, given=given: call(**given), told)
        if found is not None:
            look(name, found)
        came[name, found is not None] += 1
    assert all(came[name, True] for name in made[0]), came
    assert sum(came[name, False] for name in made[0]) > count / 20, came
