"""The front door: the same answers as ``solve``, clear errors, and a status for whatever has no answer."""

from __future__ import annotations

import jax
import networkx as nx
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from oracles import refit, solve

import teaser_jax as tj
from teaser_jax.engine import single
from teaser_jax.engine.programs import ON_ONE_DEVICE, Programs
from teaser_jax.engine.sizes import padded_size
from teaser_jax.problem import pad_problem
from teaser_jax.settings import ExactClique, Gnc, PairSearch, ScaleVote
from teaser_jax.synthetic import descriptor_problem, random_problem

N = 60  # most problems here share one bucket, so two programs serve the file


def answer(problem, **known):
    return tj.register(problem.src, problem.dst, noise_bound=problem.noise_bound, **known)


@pytest.fixture(scope="module")
def problem():
    return random_problem(1, n=N, outlier_rate=0.6)


@pytest.fixture(scope="module")
def result(problem):
    return answer(problem)


def test_finds_the_pose_and_the_right_matches(problem, result):
    assert result.ok
    np.testing.assert_array_equal(result.inliers, problem.inliers)
    assert tj.metrics.rotation_error(result.pose, problem.truth) < 0.05
    assert tj.metrics.translation_error(result.pose, problem.truth) < 0.05


def test_everything_is_numpy_in_float64(result):
    assert not jax.config.jax_enable_x64
    for leaf in jax.tree.leaves(result.solution):
        assert isinstance(leaf, (np.ndarray, np.generic))
        assert leaf.dtype.kind != "f" or leaf.dtype == np.float64


@pytest.mark.long
@pytest.mark.parametrize("scale", [1.0, None], ids=["known scale", "voted scale"])
def test_solve_gives_the_same_sets_and_pose(scale, x64):
    n = 30  # padded to 32, for which the tests of solve have a program
    problem = random_problem(1, n=n, outlier_rate=0.6)
    ours = answer(problem, scale=scale)
    src, dst = problem.src - problem.src.mean(0), problem.dst - problem.dst.mean(0)
    made = tj.make_problem(src, dst, noise_bound=problem.noise_bound, scale=scale)
    theirs = solve(pad_problem(made, 32))
    for name in ("clique", "rotation", "translation", "inliers"):
        mine, expected = (getattr(x.selection, name) for x in (ours.solution, theirs))
        np.testing.assert_array_equal(mine, expected[:n])
    np.testing.assert_allclose(ours.pose.rotation, theirs.pose.rotation, atol=1e-12)
    np.testing.assert_allclose(ours.pose.scale, theirs.pose.scale, atol=1e-12)
    moved = theirs.pose.apply(src) + problem.dst.mean(0)
    np.testing.assert_allclose(ours.pose.apply(problem.src), moved, atol=1e-12)
    assert ours.status == theirs.status


@pytest.mark.long
@pytest.mark.parametrize("scale", [1.0, None], ids=["known scale", "voted scale"])
@pytest.mark.parametrize("refined", [True, False])
def test_the_pose_is_the_refit_of_its_own_selection(problem, scale, refined, x64):
    """Also after padding, centring and the way back: the selection is in the user's rows."""
    found = answer(problem, scale=scale, settings=tj.Settings(refine=refined))
    made = tj.make_problem(problem.src, problem.dst, noise_bound=problem.noise_bound, scale=scale)
    again = refit(made, found.solution.selection)
    np.testing.assert_allclose(again.matrix, found.pose.matrix, atol=1e-10)


def test_offsets_of_a_million_metres_change_nothing(problem, result):
    far = np.array([1e6, -2e6, 5e5])
    found = tj.register(problem.src + far, problem.dst - far, noise_bound=problem.noise_bound)
    assert found.ok
    np.testing.assert_array_equal(found.inliers, result.inliers)
    np.testing.assert_allclose(found.pose.rotation, result.pose.rotation, atol=1e-8)
    np.testing.assert_allclose(
        found.pose.apply(problem.src + far) + far, result.pose.apply(problem.src), atol=1e-6
    )


