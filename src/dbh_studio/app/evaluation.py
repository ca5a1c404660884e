"""Evaluating inventories against a reference: from files or the open plot to a folder with table, pairs and figures."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from dbh_studio import __version__
from dbh_studio.core.arrays import Float64, readonly
from dbh_studio.core.comparison import Comparison, Grouping, compare
from dbh_studio.core.evaluation import ALL, Sample
from dbh_studio.core.evaluation_figures import SectionPicture, boxes_svg, scatter_svg, sections_svg
from dbh_studio.core.stem_layout import PairingRule
from dbh_studio.core.stem_table import StemTable, combined
from dbh_studio.errors import FileError, MalformedFileError
from dbh_studio.io.atomic import atomic_file
from dbh_studio.io.evaluation_report import (
    REMARKS,
    line_values,
    markdown_text,
    pairs_csv,
    table_csv,
    table_latex,
    table_markdown,
)
from dbh_studio.io.inventory_csv import check_not_source, inventory_csv
from dbh_studio.io.table_columns import Reading, numbered_as_files, read_stem_table, stem_table_of
from dbh_studio.settings import CurveName

if TYPE_CHECKING:
    from dbh_studio.app.document import Document
    from dbh_studio.app.session import Session
    from dbh_studio.stages.measure import StemMeasurement

_KIND = "dbh-studio evaluation"
_RECORD = "evaluation.json"
AS_MEASURED = "as measured"
"""The plot's diameters where some of its trees have a method of their own."""
_SECTIONS_SHOWN = 12
_PAPERS_CURVES = ("fourier", "ellipse", "bspline")
_MOST_PANELS = 24


@dataclass(frozen=True)
class EvaluationRequest:
    """What to compare, and how.

    Attributes:
        reference: The file with the diameters believed.
        inventories: The files compared with it; none where the open plot is.
        by: What to tell stems apart by.
        rule: How stems are paired.
        inventory_reading: How the inventories are read.
        reference_reading: How the reference is read.
        combine_stems: Join stems with one number into trees of √Σd², in all tables.
        pool: Take the inventories for samples of one thing rather than for rival methods.
        every_method: Of the open plot: measure its stems by the other methods, too, and compare them all.
    """

    reference: Path
    inventories: tuple[Path, ...] = ()
    by: tuple[Grouping, ...] = ()
    rule: PairingRule = field(default_factory=PairingRule)
    inventory_reading: Reading = field(default_factory=lambda: Reading(find_methods=True))
    reference_reading: Reading = field(default_factory=Reading)
    combine_stems: bool = False
    pool: bool = False
    every_method: bool = False


def evaluate_files(request: EvaluationRequest) -> Comparison:
    """Evaluate inventories that lie in files.

    Raises:
        FileError: A table cannot be read or understood; says what to do.
        StudioError: The tables cannot be paired.
    """
    names = _told_apart(request.inventories)
    tables = [
        replace(read_stem_table(path, request.inventory_reading), name=name)
        for path, name in zip(request.inventories, names, strict=True)
    ]
    return _compared(tables, request)


def _told_apart(paths: Sequence[Path]) -> list[str]:
    """What the tables are called: by their files, with as many folders as it takes to tell the files apart."""
    absolute = [path.absolute() for path in paths]

    def name(path: Path, n_folders: int) -> str:
        return "/".join((*path.parts[-1 - n_folders : -1], path.stem))

    names = []
    for path in absolute:
        others = [other for other in absolute if other != path]
        depths = range(len(path.parts))
        apart = (n for n in depths if all(name(other, n) != name(path, n) for other in others))
        depth = next(apart, None)
        # Else they differ by their endings alone.
        names.append(path.name if depth is None else name(path, depth))
    return names


