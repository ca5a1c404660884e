"""Seconds, memory and findings of `dbh-studio run` on real and generated plots, beside 3DFin on the same files.

    python bench/run_bench.py                    all plots, both programs
    python bench/run_bench.py --quick --no-peers two small plots, this program only
    python bench/run_bench.py --gate             exit 1 where it is slower or hungrier than bench/baseline.json
    python bench/run_bench.py --update-baseline  write the figures of this run into bench/baseline.json
    python bench/run_bench.py --install-peers    set up 3DFin for comparison (about 1 GB), and run

The table goes to standard output and bench/results/, with all figures as JSON beside it. See bench/README.md.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shlex
import shutil
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent / "src")]

import bench_peers  # noqa: E402
from bench_match import Score, count, read_table, score  # noqa: E402
from bench_plots import Plot, generated_plot, plots  # noqa: E402
from bench_process import Outcome, calibrate, run  # noqa: E402

BASELINE = HERE / "baseline.json"
RESULTS = HERE / "results"
OURS, PEER = "DBH Studio", "3DFin"
# Differences below this are the scheduler's, not the program's.
_NOISE_S, _NOISE_MB = 0.3, 20.0


@dataclass(frozen=True)
class Row:
    """One program on one plot."""

    plot: str
    program: str
    how: str
    seconds: float
    cpu_seconds: float | None
    peak_mb: float | None
    exit_code: int | None
    score: Score | None
    note: str = ""

    @property
    def is_finished(self) -> bool:
        """Whether the program ended well and left a table."""
        return self.exit_code == 0 and self.score is not None


def program_command(given: str | None) -> list[str]:
    """How to start the program: as given, else the one installed beside this Python, else from the sources."""
    if given:
        return shlex.split(given)
    beside = shutil.which("dbh-studio", path=str(Path(sys.executable).parent))
    return (
        [beside] if beside else [sys.executable, "-c", "import sys; from dbh_studio.cli import main; sys.exit(main())"]
    )


def inventory_in(folder: Path) -> Path | None:
    """The table of trees in what a run has written: `inventory.csv`, or the CSV file named after the plot."""
    tables = sorted(folder.glob("*.csv"), key=lambda path: (path.name != "inventory.csv", path.name))
    return tables[0] if tables else None


def run_ours(plot: Plot, folder: Path, command: Sequence[str], *, limit_s: float, repeat: int) -> Row:
    """The whole way from file to inventory; of several runs the quickest counts, and the largest memory."""
    assert plot.path is not None
    outcomes: list[Outcome] = []
    for attempt in range(repeat):
        out = folder / f"ours_{attempt}"
        out.mkdir(parents=True)
        source = str(HERE.parent / "src")
        environment = {"PYTHONPATH": os.pathsep.join(filter(None, [source, os.environ.get("PYTHONPATH")]))}
        full = [*command, "run", str(plot.path), "--out", str(out), "--json"]
        outcomes.append(run(full, limit_s=limit_s, log=folder / f"ours_{attempt}.log", environment=environment))
    best = min(outcomes, key=lambda outcome: (outcome.exit_code != 0, outcome.seconds))
    peaks = [outcome.peak_mb for outcome in outcomes if outcome.peak_mb is not None]
    path = inventory_in(out)
    found = read_table(path) if path is not None and best.exit_code == 0 else None
    result = None if found is None else count(found) if plot.truth is None else score(found, plot.truth)
    note = "" if result is not None else _last_line(best)
    return Row(
        plot.name, OURS, "", best.seconds, best.cpu_seconds, max(peaks, default=None), best.exit_code, result, note
    )


def run_peer(plot: Plot, folder: Path, *, limit_s: float) -> list[Row]:
    """3DFin on the same file."""
    assert plot.path is not None
    rows = []
    for peer in bench_peers.run_3dfin(plot.path, folder, has_ground=plot.has_ground, limit_s=limit_s):
        outcome, found = peer.outcome, peer.found
        result = None if found is None else count(found) if plot.truth is None else score(found, plot.truth)
        note = "" if result is not None else _last_line(outcome)
        rows.append(
            Row(
                plot.name,
                PEER,
                peer.how,
                outcome.seconds,
                outcome.cpu_seconds,
                outcome.peak_mb,
                outcome.exit_code,
                result,
                note,
            )
        )
    return rows


def _last_line(outcome: Outcome) -> str:
    if outcome.exit_code is None:
        return "stopped at the time limit"
    lines = [line.strip() for line in outcome.output.splitlines() if line.strip()]
    return f"exit {outcome.exit_code}: {lines[-1][:160] if lines else 'no output'}"


def machine() -> dict[str, Any]:
    """What the figures depend on."""
    wall, cpu = calibrate()
    versions = {"python": platform.python_version()}
    for package in ("numpy", "scipy", "open3d-cpu", "open3d", "laspy", "lazrs", "dbh-studio"):
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    return {
        "when": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "system": f"{platform.system()} {platform.machine()}",
        "n_cpus": os.cpu_count(),
        "load_at_start": None if load is None else round(load, 2),
        "calibration_s": round(wall, 4),
        "calibration_cpu_s": round(cpu, 4),
        "versions": versions,
    }


def table(rows: Sequence[Row]) -> str:
    """Markdown: one row per program and plot, with ratios to the best finished run of 3DFin on that plot."""
    lines = [
        "| plot | program | s | CPU s | peak MB | stems | with DBH | matched / true | bias cm | RMSE cm | worst cm "
        "| note |",
        "|---|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|---|",
    ]
    for row in rows:
        found = row.score
        cells = [row.plot, f"{row.program} {f'({row.how})' if row.how else ''}".strip(), f"{row.seconds:.1f}"]
        cells.append(f"{row.cpu_seconds:.1f}" if row.cpu_seconds is not None else "?")
        cells.append(f"{row.peak_mb:.0f}" if row.peak_mb is not None else "?")
        if found is None:
            cells += ["–"] * 6
        else:
            cells += [str(found.n_found), str(found.n_dbh)]
            cells.append(f"{found.n_matched} / {found.n_true}" if found.n_true else "no truth")
            cells += [
                "–" if value is None else f"{value:+.2f}" if signed else f"{value:.2f}"
                for value, signed in ((found.bias_cm, True), (found.rmse_cm, False), (found.worst_cm, True))
            ]
        lines.append("| " + " | ".join([*cells, row.note.replace("|", "/")]) + " |")
    ratios = [line for plot in dict.fromkeys(row.plot for row in rows) if (line := _ratio(plot, rows))]
    return "\n".join([*lines, "", *ratios])


def _ratio(plot: str, rows: Sequence[Row]) -> str:
    ours = [row for row in rows if row.plot == plot and row.program == OURS and row.is_finished]
    peers = [row for row in rows if row.plot == plot and row.program == PEER and row.is_finished]
    if not ours or not peers:
        return ""
    peer = max(peers, key=lambda row: (row.score.n_dbh if row.score else 0, -row.seconds))
    text = f"- {plot}: {OURS} takes {ours[0].seconds / peer.seconds:.2f} of the time of {PEER}"
    if ours[0].peak_mb is not None and peer.peak_mb is not None:
        text += f" and {ours[0].peak_mb / peer.peak_mb:.2f} of its memory"
    return f"{text} ({peer.how})."


def gate(rows: Sequence[Row], about: Mapping[str, Any], baseline: Mapping[str, Any], *, tolerance: float) -> list[str]:
    """What is worse than the baseline by more than the tolerance; seconds are divided by the speed of the machine.

    On a busy machine wall time says nothing, so there only processor time counts.
    """
    problems = []
    load, n_cpus = about.get("load_at_start"), about.get("n_cpus") or 1
    is_quiet = load is None or load < 0.5 * n_cpus
    for row in (row for row in rows if row.program == OURS):
        if not row.is_finished:
            problems.append(f"{row.plot}: no result ({row.note})")
            continue
        base = baseline.get("plots", {}).get(row.plot)
        if base is None:
            problems.append(f"{row.plot}: not in the baseline; run with --update-baseline")
            continue
        clocks = [("s of processor time", row.cpu_seconds, base.get("cpu_seconds"), "calibration_cpu_s")]
        if is_quiet or row.cpu_seconds is None:
            clocks.append(("s", row.seconds, base["seconds"], "calibration_s"))
        for unit, taken, before, speed in clocks:
            if taken is None or before is None:
                continue
            expected = before * about[speed] / baseline[speed]
            if taken > expected * (1 + tolerance) + _NOISE_S:
                problems.append(f"{row.plot}: {taken:.2f} {unit} where {expected:.2f} was expected")
        if row.peak_mb and base["peak_mb"] and row.peak_mb > base["peak_mb"] * (1 + tolerance) + _NOISE_MB:
            problems.append(f"{row.plot}: {row.peak_mb:.0f} MB where {base['peak_mb']:.0f} MB was expected")
        if row.score and row.score.n_dbh < base["n_dbh"]:
            problems.append(f"{row.plot}: {row.score.n_dbh} diameters where there were {base['n_dbh']}")
    return problems


def updated_baseline(rows: Sequence[Row], about: Mapping[str, Any], baseline: Mapping[str, Any]) -> dict[str, Any]:
    """The baseline with the figures of this run, kept comparable: old ones are rescaled to this run's speed."""
    kept = {name: dict(figures) for name, figures in baseline.get("plots", {}).items()}
    for figures in kept.values():
        for clock, speed in (("seconds", "calibration_s"), ("cpu_seconds", "calibration_cpu_s")):
            if figures.get(clock) is not None:
                figures[clock] = round(figures[clock] * about[speed] / baseline[speed], 2)
    for row in rows:
        if row.program == OURS and row.is_finished and row.score is not None:
            peak = None if row.peak_mb is None else round(row.peak_mb)
            cpu = None if row.cpu_seconds is None else round(row.cpu_seconds, 2)
            kept[row.plot] = {
                "seconds": round(row.seconds, 2),
                "cpu_seconds": cpu,
                "peak_mb": peak,
                **asdict(row.score),
            }
    return {**about, "plots": kept}