def test_rows_that_are_not_finite_are_left_out_and_counted(problem, result):
    src, dst = problem.src.copy(), problem.dst.copy()
    wrong = np.flatnonzero(~problem.inliers)
    src[wrong[0]], dst[wrong[1], 2], src[wrong[2], 0] = np.nan, np.inf, -np.inf
    found = tj.register(src, dst, noise_bound=problem.noise_bound)
    assert found.ok
    assert found.solution.excluded == 3
    assert "3 rows were not finite" in str(found)
    np.testing.assert_array_equal(found.inliers, result.inliers)
    np.testing.assert_allclose(found.pose.matrix, result.pose.matrix, atol=1e-12)


def test_masked_and_weightless_rows_are_left_out(problem):
    some = np.arange(N) % 3 > 0
    by_mask = answer(problem, mask=some)
    by_weight = answer(problem, confidence=some.astype(float))
    assert by_mask.ok
    assert not (by_mask.inliers & ~some).any()
    np.testing.assert_array_equal(by_mask.inliers, by_weight.inliers)
    np.testing.assert_allclose(by_mask.pose.matrix, by_weight.pose.matrix, atol=1e-14)


@pytest.mark.long
def test_duplicates_and_many_to_one_matches_do_no_harm(problem):
    twice = tj.register(
        np.concatenate([problem.src, problem.src[:4]]),
        np.concatenate([problem.dst, problem.dst[:4]]),
        noise_bound=problem.noise_bound,
    )
    assert twice.ok
    np.testing.assert_array_equal(twice.inliers[:N], problem.inliers)
    crowded = descriptor_problem(3, n=N, outlier_rate=0.6, hubs=0.1)
    found = answer(crowded)
    assert found.ok
    assert found.inliers[crowded.inliers].mean() > 0.95


@pytest.mark.long
def test_pairs_and_graphs_of_pairs_are_the_same(problem):
    pairs = np.array([(i, j) for i in range(N) for j in range(i + 1, N) if (i + j) % 3])
    graph = nx.Graph(pairs.tolist())
    a, b = answer(problem, pairs=pairs), answer(problem, pairs=graph)
    assert a.ok
    np.testing.assert_array_equal(a.inliers, b.inliers)
    np.testing.assert_allclose(a.pose.matrix, b.pose.matrix, atol=1e-12)


def test_no_edge_in_the_graph_is_no_consensus():
    src = np.cumsum(np.arange(1.0, 41))[:, None] * [1.0, 0, 0]
    assert tj.register(src, 3.7 * src**1.5, noise_bound=1e-3).status == tj.Status.NO_CONSENSUS


@pytest.mark.parametrize("budget", [dict(nodes=1), dict(seconds=0.0)], ids=str)
def test_a_spent_budget_is_said_and_its_bound_holds(budget):
    # Agreements of one match in two: too hard for the device, and for one node.
    rng = np.random.default_rng(1)
    src, dst = rng.uniform(size=(N, 3)), rng.uniform(size=(N, 3))
    full = tj.register(src, dst, noise_bound=0.18)
    cut = tj.register(src, dst, noise_bound=0.18, settings=tj.Settings(clique=ExactClique(**budget)))
    assert full.solution.clique_is_maximum
    assert not cut.solution.clique_is_maximum
    assert cut.solution.clique_size <= full.solution.clique_size <= cut.solution.clique_upper_bound
    assert "not proved" in str(cut)


def test_inside_jit_it_names_the_function_to_use(problem):
    with pytest.raises(ValueError, match="solve"):
        jax.jit(lambda x: tj.register(x, problem.dst, noise_bound=0.1).pose.matrix)(problem.src)


