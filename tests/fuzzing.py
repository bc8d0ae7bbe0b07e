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


def _noise(rng: np.random.Generator, n: int) -> np.ndarray:
    return rng.uniform(-1, 1, (n, 3)) * (BOUND / 2)


def ordinary(rng: np.random.Generator) -> Case:
    """A fair problem: what the truth is can be told."""
    n = int(rng.choice(SIZES))
    scale = float(rng.choice([1.0, 1.0, rng.uniform(0.5, 2)]))
    src, truth = rng.normal(size=(n, 3)), draw_pose(rng, scale)
    dst = truth.apply(src) + _noise(rng, n)
    wrong = rng.random(n) < rng.choice([0, 0.3, 0.7])
    dst[wrong] = rng.normal(size=(wrong.sum(), 3)) * 2
    known = {} if scale == 1 else {"scale": rng.choice([scale, None])}
    return Case("ordinary", src, dst, known, truth, src[~wrong])


def all_wrong(rng: np.random.Generator) -> Case:
    n = int(rng.choice(SIZES))
    return Case("all wrong", rng.normal(size=(n, 3)), rng.normal(size=(n, 3)), {}, hopeless=True)


def mirrored(rng: np.random.Generator) -> Case:
    case = ordinary(rng)
    case.dst = truth = draw_pose(rng).apply(case.src * [1, 1, -1]) + _noise(rng, len(case.src))
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


# Files


def _good_files(folder: Path) -> dict[str, bytes]:
    """One file of each kind that can be read."""
    rng = np.random.default_rng(0)
    src = rng.normal(size=(20, 3))
    truth = draw_pose(rng)
    dst = truth.apply(src) + _noise(rng, 20)
    table, good = np.hstack([src, dst]), folder / "good"
    good.mkdir()
    more = {"noise_bound": BOUND, "scale": 1.0, "mask": np.ones(20, bool), "T_dst_src": truth.matrix}
    np.savez(good / "all.npz", src=src, dst=dst, **more)
    np.savez_compressed(good / "small.npz", src=src, dst=dst)
    np.save(good / "table.npy", table)
    np.save(good / "model.npy", src)
    np.savetxt(good / "table.txt", table)
    np.savetxt(good / "table.csv", table, delimiter=",", header="a,b,c,d,e,f", comments="")
    np.savetxt(good / "table.tsv", table, delimiter="\t")
    comma = "\n".join(";".join(f"{x:.4f}".replace(".", ",") for x in row) for row in table)
    (good / "comma.dat").write_text(comma)
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
    faces = [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]
    ply = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    ply += "element face 4\nproperty list uchar int vertex_indices\nend_header\n"
    rows = "".join(f"{x:g} {y:g} {z:g}\n" for x, y, z in corners)
    listed = "".join(f"3 {i} {j} {k}\n" for i, j, k in faces)
    (good / "model.ply").write_text(ply + rows + listed)
    (good / "model.off").write_text(f"OFF\n4 4 0\n{rows}{listed}")
    obj = "".join(f"v {x:g} {y:g} {z:g}\n" for x, y, z in corners)
    (good / "model.obj").write_text(obj + "".join(f"f {i + 1} {j + 1} {k + 1}\n" for i, j, k in faces))
    return {path.name: path.read_bytes() for path in sorted(good.iterdir())}


WORDS = [
    b"nan", b"inf", b"-", b"", b",", b";", b"\t", b"\n", b"\r\n", b"\0", b"x", b"1e999", b"1,5", b"#", b'"',
    b"\xff", b"\xef\xbb\xbf", b"99999999999", b"0", b"-1", b" ", "\u00b2".encode(), b"True", b"None", b"1_0",
]  # fmt: skip