def evaluate_plot(
    session: Session,
    request: EvaluationRequest,
    *,
    document: Document | None = None,
    compared: Iterable[StemMeasurement] | None = None,
) -> Comparison:
    """Evaluate the open plot as it is measured now, or was.

    Args:
        session: The plot.
        request: What to compare it with.
        document: Another state of it than that of now.
        compared: For `EvaluationRequest.every_method`: the stems of that state with every method's curve, as a job
            measured them (`pipeline.comparison_call`). None to measure them here, which takes long.

    Raises:
        FileError: The reference cannot be read or understood.
        StudioError: They cannot be paired.
    """
    document = document or session.document
    # Without fields of one's own: they may be called as anything that is looked for in a table.
    content = inventory_csv(replace(session.inventory(document=document), own=()))
    table = stem_table_of(content, request.inventory_reading, name=document.plot_id or "this plot")
    if request.every_method:
        if compared is None:
            compared = (session.compared(i, document=document) for i in document.trunks.ids)
        table = _with_methods(table, document.settings.measure.curve, compared)
    return _compared([table], request)


def _with_methods(table: StemTable, curve: CurveName, compared: Iterable[StemMeasurement]) -> StemTable:
    """The table with the diameters by every other method; a stem that is refused has none by any."""
    from dbh_studio.core.measured import CurveFit, DbhEstimate

    n, row_of = len(table), {int(number): row for row, number in enumerate(table.cells["stem_id"])}
    # Value and ends of the interval.
    given: dict[str, Float64] = {name: np.full((n, 3), np.nan) for name in get_args(CurveName)}
    for stem in compared:
        result, row = stem.result, row_of.get(stem.trunk_id)
        if row is None or not isinstance(result, DbhEstimate):
            continue
        for name, fit in result.fits.items():
            if isinstance(fit, CurveFit) and name in given:
                diameter = fit.diameter(result.definition)
                given[name][row] = [
                    np.nan if v is None else v for v in (diameter.value_cm, diameter.low_cm, diameter.high_cm)
                ]
    main = table.methods[0]
    # What was chosen of single trees, or drawn by hand, is no other method's.
    is_plain = set(table.cells["dbh_method"]) <= {"", curve}
    first = curve if is_plain else AS_MEASURED
    known = {name: v for name, v in given.items() if name != first and np.isfinite(v).any()}
    diameters = {first: table.diameters_cm[main]} | {name: readonly(v[:, 0].copy()) for name, v in known.items()}
    intervals = {first: table.intervals_cm[main]} if main in table.intervals_cm else {}
    intervals |= {name: readonly(v[:, 1:].copy()) for name, v in known.items() if np.isfinite(v).all(axis=1).any()}
    whys = table.problems.get(main, ("",) * n)
    problems = {
        name: tuple(
            "" if np.isfinite(value) else why or f"{name} finds no hold on it"
            for value, why in zip(values.tolist(), whys, strict=True)
        )
        for name, values in diameters.items()
    }
    return replace(table, diameters_cm=diameters, intervals_cm=intervals, problems=problems)


def _compared(tables: Sequence[StemTable], request: EvaluationRequest) -> Comparison:
    reference = read_stem_table(request.reference, request.reference_reading)
    if "id" not in request.reference_reading.columns:
        reference = numbered_as_files(reference, tables)
    if request.combine_stems:
        tables, reference = [combined(table) for table in tables], combined(reference)
    main = reference.methods[0]
    if not any(math.isfinite(value) for value in reference.diameters_cm[main].tolist()):
        raise MalformedFileError(
            request.reference,
            "it has no usable diameter.",
            "Name the column that holds them: --reference-column dbh=COLUMN.",
        )
    return compare(tables, reference, by=request.by, rule=request.rule, pool=request.pool)


# ---- the folder


