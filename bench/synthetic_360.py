"""The rendered 360° plot: the whole program on an unscaled dense cloud of twelve trees, against the truth.

    python bench/synthetic_360.py [--markers] [--data FOLDER] [--program COMMAND] [--args OPTIONS] [--inventory FILE]

Runs `dbh-studio run dense_unscaled.ply --scale S` with the true scale, or with --markers lets the program take the
scale from the markers in the panoramas, and prints a Markdown table of errors per tree, and one of every method on the
same trunks.
The truth is for a tape at 1.30 m above the mean ground around the stem. Trees are matched by place. The program sets
the plot upright in a frame of its own, so its map is first turned and moved (never scaled) onto the true one.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import shlex
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent / "src")]

import numpy as np  # noqa: E402
from bench_match import Table, aligned, pair, read_table, score  # noqa: E402
from bench_process import run  # noqa: E402
from run_bench import inventory_in, program_command  # noqa: E402

DATA = HERE.parents[1] / "shared" / "data" / "synthetic_360"
DEFINITIONS = {"tape": "dbh_tape_cm", "curve": "dbh_smooth_perim_cm", "area": "dbh_area_cm"}


def scale_options(data: Path, scale: float, *, markers: bool) -> list[str]:
    """How the program is told the scale: as a number, or where to find markers of known side."""
    if not markers:
        return ["--scale", f"{scale:.6g}"]
    boards = json.loads((data / "poses_gt.json").read_text(encoding="utf-8"))["markers"]
    given = ["--cameras", str(data / "colmap_equirectangular"), "--images", str(data / "images")]
    for board in boards:
        given += ["--marker", f"{board['dictionary']}:{board['id']}={board['side_m']}"]
    for name in sorted({board["dictionary"] for board in boards}):
        given += ["--dictionary", name]
    return given


METHODS = ("shrinkage", "circle", "fourier", "ellipse", "bspline")


def every_method(folder: Path, options: argparse.Namespace) -> dict[str, dict[str, float]]:
    """Diameters in cm by method and stem number, of the plot that a run left in a folder; NaN where it gives none."""
    (plot,) = folder.glob("*.dbh")
    table = folder / "methods.csv"
    command = [*program_command(options.program), "measure", str(plot), "--csv", str(table), "--quiet"]
    environment = {"PYTHONPATH": os.pathsep.join([str(HERE.parent / "src"), os.environ.get("PYTHONPATH", "")])}
    outcome = run(command, limit_s=options.limit, log=folder / "measure.txt", environment=environment)
    if outcome.exit_code != 0:
        sys.exit(f"Measuring by every method ended with {outcome.exit_code}:\n{outcome.output[-2000:]}")
    with table.open(encoding="utf-8-sig", newline="") as file:
        rows = list(csv.DictReader(file))
    return {method: {row["stem_id"]: float(row[f"{method}_cm"] or "nan") for row in rows} for method in METHODS}


def method_table(found: Table, by_method: dict[str, dict[str, float]], data: Path) -> str:
    """Markdown: the error of every method per true tree, each as it reads a tape, and what they come to."""
    truth = read_table(data / "gt_dbh.csv", x="x", y="y", dbh="dbh_tape_cm")
    pairs = pair(aligned(found, truth).xy_m, truth.xy_m)
    lines = ["| tree | tape cm | " + " | ".join(METHODS) + " |", "|--:" * (2 + len(METHODS)) + "|"]
    errors: dict[str, list[float]] = {method: [] for method in METHODS}
    for mine, index in sorted(pairs.tolist(), key=lambda both: both[1]):
        cells = []
        for method in METHODS:
            error = by_method[method].get(found.names[mine], float("nan")) - truth.dbh_cm[index]
            errors[method].append(error)
            cells.append("–" if np.isnan(error) else f"{error:+.2f}")
        lines.append(f"| {truth.names[index]} | {truth.dbh_cm[index]:.1f} | " + " | ".join(cells) + " |")
    for title, of in (
        ("bias cm", np.nanmean),
        ("median |error| cm", lambda e: np.nanmedian(np.abs(e))),
        ("RMSE cm", lambda e: np.sqrt(np.nanmean(np.square(e)))),
        ("measured", lambda e: np.isfinite(e).sum()),
    ):
        lines.append(f"| {title} | | " + " | ".join(f"{of(np.array(errors[m])):.4g}" for m in METHODS) + " |")
    return "\n".join(lines)


def measured(data: Path, scale: float, options: argparse.Namespace) -> tuple[Table, str, str]:
    """The program's inventory of the cloud, what the run took, and the table of every method."""
    with tempfile.TemporaryDirectory(prefix="dbh-360-") as name:
        folder = Path(name)
        command = [*program_command(options.program), "run", str(data / "dense_unscaled.ply")]
        command += ["--out", str(folder), *scale_options(data, scale, markers=options.markers), "--json"]
        command += shlex.split(options.args)
        environment = {"PYTHONPATH": os.pathsep.join([str(HERE.parent / "src"), os.environ.get("PYTHONPATH", "")])}
        outcome = run(command, limit_s=options.limit, log=folder / "log.txt", environment=environment)
        table = inventory_in(folder)
        if outcome.exit_code != 0 or table is None:
            sys.exit(f"The program ended with {outcome.exit_code}:\n{outcome.output[-2000:]}")
        memory = "?" if outcome.peak_mb is None else f"{outcome.peak_mb:.0f}"
        found = read_table(table)
        methods = method_table(found, every_method(folder, options), data)
        return found, f"{outcome.seconds:.1f} s, {memory} MB", methods


