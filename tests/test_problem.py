"""Problems from arrays: everything that cannot be solved is refused, with what to do about it."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import networkx as nx
import numpy as np
import pytest
from oracles import problem_of, random_matches

import teaser_jax as tj
from teaser_jax.problem import pad_problem

GOOD = random_matches(0, n=8).src


class OnlyDlpack:
    """What a tensor of another library offers at least."""

    def __init__(self, array: np.ndarray) -> None:
        self._array = array

    def __dlpack__(self, **options):
        return self._array.__dlpack__(**options)

    def __dlpack_device__(self):
        return self._array.__dlpack_device__()


class OnlyArray:
    """What a data frame offers at least."""

    def __init__(self, array: np.ndarray) -> None:
        self._array = array

    def __array__(self, dtype=None, copy=None):
        return np.asarray(self._array, dtype)


def make(src=GOOD, dst=GOOD, noise_bound=0.1, **known) -> tj.Problem:
    return tj.make_problem(src, dst, noise_bound=noise_bound, **known)


def with_entry(array, index, value) -> np.ndarray:
    array = np.array(array, float)
    array[index] = value
    return array


# --- refusals: what was received, and what to do --------------------------------------------------

BAD_POINTS = {
    "unequal lengths": (dict(dst=GOOD[:5]), r"8 rows and dst has 5.*rows are matches.*Match the clouds"),
    "columns as points": (dict(src=GOOD.T, dst=GOOD.T), r"\(3, 8\).*points are rows.*src\.T"),
    "target as columns": (dict(dst=GOOD.T), r"dst has shape \(3, 8\).*dst\.T"),
    "no rows": (dict(src=np.zeros((0, 3)), dst=np.zeros((0, 3))), r"empty.*trusted needs at least 5 matches"),
    "empty lists": (dict(src=[], dst=[]), r"src is empty"),
    "two columns": (dict(src=GOOD[:, :2]), r"\(8, 2\).*expected \(n, 3\)"),
    "one point": (dict(src=[1.0, 2.0, 3.0]), r"\(3,\).*expected \(n, 3\)"),
    "a number": (dict(src=1.0), r"shape \(\).*expected \(n, 3\)"),
    "nothing": (dict(src=None), r"src is missing"),
    "no target": (dict(dst=None), r"dst is missing"),
    "a batch": (dict(src=np.zeros((2, 8, 3))), r"\(2, 8, 3\).*expected \(n, 3\)"),
    "text": (dict(src=GOOD.astype(str)), r"src has dtype <U.*real numbers.*numpy.asarray"),
    "words": (dict(src=[["a", "b", "c"]] * 8), r"src has dtype <U.*real numbers"),
    "complex": (dict(dst=GOOD + 1j), r"dst has dtype complex128.*real numbers"),
    "objects": (dict(src=GOOD.astype(object)), r"src has dtype object"),
    "truth values": (dict(src=GOOD > 0), r"src holds truth values"),
    "dates": (dict(src=GOOD.astype("datetime64[s]")), r"src has dtype datetime64"),
    "ragged": (dict(src=[[1.0, 2.0, 3.0], [1.0, 2.0]]), r"src cannot be read as an array"),
    "all NaN": (dict(src=np.full((8, 3), np.nan)), r"no row .* is finite"),
    "all infinite": (dict(dst=np.full((8, 3), -np.inf)), r"no row .* is finite"),
    "never both finite": (
        dict(src=with_entry(GOOD, slice(0, 4), np.nan), dst=with_entry(GOOD, slice(4, 8), np.nan)),
        r"no row .* is finite",
    ),
}

BAD_NUMBERS = {
    "bound zero": (dict(noise_bound=0.0), r"noise_bound contains 0.*above 0.*unit of the points"),
    "bound negative": (dict(noise_bound=-1), r"noise_bound contains -1"),
    "bound NaN": (dict(noise_bound=np.nan), r"noise_bound contains nan"),
    "bound infinite": (dict(noise_bound=np.inf), r"noise_bound contains infinity"),
    "one bad bound": (dict(noise_bound=with_entry(np.ones(8), 3, -2)), r"noise_bound contains -2"),
    "bounds of another length": (
        dict(noise_bound=np.ones(7)),
        r"noise_bound has shape \(7,\).*one a match, \(8,\)",
    ),
    "bounds as a column": (dict(noise_bound=np.ones((8, 1))), r"noise_bound has shape \(8, 1\)"),
    "bound as text": (dict(noise_bound="0.1"), r"noise_bound has dtype"),
    "no bound": (dict(noise_bound=None), r"noise_bound is missing"),
    "mask of another length": (dict(mask=np.ones(7, bool)), r"mask has shape \(7,\).*\(8,\) truth values"),
    "mask of numbers": (dict(mask=np.ones(8)), r"mask has .*float64.*truth values.*mask\.astype\(bool\)"),
    "mask of integers": (dict(mask=[1] * 8), r"mask has .*int64.*truth values.*mask\.astype\(bool\)"),
    "mask of words": (dict(mask=["True"] * 8), r"mask has .*<U4.*truth values, one a match\.$"),
    "confidence negative": (
        dict(confidence=with_entry(np.ones(8), 0, -0.1)),
        r"confidence contains a negative",
    ),
    "confidence NaN": (
        dict(confidence=with_entry(np.ones(8), 0, np.nan)),
        r"confidence contains .*non-finite",
    ),
    "confidence of another length": (dict(confidence=np.ones(9)), r"confidence has shape \(9,\)"),
    "scale zero": (dict(scale=0), r"scale is 0.*above 0"),
    "scale negative": (dict(scale=-1.0), r"scale is -1.*above 0"),
    "scale NaN": (dict(scale=np.nan), r"scale is nan"),
    "scale as a word": (dict(scale="estimate"), r"scale is the text 'estimate'.*scale=None to estimate"),
    "scale infinite": (dict(scale=np.inf), r"scale is inf"),
    "two scales": (dict(scale=[1.0, 2.0]), r"scale has shape \(2,\).*one number"),
    "cbar2 zero": (dict(cbar2=0.0), r"cbar2 is 0.*above 0"),
    "cbar2 NaN": (dict(cbar2=np.nan), r"cbar2 is nan"),
    "pairs of numbers": (dict(pairs=[[0.0, 1.0]]), r"pairs has .*float64.*\(m, 2\) integers"),
    "no pairs": (dict(pairs=np.zeros((0, 2), int)), r"pairs is empty.*pairs=None"),
    "an empty list of pairs": (dict(pairs=[]), r"pairs is empty.*pairs=None"),
    "graph without edges": (dict(pairs=nx.empty_graph(8)), r"pairs is empty.*pairs=None"),
    "pairs as columns": (dict(pairs=np.zeros((2, 8), int)), r"pairs has shape \(2, 8\)"),
    "pairs too high": (dict(pairs=[[0, 8]]), r"rows 0 to 8.*rows run from 0 to 7"),
    "pairs negative": (dict(pairs=[[-1, 2]]), r"rows -1 to 2.*rows run from 0 to 7"),
    "graph of names": (dict(pairs=nx.Graph([("a", "b")])), r"nodes .* row numbers"),
    "graph too large": (dict(pairs=nx.path_graph(9)), r"rows 0 to 8.*rows run from 0 to 7"),
}


@pytest.mark.parametrize("case", BAD_POINTS | BAD_NUMBERS)
@pytest.mark.parametrize("function", [tj.make_problem, tj.register])
def test_bad_input_is_refused_with_advice(function, case):
    known, message = (BAD_POINTS | BAD_NUMBERS)[case]
    known = {"src": GOOD, "dst": GOOD, "noise_bound": 0.1, **known}
    with pytest.raises(ValueError, match=f"(?s){message}"):
        function(known.pop("src"), known.pop("dst"), **known)


def test_far_from_the_origin_float32_is_refused_and_register_named():
    with pytest.raises(
        ValueError, match=r"coordinates reach 5e\+05.*float32.*Subtract a common origin.*register\(\)"
    ):
        make(GOOD + 5e5, GOOD, noise_bound=0.1)
    with pytest.raises(ValueError, match="1 %"):
        make(GOOD, GOOD + 5e5, noise_bound=0.1)
    make(GOOD + 5e5, GOOD + 5e5, noise_bound=10.0)  # the bound decides


def test_far_from_the_origin_float64_resolves_more(x64):
    make(GOOD + 5e5, GOOD + 5e5)
    with pytest.raises(ValueError, match=r"float64.*Subtract a common origin from each cloud first\.$"):
        make(GOOD + 1e14, GOOD)


def test_rows_that_cannot_be_used_do_not_refuse_the_others():
    far = with_entry(GOOD, 0, 1e9)
    make(far, GOOD, mask=np.arange(8) > 0)
    make(with_entry(GOOD, 0, np.nan), with_entry(GOOD, 1, np.inf))
    make(noise_bound=with_entry(np.ones(8), 0, np.nan), mask=np.arange(8) > 0)
    make(mask=np.zeros(8, bool))


def test_a_profile_repeats_at_least_once():
    with pytest.raises(ValueError, match="repeats is 0"):
        tj.profile(GOOD, GOOD, noise_bound=0.1, repeats=0)


# --- what is accepted ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    "convert",
    [
        np.ndarray.tolist, jnp.asarray, OnlyDlpack, OnlyArray, np.asfortranarray,
        lambda x: x.astype(">f8"), lambda x: x.astype(np.longdouble), lambda x: [tuple(row) for row in x],
    ],
    ids=["lists", "jax", "dlpack", "array", "fortran", "big endian", "long double", "tuples"],
)  # fmt: skip
def test_anything_that_holds_numbers_is_read(convert, x64):
    problem = make(convert(GOOD), convert(GOOD))
    np.testing.assert_array_equal(problem.src, GOOD)
    np.testing.assert_array_equal(problem.dst, GOOD)
    assert problem.src.dtype == jnp.float64


def test_rows_that_a_masked_array_hides_are_left_out_and_counted():
    hidden = np.zeros((8, 3), bool)
    hidden[2, 1] = True
    src = np.ma.array(GOOD, mask=hidden)
    np.testing.assert_array_equal(make(src).src, np.where(hidden, np.nan, GOOD.astype(np.float32)))
    integers = np.ma.array(np.arange(24).reshape(8, 3), mask=hidden)
    np.testing.assert_array_equal(np.isnan(make(integers).src), hidden)
    np.testing.assert_array_equal(make(mask=np.ma.array([True] * 8, mask=hidden[:, 1])).mask, ~hidden[:, 1])
    np.testing.assert_array_equal(make(pairs=np.ma.array([[0, 1]])).pairs, [[0, 1]])
    assert tj.register(src, GOOD, noise_bound=0.1).solution.excluded == 1


def test_integers_become_floats():
    points = np.arange(24).reshape(8, 3)
    problem = make(points, points.astype(np.uint8), noise_bound=1)
    assert problem.src.dtype == problem.dst.dtype == problem.noise_bound.dtype == jnp.float32
    np.testing.assert_array_equal(problem.src, points)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_every_number_takes_the_dtype_of_the_points(dtype, x64):
    problem = make(GOOD.astype(dtype), GOOD.astype(dtype), scale=2.0, confidence=np.ones(8))
    for name in ("src", "dst", "noise_bound", "cbar2", "confidence", "scale"):
        assert getattr(problem, name).dtype == dtype


def test_mixed_points_take_the_wider_dtype(x64):
    problem = make(GOOD.astype(np.float32), GOOD)
    assert problem.src.dtype == problem.dst.dtype == jnp.float64


def test_without_x64_points_are_float32():
    assert make().src.dtype == jnp.float32


def test_defaults_use_every_match_equally():
    problem = make(noise_bound=0.25)
    np.testing.assert_array_equal(problem.noise_bound, np.full(8, 0.25))
    assert bool(problem.mask.all())
    assert np.all(np.asarray(problem.confidence) == 1)
    assert problem.scale == 1
    assert problem.cbar2 == 1
    assert problem.pairs is None


def test_unknown_scale_stays_none():
    assert make(scale=None).scale is None


def test_a_networkx_graph_gives_its_edges():
    graph = nx.path_graph(8)
    graph.add_edge(np.int64(0), np.int64(7))
    problem = make(pairs=graph)
    assert {frozenset(pair) for pair in np.asarray(problem.pairs).tolist()} == {
        frozenset(e) for e in graph.edges
    }


def test_given_pairs_keep_order_direction_and_repeats():
    pairs = [[3, 1], [1, 3], [1, 3], [2, 2]]
    np.testing.assert_array_equal(make(pairs=pairs).pairs, pairs)


def test_the_callers_arrays_are_left_alone():
    src, bounds = GOOD.copy(), np.full(8, 0.1)
    src.flags.writeable = bounds.flags.writeable = False
    make(src, src, noise_bound=bounds)
    np.testing.assert_array_equal(src, GOOD)


# --- traced arrays ------------------------------------------------------------------------------


def test_traced_values_are_not_looked_at():
    build = jax.jit(lambda src, bound, scale: make(src, GOOD, noise_bound=bound, scale=scale))
    problem = build(jnp.full((8, 3), jnp.nan), -1.0, 0.0)
    assert problem.noise_bound.shape == (8,)
    assert float(problem.noise_bound[0]) == -1


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda x: make(x.T, x.T), r"points are rows"),
        (lambda x: make(x[:5]), r"5 rows and dst has 8"),
        (lambda x: make(x[:0], x[:0]), r"empty"),
        (lambda x: make(x, noise_bound=x[0]), r"noise_bound has shape \(3,\)"),
        (lambda x: make(x, mask=x[:, 0]), r"truth values"),
        (lambda x: make(x, pairs=x[:, :2]), r"\(m, 2\) integers"),
        (lambda x: make(x.astype(complex)), r"real numbers"),
        (lambda x: make(x, scale=x[:, 0]), r"scale has shape \(8,\)"),
    ],
    ids=["columns", "lengths", "empty", "bounds", "mask", "pairs", "complex", "scale"],
)
def test_traced_shapes_and_dtypes_are_checked(build, message):
    with pytest.raises(ValueError, match=message):
        jax.eval_shape(build, jax.ShapeDtypeStruct((8, 3), jnp.float32))


@pytest.mark.parametrize(
    ("known", "message"),
    [
        (dict(noise_bound=-1.0), "noise_bound contains -1"),
        (dict(scale=0.0), "scale is 0"),
        (dict(confidence=np.full(8, -1.0)), "confidence contains"),
        (dict(pairs=[[0, 9]]), "rows 0 to 9"),
    ],
    ids=["bound", "scale", "confidence", "pairs"],
)
def test_concrete_numbers_are_checked_beside_traced_points(known, message):
    with pytest.raises(ValueError, match=message):
        jax.eval_shape(lambda x: make(x, **known), jax.ShapeDtypeStruct((8, 3), jnp.float32))


def test_problems_can_be_made_under_vmap():
    batch = np.stack([GOOD, GOOD + 1])
    problems = jax.vmap(lambda x: make(x, noise_bound=0.1))(batch)
    assert problems.src.shape == (2, 8, 3)


# --- stacking -----------------------------------------------------------------------------------


@pytest.mark.long
def test_stacking_pads_and_masks():
    sizes = (5, 8, 3)
    problems = [problem_of(random_matches(k, n), confidence=np.arange(n) + 1.0) for k, n in enumerate(sizes)]
    batch = tj.stack_problems(problems)
    assert batch.src.shape == (3, 8, 3)
    np.testing.assert_array_equal(batch.mask.sum(axis=1), sizes)
    for k, (n, problem) in enumerate(zip(sizes, problems, strict=True)):
        for name in ("src", "dst", "noise_bound", "mask", "confidence"):
            np.testing.assert_array_equal(getattr(batch, name)[k, :n], getattr(problem, name))
        assert np.all(np.asarray(batch.noise_bound[k]) > 0)
        assert not np.any(batch.mask[k, n:])


def test_stacking_pads_pairs_with_loops():
    problems = [make(pairs=[[0, 1], [2, 1], [5, 7]]), make(pairs=[[4, 3]])]
    pairs = np.asarray(tj.stack_problems(problems).pairs)
    np.testing.assert_array_equal(pairs[0], [[0, 1], [2, 1], [5, 7]])
    np.testing.assert_array_equal(pairs[1, 0], [4, 3])
    assert np.all(pairs[1, 1:, 0] == pairs[1, 1:, 1])


def test_stacking_takes_any_iterable():
    assert tj.stack_problems(make() for _ in range(2)).src.shape == (2, 8, 3)


@pytest.mark.parametrize(
    ("problems", "message"),
    [
        ([], "no problem"),
        ([make(), make(scale=None)], "some problems have scale=None"),
        ([make(), make(pairs=[[0, 1]])], "some problems have pairs=None"),
        (5, "takes a list of problems, and received int"),
        (make(), "takes a list of problems, and received Problem"),
    ],
    ids=["none", "scale", "pairs", "number", "problem"],
)
def test_stacking_refuses_a_mixture_and_what_is_no_list(problems, message, unchecked):
    with pytest.raises(ValueError, match=message):
        tj.stack_problems(problems)


def test_padding_refuses_to_cut():
    with pytest.raises(ValueError, match="cannot pad 8 rows to 4"):
        pad_problem(make(), 4)


def test_padding_keeps_numpy_on_the_host():
    problem = jax.tree.map(np.asarray, make())
    assert all(isinstance(x, np.ndarray) for x in jax.tree.leaves(pad_problem(problem, 16)))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda src: (src + 1e6).astype(np.float32), r"given in float32.*before converting"),
        (lambda src: np.concatenate([src[:-1], [[1e13, 0, 0]]]), r"if row 9 is corrupt, mask it"),
        (lambda src: np.concatenate([src[:-1], [[1e300, 0, 0]]]), r"if row 9 is corrupt, mask it"),
    ],
)
def test_digits_that_are_lost_are_named(change, words):
    points = np.random.default_rng(0).uniform(size=(10, 3))
    with pytest.raises(ValueError, match=words):
        tj.register(change(points), points, noise_bound=0.01)


def test_what_is_masked_is_not_looked_at():
    points = np.random.default_rng(0).uniform(size=(10, 3))
    odd = points.copy()
    odd[3] = 1e300
    weights = np.where(np.arange(10) == 3, np.nan, 1.0)
    known = dict(noise_bound=0.01, mask=np.arange(10) != 3, confidence=weights)
    assert tj.register(odd, points, **known).ok


def test_a_stack_wants_vmap():
    problem = tj.make_problem(np.ones((5, 3)), np.ones((5, 3)), noise_bound=0.1)
    with pytest.raises(ValueError, match="vmap"):
        tj.solve(tj.stack_problems([problem, problem]))


@pytest.mark.parametrize(("name", "value"), [("cbar2", 1e75), ("cbar2", 1e-75), ("scale", 1e75)])
def test_numbers_that_float32_cannot_hold_are_named_and_not_infinite(name, value):
    with pytest.raises(ValueError, match=f"{name} is 1e.75, which float32 cannot hold"):
        make(**{name: value})
    points = np.random.default_rng(0).normal(size=(8, 3))
    assert getattr(tj.host_problem(points, points, noise_bound=0.1, **{name: value}), name) == value


def test_masked_rows_beyond_float32_are_cast_without_a_warning():
    points, mask = np.random.default_rng(0).normal(size=(8, 3)), np.arange(8) > 0
    points[0] = 1e300
    assert tj.make_problem(points, points, noise_bound=0.1, mask=mask).src.dtype == jnp.float32
