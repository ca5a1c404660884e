"""The benchmark's own arithmetic: a wrong comparison would praise or blame the program for nothing."""

import importlib
import math
import sys
from pathlib import Path

import numpy as np
import pytest

BENCH = Path(__file__).parents[2] / "bench"


@pytest.fixture(scope="module")
def bench():
    if not (BENCH / "run_bench.py").is_file():
        pytest.skip("the benchmarks are not part of this copy of the project")
    before = list(sys.path)
    sys.path.insert(0, str(BENCH))
    try:
        yield importlib.import_module("run_bench")
    finally:
        sys.path[:] = before


def table(bench, places, diameters):
    match = sys.modules["bench_match"]
    names = tuple(str(i + 1) for i in range(len(places)))
    return match.Table(names, np.asarray(places, float), np.asarray(diameters, float))


PLACES = np.array([[0.0, 0.0], [5.0, 1.0], [2.0, 7.0], [9.0, 4.0], [7.0, 9.5]])


def test_errors_are_of_the_pairs_that_stand_together(bench):
    truth = table(bench, PLACES, [30, 40, 50, 20, 10])
    found = table(bench, PLACES[[3, 1, 0]] + 0.1, [21, 38, np.nan])
    result = bench.score(found, truth)
    assert (result.n_true, result.n_found, result.n_dbh, result.n_matched, result.n_compared) == (5, 3, 2, 3, 2)
    assert result.bias_cm == pytest.approx(-0.5)
    assert result.rmse_cm == pytest.approx(math.sqrt(2.5))
    assert result.worst_cm == pytest.approx(-2.0)


def test_a_stem_out_of_reach_is_not_matched(bench):
    truth = table(bench, PLACES, [30] * 5)
    found = table(bench, np.vstack([PLACES[:4], [[7.0, 10.5]]]), [30] * 5)
    assert bench.score(found, truth).n_matched == 4


def test_a_plot_in_another_frame_is_turned_and_moved_but_not_scaled(bench):
    truth = table(bench, PLACES, [30, 40, 50, 20, 10])
    turn = np.array([[np.cos(2), -np.sin(2)], [np.sin(2), np.cos(2)]])
    found = table(bench, np.vstack([PLACES @ turn.T + [40, -7], [[99, 99]]]), [30, 40, 50, 20, 10, 5])
    result = bench.score(found, truth)
    assert result.n_matched == 5 and result.n_found == 6
    assert result.rmse_cm == pytest.approx(0.0)
    stretched = table(bench, 1.5 * PLACES @ turn.T, [30, 40, 50, 20, 10])
    assert bench.score(stretched, truth).n_matched < 5
    mirrored = table(bench, PLACES * [-1, 1], [30, 40, 50, 20, 10])
    assert bench.score(mirrored, truth).n_matched < 5


def test_nothing_found_is_no_error_of_zero(bench):
    result = bench.score(table(bench, np.zeros((0, 2)), []), table(bench, PLACES, [30] * 5))
    assert result.n_found == 0 and result.bias_cm is None and result.rmse_cm is None


def test_a_zero_or_empty_diameter_is_none(bench, tmp_path):
    path = tmp_path / "inventory.csv"
    path.write_text("\ufefftree_id,dbh_cm,x_m,y_m\n1,0.000,1,2\n2,,3,4\n3,25.5,5,6\n", encoding="utf-8")
    assert np.isnan(bench.read_table(path).dbh_cm).tolist() == [True, True, False]


def machine(calibration_s, *, load=0.1):
    return {"calibration_s": calibration_s, "calibration_cpu_s": calibration_s, "n_cpus": 2, "load_at_start": load}


def row(bench, **values):
    score = bench.Score(6, 6, values.pop("n_dbh", 5), 6, 5, 0.1, 0.2, 0.3)
    given = {"seconds": 10.0, "cpu_seconds": 8.0, "peak_mb": 500.0, "exit_code": 0, "score": score, **values}
    return bench.Row("plot", bench.OURS, "", **given)


FIGURES = {"seconds": 10.0, "cpu_seconds": 8.0, "peak_mb": 500, "n_dbh": 5}
BASELINE = {"calibration_s": 2.0, "calibration_cpu_s": 2.0, "plots": {"plot": FIGURES}}


@pytest.mark.parametrize(
    ("values", "calibration_s", "n_problems"),
    [
        ({}, 2.0, 0),
        ({"seconds": 12.0}, 2.0, 0),
        ({"seconds": 12.6}, 2.0, 1),
        ({"seconds": 20.0}, 4.0, 0),  # a machine half as fast may take twice as long
        ({}, 1.0, 2),  # and one twice as fast must take half, by both clocks
        ({"cpu_seconds": 10.5}, 2.0, 1),
        ({"peak_mb": 650.0}, 2.0, 1),
        ({"n_dbh": 4}, 2.0, 1),
        ({"exit_code": 1}, 2.0, 1),
        ({"score": None}, 2.0, 1),
    ],
)
def test_gate(bench, values, calibration_s, n_problems):
    assert len(bench.gate([row(bench, **values)], machine(calibration_s), BASELINE, tolerance=0.2)) == n_problems


def test_gate_fails_for_a_plot_without_a_baseline(bench):
    assert bench.gate([row(bench)], machine(2.0), {**BASELINE, "plots": {}}, tolerance=0.2)


def test_on_a_busy_machine_only_processor_time_counts(bench):
    busy = machine(2.0, load=3.0)
    assert bench.gate([row(bench, seconds=100.0)], busy, BASELINE, tolerance=0.2) == []
    assert bench.gate([row(bench, seconds=100.0, cpu_seconds=20.0)], busy, BASELINE, tolerance=0.2)
    assert bench.gate([row(bench, seconds=100.0, cpu_seconds=None)], busy, BASELINE, tolerance=0.2)


def test_an_updated_baseline_passes_its_own_gate_and_keeps_other_plots(bench):
    others = {**BASELINE, "calibration_s": 1.0, "plots": {"other": {**FIGURES, "seconds": 3.0}}}
    new = bench.updated_baseline([row(bench)], machine(2.0), others)
    assert new["plots"]["other"]["seconds"] == pytest.approx(6.0)
    assert bench.gate([row(bench)], machine(2.0), new, tolerance=0.0) == []


def test_a_run_is_timed_weighed_and_stopped(bench, tmp_path):
    run = sys.modules["bench_process"].run
    ballast = np.ones(40_000_000)  # what this process holds must not count
    code = "import time; x = b'1' * 80_000_000; time.sleep(1.5); print('done')"  # long enough to be looked at
    done = run([sys.executable, "-c", code], limit_s=60, log=tmp_path / "log")
    assert done.exit_code == 0 and "done" in done.output
    if done.peak_mb is not None:
        assert 80 < done.peak_mb < 200 < ballast.nbytes / 1e6
    stopped = run([sys.executable, "-c", "import time; time.sleep(60)"], limit_s=0.3, log=tmp_path / "log")
    assert stopped.exit_code is None and stopped.seconds < 30
    failed = run([sys.executable, "-c", "raise SystemExit(3)"], limit_s=60, log=tmp_path / "log")
    assert failed.exit_code == 3


def test_benchmark_seeds_are_kept_apart(bench):
    plots = sys.modules["bench_plots"]
    seeds = [recipe.seed for recipe in plots._RECIPES.values()]
    assert min(seeds) > plots.FIRST_SEED - 1 and len(set(seeds)) == len(seeds)
