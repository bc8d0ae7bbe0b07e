"""The report of the paper: a row for everything in it, and claims that are tested on tables."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from benchmarks.paper.__main__ import main
from benchmarks.paper.claims import CLAIMS, COMPETITORS
from benchmarks.paper.report import write_report
from benchmarks.paper.verdicts import Verdict, breaks_at, robust_to
from teaser_jax.files import FileError
from teaser_jax.studies import Model, read_results, run_study, studies


@pytest.fixture(scope="module")
def quick(tmp_path_factory):
    """One run a cell of the study of Fig. 6a, of two methods of ours."""
    folder = tmp_path_factory.mktemp("quick")
    chosen = ["teaser_jax", "least squares on the true inliers"]
    run_study("known-scale", folder, quick=True, runs=2, methods=chosen)
    return folder


@pytest.mark.long
def test_the_report_has_a_row_for_every_figure_table_and_competitor(quick, tmp_path):
    path = write_report(quick, tmp_path / "PAPER.md")
    text = path.read_text()
    for claim in CLAIMS:
        assert f"| {claim.where} | {claim.text} |" in text
    for name, _, _ in COMPETITORS:
        assert f"| {name} |" in text
    for name in studies():
        assert f"\n## {name}\n" in text
    assert "known-scale/figure.png" in text
    assert "Not run: `teaser-jax study extreme`" in text
    for figure in ("1", "2", "3", "4a", "4b", "4c", "4d", "5", "6a", "6b", "6c", "7a, b", "7c", "9"):
        assert f"| Fig. {figure} |" in text
    for table in ("Table I", "Table II"):
        assert table in text
    with pytest.raises(FileError, match="holds no study"):
        write_report(tmp_path, tmp_path / "none.md")


@pytest.mark.long
def test_the_report_tells_of_other_models_in_folders_of_their_own(quick, tmp_path):
    folder = shutil.copytree(quick, tmp_path / "studies")
    cloud = Model("cloud", np.random.default_rng(0).standard_normal((400, 3)))
    run_study("known-scale", folder / "cloud", quick=True, model=cloud, methods=["teaser_jax"])
    text = write_report(folder, tmp_path / "PAPER.md").read_text()
    assert "| right, at least: cloud: known-scale 100% to 90% | yes |" in text
    section = text[text.index("\n### cloud\n") :]
    assert "model: cloud; 3 runs a box (Fig. 6a)" in section
    assert "| teaser_jax | 100% | 100% | 100% |" in section
    assert "### cloud" not in write_report(quick, tmp_path / "alone.md").read_text()


@pytest.mark.long
def test_claims_are_tested_and_not_believed(quick):
    results = read_results(quick / "known-scale")
    assert robust_to("teaser_jax", 0.9)(results).holds is True
    assert robust_to("nobody", 0.9)(results) == Verdict("not run")
    assert breaks_at("teaser_jax", 0.9)(results).holds is False
    for row in results.rows:
        if row["outlier_rate"] == 0.9:
            row["rotation_deg"] = 90.0
    assert robust_to("teaser_jax", 0.9)(results).holds is False
    assert robust_to("teaser_jax", 0.5)(results).holds is True
    assert breaks_at("teaser_jax", 0.9)(results).holds is True


@pytest.mark.long
def test_the_command_writes_the_report_or_says_in_one_line_why_not(quick, tmp_path, capsys):
    path = tmp_path / "PAPER.md"
    assert main([str(quick), "-o", str(path)]) == 0
    assert capsys.readouterr().out == f"{path}\n"
    assert path.read_text() == write_report(quick, path).read_text()
    assert main([str(tmp_path / "none")]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