def arguments(given: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="two small plots only")
    parser.add_argument("--no-peers", action="store_true", help="do not run 3DFin")
    parser.add_argument("--install-peers", action="store_true", help="set up 3DFin under bench/peers first")
    parser.add_argument("--only", action="append", metavar="PLOT", help="this plot only; may be given again")
    parser.add_argument("--repeat", type=int, default=1, help="runs of this program per plot; the quickest counts")
    parser.add_argument("--limit", type=float, default=1800, help="seconds after which a run is stopped")
    parser.add_argument("--program", help="command to run in place of dbh-studio")
    parser.add_argument("--gate", action="store_true", help="exit 1 where the baseline is missed")
    parser.add_argument("--tolerance", type=float, default=0.20, help="how much worse passes the gate (0.20)")
    parser.add_argument("--update-baseline", action="store_true", help="write bench/baseline.json")
    return parser.parse_args(given)


def warm_up(command: Sequence[str], *, with_peers: bool, limit_s: float) -> None:
    """Run both programs once without counting it: what they compile of themselves on a first start is kept."""
    small = generated_plot("generated_0.3M")
    with tempfile.TemporaryDirectory(prefix="dbh-bench-") as name:
        print("warming up …", file=sys.stderr)
        run_ours(small, Path(name), command, limit_s=limit_s, repeat=1)
        if with_peers:
            run_peer(small, Path(name) / "3dfin", limit_s=limit_s)


