"""A graph of poses: clouds are its nodes, answers to two of them its edges, and all are laid to agree.

Each edge has a Cauchy kernel about its error in standard deviations: a false one that came so far pulls
little. The engine is GTSAM where it is installed, and scipy, with the same cost, where it is not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Literal, NamedTuple, TypeAlias

import networkx as nx
import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import least_squares
from scipy.sparse import csr_matrix

from teaser_jax.ground.checks import one_of
from teaser_jax.ground.extras import needed
from teaser_jax.maps.motions import exp, inverse, log

Engine: TypeAlias = Literal["gtsam", "scipy"]

# The kernel: errors of six numbers are shorter than this in 95 of 100 cases, and are hardly weighed less.
CAUCHY = 3.55  # standard deviations
TOLERANCE = 1e-12  # of the cost, where an engine ends
ROUNDS, LSMR_ROUNDS = 100, 3000
DIFFERENCE = 1e-3  # standard deviations, to either side


class Edge(NamedTuple):
    """A measured pose between two nodes.

    Attributes:
        i, j: The nodes.
        T: ``T_i_j``.
        covariance: Of a small motion (w, v) to the right of ``T``.
        spread: What the edge adds to the squared error of a way through it [length squared].
    """

    i: int
    j: int
    T: Float[np.ndarray, "4 4"]
    covariance: Float[np.ndarray, "6 6"]
    spread: float


def engine_or_any(engine: Engine | None) -> Engine:
    """Check the name of an engine; None: GTSAM if it is installed.

    Raises:
        ValueError: For another name.
        ImportError: If GTSAM is asked for and missing.
    """
    if engine is None:
        return "gtsam" if find_spec("gtsam") else "scipy"
    one_of("engine", engine, ("gtsam", "scipy"))
    if engine == "gtsam":
        needed("gtsam", "the engine 'gtsam' needs it", "map")
    return engine


def settle(edges: Sequence[Edge], anchor: int, engine: Engine) -> dict[int, Float[np.ndarray, "4 4"]]:
    """Find the poses of all nodes of a connected graph that agree best with its edges.

    Args:
        edges: At least one; they connect all their nodes.
        anchor: The node whose pose is the identity.
        engine: Which library does it.

    Returns:
        ``T_anchor_k`` for each node k.
    """
    start = _from_a_tree(edges, anchor)
    return (_by_gtsam if engine == "gtsam" else _by_scipy)(edges, start, anchor)


def strain(edge: Edge, poses: dict[int, Float[np.ndarray, "4 4"]]) -> float:
    """Compute the squared error of an edge in standard deviations."""
    error = log(inverse(edge.T) @ inverse(poses[edge.i]) @ poses[edge.j])
    return float(error @ np.linalg.solve(edge.covariance, error))


def _from_a_tree(edges: Sequence[Edge], anchor: int) -> dict[int, Float[np.ndarray, "4 4"]]:
    """Chain the edges of the tree of least spread."""
    graph = nx.Graph()
    for edge in edges:
        graph.add_edge(edge.i, edge.j, weight=edge.spread, edge=edge)
    tree, poses = nx.minimum_spanning_tree(graph), {anchor: np.eye(4)}
    for a, b in nx.bfs_edges(tree, anchor):
        edge = tree.edges[a, b]["edge"]
        poses[b] = poses[a] @ (edge.T if edge.i == a else inverse(edge.T))
    return poses


def _by_gtsam(
    edges: Sequence[Edge], start: dict[int, Float[np.ndarray, "4 4"]], anchor: int
) -> dict[int, Float[np.ndarray, "4 4"]]:
    import gtsam

    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    kernel = gtsam.noiseModel.mEstimator.Cauchy.Create(CAUCHY)
    for edge in edges:
        gaussian = gtsam.noiseModel.Gaussian.Covariance(edge.covariance)
        noise = gtsam.noiseModel.Robust.Create(kernel, gaussian)
        graph.add(gtsam.BetweenFactorPose3(edge.i, edge.j, gtsam.Pose3(edge.T), noise))
    # The edges know no place: this factor is met exactly, whatever it weighs, so it weighs as they do.
    there = gtsam.noiseModel.Gaussian.Covariance(edges[0].covariance)
    graph.add(gtsam.PriorFactorPose3(anchor, gtsam.Pose3(np.eye(4)), there))
    for node, pose in start.items():
        values.insert(node, gtsam.Pose3(pose))
    how = gtsam.LevenbergMarquardtParams()
    how.setRelativeErrorTol(TOLERANCE)
    how.setAbsoluteErrorTol(TOLERANCE)
    how.setMaxIterations(ROUNDS)
    found = gtsam.LevenbergMarquardtOptimizer(graph, values, how).optimize()
    home = inverse(found.atPose3(anchor).matrix())
    return {node: np.eye(4) if node == anchor else home @ found.atPose3(node).matrix() for node in start}


def _by_scipy(
    edges: Sequence[Edge], start: dict[int, Float[np.ndarray, "4 4"]], anchor: int
) -> dict[int, Float[np.ndarray, "4 4"]]:
    nodes = [anchor, *(node for node in start if node != anchor)]
    place = {node: k for k, node in enumerate(nodes)}
    cost = _Cost(
        first=np.array([start[node] for node in nodes]),
        i=np.array([place[edge.i] for edge in edges]),
        j=np.array([place[edge.j] for edge in edges]),
        back=inverse(np.array([edge.T for edge in edges])),
        root=np.linalg.inv(np.linalg.cholesky(np.array([edge.covariance for edge in edges]))),
    )
    found = least_squares(
        cost.residuals, np.zeros(6 * len(nodes) - 6), cost.jacobian, x_scale="jac", xtol=TOLERANCE,
        ftol=TOLERANCE, gtol=TOLERANCE, max_nfev=ROUNDS, tr_solver="lsmr",
        # Long loops are stiff: solved less tightly, steps end far from the least cost.
        tr_options={"atol": TOLERANCE, "btol": TOLERANCE, "maxiter": LSMR_ROUNDS},
    )  # fmt: skip
    return dict(zip(nodes, cost.poses(found.x), strict=True))


@dataclass(frozen=True, eq=False)
class _Cost:
    """The cost of GTSAM's graph, as scipy asks for it: of all nodes but the first, which stays.

    Attributes:
        first: Poses to begin with.
        i, j: The nodes of each edge.
        back: The inverse of what each edge measured.
        root: Such that the square of root times error is the squared error in standard deviations.
    """

    first: Float[np.ndarray, "n 4 4"]
    i: Int[np.ndarray, " k"]
    j: Int[np.ndarray, " k"]
    back: Float[np.ndarray, "k 4 4"]
    root: Float[np.ndarray, "k 6 6"]

    def poses(self, x: Float[np.ndarray, " m"]) -> Float[np.ndarray, "n 4 4"]:
        """Move all poses but the first."""
        return self.first @ exp(np.concatenate([np.zeros((1, 6)), x.reshape(-1, 6)]))

    def residuals(self, x: Float[np.ndarray, " m"]) -> Float[np.ndarray, " r"]:
        """Compute numbers whose squares sum to what the kernel makes of the errors."""
        poses = self.poses(x)
        return self._between(poses[self.i], poses[self.j]).ravel()

    def _between(
        self, T_i: Float[np.ndarray, "k 4 4"], T_j: Float[np.ndarray, "k 4 4"]
    ) -> Float[np.ndarray, "k 6"]:
        """Weigh errors so that their squares become c^2 log(1 + e^2 / c^2)."""
        error = np.einsum("kij,kj->ki", self.root, log(self.back @ inverse(T_i) @ T_j))
        ratio = np.maximum(np.sum(error**2, axis=1) / CAUCHY**2, 1e-30)
        return error * np.sqrt(np.log1p(ratio) / ratio)[:, None]

    def jacobian(self, x: Float[np.ndarray, " m"]) -> csr_matrix:
        """Differentiate the residuals: each edge by its two nodes, all edges at once."""
        count, steps = len(self.i), x.reshape(-1, 6)
        base, blocks = self.poses(x), np.zeros((count, 6, 2, 6))
        scale = 1 / np.sqrt(np.einsum("kij,kij->j", self.root, self.root) / count)  # of a usual deviation
        for c in range(6):
            step = DIFFERENCE * scale[c] * np.eye(6)[c]
            ahead, behind = (
                np.concatenate([self.first[:1], self.first[1:] @ exp(steps + sign * step)])
                for sign in (1, -1)
            )
            for end, a, b in ((0, (ahead, base), (behind, base)), (1, (base, ahead), (base, behind))):
                more, less = (self._between(T_i[self.i], T_j[self.j]) for T_i, T_j in (a, b))
                blocks[:, :, end, c] = (more - less) / (2 * step[c])
        rows = np.broadcast_to(np.arange(6 * count).reshape(count, 6, 1, 1), blocks.shape)
        ends = 6 * np.stack([self.i, self.j], axis=1)[:, None, :, None] + np.arange(6)
        columns = np.broadcast_to(ends, blocks.shape)
        shape = (6 * count, 6 * len(self.first))
        return csr_matrix((blocks.ravel(), (rows.ravel(), columns.ravel())), shape)[:, 6:]
