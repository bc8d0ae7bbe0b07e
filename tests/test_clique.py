"""Maximum cliques against networkx: every set returned is a clique, every bound is one."""

from __future__ import annotations

from functools import cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import networkx as nx
import numpy as np
import pytest
from jax import lax
from oracles import clique_number, is_clique, pack, random_graph, unpack

from teaser_jax.stages.clique import branching, reduction
from teaser_jax.stages.clique import exact as exact_room
from teaser_jax.stages.clique.clique import Clique
from teaser_jax.stages.clique.every_match import EveryMatch
from teaser_jax.stages.clique.exact import ExactClique, search_clique, two_pentagons
from teaser_jax.stages.clique.greedy import GreedyClique, peeling_bound
from teaser_jax.stages.clique.maximum import finish_on_host, maximum_clique, search_on_device
from teaser_jax.stages.clique.oracle import NetworkxClique, graph_of

N = 64
BATCH = 300
METHODS = {"exact": ExactClique(), "greedy": GreedyClique(), "none": EveryMatch()}


class Case(NamedTuple):
    """A graph padded to N vertices, and its clique number."""

    dense: np.ndarray
    mask: np.ndarray
    number: int


def dense_of(graph: nx.Graph) -> np.ndarray:
    return nx.to_numpy_array(graph, dtype=bool) if len(graph) else np.zeros((0, 0), bool)


def padded(graph: np.ndarray) -> Case:
    n = len(graph)
    dense = np.zeros((N, N), bool)
    dense[:n, :n] = graph
    return Case(dense, np.arange(N) < n, clique_number(graph) if n else 0)


@cache
def random_cases() -> list[Case]:
    """Graphs of 1 to 60 vertices and all densities, a third of them with a planted clique."""
    rng = np.random.default_rng(0)
    cases = []
    for k in range(BATCH):
        n = int(rng.integers(1, 61))
        planted = int(rng.integers(2, 15)) if k % 3 == 0 else 0
        cases.append(padded(random_graph(rng, n, rng.uniform(0, 0.9), planted)))
    return cases


SPECIAL = {
    "no vertex": nx.empty_graph(0),
    "one vertex": nx.empty_graph(1),
    "no edge": nx.empty_graph(40),
    "one edge": nx.path_graph(2),
    "complete": nx.complete_graph(40),
    "complete, full width": nx.complete_graph(N),
    "all but one edge": nx.from_edgelist(set(nx.complete_graph(40).edges) - {(3, 17)}),
    "path": nx.path_graph(40),
    "odd cycle": nx.cycle_graph(41),
    "star": nx.star_graph(40),
    "wheel": nx.wheel_graph(30),
    "bipartite": nx.complete_bipartite_graph(20, 25),
    "multipartite": nx.complete_multipartite_graph(*[3] * 20),  # 3^20 maximum cliques
    "complement of a matching": nx.complement(nx.from_edgelist([(2 * i, 2 * i + 1) for i in range(25)])),
    "Petersen": nx.petersen_graph(),
    "two cliques": nx.disjoint_union(nx.complete_graph(20), nx.complete_graph(20)),
    "barbell": nx.barbell_graph(15, 5),
    "caveman": nx.connected_caveman_graph(6, 9),
    "Paley 61": nx.paley_graph(61).to_undirected(),
    "sparse hubs": nx.windmill_graph(7, 6),
    "Mycielski": nx.mycielski_graph(6),  # no triangle, yet many colours
}


@cache
def special_cases() -> list[Case]:
    return [padded(dense_of(graph)) for graph in SPECIAL.values()]


def stacked(cases: list[Case]) -> tuple[np.ndarray, np.ndarray]:
    """The cases as one batch of BATCH graphs, the first one repeated at the end."""
    filled = cases + [cases[0]] * (BATCH - len(cases))
    return np.stack([pack(c.dense) for c in filled]), np.stack([c.mask for c in filled])


batched = {
    name: jax.jit(jax.vmap(partial(maximum_clique, method=method))) for name, method in METHODS.items()
}
one_exact = jax.jit(maximum_clique)


@cache
def answers(method: str, special: bool) -> list[Clique]:
    cases = special_cases() if special else random_cases()
    found = jax.tree.map(np.asarray, batched[method](*stacked(cases)))
    return [Clique(found.members[i], int(found.upper_bound[i])) for i in range(len(cases))]


def check(case: Case, found: Clique, *, maximum: bool) -> None:
    members = np.asarray(found.members)
    assert not np.any(members & ~case.mask)
    assert is_clique(case.dense, members)
    assert members.sum() <= case.number <= int(found.upper_bound)
    if maximum:
        assert members.sum() == case.number == int(found.upper_bound)