def _mutated(rng: np.random.Generator, data: bytes) -> bytes:
    """Change a file in one to three places."""
    for _ in range(rng.integers(1, 4)):
        a, b = sorted(rng.integers(0, len(data) + 1, 2))
        near = min(b, a + int(rng.integers(1, 9)))
        word = WORDS[rng.integers(len(WORDS))]
        changes = [
            data[:a], data[:a] + data[b:], data[:a] + data[near:], data[:a] + word + data[near:],
            data[:a] + word + data[a:], data[:a] + data[a:b] + data[a:], data[a:b],
            data[:a] + rng.bytes(near - a) + data[near:],
            data.replace(b" " if rng.random() < 0.5 else b",", word), data.replace(b"\n", word),
        ]  # fmt: skip
        data = changes[rng.integers(len(changes))][:20_000]
    return data


def broken_files(door: int, count: int, folder: Path) -> Iterator[tuple[Path, str]]:
    """Write files that were changed, each over the one before, and say what each was to be."""
    good = _good_files(folder)
    for rng in seeds(door, count):
        name = list(good)[rng.integers(len(good))]
        data = good[name] if rng.random() < 0.05 else _mutated(rng, good[name])
        path = folder / f"changed{Path(name).suffix}"
        path.write_bytes(data)
        yield path, "model" if name.startswith("model") else "matches"


# The command line

COMMANDS = [
    ["register", "good/all.npz"],
    ["register", "good/small.npz", "--noise-bound", "0.05"],
    ["register", "good/table.csv", "--noise-bound", "0.05", "--json"],
    ["register", "good/table.txt", "--noise-bound", "0.05", "--scale", "estimate"],
    ["register", "good/comma.dat", "--noise-bound", "0.05", "--clique", "greedy"],
    ["register", "wrong.csv", "--noise-bound", "0.05", "-o", "pose.txt"],
    ["register", "good/table.npy", "--noise-bound", "0.05", "--clique-seconds", "1", "--no-refine"],
    ["register", "good/model.ply", "--noise-bound", "0.05"],
    ["demo", "--plot", "nowhere/demo.png", "--seed", "1"],
    ["study", "nothing", "--runs", "1", "--seed", "2", "--folder", "f", "--method", "m", "--quick"],
]
TOKENS = [
    "", "-", "--", "0.05", "-1", "0", "nan", "inf", "1e400", "x", "estimate", "exact", "greedy", "nonsense",
    "--noise", "--noise-bound", "--noise_bound", "--scale", "--cbar2", "--json", "--certify", "--help",
    "--version", "-o", "--output", "pose.txt", "good", "good/all.npz", "nothing.npz", "a\0b", "n" * 300,
    "--no-refine", "--clique", "--clique-nodes", "--clique-seconds", "--plot", "x.gif", "nowhere/x.png",
    "--seed", "--scale=2", "--noise-bound=", "--json=1", "\u00e4", "\n", "%s", "{}", "@x", "-h", "9" * 5000,
]  # fmt: skip


def argument_lists(door: int, count: int, folder: Path) -> Iterator[list[str]]:
    """Argument lists typed in a hurry; none asks for a picture or a study, which take their time."""
    _good_files(folder)
    rng = np.random.default_rng(0)
    np.savetxt(folder / "wrong.csv", rng.normal(size=(20, 6)), delimiter=",")
    for rng in seeds(door, count):
        given = list(COMMANDS[rng.integers(len(COMMANDS))])
        for _ in range(rng.choice([0, 1, 1, 1, 2, 3])):
            k, token = int(rng.integers(0, len(given) + 1)), TOKENS[rng.integers(len(TOKENS))]
            change = rng.integers(5)
            if change == 0:
                given.insert(k, token)
            elif change == 1:
                given[k : k + 1] = [token]
            elif change == 2:
                del given[k : k + 1]
            elif change == 3:
                given[k:k] = given[k : k + 2]
            else:
                given[k : k + 1] = [x[: int(rng.integers(1, len(x) + 1))] for x in given[k : k + 1] if x]
        if given[:1] != ["study"] or "nothing" in given[1:2]:
            yield given