def test_the_summary_says_what_matters(problem, result):
    text = str(result)
    for word in ("ok", f"{result.inliers.sum()} of {N}", "proved maximum", "quaternion", "translation"):
        assert word in text
    wrong = tj.register(problem.src, problem.dst[::-1], noise_bound=problem.noise_bound)
    assert not wrong.ok
    assert str(wrong).startswith("NOT OK: NO_CONSENSUS")
    assert wrong.status.advice in str(wrong)


def test_a_stream_of_sizes_shares_programs(problem):
    def programs():
        return [program._cache_size() for program in ON_ONE_DEVICE]

    answer(problem)
    before = programs()
    for n in (33, 40, 57, 64):
        other = random_problem(n, n=n, outlier_rate=0.5)
        assert answer(other).ok
    assert programs() == before


def test_eight_programs_serve_a_stream():
    sizes = {n: padded_size(n) for n in range(1, 30_001)}
    assert all(size >= n for n, size in sizes.items())
    assert all(size <= max(2 * n, 32) for n, size in sizes.items())
    assert len({sizes[n] for n in range(300, 6001)}) <= 8


@pytest.mark.long
@pytest.mark.parametrize(
    ("most", "stream"),
    [
        (100, ((20, 0.2), (50, 0.5), (90, 0.5), (100, 1.0))),
        pytest.param(
            6000, ((300, 0.5), (777, 0.8), (1500, 0.9), (3100, 0.95), (6000, 0.95)), marks=pytest.mark.slow
        ),
    ],
)
def test_after_warmup_nothing_compiles(most, stream):
    sizes = tj.warmup(most, settings=tj.Settings(rotation=Gnc(factor=1.5)))
    assert sizes == sorted({padded_size(n) for n in range(1, most + 1)})
    compiled, listening = [], [True]

    def listener(event, *_, **__):  # stays registered: older JAX cannot take it back
        if listening and "backend_compile" in event:
            compiled.append(event)

    jax.monitoring.register_event_duration_secs_listener(listener)
    for n, rate in stream:
        drawn = random_problem(n, n=n, outlier_rate=rate, radius=1.0)
        tj.register(drawn.src, drawn.dst, noise_bound=drawn.noise_bound)
    # Numbers and budgets are sent, whole ones too.
    other = tj.Settings(rotation=Gnc(factor=2, tolerance=0), clique=ExactClique(nodes=10, seconds=5))
    tj.register(drawn.src, drawn.dst, noise_bound=drawn.noise_bound, settings=other)
    assert not compiled
    new = tj.Settings(rotation=Gnc(iterations=100 + most))
    tj.register(drawn.src[:10], drawn.dst[:10], noise_bound=0.05, settings=new)
    assert compiled  # whatever is new is seen
    listening.clear()


@pytest.mark.parametrize("max_points", [0, -3, 1.5, "10", None, float("nan")])
def test_warmup_wants_a_size(max_points, unchecked):
    with pytest.raises(ValueError, match="max_points"):
        tj.warmup(max_points)


@pytest.mark.long
def test_profile_names_every_stage(problem, result):
    profile = tj.profile(problem.src, problem.dst, noise_bound=problem.noise_bound, repeats=1)
    assert profile.warm.keys() == profile.cold.keys()
    assert {"scale", "consistency graph", "rotation", "translation", "refinement"} < profile.warm.keys()
    assert all(seconds > 0 for seconds in profile.warm.values())
    np.testing.assert_allclose(profile.result.pose.matrix, result.pose.matrix, atol=1e-12)
    assert "total" in str(profile)


numbers = st.one_of(st.floats(-5, 5), st.sampled_from([0.0, np.nan, np.inf, -np.inf, 1e300, -1e300, 1e-300]))