@pytest.mark.long
@pytest.mark.parametrize("special", [False, True], ids=["random", "special"])
@pytest.mark.parametrize("method", ["greedy", "exact"])
def test_every_set_is_a_clique_and_every_bound_holds(method, special):
    cases = special_cases() if special else random_cases()
    for case, found in zip(cases, answers(method, special), strict=True):
        check(case, found, maximum=method == "exact")


def test_greedy_proves_the_easy_ones():
    # A clique with a few stray edges around is what a registration problem looks like.
    rng = np.random.default_rng(1)
    cases = [padded(random_graph(rng, 60, 0.05, planted=12)) for _ in range(20)]
    found = jax.tree.map(np.asarray, batched["greedy"](*stacked(cases)))
    proved = found.members.sum(axis=1) == found.upper_bound
    assert proved[: len(cases)].all()
    assert not np.all(
        [c.number == f.upper_bound for c, f in zip(random_cases(), answers("greedy", False), strict=True)]
    )


def test_none_returns_all_usable_matches():
    for case, found in zip(special_cases(), answers("none", True), strict=True):
        np.testing.assert_array_equal(found.members, case.mask)


def test_a_batch_equals_a_loop():
    for case, together in list(zip(random_cases(), answers("exact", False), strict=True))[:20]:
        alone = one_exact(pack(case.dense), case.mask)
        np.testing.assert_array_equal(alone.members, together.members)
        assert int(alone.upper_bound) == together.upper_bound


@pytest.mark.long
def test_the_callback_equals_the_host_search():
    exactly, start = ExactClique(), jax.jit(search_on_device)
    for case, exact in zip(random_cases(), answers("exact", False), strict=True):
        begun = start(exactly, pack(case.dense), case.mask)
        found = finish_on_host(exactly, pack(case.dense), case.mask, begun)
        np.testing.assert_array_equal(found.members, exact.members)
        assert int(found.upper_bound) == exact.upper_bound


def test_networkx_is_exact_too():
    run = jax.jit(jax.vmap(partial(maximum_clique, method=NetworkxClique())))
    edge_bits, mask = stacked(special_cases())
    chosen = [
        list(SPECIAL).index(k)
        for k in ("one vertex", "no edge", "complete", "Petersen", "two cliques", "barbell")
    ]
    found = run(edge_bits[chosen], mask[chosen])
    for k, i in enumerate(chosen):
        check(special_cases()[i], Clique(found.members[k], found.upper_bound[k]), maximum=True)


def test_inside_scan_and_under_grad():
    edge_bits, mask = stacked(random_cases())

    def one(total, graph):
        found = maximum_clique(*graph)
        return total + jnp.sum(found.members), found.upper_bound

    total, bounds = jax.jit(lambda x: lax.scan(one, 0, x))((edge_bits[:20], mask[:20]))
    np.testing.assert_array_equal(bounds, [c.number for c in random_cases()[:20]])
    assert total == sum(c.number for c in random_cases()[:20])

    def weigh(x):
        found = maximum_clique(jnp.asarray(edge_bits[0]), jnp.asarray(mask[0]) & (x > 0))
        return jnp.sum(jnp.where(found.members, x, 0))

    slope = jax.jit(jax.grad(weigh))(jnp.ones(N))
    np.testing.assert_array_equal(slope, answers("exact", False)[0].members)


@pytest.mark.parametrize("n", [0, 1, 33])
def test_graphs_of_any_size(n):
    dense = ~np.eye(n, dtype=bool)
    found = jax.jit(maximum_clique)(pack(dense), np.ones(n, bool))
    assert int(found.members.sum()) == int(found.upper_bound) == n


def test_masked_vertices_stay_out():
    rng = np.random.default_rng(2)
    dense, mask = random_graph(rng, N, 0.5, planted=12), rng.uniform(size=N) < 0.7
    dense &= mask[:, None] & mask
    check(
        Case(dense, mask, clique_number(dense[np.ix_(mask, mask)])),
        one_exact(pack(dense), mask),
        maximum=True,
    )


def test_the_order_of_vertices_does_not_matter():
    case = random_cases()[0]
    for seed in range(3):
        order = np.random.default_rng(seed).permutation(N)
        found = one_exact(pack(case.dense[np.ix_(order, order)]), case.mask[order])
        assert int(found.upper_bound) == case.number