def measure(options: argparse.Namespace) -> list[Row]:
    """Run everything; what is absent is skipped with a word."""
    with_peers = not options.no_peers
    if with_peers and options.install_peers and not bench_peers.is_installed():
        bench_peers.install()
    if with_peers and not bench_peers.is_installed():
        print("3DFin is not set up, so nothing is compared with it; --install-peers does that.", file=sys.stderr)
        with_peers = False
    rows: list[Row] = []
    command = program_command(options.program)
    warm_up(command, with_peers=with_peers, limit_s=options.limit)
    for plot in plots(quick=options.quick):
        if options.only and plot.name not in options.only:
            continue
        if plot.path is None:
            print(f"{plot.name} is skipped: {plot.note}.", file=sys.stderr)
            continue
        with tempfile.TemporaryDirectory(prefix="dbh-bench-") as name:
            folder = Path(name)
            print(f"{plot.name} ({plot.note}) …", file=sys.stderr)
            rows.append(run_ours(plot, folder, command, limit_s=options.limit, repeat=options.repeat))
            if with_peers:
                rows += run_peer(plot, folder / "3dfin", limit_s=options.limit)
    return rows


def main(given: Sequence[str] | None = None) -> int:
    """Measure, report, and compare with the baseline. Returns the exit status."""
    options = arguments(given)
    about = machine()
    rows = measure(options)
    if not options.no_peers and bench_peers.is_installed():
        about["peer"] = f"{PEER} {bench_peers.version()}"
    for name, seconds in zip(("calibration_s", "calibration_cpu_s"), calibrate(), strict=True):
        about[name] = round(min(about[name], seconds), 4)
    text = f"{json.dumps(about)}\n\n{table(rows)}\n"
    print(text)
    RESULTS.mkdir(parents=True, exist_ok=True)
    (RESULTS / "latest.md").write_text(text, encoding="utf-8")
    figures = {**about, "rows": [asdict(row) for row in rows]}
    (RESULTS / "latest.json").write_text(json.dumps(figures, indent=1), encoding="utf-8")
    baseline = json.loads(BASELINE.read_text(encoding="utf-8")) if BASELINE.exists() else {}
    if options.update_baseline:
        BASELINE.write_text(json.dumps(updated_baseline(rows, about, baseline), indent=1) + "\n", encoding="utf-8")
    if options.gate:
        problems = gate(rows, about, baseline, tolerance=options.tolerance)
        problems += [] if rows else ["nothing was measured"]
        print("\n".join(f"GATE: {problem}" for problem in problems) or "GATE: passed")
        return 1 if problems else 0
    return 0 if rows and all(row.is_finished for row in rows if row.program == OURS) else 1


if __name__ == "__main__":
    sys.exit(main())