def error_table(found: Table, data: Path) -> str:
    """Markdown: one row per true tree, then found trees that are none."""
    truth = read_table(data / "gt_dbh.csv", x="x", y="y", dbh="dbh_tape_cm")
    others = {name: read_table(data / "gt_dbh.csv", x="x", y="y", dbh=column) for name, column in DEFINITIONS.items()}
    placed = aligned(found, truth)
    pairs = dict(np.fliplr(pair(placed.xy_m, truth.xy_m)).tolist())
    lines = ["| tree | found as | DBH cm | tape cm | error cm | error % | to curve cm | to area cm | off by m |"]
    lines.append("|--:|--:|--:|--:|--:|--:|--:|--:|--:|")
    for index, name in enumerate(truth.names):
        tape = truth.dbh_cm[index]
        if index not in pairs:
            lines.append(f"| {name} | not found | – | {tape:.1f} | – | – | – | – | – |")
            continue
        mine = pairs[index]
        dbh, away = found.dbh_cm[mine], np.linalg.norm(placed.xy_m[mine] - truth.xy_m[index])
        if np.isnan(dbh):
            lines.append(f"| {name} | {found.names[mine]} | refused | {tape:.1f} | – | – | – | – | {away:.2f} |")
            continue
        error = dbh - tape
        rest = " | ".join(f"{dbh - others[definition].dbh_cm[index]:+.2f}" for definition in ("curve", "area"))
        lines.append(
            f"| {name} | {found.names[mine]} | {dbh:.1f} | {tape:.1f} | {error:+.2f} | {100 * error / tape:+.1f} "
            f"| {rest} | {away:.2f} |"
        )
    extra = [name for index, name in enumerate(found.names) if index not in pairs.values()]
    lines += ["", f"Found besides: {', '.join(extra) or 'nothing'}."]
    for definition, table in others.items():
        result = score(placed, table)
        if result.n_compared:
            lines.append(
                f"Against the {definition}: {result.n_compared} of {result.n_true} trees, "
                f"bias {result.bias_cm:+.2f} cm, RMSE {result.rmse_cm:.2f} cm, worst {result.worst_cm:+.2f} cm."
            )
    return "\n".join(lines)


def main(given: Sequence[str] | None = None) -> int:
    """Run, print, and keep the figures in bench/results. Returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=DATA, help="the folder with the rendered plot")
    parser.add_argument("--markers", action="store_true", help="scale from the markers, not from the number")
    parser.add_argument("--program", help="command to run in place of dbh-studio")
    parser.add_argument("--args", default="", help="more options for `dbh-studio run`, in one string")
    parser.add_argument("--inventory", type=Path, help="compare this inventory instead of running the program")
    parser.add_argument("--scale", type=float, help="metres per unit; the true scale if not given")
    parser.add_argument("--limit", type=float, default=1800, help="seconds after which the run is stopped")
    options = parser.parse_args(given)
    if not (options.data / "dense_unscaled.ply").is_file():
        print("The rendered plot is not there, so nothing was measured; --data names its folder.", file=sys.stderr)
        return 2
    known = json.loads((options.data / "world_from_model.json").read_text(encoding="utf-8"))
    scale = options.scale or float(known["metres_per_unit"])
    if options.inventory:
        found, took, methods = read_table(options.inventory), "not run", ""
    else:
        found, took, methods = measured(options.data, scale, options)
    how = "with markers" if options.markers else f"--scale {scale:.5f}"
    text = f"`dbh-studio run dense_unscaled.ply` {how}: {took}\n\n{error_table(found, options.data)}\n"
    if methods:
        text += f"\nEvery method on the same trunks: error against the tape, cm\n\n{methods}\n"
    print(text)
    results = HERE / "results"
    results.mkdir(exist_ok=True)
    (results / "synthetic_360.md").write_text(text, encoding="utf-8")
    truth = read_table(options.data / "gt_dbh.csv", x="x", y="y", dbh="dbh_tape_cm")
    figures = {"scale": scale, "took": took, **asdict(score(found, truth))}
    (results / "synthetic_360.json").write_text(json.dumps(figures, indent=1), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