@given(data=st.data())
@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
def test_any_input_gives_an_error_or_a_finite_answer(data):
    shapes = st.sampled_from(
        [(0, 3), (1, 3), (2, 3), (3, 3), (5, 3), (20, 3), (3, 20), (4,), (4, 2), (2, 4, 3), ()]
    )
    dtypes = st.sampled_from([np.float64, np.float32, np.int32, np.complex64, np.bool_, np.str_])

    def array():
        dtype = data.draw(dtypes)
        elements = numbers if dtype == np.float64 else None
        return data.draw(hnp.arrays(dtype, data.draw(shapes), elements=elements))

    src = array()
    dst = array() if data.draw(st.booleans()) else src.copy()
    bound = data.draw(st.one_of(st.floats(0.01, 1.0), numbers))
    scale = data.draw(st.one_of(st.just(1.0), numbers))
    found, refused = None, ""
    try:
        with np.errstate(all="ignore"):
            found = tj.register(src, dst, noise_bound=bound, scale=scale)
    except ValueError as error:
        refused = str(error)
    if found is None:
        assert len(refused) > 20
        return
    told = {name: value for name, value in vars(found.solution).items() if name != "selection"}
    for leaf in jax.tree.leaves(told):
        assert np.all(np.isfinite(leaf))
    assert not found.ok or found.inliers.sum() >= 3


# --- misuse ---------------------------------------------------------------------------------------


def test_a_result_is_as_true_as_its_ok(problem, result):
    assert result
    wrong = tj.register(problem.src, problem.dst[::-1], noise_bound=problem.noise_bound)
    assert not wrong


def test_on_constants_inside_jit_it_names_the_function_to_use_too(problem):
    inside = lambda x: x * tj.register(problem.src, problem.dst, noise_bound=problem.noise_bound).pose.scale
    with pytest.raises(ValueError, match=r"register was called inside jit.*solve"):
        jax.jit(inside)(2.0)


@pytest.mark.parametrize(
    "settings",
    [
        lambda: {},
        lambda: None,
        lambda: tj.Settings(rotation=Gnc(factor=None)),
        lambda: tj.Settings(rotation=Gnc(factor=np.float32(0.5))),
        lambda: tj.Settings(rotation=PairSearch(gnc=Gnc(factor=np.full((), 0.5)))),
        lambda: tj.Settings(rotation=Gnc(tolerance="x")),
        lambda: tj.Settings(rotation=Gnc(tolerance=float("nan"))),
        lambda: tj.Settings(scale_search=ScaleVote(range=None)),
        lambda: tj.Settings(scale_search=ScaleVote((0.0,))),
        lambda: tj.Settings(scale_search=ScaleVote((0.9, "x"))),
        lambda: tj.Settings(scale_search=ScaleVote((0.9, None))),
        lambda: tj.Settings(scale_search=ScaleVote((-5.0, -1.0))),
        lambda: tj.Settings(clique=ExactClique(seconds=None)),
        lambda: tj.Settings(clique=ExactClique(nodes=True)),
        lambda: tj.Settings(clique=Gnc()),
        lambda: tj.Settings(rotation=None),
        lambda: tj.Settings(clique="best"),
        lambda: tj.Settings(refine="no"),
        lambda: tj.Settings(rotation=Gnc(factor="2")),
        lambda: tj.Settings(rotation=Gnc(iterations=2**31)),
        lambda: tj.Settings(refine=3),
    ],
)
def test_settings_that_make_no_sense_are_refused(problem, settings, unchecked):
    for call in (tj.register, tj.profile):
        with pytest.raises(
            ValueError, match=r"(settings|Settings|Gnc|ExactClique|ScaleVote)\b.* is .*expected"
        ):
            call(problem.src, problem.dst, noise_bound=problem.noise_bound, settings=settings())


def test_too_many_matches_are_a_memory_error_with_advice(problem, monkeypatch):
    def exhausted(*_):
        raise jax.errors.JaxRuntimeError("INTERNAL: Out of memory allocating 125112025088 bytes.")

    monkeypatch.setattr(single, "ON_ONE_DEVICE", Programs(exhausted, exhausted))
    with pytest.raises(MemoryError, match="give fewer"):
        tj.register(problem.src, problem.dst, noise_bound=problem.noise_bound)