def report_files(comparison: Comparison, pictures: Sequence[SectionPicture] = ()) -> dict[str, bytes]:
    """The content of a report folder by file name."""
    columns = tuple(comparison.categories)
    files = {
        "table.csv": table_csv(comparison.lines),
        "table.md": table_markdown(comparison.lines).encode(),
        "table.tex": table_latex(comparison.lines).encode(),
        "pairs.csv": pairs_csv(comparison.samples, columns),
    }
    methods = comparison.methods
    for column in ("", *columns):
        panels = _panels(comparison, column)
        suffix = f"_by_{_file_word(column, columns)}" if column else ""
        files[f"scatter{suffix}.svg"] = scatter_svg(panels, methods).encode()
        files[f"relative_error{suffix}.svg"] = boxes_svg(panels, methods).encode()
    if pictures:
        files["sections.svg"] = sections_svg(pictures).encode()
    files["report.md"] = _report(comparison, [name for name in files if name.endswith(".svg")]).encode()
    files[_RECORD] = json.dumps(
        record(comparison) | {"files": sorted(files)}, indent=1, ensure_ascii=False, allow_nan=False
    ).encode()
    return files


def write_report(
    comparison: Comparison,
    folder: Path,
    *,
    pictures: Sequence[SectionPicture] = (),
    sources: Sequence[Path] = (),
    overwrite: bool = False,
) -> tuple[Path, ...]:
    """Write the report; an earlier one in the same folder is replaced.

    Args:
        comparison: What was found.
        folder: Made where it is not there.
        pictures: Cross-sections to show.
        sources: Files that must not be written over.
        overwrite: Replace files of the same names that no evaluation wrote.

    Raises:
        FileError: The folder cannot be written, or holds files of these names that no evaluation wrote.
    """
    files = report_files(comparison, pictures)
    earlier = _files_of_report(folder)
    in_the_way = [name for name in files if (folder / name).exists()]
    if in_the_way and not overwrite and earlier is None:
        raise FileError(
            folder / in_the_way[0],
            "there is such a file already, and no evaluation wrote it.",
            "Choose another folder, or say that it may be overwritten.",
        )
    for name in files:
        check_not_source(folder / name, [path for path in sources if path.is_file()])
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # The record last: a folder that was begun by somebody else is not taken for ours.
        for name, content in files.items():
            with atomic_file(folder / name) as file:
                file.write(content)
        # Figures of the earlier report that this one has not would be taken for its own.
        for name in set(earlier or ()) - set(files):
            (folder / name).unlink(missing_ok=True)
    except OSError as error:
        raise FileError(
            folder,
            f"The report could not be written ({error.strerror or error}).",
            "Make room on the disk, or choose another folder.",
        ) from error
    return tuple(folder / name for name in files)


def record(comparison: Comparison) -> dict[str, Any]:
    """The table and how it came about, for programs."""
    frames = [
        {
            "inventory": table.name,
            "plot": frame.plot,
            "is_moved": frame.is_moved,
            "turn_deg": frame.turn_deg,
            "moved_m": frame.moved_m,
            "pairs": frame.n_pairs,
            "rms_m": frame.rms_m if math.isfinite(frame.rms_m) else None,
            "reason": frame.reason,
        }
        for table, pairing in zip(comparison.inventories, comparison.pairings, strict=True)
        for frame in pairing.frames
    ]
    return {
        "kind": _KIND,
        "schema_version": 1,
        "version": __version__,
        "reference": comparison.reference.name,
        "inventories": [table.name for table in comparison.inventories],
        "paired_by": [pairing.by for pairing in comparison.pairings],
        "frames": frames,
        "notes": list(comparison.notes),
        "lines": [line_values(line) for line in comparison.lines],
    }


def _files_of_report(folder: Path) -> tuple[str, ...] | None:
    """The files of the report in a folder, as far as it says; None where there is no report."""
    try:
        content = json.loads((folder / _RECORD).read_bytes())
    except (OSError, ValueError, RecursionError):
        return None
    if not isinstance(content, dict) or content.get("kind") != _KIND:
        return None
    names = content.get("files", [])
    # A record somebody has changed must not have other files removed.
    is_plain = isinstance(names, list) and all(isinstance(n, str) and Path(n).name == n for n in names)
    return tuple(n for n in names if n.endswith(".svg")) if is_plain else ()


def _file_word(column: str, columns: Sequence[str]) -> str:
    """A column's name as part of a file name; its number behind it where two would be the same."""
    words = ["".join(c if c.isascii() and c.isalnum() else "_" for c in name)[:60] for name in columns]
    k = list(columns).index(column)
    word = words[k] or "column"
    return word if [w.casefold() for w in words].count(words[k].casefold()) == 1 else f"{word}_{k + 1}"


