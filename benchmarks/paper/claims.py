"""What the paper reports, figure by figure and competitor by competitor.

A claim that a study can test is tested on its table; for the others there is the reason.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from benchmarks.paper.verdicts import (
    CONSENSUS,
    TLS,
    Models,
    Verdict,
    best_at,
    breaks_at,
    certificates_tell,
    clique_prunes,
    faster_than,
    gnc_finds_rotation,
    growth_is_borne,
    holds_at,
    icp_fails,
    less_robust,
    noise_is_borne,
    other_models,
    robust_to,
    stages_that_dominate,
)
from teaser_jax.studies.catalogue import CASCADE, ONE_BY_ONE
from teaser_jax.studies.methods import OURS
from teaser_jax.studies.results import Results

NOT_INSTALLABLE = "no package index has it, and its licence or toolchain keeps it from being built here"
NEEDS_3DMATCH = (
    "needs 3DMatch with 3DSmoothNet features, which is not part of the test data; one of its pairs is in the "
    "benchmarks `accuracy` and `trust`"
)
NEEDS_RGBD = "needs the RGB-D object data set, which is not part of the test data"


@dataclass(frozen=True)
class PaperClaim:
    """A ``PaperClaim`` is one figure, table or finding of the paper.

    Attributes:
        where: Where it stands in the paper.
        text: What it reports.
        study: The study that tests it, or None.
        test: Gives the verdict of that study's results.
        of_models: Gives the verdict of the studies of other models instead.
        reason: Why no study tests it, or where else it is tested.
    """

    where: str
    text: str
    study: str | None = None
    test: Callable[[Results], Verdict] | None = None
    of_models: Callable[[Models], Verdict] | None = None
    reason: str = ""


CLAIMS = (
    PaperClaim("Fig. 1", "a Bunny, 95 % of its matches wrong, in milliseconds", reason="`teaser-jax demo`"),
    PaperClaim("Fig. 2", "TIMs of a complete graph, a picture", reason="notebook `02_inside_the_method`"),
    PaperClaim("Fig. 3", "the adaptive vote, a picture", reason="notebook `02_inside_the_method`"),
    PaperClaim("Fig. 4a", "the TLS scale is robust to 80 %", "scale", robust_to(TLS, 0.8)),
    PaperClaim("Fig. 4a", "consensus maximisation fails twice at 80 %, TLS never", "scale", less_robust(0.8)),
    PaperClaim(
        "Fig. 4b", "below 10 % wrong matches after the maximum clique, to 99 %", "clique", clique_prunes
    ),
    PaperClaim(
        "Fig. 4c", "GNC is right below 80 %, the quaternion relaxation beyond", "rotation", gnc_finds_rotation
    ),
    PaperClaim("Fig. 4d", "the TLS translation is robust to 80 %", "translation", robust_to(TLS, 0.8)),
    PaperClaim(
        "Fig. 4d", "consensus maximisation is robust to 80 %", "translation", robust_to(CONSENSUS, 0.8)
    ),
    PaperClaim(
        "Fig. 5",
        "all right answers of GNC are certified, all wrong ones rejected, within 200 iterations; 24 on "
        "average, 50 ms each",
        "certificate",
        certificates_tell,
    ),
    PaperClaim("Fig. 6a", "TEASER++ is robust to 90 %", "known-scale", robust_to(CASCADE, 0.9)),
    PaperClaim("Fig. 6a", "the same, refined (not in the paper)", "known-scale", robust_to(OURS, 0.9)),
    PaperClaim("Fig. 6a", "under 10 ms", "known-scale", faster_than(ONE_BY_ONE, 10)),
    PaperClaim("Fig. 6a", "TEASER (SDP) is robust to 90 %", "known-scale", holds_at(f"{OURS}, sdp", 0.9)),
    PaperClaim("Fig. 6a", "FGR resists 70 % only", "known-scale", breaks_at("FGR", 0.8)),
    PaperClaim("Fig. 6a", "RANSAC-1k breaks at 90 %", "known-scale", breaks_at("RANSAC-1k", 0.9)),
    PaperClaim("Fig. 6a", "RANSAC of a minute is robust to 90 %", "known-scale", holds_at("RANSAC-60s", 0.9)),
    PaperClaim("Fig. 6b", "TEASER++ is robust to 99 %", "extreme", robust_to(CASCADE, 0.99)),
    PaperClaim("Fig. 6b", "the same, refined (not in the paper)", "extreme", robust_to(OURS, 0.99)),
    PaperClaim("Fig. 6b", "RANSAC-10k performs poorly", "extreme", breaks_at("RANSAC-10k", 0.95)),
    PaperClaim("Fig. 6b", "FGR performs poorly", "extreme", breaks_at("FGR", 0.95)),
    PaperClaim("Fig. 6b", "RANSAC of a minute resists 98 %", "extreme", holds_at("RANSAC-60s", 0.98)),
    PaperClaim(
        "Fig. 6c", "TEASER++ is robust to 80 %, fails at 90 %", "unknown-scale", robust_to(CASCADE, 0.8)
    ),
    PaperClaim("Fig. 6c", "under 30 ms", "unknown-scale", faster_than(ONE_BY_ONE, 30)),
    PaperClaim("Fig. 6c", "FGR with Horn's scale fails at 70 %", "unknown-scale", breaks_at("FGR", 0.7)),
    PaperClaim("Fig. 6c", "RANSAC-1k fails at 90 %", "unknown-scale", breaks_at("RANSAC-1k", 0.9)),
    PaperClaim(
        "Fig. 6c", "RANSAC of a minute is the best at 90 %", "unknown-scale", best_at("RANSAC-60s", 0.9)
    ),
    PaperClaim(
        "Fig. 7a, b", "TEASER++ is right down to an overlap of 10 %", "all-to-all", robust_to(OURS, 0.1)
    ),
    PaperClaim("Fig. 7a, b", "ICP fails practically always", "all-to-all", icp_fails),
    PaperClaim("Fig. 7c", "the clique and the scale dominate the time", "all-to-all", stages_that_dominate),
    PaperClaim("Fig. 8, Table I", "objects in RGB-D scenes: 0.066 rad, 0.069 m", reason=NEEDS_RGBD),
    PaperClaim(
        "Table II", "3DMatch: 86.5 to 98.6 % right, certified ones 88.7 to 99.4 %", reason=NEEDS_3DMATCH
    ),
    PaperClaim(
        "Fig. 9",
        "certificates of 50, 100, 110 TIMs: 1.12 s below 50; MOSEK out of memory beyond 150",
        reason="benchmark `certificate` in RESULTS.md; MOSEK is commercial and cannot be installed here",
    ),
    PaperClaim("Fig. 10, 11", "certified wrong answers on 3DMatch are symmetries", reason=NEEDS_3DMATCH),
    PaperClaim("Supplement", "high noise, sigma 0.1", "high-noise", noise_is_borne),
    PaperClaim("Supplement", "N up to 10 000", "scaling", growth_is_borne),
    PaperClaim("Fig. 6, 7, supplement", "the Bunny, Armadillo and Dragon as models", of_models=other_models),
    PaperClaim(
        "Supplement", "the Buddha as a model", reason="not part of the test data; `--model PATH` takes it"
    ),
    PaperClaim("Supplement", "tightness of the two relaxations", reason="benchmark `certificate`"),
)

# Of the figures above and of related work in its experiments: name, word in the tables' methods, reason.
COMPETITORS = (
    ("TEASER++ (C++)", "TEASER++", "a curve as soon as `teaserpp_python` can be imported; it has no wheel"),
    ("TEASER (semidefinite relaxation)", f"{OURS}, sdp", "a slow curve of known-scale: not run"),
    ("consensus maximisation", CONSENSUS, "not run"),
    ("FGR", "FGR", "needs open3d"),
    ("RANSAC1K", "RANSAC-1k", "needs open3d"),
    ("RANSAC10K", "RANSAC-10k", "needs open3d"),
    ("RANSAC1min", "RANSAC-60s", "needs open3d"),
    ("ICP", "ICP", "needs open3d"),
    ("kiss-matcher (not in the paper)", "kiss-matcher", "needs kiss-matcher"),
    ("GORE", "GORE", f"C++ and MATLAB of its authors: {NOT_INSTALLABLE}"),
    ("Go-ICP, trimming 30, 60 and 90 %", "Go-ICP", f"C++ of its authors, GPL: {NOT_INSTALLABLE}"),
    ("rotation-matrix relaxation", "rotation-matrix", "the quaternion relaxation is tighter"),
    ("MOSEK", "MOSEK", "a commercial solver; the relaxation is solved with SCS instead"),
)  # fmt: skip