def test_peeling_bound_never_falls_below_what_it_was_given_or_the_truth():
    bound = jax.jit(jax.vmap(peeling_bound))
    cases = random_cases()
    for lower in (0, 3, 8):
        alive, bounds = jax.device_get(bound(*stacked(cases), np.full(BATCH, lower, np.int32)))
        assert np.all(bounds >= np.maximum(lower, [c.number for c in cases]))
        # Nobody is peeled who is in a larger clique.
        larger = [c.number > lower and not alive[k].any() for k, c in enumerate(cases)]
        assert not any(larger)


# --- the host search by itself: larger graphs, budgets ----------------------------------------------


def search(dense: np.ndarray, *, nodes: int = 10**8, seconds: float = 60.0) -> Clique:
    """The search from the worst start there is: one vertex, and the trivial bound."""
    start = Clique(np.arange(len(dense)) == 0, np.int32(len(dense)))
    return search_clique(pack(dense), start, nodes=nodes, seconds=seconds)


@pytest.mark.parametrize(
    ("n", "density", "planted"),
    [(150, 0.5, 0), (200, 0.3, 0), (300, 0.1, 25), (120, 0.7, 30), (500, 0.05, 0)],
)
def test_larger_graphs(n, density, planted):
    dense = random_graph(np.random.default_rng(n), n, density, planted)
    members, upper = search(dense)
    assert is_clique(dense, members)
    assert members.sum() == upper == clique_number(dense)


def test_exact_from_any_start():
    for case in random_cases()[:100]:
        if case.mask.any():
            members, upper = search(case.dense)
            check(case, Clique(members, upper), maximum=True)


@pytest.mark.parametrize(
    "budget", [dict(nodes=0), dict(nodes=1), dict(nodes=100), dict(seconds=0.0), dict(seconds=1e-3)], ids=str
)
def test_out_of_budget_the_set_is_a_clique_and_the_bound_holds(budget):
    rng = np.random.default_rng(3)
    unproved = 0
    for n, density in ((64, 0.6), (150, 0.5), (200, 0.4), (150, 0.7)):
        dense = random_graph(rng, n, density)
        members, upper = search(dense, **budget)
        best, proved = search(dense)
        assert best.sum() == proved
        assert is_clique(dense, members)
        assert 1 <= members.sum() <= proved <= upper <= n
        unproved += members.sum() < upper
    if "nodes" in budget:
        assert unproved >= 3


def test_budget_holds_under_jit():
    rng = np.random.default_rng(4)
    dense = random_graph(rng, N, 0.8)
    found = one_exact(pack(dense), np.ones(N, bool), ExactClique(nodes=1))
    assert is_clique(dense, np.asarray(found.members))
    assert int(found.members.sum()) <= clique_number(dense) <= int(found.upper_bound)
    assert int(found.members.sum()) < int(found.upper_bound)


def test_a_proved_clique_is_returned_as_it_is():
    dense = ~np.eye(5, dtype=bool)
    members = np.array([True, True, True, False, False])
    found = finish_on_host(ExactClique(), pack(dense), np.ones(5, bool), Clique(members, np.int32(3)))
    np.testing.assert_array_equal(found.members, members)
    assert found.upper_bound == 3


def test_without_numba_networkx_searches(monkeypatch):
    monkeypatch.setattr(exact_room, "load_kernels", lambda: False)
    for case, greedy in list(zip(random_cases(), answers("greedy", False), strict=True))[:50]:
        check(case, finish_on_host(ExactClique(), pack(case.dense), case.mask, greedy), maximum=True)


def test_graph_of_is_the_graph():
    case = random_cases()[5]
    graph = graph_of(pack(case.dense), case.mask)
    np.testing.assert_array_equal(sorted(graph), np.flatnonzero(case.mask))
    np.testing.assert_array_equal(
        nx.to_numpy_array(graph, nodelist=sorted(graph)), case.dense[np.ix_(case.mask, case.mask)]
    )


def test_warming_runs_through_every_loop():
    nothing = Clique(np.zeros(10, bool), np.int32(10))
    found = search_clique(two_pentagons(), nothing, nodes=10_000, seconds=600.0)
    assert found.members.sum() == found.upper_bound == clique_number(unpack(two_pentagons(), 10)) == 4
    # Those that the search calls; what they call in turn is compiled into them.
    called = {
        reduction: ("degrees", "induced", "degeneracy_order", "grow_clique", "peel", "drop_weak_edges"),
        branching: ("colour", "root_bounds", "branch"),
    }
    assert not [
        name for room, names in called.items() for name in names if not getattr(room, name).signatures
    ]