def _panels(comparison: Comparison, column: str) -> Mapping[str, list[Sample]]:
    if not column:
        return {ALL: list(comparison.samples)}
    names = comparison.categories[column][:_MOST_PANELS]
    return {f"{column}: {name}": [s for s in comparison.samples if s.groups.get(column) == name] for name in names}


def _report(comparison: Comparison, figures: Sequence[str]) -> str:
    names = ", ".join(table.name for table in comparison.inventories)
    parts = [
        f"# {markdown_text(names)} against {markdown_text(comparison.reference.name)}",
        table_markdown(comparison.lines),
        REMARKS,
        "## How it was read and paired",
        "\n".join(f"- {markdown_text(note)}" for note in comparison.notes),
        "Every stem is in [pairs.csv](pairs.csv), with the reason where it does not count.",
        "## Figures",
        "\n".join(f"![{name.removesuffix('.svg')}]({name})" for name in figures),
    ]
    return "\n\n".join(parts) + "\n"


# ---- cross-sections


def section_pictures(session: Session, comparison: Comparison) -> tuple[SectionPicture, ...]:
    """Cross-sections of a plot's stems with the chosen curve and the paper's three: the best, middling and worst pairs.

    Args:
        session: The plot the first inventory was measured in.
        comparison: Its evaluation.
    """
    from dbh_studio.app.derived import stem_setup_of
    from dbh_studio.core.measured import CurveFit, DbhEstimate
    from dbh_studio.stages.measure import measure_trunk

    document = session.document
    trunk_ids = stem_numbers(comparison)
    method = comparison.methods[0]
    known = [s for s in comparison.samples if s.method == method and s.error_pct is not None and s.stem in trunk_ids]
    known = [s for s in known if trunk_ids[s.stem] in document.trunks]
    pictures = []
    for word, sample in _spread(sorted(known, key=lambda s: abs(s.error_pct or 0.0))):
        setup = stem_setup_of(document, trunk_ids[sample.stem])
        result = measure_trunk(
            setup.measured(session.points_world(document)[document.trunks[trunk_ids[sample.stem]].points]),
            trunk_id=trunk_ids[sample.stem],
            ground=session.ground(document=document),
            settings=setup.settings,
            curves=_PAPERS_CURVES,
            **setup.placed,
        ).result
        if not isinstance(result, DbhEstimate) or sample.reference_cm is None:
            continue
        fits = {name: fit for name, fit in result.fits.items() if isinstance(fit, CurveFit)}
        chosen = fits.get(result.curve)
        if chosen is None:
            continue
        outlines = {name: fit.outline_uv_m for name, fit in sorted(fits.items(), key=lambda f: f[0] != result.curve)}
        title = f"{word}tree {sample.tree or sample.stem} ({round(sample.error_pct or 0.0, 1) + 0.0:+.1f} %)"
        pictures.append(SectionPicture(title, result.section.uv_m, chosen.inliers, outlines, sample.reference_cm))
    return tuple(pictures)


def stem_numbers(comparison: Comparison) -> dict[str, int]:
    """The studio's number of each stem of the first inventory, by the number it has in the evaluation."""
    table = comparison.inventories[0]
    own = table.cells.get("stem_id", table.ids)
    return {name: int(text) for name, text in zip(table.ids, own, strict=True) if text.isdecimal()}


def _spread(ordered: Sequence[Sample]) -> list[tuple[str, Sample]]:
    """A third each of the best, the middling and the worst; all where there are few."""
    third = _SECTIONS_SHOWN // 3
    if len(ordered) <= _SECTIONS_SHOWN:
        return [("", sample) for sample in ordered]
    middle = (len(ordered) - third) // 2
    parts = (
        ("good: ", ordered[:third]),
        ("middling: ", ordered[middle : middle + third]),
        ("worst: ", ordered[-third:]),
    )
    return [(word, sample) for word, part in parts for sample in part]
